//! Named axes: the domain of every tensor.

use std::fmt;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// A named axis of fixed size, for example `frame` or `pixel`.
///
/// Two axes are the same only if one is a clone of the other. Axes of a tensor are kept in the order in which the axes
/// were created, outermost first: create `frame` before `pixel` and a `[frame, pixel]` tensor is stored frame by frame.
#[derive(Clone)]
pub struct Axis(Arc<AxisData>);

struct AxisData {
    id: u64,
    name: String,
    size: usize,
}

static NEXT: AtomicU64 = AtomicU64::new(0);

impl Axis {
    /// A new axis, distinct from every other one.
    pub fn new(name: impl Into<String>, size: usize) -> Axis {
        Axis(Arc::new(AxisData { id: NEXT.fetch_add(1, Ordering::Relaxed), name: name.into(), size }))
    }

    pub fn name(&self) -> &str {
        &self.0.name
    }

    pub fn size(&self) -> usize {
        self.0.size
    }
}

impl PartialEq for Axis {
    fn eq(&self, other: &Axis) -> bool {
        self.0.id == other.0.id
    }
}
impl Eq for Axis {}
impl PartialOrd for Axis {
    fn partial_cmp(&self, other: &Axis) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}
impl Ord for Axis {
    fn cmp(&self, other: &Axis) -> std::cmp::Ordering {
        self.0.id.cmp(&other.0.id)
    }
}
impl std::hash::Hash for Axis {
    fn hash<H: std::hash::Hasher>(&self, state: &mut H) {
        self.0.id.hash(state);
    }
}
impl fmt::Display for Axis {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{}={}", self.0.name, self.0.size)
    }
}
/// The name alone: it appears in op keys, where size and identity do not belong.
impl fmt::Debug for Axis {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(&self.0.name)
    }
}

/// Sorted set of axes, outermost first.
#[derive(Clone, PartialEq, Eq, Hash, Default, PartialOrd, Ord)]
pub struct Axes(Vec<Axis>);

impl Axes {
    pub fn new(axes: impl IntoIterator<Item = Axis>) -> Axes {
        let mut v: Vec<Axis> = axes.into_iter().collect();
        v.sort();
        v.dedup();
        Axes(v)
    }
    pub fn none() -> Axes {
        Axes::default()
    }
    pub fn contains(&self, axis: &Axis) -> bool {
        self.0.contains(axis)
    }
    pub fn is_subset(&self, of: &Axes) -> bool {
        self.0.iter().all(|a| of.contains(a))
    }
    pub fn union(&self, other: &Axes) -> Axes {
        Axes::new(self.iter().chain(other.iter()).cloned())
    }
    pub fn minus(&self, other: &Axes) -> Axes {
        Axes(self.iter().filter(|a| !other.contains(a)).cloned().collect())
    }
    pub fn without(&self, axis: &Axis) -> Axes {
        Axes(self.iter().filter(|a| *a != axis).cloned().collect())
    }
    pub fn iter(&self) -> std::slice::Iter<'_, Axis> {
        self.0.iter()
    }
    pub fn len(&self) -> usize {
        self.0.len()
    }
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }
    pub fn last(&self) -> Option<&Axis> {
        self.0.last()
    }
    /// Number of elements: the product of the sizes, 1 for no axes.
    pub fn elements(&self) -> usize {
        self.0.iter().map(Axis::size).product()
    }
    /// For every axis of `domain`, the stride in elements of a tensor with these axes, 0 where it lacks the axis.
    pub fn strides_in(&self, domain: &Axes) -> Vec<usize> {
        let mut stride = 1;
        let mut own = vec![0; self.len()];
        for (i, a) in self.0.iter().enumerate().rev() {
            own[i] = stride;
            stride *= a.size();
        }
        domain.iter().map(|a| self.0.iter().position(|b| a == b).map_or(0, |i| own[i])).collect()
    }
}

impl<'a> IntoIterator for &'a Axes {
    type Item = &'a Axis;
    type IntoIter = std::slice::Iter<'a, Axis>;
    fn into_iter(self) -> Self::IntoIter {
        self.0.iter()
    }
}
impl fmt::Display for Axes {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str("[")?;
        for (i, a) in self.iter().enumerate() {
            write!(f, "{}{a}", if i > 0 { ", " } else { "" })?;
        }
        f.write_str("]")
    }
}
impl fmt::Debug for Axes {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.debug_list().entries(&self.0).finish()
    }
}
