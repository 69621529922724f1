//! The test that a device has to pass before programs use its cooperative matrices.

use crate::{Device, Forms, RunError, Session};
use raygrad_compiler::autodiff::grad;
use raygrad_compiler::ops::input::Role;
use raygrad_compiler::{Axis, Shape, Step, Tensor, compile};

/// Whether two layers and their gradients come out as in single precision, to the bit: their numbers are integers that
/// halves hold, and so are their sums.
pub(crate) fn matrices_work(device: &Device) -> bool {
    // Tiles for software would not use them.
    let device = device.clone().with_forms(Forms { tiles: 0, ..device.forms() });
    let (Ok(expected), Ok(found)) = (layers(&device.clone().with_half(None)), layers(&device)) else { return false };
    expected == found
}

/// Every kind of matrix product: two layers with ragged sizes, and the gradients of inputs and weights.
fn layers(device: &Device) -> Result<Vec<Vec<f32>>, RunError> {
    let row = Axis::new("row", 1000);
    let (x, up) = (Shape::new(&[&row], 70), Shape::new(&[&row], 64));
    let (v, w) = (Shape::new(&[], (70, 100)), Shape::new(&[], (100, 64)));
    let shapes = [("x", x), ("up", up), ("v", v), ("w", w)];
    let inputs: Vec<Tensor> = shapes.iter().map(|(n, s)| Tensor::input(*n, Role::State, s.clone())).collect();
    let [x, up, v, w] = &inputs[..] else { return Ok(vec![]) };
    let y = x.linear(v).linear(w);
    let loss = (&y * up).sum_channels().sum(&[&row]);
    let results = [vec![y], grad(&loss, &[x, v, w])].concat();
    let names = ["y", "dx", "dv", "dw"];
    let outputs = names.iter().map(|n| n.to_string()).zip(results).collect();
    let program = compile(&Step { outputs, updates: vec![] }, &device.target())
        .map_err(|e| RunError::Device { device: device.name(), problem: e.to_string() })?;
    let mut session = Session::new(device.clone())?;
    let id = session.add(program)?;
    let mut state = 1u32;
    for (name, shape) in &shapes {
        let mut next = || {
            // A linear congruential generator (Knuth); its upper bits as an integer from -2 to 2.
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            ((state >> 16) % 5) as f32 - 2.0
        };
        session.set(name, &(0..shape.lanes()).map(|_| next()).collect::<Vec<_>>())?;
    }
    session.run(id)?;
    names.iter().map(|n| session.read(id, n)).collect()
}
