//! Pointwise ops, choices and integers.

use super::builder::{Builder, Float, Value};
use raygrad_compiler::graph::{Axes, Shape, Tensor};
use raygrad_compiler::ops::custom::custom_adjoint;
use raygrad_compiler::ops::random;
use raygrad_compiler::reference::Array;
use raygrad_compiler::scalar::DType;

impl Builder {
    pub(super) fn unary(&mut self) -> Option<Value> {
        let x = self.float()?;
        let (t, b) = (&x.t, x.bound);
        let (y, bound, unit) = match self.rng.below(19) {
            0 => (t.sin(), 1.0, None),
            1 => (t.cos(), 1.0, None),
            2 => (t.tanh(), 1.0, None),
            3 => (t.sigmoid(), 1.0, None),
            4 => (t.softplus(1.0), b + 0.7, None),
            5 => (t.softplus(10.0), b + 0.1, None),
            6 => (t.gaussian(0.8), 1.0, None),
            7 => (-t, b, x.unit),
            8 => (t * t, b * b, x.unit.map(|u| u * u)),
            9 => (self.fit(&x, -2.0, 1.0).exp(), 2.8, None),
            10 => (self.fit(&x, 0.5, 2.5).log(), 1.0, None),
            11 => (self.fit(&x, 0.3, 2.0).sqrt(), 1.5, None),
            12 => (1.0 / self.fit(&x, 0.5, 2.0), 2.0, None),
            13 => (self.fit(&x, 0.2, 1.5).abs(), 1.5, None),
            14 => (t * 0.5, b * 0.5, x.unit.map(|u| u * 0.5)),
            15 => (2.0 - t, b + 2.0, x.unit),
            16 => {
                let constant: Vec<f64> = (0..t.width()).map(|c| (c % 5) as f64 * 0.5 - 1.0).collect();
                (t + Tensor::constant(&constant).reshape(t.channels()), b + 1.0, x.unit.map(|u| u.min(0.5)))
            }
            17 => {
                // Its adjoint is the true one, written by hand.
                let rule = |x: &[Tensor], g: &Tensor| vec![Some(g * &x[0] * 2.0)];
                (custom_adjoint(&(t * t), &[t], rule), b * b, x.unit.map(|u| u * u))
            }
            _ => (t.clamp(-b - 1.0, b + 1.0) * 1.0, b, x.unit),
        };
        self.result(y, bound, unit)
    }

    pub(super) fn binary(&mut self) -> Option<Value> {
        let x = self.float()?;
        let y = self.matching(&x.t)?;
        let units = x.unit.zip(y.unit);
        let (a, b) = (&x.t, &y.t);
        let (z, bound, unit) = match self.rng.below(8) {
            0 | 1 => (a + b, x.bound + y.bound, units.map(|u| u.0.min(u.1))),
            2 | 3 => (a * b, x.bound * y.bound, units.map(|u| u.0 * u.1)),
            4 => (a - b, x.bound + y.bound, units.map(|u| u.0.min(u.1))),
            5 => (a / self.fit(&y, 0.5, 2.0), x.bound * 2.0, None),
            6 => (a.atan2(&self.fit(&y, 0.4, 1.5)), 1.6, None),
            _ => (a * b + a, x.bound * (y.bound + 1.0), units.map(|u| (u.0 * u.1).min(u.0))),
        };
        self.result(z, bound, unit)
    }

    /// Ops with a kink or a jump, on exact values half a unit away from it.
    pub(super) fn kink(&mut self) -> Option<Value> {
        let x = self.float_where(|f| f.unit.is_some())?;
        let unit = x.unit?;
        let off = &x.t + unit / 2.0;
        let (bound, half) = (x.bound + unit, Some(unit / 2.0));
        let y = match self.rng.below(7) {
            0 | 1 => off.relu(),
            2 => off.abs(),
            3 | 4 => {
                let y = self.float_where(|f| f.unit.is_some_and(|u| u >= unit) && f.t.width() == 1)?;
                let both = if self.rng.chance(0.5) { off.min(&y.t) } else { off.max(&y.t) };
                return self.result(both, bound.max(y.bound), half);
            }
            5 => off.clamp(-0.25, 0.5),
            // Whole numbers have the unit 1; the bound has room for rounding down.
            _ => return self.result((&off * 4.0).floor() * &off, (4.0 * bound + 1.0) * bound, half),
        };
        self.result(y, bound, half.map(|h| h.min(0.25)))
    }

    /// One of two floats, by an integer.
    pub(super) fn choice(&mut self) -> Option<Value> {
        let x = self.float()?;
        let y = self.matching(&x.t)?;
        let width = x.t.width().max(y.t.width());
        let mask = self.integer_where(|t| t.width() == 1 || (t.width() == width && t.channels() == width.into()))?;
        let vector = |t: &Tensor| t.reshape(t.width());
        let t = mask.bit_and(&Tensor::integers(&[1])).select(&vector(&x.t), &vector(&y.t));
        self.result(t, x.bound.max(y.bound), x.unit.zip(y.unit).map(|u| u.0.min(u.1)))
    }

    /// Integers, and floats made of them.
    pub(super) fn integer(&mut self) -> Option<Value> {
        let known = self.integer_where(|_| true);
        let t = match (self.rng.below(10), known) {
            (0 | 1, _) | (_, None) => self.integer_source()?,
            (2, Some(i)) => {
                let low = i.bit_and(&Tensor::integers(&[7])).to_f32();
                return self.result(low, 7.0, Some(1.0));
            }
            (3, Some(i)) => i.wrapping_mul(&Tensor::integers(&[0x9E37_79B1])).shift_right(&Tensor::integers(&[29])),
            (4, Some(i)) => {
                let j = self.integer_where(|t| t.width() == 1 || t.width() == i.width())?;
                let (i, j) = (i.reshape(i.width()), j.reshape(j.width()));
                match self.rng.below(6) {
                    0 => i.wrapping_add(&j),
                    1 => i.wrapping_mul(&j),
                    2 => i.bit_xor(&j),
                    3 => i.bit_or(&j),
                    4 => i.shift_left(&j),
                    _ => i.less_equal(&j),
                }
            }
            (5, Some(i)) => {
                let channels: Vec<usize> = (0..1 + self.rng.below(3)).map(|_| self.rng.below(i.width())).collect();
                i.pick(&channels)
            }
            (6, Some(i)) => i.equal(&Tensor::integers(&[1])).select(&Tensor::integers(&[3]), &i),
            (_, Some(_)) => self.comparison()?,
        };
        (t.shape().lanes() <= 40_000 && t.error().is_none()).then_some(Value::Integer(t))
    }

    fn integer_source(&mut self) -> Option<Tensor> {
        let axes = self.some_axes();
        let axes = Axes::new(axes);
        match self.rng.below(4) {
            0 | 1 => {
                let all: Vec<_> = self.axes.iter().chain([&self.slot]).cloned().collect();
                Some(Tensor::index(&all[self.rng.below(all.len())]))
            }
            2 => {
                let shape = Shape::of(axes, 1 + self.rng.below(2), DType::U32);
                let name = self.next.clone();
                let values = (0..shape.lanes()).map(|_| self.rng.below(6) as u32).collect();
                self.bindings.insert(name.clone(), Array::integers(&shape, values));
                Some(Tensor::data(name, shape))
            }
            _ => {
                let step = Tensor::per_step("step", Shape::new(&[], 1).with_dtype(DType::U32));
                self.bindings.insert("step".into(), Array::integers(step.shape(), vec![7]));
                let stream = self.rng.below(9) as u32;
                Some(random::random_bits(&random::counter(&axes, 1), stream, &step))
            }
        }
    }

    fn comparison(&mut self) -> Option<Tensor> {
        let x = self.float_where(|f| f.unit.is_some())?;
        let unit = x.unit?;
        let off = x.t.reshape(x.t.width()) + unit / 2.0;
        let at = Tensor::scalar(0.25);
        Some(match self.rng.below(4) {
            0 if unit <= 0.25 => off.less_than(&at),
            1 if unit <= 0.25 => at.less_equal(&off),
            // Negative ones saturate at zero.
            2 => (off * 8.0).to_u32(),
            _ => off.greater_than(&Tensor::scalar(0.0)),
        })
    }

    /// Markers, broadcasts, reshapes, and numbers drawn in the step.
    pub(super) fn marker(&mut self) -> Option<Value> {
        if self.rng.chance(0.4) {
            let axes = Axes::new(self.some_axes());
            let width = self.some_width();
            let step = Tensor::per_step("step", Shape::new(&[], 1).with_dtype(DType::U32));
            self.bindings.insert("step".into(), Array::integers(step.shape(), vec![7]));
            return self.result(random::uniform(&axes, width, 3, &step), 1.0, None);
        }
        let Float { t, bound, unit } = self.float()?;
        let y = match self.rng.below(4) {
            0 => t.stop_gradient(),
            1 | 2 => {
                let axes = Axes::new(self.some_axes());
                t.broadcast_to(&axes)
            }
            _ => {
                let n = t.width();
                let rows = (1..=n).filter(|r| n.is_multiple_of(*r)).nth(self.rng.below(2)).unwrap_or(1);
                t.reshape((rows, n / rows))
            }
        };
        self.result(y, bound, unit)
    }
}
