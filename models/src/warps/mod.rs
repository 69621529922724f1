//! Warps: maps of sensor points to field points.
//!
//! Naive registration, BARF and L2G are one thing: a per-point map with a code a frame, one global transform a frame, and
//! the distance between the two. A warp says only how it maps; the global transform, its fit, the alignment loss and the
//! gauge follow from that in [`Registration`], once for all warps.

mod fit;
mod global;
pub mod invertible;
mod known;
mod local;
mod plain;

pub use fit::fit_global;
pub(crate) use fit::move_by;
pub use global::GlobalWarp;
pub use invertible::InvertibleWarp;
pub use known::{KnownWarp, TRUTH as KNOWN_TRUTH};
pub use local::LocalWarp;
pub use plain::{ImplicitMlpWarp, MlpWarp, Se3Field};

use crate::config::{Dof, Method, Settings, Solver, WarpSettings};
use raygrad_compiler::functions::matrix::{apply, identity, join_affine, split_pose};
use raygrad_compiler::functions::mlp::{Init, Parameter};
use raygrad_compiler::graph::with_source;
use raygrad_compiler::{Axes, Axis, Shape, Tensor};
use std::fmt::Debug;
use std::sync::Arc;

/// Sensor points of every frame: pixels of a picture, or in 3D either end of a camera's rays.
#[derive(Clone, Debug)]
pub struct Points {
    pub frame: Axis,
    pub point: Axis,
    /// Where on the sensor: two channels along `point`, and along `frame` if the frames have different points.
    pub xy: Tensor,
    /// What is mapped: `xy` itself; in 3D three channels, the pixel at unit depth or the camera's centre, where the frame's
    /// rough guess of its pose puts them, as seen from the warp's origin ([`Registration::about`]).
    pub position: Tensor,
    /// How many points of the same frame come before these: the camera centres follow the pixels.
    pub first: usize,
}

impl Points {
    /// Points of a picture.
    pub fn planar(frame: Axis, point: Axis, xy: Tensor) -> Points {
        Points { frame, point, position: xy.clone(), xy, first: 0 }
    }

    #[track_caller]
    pub fn x(&self) -> Tensor {
        self.xy.ch(0)
    }
    #[track_caller]
    pub fn y(&self) -> Tensor {
        self.xy.ch(1)
    }
}

/// A map of sensor points to field points.
pub trait Warp: Debug + Send + Sync {
    /// Field points of all `at.position`, as many channels. `code` has [`Warp::code_width`] channels a frame.
    fn map(&self, at: &Points, code: &Tensor) -> Tensor;

    /// Channels of the code of a frame that the optimiser may move; 0 for none.
    fn code_width(&self) -> usize {
        0
    }

    /// How codes start.
    fn code_init(&self) -> Init {
        Init::Normal(1.0)
    }

    /// Whether the codes move, or stay as they started.
    fn code_trained(&self) -> bool {
        true
    }

    /// What the warp trains besides the codes.
    fn parameters(&self) -> Vec<Parameter> {
        vec![]
    }

    /// The axis of the frames, where parameters of the warp lie along it.
    fn frame(&self) -> Option<&Axis> {
        None
    }

    /// A term that the warp adds to the loss, given the field points of its map, and the term's weight. Of one that has axes or
    /// channels the mean is taken, and in space that of pixels and centres.
    fn penalty(&self, _at: &Points, _code: &Tensor, _mapped: &Tensor) -> Option<(Tensor, f64)> {
        None
    }

    /// The transform of each frame (see [`Registration::transform`]), where the map is nothing but that. By default it is
    /// fitted to the map.
    fn global(&self, _frame: &Axis, _code: &Tensor) -> Option<Tensor> {
        None
    }

    /// The group that the global transform belongs to.
    fn dof(&self) -> Dof {
        Dof::Homography
    }

    /// How a homography is fitted.
    fn solver(&self) -> Solver {
        Solver::InverseIteration
    }

    /// Whether a code of zeros makes the map the identity. The gauge is then held by resetting the first frame's code
    /// after every step, as BARF does, and otherwise by leaving the first frame's points where they are, as L2G does.
    fn zero_code_is_identity(&self) -> bool {
        false
    }
}

/// The warp that settings ask for, of so many frames.
pub fn of_settings(settings: &Settings, frames: usize) -> Arc<dyn Warp> {
    let warp = &settings.warp;
    let frame = || Axis::new("frame", frames);
    match warp.method {
        Method::None => Arc::new(KnownWarp { dof: warp.dof }),
        Method::Global => Arc::new(GlobalWarp { dof: warp.dof }),
        Method::Local => Arc::new(LocalWarp::new(warp)),
        Method::Invertible => Arc::new(InvertibleWarp::new(warp, None)),
        Method::MultiInvertible => Arc::new(InvertibleWarp::new(warp, Some(frame()))),
        Method::Mlp => Arc::new(MlpWarp::new(warp)),
        Method::ImplicitMlp => Arc::new(ImplicitMlpWarp::new(warp, settings.loss.cycle)),
        Method::Se3Field => Arc::new(Se3Field::new(warp)),
    }
}

/// A warp applied to points, and everything that follows from it.
#[derive(Clone, Debug)]
pub struct Registration {
    /// Field points of the map.
    pub local: Tensor,
    /// One transform a frame: `(3, 3)` from sensor to field; in 3D the pose `(3, 4)` that takes field points back to
    /// `at.position`, so that a frame's own pose is its rough guess after this one.
    pub transform: Tensor,
    /// Field points under the global transform.
    pub global: Tensor,
    /// In 3D, where the camera centres of the same rays are mapped.
    pub centers: Option<Tensor>,
    /// Mean of (local - global)^2 over frames, points (in 3D pixels and centres) and coordinates; none where the map is the
    /// global transform.
    pub residual: Option<Tensor>,
    /// A term of the warp's own and its weight, see [`Warp::penalty`].
    pub penalty: Option<(Tensor, f64)>,
}

impl Registration {
    /// Applies `warp` to pixels `at` and, in 3D, to the camera centres of the same rays; `pinned` says whether the first
    /// frame is the gauge. Field points that do not fit carry an error with the warp's own line.
    pub fn new(warp: &dyn Warp, at: &Points, centers: Option<&Points>, code: &Tensor, pinned: bool) -> Registration {
        let first = Tensor::index(&at.frame).equal(&Tensor::integers(&[0]));
        let held = pinned && !warp.zero_code_is_identity();
        let map = |at: &Points| {
            let mapped = fitting(at, warp.dof(), warp.map(at, code));
            if held { first.select(&at.position, &mapped) } else { mapped }
        };
        let (local, mapped_centers) = (map(at), centers.map(map));
        let mean = |p: Tensor| if p.shape().lanes() == 1 { p } else { p.mean_all() };
        let penalty = |at: &Points, mapped| warp.penalty(at, code, mapped).map(|(p, weight)| (mean(p), weight));
        let penalty = match (penalty(at, &local), centers.zip(mapped_centers.as_ref())) {
            (Some((of_pixels, weight)), Some((at, mapped))) => {
                let of_centers = penalty(at, mapped).map_or(of_pixels.clone(), |(p, _)| p);
                Some(((of_pixels + of_centers) * 0.5, weight))
            }
            (penalty, _) => penalty,
        };
        if let Some(transform) = warp.global(&at.frame, code) {
            let transform = fitting_transform(&at.frame, warp.dof(), transform);
            let transform = if held { first.select(&neutral(warp.dof()), &transform) } else { transform };
            let global = local.clone();
            return Registration { local, transform, global, centers: mapped_centers, residual: None, penalty };
        }
        let mut pairs = vec![(at, &local)];
        pairs.extend(centers.zip(mapped_centers.as_ref()));
        let transform = fit_global(warp.dof(), warp.solver(), &pairs, held.then_some(&first));
        let global = move_by(warp.dof(), &transform, &at.position);
        let mut residual = fit::residual(warp.dof(), &transform, at, &local, &global);
        if let Some((at, local)) = pairs.get(1) {
            let global = move_by(warp.dof(), &transform, &at.position);
            residual = (residual + fit::residual(warp.dof(), &transform, at, local, &global)) * 0.5;
        }
        Registration { local, transform, global, centers: mapped_centers, residual: Some(residual), penalty }
    }

    /// The loss of a step: `render`, `alignment` times the residual, and the warp's own term. A weight of zero removes a term: its
    /// gradient is not even computed.
    pub fn loss(&self, render: &Tensor, alignment: f64) -> Tensor {
        let aligned = match &self.residual {
            Some(residual) if alignment > 0.0 => render + residual * alignment,
            _ => render.clone(),
        };
        match &self.penalty {
            Some((penalty, weight)) if *weight != 0.0 => aligned + penalty * *weight,
            _ => aligned,
        }
    }

    /// The same in 3D for a warp that has the point `origin` of the world as its own: what the warp turns, it turns about that
    /// point. A camera that turns about its centre moves its whole picture; one that turns about what it sees does not.
    pub fn about(
        origin: [f64; 3],
        warp: &dyn Warp,
        at: &Points,
        centers: Option<&Points>,
        code: &Tensor,
        pinned: bool,
    ) -> Registration {
        if origin == [0.0; 3] {
            return Registration::new(warp, at, centers, code, pinned);
        }
        let origin = Tensor::constant(&origin);
        let seen = |at: &Points| Points { position: &at.position - &origin, ..at.clone() };
        let found = Registration::new(warp, &seen(at), centers.map(seen).as_ref(), code, pinned);
        let (rotation, translation) = split_pose(&found.transform);
        Registration {
            local: found.local + &origin,
            global: found.global + &origin,
            centers: found.centers.map(|centers| centers + &origin),
            transform: join_affine(&rotation, &(translation + &origin - apply(&rotation, &origin))),
            ..found
        }
    }
}

/// What a warp made of points, if these are points again: as many coordinates, along the axes of the points and no others; and if
/// they have the transform that the warp says they have.
fn fitting(at: &Points, dof: Dof, mapped: Tensor) -> Tensor {
    if mapped.error().is_some() {
        return mapped;
    }
    let own = at.position.axes();
    let all = own.union(&Axes::new([at.frame.clone(), at.point.clone()]));
    let fits = own.is_subset(mapped.axes()) && mapped.axes().is_subset(&all) && mapped.width() == at.position.width();
    let width = at.position.width();
    if !fits {
        let problem = "the points that are mapped (operand 1) do not become points (operand 2)";
        let hint = format!("a map gives {width} channels along {own} and, where frames differ, [{}]", at.frame);
        return with_source(mapped.source(), || Tensor::misfit("Warp::map", &[&at.position, &mapped], problem, hint));
    }
    if (dof == Dof::Pose) != (width == 3) {
        let problem = format!("points of {width} coordinates have no transform `{dof:?}`");
        let hint = match width {
            3 => "of points in space `Warp::dof` is Dof::Pose",
            _ => "of points in the plane `Warp::dof` is a group of the plane, Dof::Homography for instance",
        };
        return with_source(mapped.source(), || Tensor::misfit("Warp::dof", &[&at.position, &mapped], problem, hint));
    }
    mapped
}

/// The transform of each frame that a warp gives, if it is one.
fn fitting_transform(frame: &Axis, dof: Dof, transform: Tensor) -> Tensor {
    let (channels, axes) = (neutral(dof).channels(), Axes::new([frame.clone()]));
    if transform.error().is_some() || (transform.channels() == channels && transform.axes().is_subset(&axes)) {
        return transform;
    }
    let problem = format!("no transform `{dof:?}` of a frame");
    let hint = format!("it has channels {channels} along {axes}");
    with_source(transform.source(), || Tensor::misfit("Warp::global", &[&transform], problem, hint))
}

/// The transform that moves nothing.
#[track_caller]
fn neutral(dof: Dof) -> Tensor {
    match dof {
        Dof::Pose => Tensor::constant_matrix(3, 4, &[1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1., 0.]),
        _ => identity(3),
    }
}

/// The parameter that holds the codes of all frames.
pub(crate) const CODE: &str = "warp.code";

/// The codes of a warp's frames, if it has any.
pub fn codes(warp: &dyn Warp, frame: &Axis) -> Option<Parameter> {
    let width = warp.code_width();
    (width > 0).then(|| {
        let shape = Shape::new(&[frame], width);
        Parameter::new(CODE, shape, warp.code_init()).trained(warp.code_trained())
    })
}

/// What holds the gauge after a step, where codes of zeros are the identity: codes whose first frame stays zero, and the axis of the
/// frames.
pub(crate) fn held<'a>(
    warp: &dyn Warp,
    settings: &WarpSettings,
    code: Option<&'a Parameter>,
    frame: &'a Axis,
) -> Option<(&'a Tensor, &'a Axis)> {
    let held = settings.fix_first && warp.zero_code_is_identity();
    code.filter(|_| held).map(|code| (&code.tensor, frame))
}

/// The codes as a map sees them. A warp without codes that looks at them all the same carries an error.
pub fn code_tensor(code: Option<&Parameter>) -> Tensor {
    let none = || {
        let hint = "let `Warp::code_width` say how many channels of a code the warp needs";
        Tensor::misfit("Warp::map", &[], "the warp uses the code of a frame, but its `code_width` is 0", hint)
    };
    code.map_or_else(none, |c| c.tensor.clone())
}
