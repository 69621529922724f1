//! Recording: a [`Tensor`] is an immutable node of the graph, shared by whatever uses it.
//!
//! There is no recorder object and no interior mutability: an op on tensors returns a new tensor that holds its operands.
//! Identifiers grow with time, so sorting by identifier is a topological order, the same in every run.

use super::axis::{Axes, Axis};
use super::error::{Misfit, RecordError};
use super::shape::{Channels, Shape};
use crate::ops::{Op, input::Input};
use crate::scalar::DType;
use std::cell::Cell;
use std::fmt;
use std::marker::PhantomData;
use std::panic::Location;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

/// A function from named axes to channels, recorded but not yet computed.
#[derive(Clone)]
pub struct Tensor(Arc<Node>);

/// One recorded op.
pub struct Node {
    pub id: u64,
    pub op: Arc<dyn Op>,
    pub inputs: Vec<Tensor>,
    pub shape: Shape,
    /// The user's line that made it; a gradient carries the line of the op it is the gradient of.
    pub source: &'static Location<'static>,
    error: Option<Arc<RecordError>>,
}

static NEXT: AtomicU64 = AtomicU64::new(0);

/// On whose behalf tensors are recorded.
#[derive(Clone, Copy)]
struct Behalf {
    source: Option<&'static Location<'static>>,
    /// The function that the user called.
    function: Option<&'static str>,
}

thread_local! {
    static BEHALF: Cell<Behalf> = const { Cell::new(Behalf { source: None, function: None }) };
}

/// Until it is dropped, tensors are recorded on behalf of whom it was made for.
pub struct Called {
    name: &'static str,
    before: Behalf,
    /// Not for other threads.
    _here: PhantomData<*const ()>,
}

impl Called {
    fn new(name: &'static str, of: Behalf) -> Called {
        Called { name, before: BEHALF.replace(of), _here: PhantomData }
    }

    /// What [`Tensor::misfit`] gives, for the function that was called.
    #[track_caller]
    pub fn misfit(&self, operands: &[&Tensor], problem: impl Into<String>, hint: impl Into<String>) -> Tensor {
        Tensor::misfit(self.name, operands, problem, hint)
    }
}

impl Drop for Called {
    fn drop(&mut self) {
        BEHALF.set(self.before);
    }
}

/// Runs `f`; every tensor recorded inside gets the source line `at`. Used by the passes that record on a user's behalf.
pub fn with_source<T>(at: &'static Location<'static>, f: impl FnOnce() -> T) -> T {
    let _called = Called::new("", Behalf { source: Some(at), ..BEHALF.get() });
    f()
}

/// The first line of a function of tensors: what does not fit in its body is told of the function `name` and its caller's line, or
/// of the function that calls it as a part of its own body.
#[track_caller]
#[must_use = "it ends where it is dropped"]
pub fn function(name: &'static str) -> Called {
    let of = BEHALF.get();
    let source = of.source.unwrap_or(Location::caller());
    Called::new(name, Behalf { source: Some(source), function: of.function.or(Some(name)) })
}

impl Tensor {
    /// Records `op` on `inputs`. If the operands do not fit, the result carries the error.
    #[track_caller]
    pub fn record(op: impl Op, inputs: &[&Tensor]) -> Tensor {
        Tensor::record_arc(Arc::new(op), inputs.iter().map(|t| (*t).clone()).collect())
    }

    #[track_caller]
    pub fn record_arc(op: Arc<dyn Op>, inputs: Vec<Tensor>) -> Tensor {
        let source = BEHALF.get().source.unwrap_or(Location::caller());
        let shapes: Vec<Shape> = inputs.iter().map(|t| t.shape().clone()).collect();
        let poisoned = inputs.iter().find_map(|t| t.0.error.clone());
        let found = op.shape(&shapes).and_then(|shape| shape.check().map(|()| shape));
        let (shape, error) = match (poisoned, found) {
            (Some(e), Ok(shape)) => (shape, Some(e)),
            (Some(e), Err(_)) => (Shape::new(&[], 1), Some(e)),
            (None, Ok(shape)) => {
                let clash = name_clash(&op, &inputs, &shape, source);
                (shape, clash)
            }
            (None, Err(m)) => (Shape::new(&[], 1), Some(Arc::new(record_error(&op, &inputs, m, source)))),
        };
        let id = NEXT.fetch_add(1, Ordering::Relaxed);
        Tensor(Arc::new(Node { id, op, inputs, shape, source, error }))
    }

    /// The same op, recorded at the same source line, of other operands; the tensor itself if they are its own.
    pub(crate) fn with_inputs(&self, inputs: Vec<Tensor>) -> Tensor {
        let same = inputs.iter().zip(self.inputs()).all(|(a, b)| a.id() == b.id());
        if same { self.clone() } else { with_source(self.source(), || Tensor::record_arc(self.op().clone(), inputs)) }
    }

    /// A tensor that only carries an error, for derived functions that check their arguments.
    #[track_caller]
    pub fn misfit(
        name: &'static str,
        operands: &[&Tensor],
        problem: impl Into<String>,
        hint: impl Into<String>,
    ) -> Tensor {
        Tensor::record(crate::ops::input::Refused { name, misfit: Misfit::new(problem, hint) }, operands)
    }

    pub fn node(&self) -> &Node {
        &self.0
    }
    pub fn id(&self) -> u64 {
        self.0.id
    }
    pub fn op(&self) -> &Arc<dyn Op> {
        &self.0.op
    }
    pub fn inputs(&self) -> &[Tensor] {
        &self.0.inputs
    }
    pub fn shape(&self) -> &Shape {
        &self.0.shape
    }
    pub fn axes(&self) -> &Axes {
        &self.0.shape.axes
    }
    pub fn channels(&self) -> Channels {
        self.0.shape.channels
    }
    /// Number of channels.
    pub fn width(&self) -> usize {
        self.0.shape.channels.count()
    }
    pub fn dtype(&self) -> DType {
        self.0.shape.dtype
    }
    pub fn source(&self) -> &'static Location<'static> {
        self.0.source
    }
    /// The first recording error among this tensor and everything it is computed from.
    pub fn error(&self) -> Option<&RecordError> {
        self.0.error.as_deref()
    }
    /// The op downcast to its concrete type, for rewrite rules.
    pub fn op_as<T: Op>(&self) -> Option<&T> {
        let any: &dyn std::any::Any = &**self.op();
        any.downcast_ref::<T>()
    }
    /// Name of an input tensor, `None` for computed ones.
    pub fn input_name(&self) -> Option<&str> {
        self.op_as::<Input>().map(|i| &*i.name)
    }
}

fn record_error(op: &Arc<dyn Op>, inputs: &[Tensor], m: Misfit, source: &'static Location<'static>) -> RecordError {
    RecordError {
        op: BEHALF.get().function.unwrap_or(op.name()).to_string(),
        operands: inputs.iter().map(|t| (t.shape().clone(), t.source())).collect(),
        problem: m.problem,
        hint: m.hint,
        source,
    }
}

/// Two different axes of one name in one op are nearly always a mistake: the user made the axis twice.
fn name_clash(
    op: &Arc<dyn Op>,
    inputs: &[Tensor],
    result: &Shape,
    source: &'static Location<'static>,
) -> Option<Arc<RecordError>> {
    let mut seen: Vec<&Axis> = vec![];
    for a in inputs.iter().flat_map(|t| t.axes()).chain(&result.axes) {
        match seen.iter().find(|b| b.name() == a.name()) {
            Some(b) if *b != a => {
                let problem = if a.size() == b.size() {
                    format!("two different axes are called `{}`", a.name())
                } else {
                    format!("axis `{}` has size {} in one place and {} in another", a.name(), b.size(), a.size())
                };
                let m = Misfit::new(
                    problem,
                    "make the axis once with Axis::new and clone it, or give the second another name",
                );
                return Some(Arc::new(record_error(op, inputs, m, source)));
            }
            Some(_) => {}
            None => seen.push(a),
        }
    }
    None
}

/// All tensors that `roots` are computed from, operands before users.
pub fn topological(roots: impl IntoIterator<Item = Tensor>) -> Vec<Tensor> {
    let mut seen = std::collections::HashSet::new();
    let mut stack: Vec<Tensor> = roots.into_iter().collect();
    let mut all = vec![];
    while let Some(t) = stack.pop() {
        if seen.insert(t.id()) {
            stack.extend(t.inputs().iter().cloned());
            all.push(t);
        }
    }
    all.sort_by_key(Tensor::id);
    all
}

impl fmt::Debug for Tensor {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "%{} = {:?}", self.id(), self.op())?;
        for i in self.inputs() {
            write!(f, " %{}", i.id())?;
        }
        write!(f, ": {}", self.shape())
    }
}

/// Long chains are freed in a loop: a recursive drop would overflow the stack.
impl Drop for Node {
    fn drop(&mut self) {
        let mut stack = std::mem::take(&mut self.inputs);
        while let Some(t) = stack.pop() {
            if let Some(mut node) = Arc::into_inner(t.0) {
                stack.append(&mut node.inputs);
            }
        }
    }
}
