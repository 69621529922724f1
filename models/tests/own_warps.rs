//! Warps of a program of one's own: what they promise, what they forget, and what follows from them.

use raygrad::Experiment;
use raygrad::config::Dof;
use raygrad::testing::{check_gradients_on, kernels};
use raygrad::training::Training;
use raygrad::warps::{GlobalWarp, Points, Registration, Warp};
use raygrad_compiler::functions::lie::se3_exp;
use raygrad_compiler::functions::matrix::{apply_affine, invert_pose};
use raygrad_compiler::functions::mlp::{Init, Parameter};
use raygrad_compiler::ops::input::Role;
use raygrad_compiler::reference::{Array, Bindings, evaluate};
use raygrad_compiler::{Axis, Shape, Tensor};
use raygrad_runtime::Device;

/// A shift by (1/2, 1/4) and a parameter that the warp may forget to list, with a term of the loss a frame and point.
#[derive(Debug)]
struct Shifted {
    by: Parameter,
    listed: bool,
}

impl Warp for Shifted {
    fn map(&self, at: &Points, _: &Tensor) -> Tensor {
        &at.xy + &self.by.tensor + Tensor::constant(&[0.5, 0.25])
    }
    fn parameters(&self) -> Vec<Parameter> {
        if self.listed { vec![self.by.clone()] } else { vec![] }
    }
    fn penalty(&self, at: &Points, _: &Tensor, mapped: &Tensor) -> Option<(Tensor, f64)> {
        Some(((mapped - &at.xy).abs() + Tensor::index(&at.frame).to_f32() * 0.0, 1.0))
    }
}

#[test]
fn forgotten_parameters_are_refused_and_penalties_are_means() {
    let trainer = |listed: bool| {
        let by = Parameter::new("shift", Shape::new(&[], 2), Init::Zero);
        tiny(Shifted { by, listed }).trainer()
    };
    let error = trainer(false).err().expect("refused").to_string();
    assert!(error.contains("the parameter `shift`") && error.contains("`parameters()`"), "{error}");
    let mut trainer = trainer(true).unwrap_or_else(|e| panic!("{e}"));
    trainer.step().and_then(|()| trainer.wait()).unwrap_or_else(|e| panic!("{e}"));
    let loss = trainer.measure().unwrap_or_else(|e| panic!("{e}")).loss;
    // Five frames of which the first stays where it is: 0.8 of the mean of both shifts.
    assert!((loss["penalty"] - 0.3).abs() < 1e-3, "{loss:?}");
    let terms = loss["render"] + loss["penalty"] + loss.get("alignment").map_or(0.0, |a| 100.0 * a);
    assert!((loss["total"] - terms).abs() < 1e-4, "{loss:?}");
}

/// A warp that is not what it says.
#[derive(Debug)]
struct Promising {
    map: fn(&Points, &Tensor) -> Tensor,
    code: usize,
    global: Option<fn(&Tensor) -> Tensor>,
    dof: Dof,
    identity: bool,
}

impl Warp for Promising {
    fn map(&self, at: &Points, code: &Tensor) -> Tensor {
        (self.map)(at, code)
    }
    fn code_width(&self) -> usize {
        self.code
    }
    fn global(&self, _: &Axis, code: &Tensor) -> Option<Tensor> {
        self.global.map(|global| global(code))
    }
    fn dof(&self) -> Dof {
        self.dof
    }
    fn zero_code_is_identity(&self) -> bool {
        self.identity
    }
}

#[test]
fn promises_of_warps_are_checked() {
    let moved: fn(&Points, &Tensor) -> Tensor = |at, code| apply_affine(&se3_exp(code), &at.position);
    let space = |global| Promising { map: moved, code: 6, global: Some(global), dof: Dof::Pose, identity: true };
    let check = |warp: &Promising| check_gradients_on(warp, &[]);
    check(&space(|code| invert_pose(&se3_exp(code)))).unwrap_or_else(|e| panic!("{e}"));
    let text = check(&space(se3_exp)).expect_err("the wrong way round").to_string();
    assert!(text.contains("`Warp::global` is not what `Warp::map` does") && text.contains("back"), "{text}");
    let doubled = |at: &Points, code: &Tensor| &at.xy * 2.0 + code;
    let plane = Promising { map: doubled, code: 2, global: None, dof: Dof::Homography, identity: true };
    let text = check(&plane).expect_err("not the identity").to_string();
    assert!(text.contains("`Warp::zero_code_is_identity` is not"), "{text}");
    check(&Promising { identity: false, ..plane }).unwrap_or_else(|e| panic!("{e}"));
}

/// What a warp says of its transform must fit its points; what does not is told with the line of the warp.
#[test]
fn transforms_that_do_not_fit_are_refused() {
    let warp = |dof, global| Promising { map: |at, _| at.position.clone(), code: 3, global, dof, identity: false };
    let refused = |coordinates: usize, warp: Promising, expected: &str| {
        let (frame, point) = (Axis::new("frame", 3), Axis::new("point", 8));
        let position = Tensor::data("position", Shape::new(&[&frame, &point], coordinates));
        let at = Points { position: position.clone(), ..Points::planar(frame.clone(), point, position.slice(0..2)) };
        let code = Tensor::parameter("code", Shape::new(&[&frame], 3));
        let found = Registration::new(&warp, &at, None, &code, true);
        let text = found.local.error().or(found.transform.error()).expect("refused").to_string();
        assert!(text.contains(expected) && text.contains(" at models/tests/own_warps.rs"), "{text}");
    };
    refused(3, warp(Dof::Homography, None), "of points in space `Warp::dof` is Dof::Pose");
    refused(2, warp(Dof::Pose, None), "`Warp::dof` is a group of the plane");
    refused(2, warp(Dof::Rigid, Some(|code| code * 1.0)), "it has channels (3, 3) along [frame=3]");
    let everywhere =
        |code: &Tensor| (code + Tensor::index(&Axis::new("other", 2)).to_f32()).pick(&[0; 12]).reshape((3, 4));
    refused(3, warp(Dof::Pose, Some(everywhere)), "it has channels (3, 4) along [frame=3]");
}

fn tiny(warp: impl Warp + 'static) -> Experiment {
    let sizes = ["data.image_size=[16,16]", "data.patch_crop=[8,8]", "data.points_per_patch=16", "run.device=cpu"];
    let small = Experiment::preset("planar-l2g-small").and_then(|e| sizes.iter().try_fold(e, |e, s| e.set(s)));
    small.unwrap_or_else(|e| panic!("{e}")).warp(warp)
}

/// Patches of 64 pixels have no more points than that.
#[test]
fn more_points_than_pixels_are_all_pixels() {
    let program = |points: usize| {
        let by = Parameter::new("shift", Shape::new(&[], 2), Init::Zero);
        let experiment = tiny(Shifted { by, listed: true }).set(&format!("data.points_per_patch={points}"));
        let trainer = experiment.and_then(|e| e.trainer()).unwrap_or_else(|e| panic!("{e}"));
        trainer.learner().program(trainer.training_program()).to_string()
    };
    assert_eq!(program(100_000), program(64));
    assert_ne!(program(63), program(64));
}

#[test]
fn codes_and_inputs_that_nobody_gives_are_refused() {
    let radial = |at: &Points, code: &Tensor| &at.xy * (1.0 + code.ch(0) * (at.x() * at.x() + at.y() * at.y()));
    let warp = || Promising { map: radial, code: 0, global: None, dof: Dof::Homography, identity: false };
    for text in [
        check_gradients_on(&warp(), &[]).expect_err("refused").to_string(),
        tiny(warp()).training().err().expect("refused").to_string(),
    ] {
        assert!(text.contains("its `code_width` is 0"), "{text}");
    }
    let heated =
        |at: &Points, code: &Tensor| &at.xy + code * Tensor::input("my.temperature", Role::PerStep, Shape::new(&[], 1));
    let warp = Promising { map: heated, code: 2, global: None, dof: Dof::Homography, identity: false };
    let mut training = tiny(warp).training().unwrap_or_else(|e| panic!("{e}"));
    let text = training.step().expect_err("refused").to_string();
    assert!(text.contains("`my.temperature`") && text.contains("nothing sets"), "{text}");
}

/// A term of negative weight is a reward, no mistake.
#[test]
fn penalties_may_be_rewards() {
    #[derive(Debug)]
    struct Rewarded;
    impl Warp for Rewarded {
        fn map(&self, at: &Points, code: &Tensor) -> Tensor {
            &at.xy + code
        }
        fn code_width(&self) -> usize {
            2
        }
        fn penalty(&self, _: &Points, _: &Tensor, mapped: &Tensor) -> Option<(Tensor, f64)> {
            Some((mapped * mapped, -0.5))
        }
    }
    let mut training = tiny(Rewarded).training().unwrap_or_else(|e| panic!("{e}"));
    training.step().and_then(|()| training.wait()).unwrap_or_else(|e| panic!("{e}"));
    let loss = training.measure().unwrap_or_else(|e| panic!("{e}")).loss;
    let terms = loss["render"] - 0.5 * loss["penalty"] + loss.get("alignment").map_or(0.0, |a| 100.0 * a);
    assert!((loss["total"] - terms).abs() < 1e-4 && loss["penalty"] > 0.0, "{loss:?}");
}

/// A warp that gives what its function makes of the points.
#[derive(Debug)]
struct Mistaken(fn(&Points) -> Tensor);
impl Warp for Mistaken {
    fn map(&self, at: &Points, _: &Tensor) -> Tensor {
        self.0(at)
    }
}

/// What does not map points to points is refused with the line of the warp that made it, in tests and in training.
#[test]
fn maps_to_something_else_are_refused() {
    let maps: [fn(&Points) -> Tensor; 3] =
        [|at| at.x(), |at| at.xy.max_over(&[&at.point]), |at| &at.xy + Tensor::index(&Axis::new("other", 4)).to_f32()];
    for map in maps {
        let line = |message: String| {
            assert!(message.contains("Warp::map: ") && message.contains("models/tests/own_warps.rs"), "{message}");
        };
        line(check_gradients_on(&Mistaken(map), &[]).expect_err("refused").to_string());
        line(kernels(&Mistaken(map)).expect_err("refused").to_string());
        let experiment = Experiment::preset("planar-l2g-small").expect("is there").warp(Mistaken(map));
        let experiment = experiment.device(Device::cpu(Some(1)).expect("starts a thread"));
        line(experiment.training().err().expect("refused").to_string());
    }
}

/// Leaves points where they are, and would have them at the origin.
#[derive(Debug)]
struct Drawn;

impl Warp for Drawn {
    fn map(&self, at: &Points, _: &Tensor) -> Tensor {
        at.position.clone()
    }
    fn code_width(&self) -> usize {
        0
    }
    fn parameters(&self) -> Vec<Parameter> {
        vec![]
    }
    fn dof(&self) -> Dof {
        Dof::Pose
    }
    fn penalty(&self, _: &Points, _: &Tensor, mapped: &Tensor) -> Option<(Tensor, f64)> {
        Some((mapped * mapped, 1.0))
    }
}

/// In space a warp's own term is the mean over pixels and centres: those of two cameras, three pixels each.
#[test]
fn penalties_are_of_pixels_and_centers() {
    let (frame, point) = (Axis::new("frame", 2), Axis::new("point", 3));
    let position = Tensor::data("pixels", Shape::new(&[&frame, &point], 3));
    let center = Tensor::data("centers", Shape::new(&[&frame], 3));
    let of = |position: &Tensor, first| {
        let xy = Tensor::data("xy", Shape::new(&[&point], 2));
        Points { frame: frame.clone(), point: point.clone(), xy, position: position.clone(), first }
    };
    let (pixels, centers) = (of(&position, 0), of(&center, 3));
    let code = Tensor::scalar(0.0);
    let (values, middles) = ((0..18).map(f64::from).collect::<Vec<_>>(), vec![1.0, 2.0, 3.0, -4.0, 5.0, 0.5]);
    let bound: Bindings = [
        ("pixels".to_string(), Array::floats(position.shape(), values.clone())),
        ("centers".to_string(), Array::floats(center.shape(), middles.clone())),
    ]
    .into_iter()
    .collect();
    let mean = |x: &[f64]| x.iter().map(|x| x * x).sum::<f64>() / x.len() as f64;
    for (centers, expected) in [(None, mean(&values)), (Some(&centers), (mean(&values) + mean(&middles)) / 2.0)] {
        let (penalty, weight) = Registration::new(&Drawn, &pixels, centers, &code, false).penalty.unwrap();
        let found = evaluate(&[penalty], &bound).unwrap()[0].f()[0];
        assert!((found - expected).abs() < 1e-9 && weight == 1.0, "{found} instead of {expected}");
    }
}

/// Moves rays by a pose, which is left to be fitted.
#[derive(Debug)]
struct Turned;

impl Warp for Turned {
    fn map(&self, at: &Points, code: &Tensor) -> Tensor {
        GlobalWarp { dof: Dof::Pose }.map(at, code)
    }
    fn dof(&self) -> Dof {
        Dof::Pose
    }
}

/// A warp with an origin of its own turns cameras about that point, and its transforms take field points back, whether they
/// are given or fitted.
#[test]
fn cameras_turn_about_the_origin_of_a_warp() {
    let (frame, point) = (Axis::new("frame", 1), Axis::new("point", 4));
    let origin = [0.5, -1.0, 2.0];
    let (plane, center) = ([-0.4, -0.3, 1.0, 0.4, -0.3, 1.0, 0.4, 0.3, 1.0, -0.4, 0.2, 1.0], [0.1, 0.2, 0.0]);
    let position = Tensor::data("pixels", Shape::new(&[&point], 3));
    let of = |position: &Tensor, first| {
        let xy = position.slice(0..2);
        Points { frame: frame.clone(), point: point.clone(), xy, position: position.clone(), first }
    };
    let (pixels, centers) = (of(&position, 0), of(&Tensor::constant(&center), 4));
    let bound: Bindings =
        [("pixels".to_string(), Array::floats(position.shape(), plane.to_vec()))].into_iter().collect();
    // Points turn by 0.3 about the y axis through the origin; a warp's code says where the camera goes, the other way round.
    let turned = |p: &[f64]| {
        let ([x, y, z], (sin, cos)) = ([0, 1, 2].map(|i| p[i] - origin[i]), 0.3f64.sin_cos());
        [origin[0] + cos * x + sin * z, origin[1] + y, origin[2] - sin * x + cos * z]
    };
    for warp in [&GlobalWarp { dof: Dof::Pose } as &dyn Warp, &Turned] {
        let code = Tensor::constant(&[0.0, -0.3, 0.0, 0.0, 0.0, 0.0]);
        let found = Registration::about(origin, warp, &pixels, Some(&centers), &code, false);
        let mapped = found.centers.unwrap();
        let back = |p: &Tensor| apply_affine(&found.transform, p);
        let all = [back(&found.local), back(&mapped), found.local, found.global, mapped];
        let all = evaluate(&all, &bound).unwrap();
        let expected: Vec<f64> = plane.chunks(3).flat_map(turned).collect();
        let expected = [&plane[..], &center, &expected, &expected, &turned(&center)];
        for (i, (found, expected)) in all.iter().zip(expected).enumerate() {
            let near = found.f().iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-9);
            assert!(near && found.f().len() == expected.len(), "{warp:?}, {i}: {:?}, {expected:?}", found.f());
        }
    }
}

/// Two warps of the same shapes.
#[derive(Debug)]
struct Pushed;
#[derive(Debug)]
struct Pulled;

impl Warp for Pushed {
    fn map(&self, at: &Points, code: &Tensor) -> Tensor {
        &at.xy + code
    }
    fn code_width(&self) -> usize {
        2
    }
}
impl Warp for Pulled {
    fn map(&self, at: &Points, code: &Tensor) -> Tensor {
        &at.xy - code
    }
    fn code_width(&self) -> usize {
        2
    }
}

/// A run belongs to the warp that it was made with, and is called after it.
#[test]
fn runs_of_a_programs_warp_go_on_with_that_warp() {
    let dir = tempfile::tempdir().unwrap();
    let run = dir.path().join("run");
    let made = |e: Experiment| e.set("optim.steps=3").unwrap().out(&run);
    made(tiny(Pushed)).train().unwrap_or_else(|e| panic!("{e}"));
    let text = std::fs::read_to_string(run.join("config.toml")).unwrap();
    assert!(text.contains("own = \"own_warps::Pushed\""), "{text}");
    fn refused<T>(result: Result<T, raygrad::Error>) -> String {
        result.err().expect("refused").to_string()
    }
    let other = refused(made(tiny(Pulled)).resume(true).train());
    assert!(other.contains("`warp.own`") && other.contains("Pushed") && other.contains("Pulled"), "{other}");
    let of_run = || Experiment::of_run(&run).unwrap_or_else(|e| panic!("{e}"));
    let none = refused(of_run().restored());
    assert!(none.contains("`own_warps::Pushed` is the warp of a program"), "{none}");
    assert!(of_run().warp(Pushed).restored().is_ok());
    assert_eq!(of_run().layered.settings.method_name(), "Pushed");
    made(tiny(Pushed)).resume(true).train().unwrap_or_else(|e| panic!("{e}"));
}
