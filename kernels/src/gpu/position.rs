//! Where an invocation is in the domain, and which of its rows are neighbours in a buffer.

use super::builder::Value;
use super::memory::Emit;
use raygrad_compiler::graph::{Axes, Axis};

/// Where an invocation is in the domain: numbers of elements of disjoint sets of axes, and single coordinates that
/// override them.
#[derive(Clone, Debug, Default)]
pub(super) struct Position {
    numbers: Vec<(Axes, Value)>,
    fixed: Vec<(Axis, Value)>,
}

impl Position {
    /// Element `number` of `axes`.
    pub fn new(axes: &Axes, number: Value) -> Position {
        Position { numbers: vec![(axes.clone(), number)], fixed: vec![] }
    }

    /// Also element `number` of `axes`, none of which the position has.
    pub fn and(mut self, axes: &Axes, number: Value) -> Position {
        self.numbers.push((axes.clone(), number));
        self
    }

    /// The same with another coordinate along `axis`, which the domain may lack.
    pub fn with(mut self, axis: &Axis, coordinate: Value) -> Position {
        self.fixed.retain(|f| f.0 != *axis);
        self.fixed.push((axis.clone(), coordinate));
        self
    }

    pub fn coordinate(&self, e: &mut Emit, axis: &Axis) -> Value {
        if let Some((_, known)) = self.fixed.iter().find(|f| f.0 == *axis) {
            return *known;
        }
        let Some((axes, number)) = self.numbers.iter().find(|n| n.0.contains(axis)) else { return e.b.u(0) };
        let below: usize = axes.iter().skip_while(|a| *a != axis).skip(1).map(Axis::size).product();
        let below_value = e.b.u(below as u32);
        let mut coordinate = e.b.div(*number, below_value);
        if below * axis.size() < axes.elements() {
            let size = e.b.u(axis.size() as u32);
            coordinate = e.b.rem(coordinate, size);
        }
        if coordinate != *number {
            e.b.name(coordinate, &format!("at_{}", axis.name()));
        }
        coordinate
    }

    /// Number of the element of a buffer with the given axes.
    pub fn element(&self, e: &mut Emit, axes: &Axes) -> Value {
        if !axes.iter().any(|a| self.fixed.iter().any(|f| f.0 == *a)) && !axes.is_empty() {
            for (own, number) in &self.numbers {
                if let Some(part) = run_of_axes(e, own, *number, axes) {
                    return part;
                }
            }
        }
        let mut sum = e.b.u(0);
        for (axis, stride) in axes.iter().zip(axes.strides_in(axes)) {
            let (coordinate, stride) = (self.coordinate(e, axis), e.b.u(stride as u32));
            let part = e.b.mul(coordinate, stride);
            sum = e.b.add(sum, part);
        }
        sum
    }
}

/// Whether elements of a buffer with the given axes that neighbour in `rows` neighbour in memory, and a multiple of four of
/// them begins at a multiple of four, if the number of rows is one: all rows, or the last axes of them.
pub(super) fn is_run(axes: &Axes, rows: &Axes) -> bool {
    let common = axes.iter().rev().zip(rows.iter().rev()).take_while(|(a, b)| a == b);
    let (count, elements) = common.fold((0, 1), |(count, elements), (axis, _)| (count + 1, elements * axis.size()));
    count > 0 && (count == rows.iter().count() || elements % 4 == 0)
}

/// Whether four rows from a multiple of four on are at the same element of a buffer with the given axes.
pub(super) fn is_constant(axes: &Axes, rows: &Axes) -> bool {
    let without: usize = rows.iter().rev().take_while(|a| !axes.contains(a)).map(Axis::size).product();
    without.is_multiple_of(4)
}

/// Four neighbouring rows of so many, from `first` on, a multiple of four. Where they may lie behind the end, they are the last four
/// again, or if rows do not end with four, the last one.
pub(super) fn four_rows(e: &mut Emit, first: Value, rows: u32, clamped: bool) -> [Value; 4] {
    let in_fours = rows.is_multiple_of(4);
    let mut first = first;
    if clamped && in_fours {
        let last = e.b.u(rows - 4);
        first = e.b.math(naga::MathFunction::Min, &[first, last]);
    }
    [0, 1, 2, 3].map(|i| {
        let offset = e.b.u(i);
        let row = e.b.add(first, offset);
        if !clamped || in_fours {
            return row;
        }
        let last = e.b.u(rows - 1);
        e.b.math(naga::MathFunction::Min, &[row, last])
    })
}

/// Neighbouring axes out of those that `number` counts need one division and one remainder at most.
fn run_of_axes(e: &mut Emit, own: &Axes, number: Value, axes: &Axes) -> Option<Value> {
    let all: Vec<&Axis> = own.iter().collect();
    let wanted: Vec<&Axis> = axes.iter().collect();
    let at = all.windows(wanted.len()).position(|w| w == wanted)?;
    let below: usize = all[at + wanted.len()..].iter().map(|a| a.size()).product();
    let below_value = e.b.u(below as u32);
    let mut part = e.b.div(number, below_value);
    if below * axes.elements() < own.elements() {
        let size = e.b.u(axes.elements() as u32);
        part = e.b.rem(part, size);
    }
    Some(part)
}
