//! What a tensor is: axes, channels and lane type.

use super::axis::{Axes, Axis};
use super::error::Misfit;
use crate::scalar::DType;
use std::fmt;

/// Channels of a tensor: a short vector or a small matrix, the same for every element of its axes.
#[derive(Clone, Copy, PartialEq, Eq, Hash, Debug)]
pub enum Channels {
    Vector(usize),
    /// Rows, columns; stored row by row.
    Matrix(usize, usize),
}

impl Channels {
    pub fn count(self) -> usize {
        match self {
            Channels::Vector(n) => n,
            Channels::Matrix(r, c) => r * c,
        }
    }
}
impl From<usize> for Channels {
    fn from(n: usize) -> Channels {
        Channels::Vector(n)
    }
}
impl From<(usize, usize)> for Channels {
    fn from((r, c): (usize, usize)) -> Channels {
        Channels::Matrix(r, c)
    }
}
impl fmt::Display for Channels {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Channels::Vector(n) => write!(f, "{n}"),
            Channels::Matrix(r, c) => write!(f, "({r}, {c})"),
        }
    }
}

/// Axes, channels and lane type of a tensor, printed as `[frame=5, pixel=4096] x 3`.
#[derive(Clone, PartialEq, Eq, Hash)]
pub struct Shape {
    pub axes: Axes,
    pub channels: Channels,
    pub dtype: DType,
}

impl Shape {
    pub fn new(axes: &[&Axis], channels: impl Into<Channels>) -> Shape {
        Shape { axes: Axes::new(axes.iter().map(|a| (*a).clone())), channels: channels.into(), dtype: DType::F32 }
    }
    pub fn of(axes: Axes, channels: impl Into<Channels>, dtype: DType) -> Shape {
        Shape { axes, channels: channels.into(), dtype }
    }
    pub fn with_dtype(mut self, dtype: DType) -> Shape {
        self.dtype = dtype;
        self
    }
    pub fn with_channels(mut self, channels: impl Into<Channels>) -> Shape {
        self.channels = channels.into();
        self
    }
    pub fn with_axes(mut self, axes: Axes) -> Shape {
        self.axes = axes;
        self
    }
    /// Refuses shapes without lanes, and those whose lanes cannot be counted.
    pub(super) fn check(&self) -> Result<(), Misfit> {
        let (rows, columns) = match self.channels {
            Channels::Vector(n) => (n, 1),
            Channels::Matrix(r, c) => (r, c),
        };
        let mut sizes = self.axes.iter().map(Axis::size).chain([rows, columns]);
        // A lane has four bytes.
        match sizes.try_fold(4usize, |n, size| n.checked_mul(size)) {
            Some(0) => Err(Misfit::new(format!("{self} is empty"), "axes and channels start at 1")),
            Some(bytes) if bytes <= isize::MAX as usize => Ok(()),
            _ => Err(Misfit::new(format!("{self} is larger than any memory"), "use smaller axes")),
        }
    }
    /// Number of 32-bit lanes: elements times channels.
    pub fn lanes(&self) -> usize {
        self.axes.elements() * self.channels.count()
    }
}

impl fmt::Display for Shape {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{} x {}", self.axes, self.channels)?;
        if self.dtype == DType::U32 { f.write_str(" u32") } else { Ok(()) }
    }
}
impl fmt::Debug for Shape {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}
