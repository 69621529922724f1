//! The solids of the built-in scene: analytic shapes with solid textures of many scales, lit by one light with shadows.

use crate::data::Random;
use crate::geometry::Pose;
use nalgebra::Vector3;

type V = Vector3<f64>;

/// Height of the ground.
const GROUND: f64 = -0.4;
/// Rays to the light start so far from where they left.
const OFFSET: f64 = 1e-6;
const AMBIENT: f64 = 0.45;

enum Form {
    Sphere(f64),
    /// Half lengths of the sides.
    Block(V),
    /// A disc in the plane z = 0.
    Disc(f64),
}

struct Solid {
    form: Form,
    /// World to the solid's own frame.
    place: Pose,
    texture: Texture,
    /// A ball around it: centre, and radius squared.
    center: V,
    reach: f64,
}

struct Texture {
    colors: [V; 2],
    /// Checks, or rings otherwise, a unit length.
    frequency: f64,
    checks: bool,
    seed: u32,
}

pub struct World {
    solids: Vec<Solid>,
    /// Towards the light, of unit length.
    light: V,
}

impl World {
    pub fn new(seed: u32) -> World {
        let mut random = Random::new(seed, "solids");
        let mut solids = vec![];
        let ground = Texture::new(&mut random, 4.0, true);
        solids.push(Solid::new(Form::Disc(1.15), V::new(0.0, 0.0, GROUND), 0.0, ground));
        let forms = [
            (Form::Sphere(0.42), -0.45, -0.35),
            (Form::Block(V::new(0.28, 0.28, 0.5)), 0.45, 0.3),
            (Form::Sphere(0.28), 0.5, -0.55),
            (Form::Block(V::new(0.22, 0.42, 0.2)), -0.5, 0.5),
            (Form::Sphere(0.2), 0.0, 0.85),
            (Form::Block(V::new(0.14, 0.14, 0.14)), 0.05, 0.05),
        ];
        // Everything moves a little and turns, but stands on the ground.
        for (i, (form, x, y)) in forms.into_iter().enumerate() {
            let [dx, dy] = [0.05 * random.normal(), 0.05 * random.normal()].map(|d| d.clamp(-0.08, 0.08));
            let height = match &form {
                Form::Sphere(radius) => *radius,
                Form::Block(half) => half.z,
                Form::Disc(_) => 0.0,
            };
            let texture = Texture::new(&mut random, 5.0 + i as f64, i % 2 == 1);
            let turn = std::f64::consts::TAU * random.uniform();
            solids.push(Solid::new(form, V::new(x + dx, y + dy, GROUND + height), turn, texture));
        }
        World { solids, light: V::new(0.4, -0.5, 0.9).normalize() }
    }

    /// The nearest solid along a ray, and where: (parameter, normal in the world, solid).
    fn hit(&self, origin: &V, direction: &V) -> Option<(f64, V, &Solid)> {
        let hits = self.near(origin, direction).filter_map(|s| s.hit(origin, direction).map(|(t, n)| (t, n, s)));
        hits.min_by(|a, b| a.0.total_cmp(&b.0))
    }

    /// The solids whose balls a ray's line passes through: a cheap test first.
    fn near(&self, origin: &V, direction: &V) -> impl Iterator<Item = &Solid> {
        let (origin, direction, length) = (*origin, *direction, direction.norm_squared());
        self.solids.iter().filter(move |s| {
            let from = origin - s.center;
            let along = from.dot(&direction);
            (from.norm_squared() - s.reach) * length <= along * along
        })
    }

    /// Parameter of the first hit.
    pub fn depth(&self, origin: &V, direction: &V) -> Option<f64> {
        self.hit(origin, direction).map(|h| h.0)
    }

    /// Colour of the first hit.
    pub fn color(&self, origin: &V, direction: &V) -> Option<V> {
        let (t, normal, solid) = self.hit(origin, direction)?;
        let at = origin + t * direction;
        let above = at + OFFSET * normal;
        let shadow = self.near(&above, &self.light).any(|s| s.hit(&above, &self.light).is_some());
        let diffuse = if shadow { 0.0 } else { normal.dot(&self.light).max(0.0) };
        Some(solid.texture.at(&solid.place.apply(&at)) * (AMBIENT + (1.0 - AMBIENT) * diffuse))
    }
}

/// World to a frame at `center`, turned about the vertical.
fn place(center: V, turn: f64) -> Pose {
    let rotation = Pose::exp(&[0.0, 0.0, turn, 0.0, 0.0, 0.0]).rotation;
    Pose { rotation, translation: -(rotation * center) }
}

impl Solid {
    fn new(form: Form, center: V, turn: f64, texture: Texture) -> Solid {
        let radius = match &form {
            Form::Sphere(radius) | Form::Disc(radius) => *radius,
            Form::Block(half) => half.norm(),
        };
        // A little larger, so that rounding takes no hit away.
        let reach = 1.001 * radius * radius;
        Solid { form, place: place(center, turn), texture, center, reach }
    }

    /// Nearest positive parameter and the normal towards the ray's origin.
    fn hit(&self, origin: &V, direction: &V) -> Option<(f64, V)> {
        let (o, d) = (self.place.apply(origin), self.place.rotation * direction);
        let (t, normal) = match &self.form {
            Form::Sphere(radius) => {
                let (a, b, c) = (d.norm_squared(), o.dot(&d), o.norm_squared() - radius * radius);
                let root = (b * b - a * c).sqrt();
                // No hit makes the root, and with it both parameters, no number; nothing below holds for those.
                let t = [(-b - root) / a, (-b + root) / a].into_iter().find(|t| *t > 0.0)?;
                (t, (o + t * d) / *radius)
            }
            Form::Block(half) => {
                let (mut enter, mut leave, mut normal) = (f64::NEG_INFINITY, f64::INFINITY, V::zeros());
                for axis in 0..3 {
                    let sides = [-half[axis], half[axis]].map(|side| (side - o[axis]) / d[axis]);
                    let near = sides[0].min(sides[1]);
                    if near > enter {
                        enter = near;
                        normal = V::zeros();
                        normal[axis] = -d[axis].signum();
                    }
                    leave = leave.min(sides[0].max(sides[1]));
                }
                (enter > 0.0 && enter < leave).then_some((enter, normal))?
            }
            Form::Disc(radius) => {
                let t = -o.z / d.z;
                let at = o + t * d;
                (t > 0.0 && at.xy().norm() < *radius).then_some((t, V::new(0.0, 0.0, -d.z.signum())))?
            }
        };
        Some((t, self.place.rotation.transpose() * normal))
    }
}

impl Texture {
    fn new(random: &mut Random, frequency: f64, checks: bool) -> Texture {
        let mut color = |low: f64| V::from_fn(|_, _| low + 0.6 * random.uniform());
        let colors = [color(0.1), color(0.4)];
        Texture { colors, frequency, checks, seed: random.next_u32() }
    }

    /// Colour at a point of the solid's frame: a pattern of two colours, and noise of four scales on each channel.
    fn at(&self, p: &V) -> V {
        let f = self.frequency;
        let pattern = if self.checks {
            // Half a cell up, so that the ground and the faces of blocks do not lie on a border.
            let cells: f64 = (p * f + V::new(0.25, 0.25, 0.5)).iter().map(|x| x.floor()).sum();
            cells.rem_euclid(2.0)
        } else {
            let wave = 1.5 * Cell::at(&(p * f * 0.7)).noise(self.seed ^ 0x55);
            0.5 + 0.5 * (2.0 * f * (p.z + 0.4 * p.x) + 4.0 * wave).sin()
        };
        let base = self.colors[0].lerp(&self.colors[1], pattern);
        let octaves: [Cell; 4] = std::array::from_fn(|k| Cell::at(&(p * 3.0 * f64::from(1u32 << k))));
        let speckle = V::from_fn(|channel, _| {
            let octave = |(k, cell): (u32, &Cell)| {
                let seed = self.seed.wrapping_add(31 * k + 7 * channel as u32);
                cell.noise(seed) / f64::from(1u32 << k).sqrt()
            };
            (0..).zip(&octaves).map(octave).sum::<f64>() / 2.6
        });
        (base + (speckle - V::repeat(0.5)) * 0.7).map(|c| c.clamp(0.02, 1.0))
    }
}

/// Where a point lies among the corners of its unit cell: what noise of any seed there has in common.
struct Cell {
    weights: [f64; 8],
    /// Of the corners' coordinates.
    hashes: [u32; 8],
}

impl Cell {
    fn at(p: &V) -> Cell {
        let cell = p.map(f64::floor);
        let f = (p - cell).map(|x| x * x * (3.0 - 2.0 * x));
        let bit = |i: usize, axis: usize| i >> axis & 1;
        let weight = |i: usize, axis: usize| if bit(i, axis) == 1 { f[axis] } else { 1.0 - f[axis] };
        let at = |axis: usize, bit: usize| (cell[axis] as i32 + bit as i32) as u32;
        // Corners that share coordinates share the beginning of their hash.
        let x: [u32; 2] = std::array::from_fn(|i| mix(0x9e37_79b9, at(0, i)));
        let xy: [u32; 4] = std::array::from_fn(|i| mix(x[bit(i, 0)], at(1, bit(i, 1))));
        Cell {
            weights: std::array::from_fn(|i| weight(i, 0) * weight(i, 1) * weight(i, 2)),
            hashes: std::array::from_fn(|i| mix(xy[i & 3], at(2, bit(i, 2)))),
        }
    }

    /// Smooth noise in 0..=1 with one value a corner.
    fn noise(&self, seed: u32) -> f64 {
        let value = |hash: u32| f64::from(mix(hash, seed)) / f64::from(u32::MAX);
        self.weights.iter().zip(&self.hashes).map(|(weight, hash)| weight * value(*hash)).sum()
    }
}

/// One more part of a hash (multiply and xor-shift).
fn mix(hash: u32, part: u32) -> u32 {
    let h = (hash ^ part).wrapping_mul(0x7feb_352d);
    let h = (h ^ (h >> 15)).wrapping_mul(0x846c_a68b);
    h ^ (h >> 16)
}
