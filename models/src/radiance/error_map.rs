//! Rays where the picture is still wrong (an option of L2G-NeRF's code): of every view a map of E x E cells says how large the
//! errors of rays through each were.
//!
//! With errors `m` of a view's cells, all 1 at first, a cell is drawn with the weight `m + 2 mean(m)`: one ray in three follows
//! the errors, two go anywhere. The weights are laid end to end and cut into as many equal parts as rays are drawn of the view;
//! one place is drawn in each. (The code draws cells without replacement; here only a cell with more than a ray's share of the
//! weight can be drawn twice, or one that a cut goes through.) In a cell the ray goes through any place. After a step
//! `m = 0.9 e + 0.1 m` in the cells that were drawn, `e` the mean squared error of their rays' colours.

use super::rays::ImageSize;
use raygrad_compiler::ops::input::Role;
use raygrad_compiler::ops::random;
use raygrad_compiler::{Axes, Axis, Shape, Tensor};

/// The errors, `[frame, cell] x 1`, cells row by row: a state.
pub const ERROR_MAP: &str = "data.error_map";

/// Streams of the random numbers that choose places among the weights, and in cells.
const PLACES: u32 = 5;
const WITHIN: u32 = 6;

/// Of rays that go anywhere, how many there are for one that follows the errors.
const ANYWHERE: f64 = 2.0;
/// What is left of a cell's error when a new one is known.
const KEPT: f64 = 0.1;

/// The initial map of so many views: as wrong everywhere.
pub fn untried(views: usize, side: usize) -> Vec<f32> {
    vec![1.0; views * side * side]
}

/// The maps in one step.
pub struct ErrorMap {
    /// As it was before the step.
    errors: Tensor,
    /// The cells that are drawn, `[frame, ray] x 1`.
    cells: Tensor,
    cell: Axis,
    frame: Axis,
}

impl ErrorMap {
    /// Draws pixels along `ray` in every view, from maps of `side` x `side` cells; `step` tells the draws of steps apart. The
    /// map, and the pixels' numbers, `[frame, ray] x 1`.
    pub fn draw(frame: &Axis, ray: &Axis, side: usize, size: ImageSize, step: &Tensor) -> (ErrorMap, Tensor) {
        // Axes made after that of the rays are inside of it.
        let (row, column) = (Axis::new("cell_row", side), Axis::new("cell_column", side));
        let cell = Axis::new("cell", side * side);
        let errors = Tensor::input(ERROR_MAP, Role::State, Shape::new(&[frame, &cell], 1));
        let weights = &errors + errors.mean(&[&cell]) * ANYWHERE;
        let number =
            |row: &Tensor, column: &Tensor| row.wrapping_mul(&Tensor::integers(&[side as u32])).wrapping_add(column);
        let weights = weights.take(&number(&Tensor::index(&row), &Tensor::index(&column)), &cell);
        let of_rows = weights.sum(&[&column]);
        let drawn = Axes::new([frame.clone(), ray.clone()]);
        let parts = Tensor::index(ray).to_f32() + random::uniform(&drawn, 1, PLACES, step);
        let place = parts * (1.0 / ray.size() as f64) * of_rows.sum(&[&row]);
        let (rows, rest) = find(&of_rows, &row, &place);
        let (columns, _) = find(&weights.take(&rows, &row), &column, &rest);
        let within = random::uniform(&drawn, 2, WITHIN, step);
        let pixel = |cells: &Tensor, within: Tensor, pixels: usize| {
            let at = ((cells.to_f32() + within) * (pixels as f64 / side as f64)).floor();
            at.clamp(0.0, pixels as f64 - 1.0)
        };
        let pixels =
            pixel(&rows, within.ch(0), size.height) * size.width as f64 + pixel(&columns, within.ch(1), size.width);
        let cells = number(&rows, &columns);
        (ErrorMap { errors, cells, cell, frame: frame.clone() }, pixels.to_u32())
    }

    /// The map, and what it becomes by what the step has found: the colours of the rays and what they should be, `[frame, ray] x 3`.
    pub fn updated(self, found: &Tensor, colors: &Tensor) -> (Tensor, Tensor) {
        let difference = found - colors;
        let error = (&difference * &difference).mean_channels();
        let frames = Axes::new([self.frame]);
        let sum = |t: &Tensor| t.scatter(&self.cells, &self.cell, &frames);
        let count = sum(&Tensor::scalar(1.0));
        let mean = sum(&error) / count.max(&Tensor::scalar(1.0));
        let seen = count.greater_than(&Tensor::scalar(0.0));
        let updated = seen.select(&(mean * (1.0 - KEPT) + &self.errors * KEPT), &self.errors);
        (self.errors, updated)
    }
}

/// Where `place` falls among `weights` laid end to end along `axis`: the number of the entry, and how far into it.
fn find(weights: &Tensor, axis: &Axis, place: &Tensor) -> (Tensor, Tensor) {
    let below = weights.cumsum(axis);
    let behind = (&below + weights).less_equal(place).to_f32().sum(&[axis]);
    let number = behind.clamp(0.0, axis.size() as f64 - 1.0).to_u32();
    let rest = place - below.take(&number, axis);
    (number, rest)
}

#[cfg(test)]
mod tests {
    use super::*;
    use raygrad_compiler::reference::{Array, Bindings, evaluate};
    use raygrad_compiler::scalar::DType;

    const SIDE: usize = 4;
    const SIZE: ImageSize = ImageSize { height: 10, width: 13 };

    /// Two views: in one all is as wrong, in the other one cell alone is, and rays of a step.
    fn drawn(rays: usize, step: u32) -> (Vec<usize>, Array, Tensor, Bindings, ErrorMap) {
        let frame = Axis::new("frame", 2);
        let ray = Axis::new("ray", rays);
        let number = Tensor::data("step", Shape::new(&[], 1).with_dtype(DType::U32));
        let (map, pixels) = ErrorMap::draw(&frame, &ray, SIDE, SIZE, &number);
        let mut errors = vec![0.5; 2 * SIDE * SIDE];
        errors[SIDE * SIDE..].fill(0.0);
        errors[SIDE * SIDE + 6] = 1.0;
        let errors = Array::floats(map.errors.shape(), errors);
        let bindings: Bindings = [
            (ERROR_MAP.to_string(), errors.clone()),
            ("step".to_string(), Array::integers(number.shape(), vec![step])),
        ]
        .into_iter()
        .collect();
        let found = evaluate(&[pixels.clone(), map.cells.clone()], &bindings).unwrap();
        for (pixel, cell) in found[0].u().iter().zip(found[1].u()) {
            let at = |pixel: usize, pixels: usize| ((pixel as f64 + 0.5) * SIDE as f64 / pixels as f64) as i64;
            let [row, column] =
                [at(*pixel as usize / SIZE.width, SIZE.height), at(*pixel as usize % SIZE.width, SIZE.width)];
            let (cell_row, cell_column) = (*cell as i64 / SIDE as i64, *cell as i64 % SIDE as i64);
            assert!((row - cell_row).abs() <= 1 && (column - cell_column).abs() <= 1, "pixel {pixel} in cell {cell}");
        }
        (found[1].u().iter().map(|c| *c as usize).collect(), errors, pixels, bindings, map)
    }

    /// Of many rays every cell gets its share of the weights, give or take the two that its ends cut through.
    #[test]
    fn cells_are_drawn_by_their_weights() {
        for rays in [1, 48, 4800] {
            let (cells, errors, ..) = drawn(rays, 3);
            for (errors, cells) in errors.f().chunks(SIDE * SIDE).zip(cells.chunks(rays)) {
                let mean = errors.iter().sum::<f64>() / errors.len() as f64;
                for (cell, error) in errors.iter().enumerate() {
                    let share = (error + 2.0 * mean) / (3.0 * mean * errors.len() as f64);
                    let count = cells.iter().filter(|c| **c == cell).count() as f64;
                    assert!((count - share * rays as f64).abs() <= 2.0, "{rays} rays, cell {cell}: {count}, {share}");
                }
            }
        }
        assert_ne!(drawn(7, 3).0, drawn(7, 4).0);
    }

    /// The mean error of a cell's rays replaces nine tenths of what was known of it; the others stay.
    #[test]
    fn what_rays_find_is_kept() {
        const RAYS: usize = 5;
        let (cells, before, pixels, mut bindings, map) = drawn(RAYS, 7);
        let shape = Shape::new(&pixels.axes().iter().collect::<Vec<_>>(), 3);
        let found: Vec<f64> = (0..shape.lanes()).map(|i| 0.1 * i as f64).collect();
        let truth: Vec<f64> = (0..shape.lanes()).map(|i| 0.07 * i as f64 + 0.3).collect();
        bindings.insert("found".into(), Array::floats(&shape, found.clone()));
        bindings.insert("truth".into(), Array::floats(&shape, truth.clone()));
        let (state, after) = map.updated(&Tensor::data("found", shape.clone()), &Tensor::data("truth", shape));
        assert_eq!(state.input_name(), Some(ERROR_MAP));
        let after = evaluate(&[after], &bindings).unwrap().remove(0);
        let error = |ray: usize| (0..3).map(|c| (found[3 * ray + c] - truth[3 * ray + c]).powi(2)).sum::<f64>() / 3.0;
        for (i, (after, before)) in after.f().iter().zip(before.f()).enumerate() {
            let (frame, cell) = (i / (SIDE * SIDE), i % (SIDE * SIDE));
            let rays: Vec<usize> = (frame * RAYS..(frame + 1) * RAYS).filter(|r| cells[*r] == cell).collect();
            let mean = rays.iter().map(|r| error(*r)).sum::<f64>() / rays.len() as f64;
            let expected = if rays.is_empty() { *before } else { 0.9 * mean + 0.1 * before };
            assert!((after - expected).abs() < 1e-12, "cell {cell} of view {frame}: {after}, expected {expected}");
        }
    }
}
