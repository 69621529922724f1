//! Closed-form rotation, translation and rigid motion from one point set to another: the least squares fit `y = R x + t`.
//!
//! In 2D the angle is `atan2(sum x_1 y_2 - x_2 y_1, sum x_1 y_1 + x_2 y_2)`. In 3D the rotation is the unit quaternion that
//! maximises a quadratic form (Horn, Closed-form solution of absolute orientation using unit quaternions, JOSA A 4(4),
//! 1987): it is always proper, also where an orthogonal fit would need a reflection. Gradients pass through the fit.

use super::expect_width;
use super::lie::so2_exp;
use super::matrix::{apply, join_affine};
use crate::graph::{Axes, Called, Tensor, function};
use crate::ops::pick::concat;

/// Sum over `over`, counting what `t` does not depend on once for every element.
#[track_caller]
fn sum_all(t: &Tensor, over: &Axes) -> Tensor {
    t.broadcast_to(over).sum_over(over)
}

/// Refuses point sets of other than `n` channels.
#[track_caller]
fn expect_points(called: &Called, x: &Tensor, y: &Tensor, n: usize) -> Result<(), Tensor> {
    expect_width(called, "points", x, n)?;
    expect_width(called, "points", y, n)
}

/// Rotation about the origin, `(2, 2)`, that takes points `x` to `y`; the points lie along `over`.
#[track_caller]
pub fn fit_rotation_2d(x: &Tensor, y: &Tensor, over: &Axes) -> Tensor {
    let called = function("fit_rotation_2d");
    if let Err(bad) = expect_points(&called, x, y, 2) {
        return bad;
    }
    let sine = (x * y.pick(&[1, 0]) * Tensor::constant(&[1.0, -1.0])).sum_channels();
    let cosine = (x * y).sum_channels();
    so2_exp(&sum_all(&sine, over).atan2(&sum_all(&cosine, over)))
}

/// Translation that takes points `x` to `y`: the difference of their means.
#[track_caller]
pub fn fit_translation(x: &Tensor, y: &Tensor, over: &Axes) -> Tensor {
    let _called = function("fit_translation");
    sum_all(&(y - x), over) * (1.0 / over.elements() as f64)
}

/// Rigid motion `[R | t]`, `(2, 3)`, that takes points `x` to `y`.
#[track_caller]
pub fn fit_rigid_2d(x: &Tensor, y: &Tensor, over: &Axes) -> Tensor {
    let _called = function("fit_rigid_2d");
    let share = 1.0 / over.elements() as f64;
    let (mean_x, mean_y) = (sum_all(x, over) * share, sum_all(y, over) * share);
    let rotation = fit_rotation_2d(&(x - &mean_x), &(y - &mean_y), over);
    let offset = &mean_y - apply(&rotation, &mean_x);
    join_affine(&rotation, &offset)
}

/// Rigid motion `[R | t]`, `(3, 4)`, that takes points `x` to `y`, over all `pairs` (x, y) of point sets together.
#[track_caller]
pub fn fit_rigid_3d(pairs: &[(&Tensor, &Tensor)], over: &Axes) -> Tensor {
    let called = function("fit_rigid_3d");
    let Some((first_x, first_y)) = pairs.first() else {
        return called.misfit(&[], "no points", "give at least one pair of point sets");
    };
    let share = 1.0 / (pairs.len() * over.elements()) as f64;
    let (mut mean_x, mut mean_y) = (sum_all(first_x, over), sum_all(first_y, over));
    for (x, y) in pairs {
        if let Err(bad) = expect_points(&called, x, y, 3) {
            return bad;
        }
    }
    for (x, y) in &pairs[1..] {
        mean_x = mean_x + sum_all(x, over);
        mean_y = mean_y + sum_all(y, over);
    }
    let (mean_x, mean_y) = (mean_x * share, mean_y * share);
    // S_ab = sum x_a y_b on centred points, row by row.
    let mut s = Tensor::constant(&[0.0; 9]);
    for (x, y) in pairs {
        let (x, y) = (*x - &mean_x, *y - &mean_y);
        let product = x.pick(&[0, 0, 0, 1, 1, 1, 2, 2, 2]) * y.pick(&[0, 1, 2, 0, 1, 2, 0, 1, 2]);
        s = s + sum_all(&product, over);
    }
    let rotation = quaternion_rotation(&horn_quaternion(&s));
    let offset = &mean_y - apply(&rotation, &mean_x);
    join_affine(&rotation, &offset)
}

/// The quaternion (w, x, y, z) that maximises Horn's quadratic form of the moments S.
#[track_caller]
fn horn_quaternion(s: &Tensor) -> Tensor {
    // Entries of the symmetric (4, 4) form as sums of entries of S and of -S (channels 9..18).
    const ENTRIES: [&[u32]; 16] = [
        &[0, 4, 8], // S_xx + S_yy + S_zz
        &[5, 16],   // S_yz - S_zy
        &[6, 11],   // S_zx - S_xz
        &[1, 12],   // S_xy - S_yx
        &[5, 16],
        &[0, 13, 17],
        &[1, 3],
        &[6, 2],
        &[6, 11],
        &[1, 3],
        &[9, 4, 17],
        &[5, 7],
        &[1, 12],
        &[6, 2],
        &[5, 7],
        &[9, 13, 8],
    ];
    let form = concat([s, &-s]).channel_groups(ENTRIES.map(<[u32]>::to_vec).to_vec()).reshape((4, 4));
    let (_, vectors) = form.sym_eig();
    vectors.pick(&[3, 7, 11, 15])
}

/// Rotation `(3, 3)` of a unit quaternion (w, x, y, z).
#[track_caller]
pub fn quaternion_rotation(q: &Tensor) -> Tensor {
    let _called = function("quaternion_rotation");
    // The ten products, doubled: ww wx wy wz xx xy xz yy yz zz.
    let p = q.pick(&[0, 0, 0, 0, 1, 1, 1, 2, 2, 3]) * q.pick(&[0, 1, 2, 3, 1, 2, 3, 2, 3, 3]) * 2.0;
    let (ww, wx, wy, wz, xx, xy, xz, yy, yz, zz) = (0, 1, 2, 3, 4, 5, 6, 7, 8, 9);
    let minus = 10;
    let groups = [
        vec![ww, xx],
        vec![xy, wz + minus],
        vec![xz, wy],
        vec![xy, wz],
        vec![ww, yy],
        vec![yz, wx + minus],
        vec![xz, wy + minus],
        vec![yz, wx],
        vec![ww, zz],
    ];
    let sums = concat([&p, &-&p]).channel_groups(groups.to_vec()).reshape((3, 3));
    sums - super::matrix::identity(3)
}
