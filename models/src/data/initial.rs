//! Initial values of parameters. A parameter's name is its random stream, so adding another one changes none of them.

use super::Random;
use raygrad_compiler::Shape;
use raygrad_compiler::functions::mlp::{Init, Parameter};

/// The values that `parameter` starts from, in host order.
pub fn initial_values(parameter: &Parameter, seed: u32) -> Vec<f32> {
    let name = parameter.tensor.input_name().unwrap_or_default();
    draw(name, parameter.tensor.shape(), &parameter.init, seed).into_iter().map(|v| v as f32).collect()
}

fn draw(name: &str, shape: &Shape, init: &Init, seed: u32) -> Vec<f64> {
    let mut random = Random::new(seed, name);
    let mut fill = |f: &dyn Fn(&mut Random) -> f64| (0..shape.lanes()).map(|_| f(&mut random)).collect::<Vec<f64>>();
    match init {
        Init::Zero => fill(&|_| 0.0),
        Init::Uniform(bound) => fill(&|r| bound * (2.0 * r.uniform() - 1.0)),
        Init::Normal(deviation) => fill(&|r| deviation * r.normal()),
        Init::NormalRows { rows, deviation } => {
            let mut values = fill(&|r| deviation * r.normal());
            let kept = rows * columns(shape);
            for element in values.chunks_mut(shape.channels.count()) {
                element.iter_mut().skip(kept).for_each(|v| *v = 0.0);
            }
            values
        }
        Init::ColumnNorms { of, rows, init } => {
            let columns = shape.channels.count();
            let matrix = draw(of, &shape.clone().with_channels((*rows, columns)), init, seed);
            let norm = |element: &[f64], c: usize| element.iter().skip(c).step_by(columns).map(|v| v * v).sum::<f64>();
            matrix
                .chunks(rows * columns)
                .flat_map(|element| (0..columns).map(move |c| norm(element, c).sqrt()))
                .collect()
        }
    }
}

fn columns(shape: &Shape) -> usize {
    match shape.channels {
        raygrad_compiler::Channels::Matrix(_, columns) => columns,
        raygrad_compiler::Channels::Vector(_) => 1,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use raygrad_compiler::Axis;
    use raygrad_compiler::functions::weight_norm::NormalisedLayer;

    #[test]
    fn a_layer_starts_with_the_lengths_of_its_directions() {
        let frame = Axis::new("frame", 2);
        let init = Init::NormalRows { rows: 2, deviation: 0.125 };
        let layer = NormalisedLayer::new("layer", 5, 300, init, &raygrad_compiler::Axes::new([frame]));
        let [v, g] = [&layer.direction, &layer.length].map(|p| initial_values(p, 7));
        assert_eq!((v.len(), g.len()), (2 * 5 * 300, 2 * 300));
        for (v, g) in v.chunks(5 * 300).zip(g.chunks(300)) {
            assert!(v[2 * 300..].iter().all(|x| *x == 0.0));
            let norms: Vec<f32> = (0..300).map(|o| v[o].hypot(v[300 + o])).collect();
            assert!(norms.iter().zip(g).all(|(a, b)| (a - b).abs() < 1e-6 && *a > 0.0));
            let variance = v[..600].iter().map(|x| x * x).sum::<f32>() / 600.0;
            assert!((variance.sqrt() - 0.125).abs() < 0.01, "{variance}");
        }
        assert_ne!(v[..1500], v[1500..], "every frame draws numbers of its own");
        assert_ne!(v, initial_values(&layer.direction, 8));
    }
}
