//! Channels picked from operands: concatenation, slices, any rearrangement.

use super::{Form, Op, Sample, SampleInput, expect_dtype};
use crate::graph::{Axis, Channels, Misfit, Shape, Tensor, function};
use crate::reference::Array;
use std::sync::Arc;

/// Output channel `c` is channel `pick[c].1` of operand `pick[c].0`.
#[derive(Clone, Debug)]
pub struct Pick {
    pub pick: Arc<[(u32, u32)]>,
    pub channels: Channels,
    pub name: &'static str,
}

/// The runs of a pick: neighbouring channels of one operand.
pub fn runs(pick: &[(u32, u32)]) -> impl Iterator<Item = &[(u32, u32)]> {
    pick.chunk_by(|a, b| (a.0, a.1 + 1) == *b)
}

impl Op for Pick {
    fn name(&self) -> &'static str {
        self.name
    }
    fn shape(&self, inputs: &[Shape]) -> Result<Shape, Misfit> {
        let mut axes = inputs[0].axes.clone();
        for (i, s) in inputs.iter().enumerate() {
            axes = axes.union(&s.axes);
            expect_dtype(s, inputs[0].dtype, i)?;
        }
        for (operand, channel) in self.pick.iter() {
            let has = inputs[*operand as usize].channels;
            if *channel as usize >= has.count() {
                return Err(Misfit::new(
                    format!("channel {channel} of a tensor with {has} channels"),
                    format!("channels 0 to {} exist", has.count() - 1),
                ));
            }
        }
        if self.pick.is_empty() {
            return Err(Misfit::new("no channels left", "take at least one channel"));
        }
        if self.pick.len() != self.channels.count() {
            return Err(Misfit::new(
                format!("{} channels arranged as {}", self.pick.len(), self.channels),
                "pick as many channels as the result has",
            ));
        }
        Ok(Shape::of(axes, self.channels, inputs[0].dtype))
    }
    fn form(&self) -> Form {
        Form::Pick(self.pick.clone())
    }
    fn eval(&self, inputs: &[&Array], out: &Shape) -> Array {
        Array::from_fn(out, |e, c| {
            let (operand, channel) = self.pick[c];
            let a = inputs[operand as usize];
            a.at(a.element_of(out, e), channel as usize)
        })
    }
    fn vjp(&self, inputs: &[Tensor], _: &Tensor, g: &Tensor) -> Vec<Option<Tensor>> {
        let adjoint = |operand: usize| {
            let mut groups = vec![vec![]; inputs[operand].width()];
            for (c, (from, channel)) in self.pick.iter().enumerate() {
                if *from as usize == operand {
                    groups[*channel as usize].push(c as u32);
                }
            }
            let used = groups.iter().any(|g| !g.is_empty());
            used.then(|| g.channel_groups(groups).reshape(inputs[operand].channels()))
        };
        (0..inputs.len()).map(adjoint).collect()
    }
    fn key(&self) -> String {
        let bytes: Vec<u8> = self.pick.iter().flat_map(|p| [p.0.to_le_bytes(), p.1.to_le_bytes()]).flatten().collect();
        format!("pick {} {:?}", blake3::hash(&bytes), self.channels)
    }
}

/// Puts the channels of several tensors side by side; axes are joined by name.
#[track_caller]
pub fn concat<'a>(parts: impl IntoIterator<Item = &'a Tensor>) -> Tensor {
    let parts: Vec<&Tensor> = parts.into_iter().collect();
    let pick: Arc<[(u32, u32)]> =
        parts.iter().enumerate().flat_map(|(i, t)| (0..t.width() as u32).map(move |c| (i as u32, c))).collect();
    if parts.is_empty() {
        return Tensor::misfit("concat", &[], "nothing to concatenate", "give at least one tensor");
    }
    let channels = Channels::Vector(pick.len());
    Tensor::record(Pick { pick, channels, name: "concat" }, &parts)
}

impl Tensor {
    /// Channel `c` alone.
    #[track_caller]
    pub fn ch(&self, c: usize) -> Tensor {
        let _called = function("ch");
        self.pick(&[c])
    }
    /// Channels `range`, for example `t.slice(0..3)`.
    #[track_caller]
    pub fn slice(&self, range: std::ops::Range<usize>) -> Tensor {
        let _called = function("slice");
        self.pick(&range.collect::<Vec<_>>())
    }
    /// Any channels in any order, repeated or not.
    #[track_caller]
    pub fn pick(&self, channels: &[usize]) -> Tensor {
        self.pick_as(channels, channels.len())
    }
    /// Like [`Tensor::pick`], with the result arranged as `shape`.
    #[track_caller]
    pub fn pick_as(&self, channels: &[usize], shape: impl Into<Channels>) -> Tensor {
        let pick = channels.iter().map(|c| (0, u32::try_from(*c).unwrap_or(u32::MAX))).collect();
        Tensor::record(Pick { pick, channels: shape.into(), name: "pick" }, &[self])
    }
    /// The transposed small matrix.
    #[track_caller]
    pub fn transpose(&self) -> Tensor {
        let Channels::Matrix(r, c) = self.channels() else {
            return Tensor::misfit("transpose", &[self], format!("{} is not a matrix", self.shape()), "reshape it first");
        };
        let order: Vec<usize> = (0..r * c).map(|i| i % r * c + i / r).collect();
        self.pick_as(&order, (c, r))
    }
}

pub fn samples() -> Vec<Sample> {
    let (row, column) = (Axis::new("row", 3), Axis::new("column", 4));
    vec![
        Sample::new(
            "concat",
            vec![
                SampleInput::new(Shape::new(&[&row, &column], 2), -1.0, 1.0),
                SampleInput::new(Shape::new(&[&row], 3), -1.0, 1.0),
            ],
            |x| concat([&x[0], &x[1]]),
        ),
        Sample::new("pick", vec![SampleInput::new(Shape::new(&[&row], 4), -1.0, 1.0)], |x| x[0].pick(&[3, 0, 0, 2])),
        Sample::new("transpose", vec![SampleInput::new(Shape::new(&[&row], (2, 3)), -1.0, 1.0)], |x| x[0].transpose()),
    ]
}
