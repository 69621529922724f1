//! Derivatives of every built-in warp, first and second order, in the reference and on the devices.

use raygrad::config::{Dof, Layered, WarpSettings};
use raygrad::testing::{check_gradients, check_gradients_on, devices};
use raygrad::warps::{GlobalWarp, ImplicitMlpWarp, InvertibleWarp, LocalWarp, MlpWarp, Se3Field, Warp};
use raygrad_compiler::Axis;

const ALL: [Dof; 5] = [Dof::Rotation, Dof::Translation, Dof::Rigid, Dof::Pose, Dof::Homography];

#[test]
fn global_warps() {
    for dof in ALL {
        check_gradients(&GlobalWarp { dof }).unwrap_or_else(|e| panic!("{dof}: {e}"));
    }
}

/// Settings of small networks.
fn small(dof: Dof, set: &[&str]) -> WarpSettings {
    let mut layered = Layered::load("planar-inn").unwrap();
    let sizes = ["warp.code=4", "warp.layers=[8,8,8]", "warp.skip=[2]", "warp.bands=2", "warp.solver=eigen"];
    for text in sizes.iter().chain(&["warp.inn.blocks=2", "warp.inn.hidden=5", "warp.inn.anneal_steps=10"]).chain(set) {
        layered.set(text).unwrap_or_else(|e| panic!("{e}"));
    }
    layered.settings.warp.dof = dof;
    layered.settings.warp
}

/// On the CPU, and where `RAYGRAD_NIGHTLY=1` on the GPU too: its hundred kernels take a software driver a minute.
fn check(what: &str, warp: &dyn Warp) {
    let nightly = std::env::var_os("RAYGRAD_NIGHTLY").is_some_and(|v| v == "1");
    let mut devices = devices().unwrap_or_else(|e| panic!("{e}"));
    devices.truncate(if nightly { usize::MAX } else { 1 });
    check_gradients_on(warp, &devices).unwrap_or_else(|e| panic!("{what}: {e}"));
}

#[test]
fn local_warps() {
    // The local group differs from the global one only for the last.
    for dof in [Dof::Rigid, Dof::Pose, Dof::Homography] {
        let warp = LocalWarp::new(&small(dof, &["warp.activation=relu"]));
        check_gradients(&warp).unwrap_or_else(|e| panic!("{dof}: {e}"));
    }
}

#[test]
fn invertible_warps_in_space() {
    let variants: [&[&str]; 6] = [
        &[],
        &["warp.inn.anneal=channels", "warp.inn.blocks=4"],
        &["warp.inn.anneal=point-slots"],
        &["warp.inn.code=posenc", "warp.activation=silu"],
        &["warp.inn.code=extrinsic", "warp.activation=sine"],
        &["warp.code=0", "warp.activation=gaussian"],
    ];
    for set in variants {
        check(&format!("{set:?}"), &InvertibleWarp::new(&small(Dof::Pose, set), None));
    }
    check("one a frame", &InvertibleWarp::new(&small(Dof::Pose, &[]), Some(Axis::new("frame", 2))));
}

#[test]
fn invertible_warps_in_the_plane() {
    for lift in ["warp.inn.lift=homogeneous", "warp.inn.lift=plane"] {
        for dof in [Dof::Rigid, Dof::Homography] {
            check(&format!("{dof}, {lift}"), &InvertibleWarp::new(&small(dof, &[lift]), None));
        }
        let slots = small(Dof::Homography, &[lift, "warp.inn.anneal=point-slots", "warp.activation=elu"]);
        check(lift, &InvertibleWarp::new(&slots, None));
        let frame = Some(Axis::new("frame", 2));
        check(lift, &InvertibleWarp::new(&small(Dof::Homography, &[lift]), frame));
    }
}

#[test]
fn plain_networks() {
    for dof in [Dof::Pose, Dof::Homography] {
        check(&dof.to_string(), &MlpWarp::new(&small(dof, &["warp.activation=relu"])));
        check(&dof.to_string(), &ImplicitMlpWarp::new(&small(dof, &["warp.activation=silu"]), 0.3));
    }
    check("pose network", &Se3Field::new(&small(Dof::Pose, &["warp.activation=gaussian"])));
}
