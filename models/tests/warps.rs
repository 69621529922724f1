//! Derivatives of every built-in warp, first and second order, in the reference and on the devices.

use raygrad::config::{Dof, Layered};
use raygrad::testing::check_gradients;
use raygrad::warps::{GlobalWarp, LocalWarp};

const ALL: [Dof; 5] = [Dof::Rotation, Dof::Translation, Dof::Rigid, Dof::Pose, Dof::Homography];

#[test]
fn global_warps() {
    for dof in ALL {
        check_gradients(&GlobalWarp { dof }).unwrap_or_else(|e| panic!("{dof}: {e}"));
    }
}

#[test]
fn local_warps() {
    // The local group differs from the global one only for the last.
    for dof in [Dof::Rigid, Dof::Pose, Dof::Homography] {
        let mut layered = Layered::load("planar-l2g").unwrap();
        for set in ["warp.code=4", "warp.layers=[8,8,8]", "warp.skip=[2]", "warp.solver=eigen"] {
            layered.set(set).unwrap();
        }
        layered.settings.warp.dof = dof;
        check_gradients(&LocalWarp::new(&layered.settings.warp)).unwrap_or_else(|e| panic!("{dof}: {e}"));
    }
}
