//! Dense f64 (or u32) values of a tensor.

use crate::graph::Shape;
use crate::scalar::DType;

/// One lane of a reference value.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Lane {
    F(f64),
    U(u32),
}

impl Lane {
    /// The float in this lane.
    ///
    /// # Panics
    /// If it holds an integer: shape rules make that impossible for an op that declares its operand types.
    pub fn f(self) -> f64 {
        match self {
            Lane::F(x) => x,
            Lane::U(u) => unreachable!("lane holds the integer {u}, not a float"),
        }
    }
    /// The integer in this lane; panics like [`Lane::f`].
    pub fn u(self) -> u32 {
        match self {
            Lane::U(x) => x,
            Lane::F(f) => unreachable!("lane holds the float {f}, not an integer"),
        }
    }
}

#[derive(Clone, Debug, PartialEq)]
pub enum Data {
    F(Vec<f64>),
    U(Vec<u32>),
}

/// A tensor's values: elements in the order of the axes (last one fastest), each with its channels side by side.
#[derive(Clone, Debug, PartialEq)]
pub struct Array {
    pub shape: Shape,
    pub data: Data,
}

impl Array {
    pub fn floats(shape: &Shape, data: Vec<f64>) -> Array {
        assert_eq!(shape.lanes(), data.len(), "{shape} needs {} values", shape.lanes());
        Array { shape: shape.clone().with_dtype(DType::F32), data: Data::F(data) }
    }
    pub fn integers(shape: &Shape, data: Vec<u32>) -> Array {
        assert_eq!(shape.lanes(), data.len(), "{shape} needs {} values", shape.lanes());
        Array { shape: shape.clone().with_dtype(DType::U32), data: Data::U(data) }
    }
    pub fn zeros(shape: &Shape) -> Array {
        match shape.dtype {
            DType::F32 => Array::floats(shape, vec![0.0; shape.lanes()]),
            DType::U32 => Array::integers(shape, vec![0; shape.lanes()]),
        }
    }
    /// Fills `shape` by calling `f(element, channel)`.
    pub fn from_fn(shape: &Shape, mut f: impl FnMut(usize, usize) -> Lane) -> Array {
        let (elements, channels) = (shape.axes.elements(), shape.channels.count());
        let lanes = (0..elements * channels).map(|i| f(i / channels, i % channels));
        match shape.dtype {
            DType::F32 => Array::floats(shape, lanes.map(Lane::f).collect()),
            DType::U32 => Array::integers(shape, lanes.map(Lane::u).collect()),
        }
    }
    pub fn f(&self) -> &[f64] {
        match &self.data {
            Data::F(v) => v,
            Data::U(_) => unreachable!("{} holds integers", self.shape),
        }
    }
    pub fn f_mut(&mut self) -> &mut [f64] {
        match &mut self.data {
            Data::F(v) => v,
            Data::U(_) => unreachable!("{} holds integers", self.shape),
        }
    }
    pub fn u(&self) -> &[u32] {
        match &self.data {
            Data::U(v) => v,
            Data::F(_) => unreachable!("{} holds floats", self.shape),
        }
    }
    pub fn at(&self, element: usize, channel: usize) -> Lane {
        let i = element * self.shape.channels.count() + channel;
        match &self.data {
            Data::F(v) => Lane::F(v[i]),
            Data::U(v) => Lane::U(v[i]),
        }
    }
    /// This array's element that an element of `domain` sees: broadcasting by name. Axes that the domain lacks count as 0.
    pub fn element_of(&self, domain: &Shape, element: usize) -> usize {
        if self.shape.axes == domain.axes {
            return element;
        }
        // Both sets of axes are sorted: one walk from the innermost outwards.
        let mut own = self.shape.axes.iter().rev().peekable();
        let (mut at, mut stride, mut rest) = (0, 1, element);
        for axis in domain.axes.iter().rev() {
            let position = rest % axis.size();
            rest /= axis.size();
            while let Some(further) = own.next_if(|a| *a > axis) {
                stride *= further.size();
            }
            if own.next_if_eq(&axis).is_some() {
                at += position * stride;
                stride *= axis.size();
            }
        }
        at
    }
    /// The lane that (element, channel) of `domain` sees; a single channel is broadcast.
    pub fn lane(&self, domain: &Shape, element: usize, channel: usize) -> Lane {
        let channel = if self.shape.channels.count() == 1 { 0 } else { channel };
        self.at(self.element_of(domain, element), channel)
    }
}
