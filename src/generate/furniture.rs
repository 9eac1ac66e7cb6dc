//! Lamp poles, traffic lights, signs, bins, planters and bollards.

use glam::{DMat3, DQuat, DVec3};

use super::plants;
use super::random::Random;
use super::surface::{Paint, Painter, Patch};
use wildcity_scene::SemanticClass;

const STEEL: Paint = Paint::matt(0.36, 0.38, 0.39);

/// A street lamp with an arm: `towards_road` is unit and horizontal.
pub(super) fn lamp(painter: &mut Painter, foot_m: DVec3, towards_road: DVec3) {
    let top_m = foot_m + 6.8 * DVec3::Z;
    pole(painter, [foot_m, foot_m + 1.1 * DVec3::Z], 0.10, STEEL.times(0.9));
    pole(painter, [foot_m + 1.1 * DVec3::Z, top_m], 0.06, STEEL);
    let head_m = top_m + 1.3 * towards_road + 0.25 * DVec3::Z;
    pole(painter, [top_m, head_m], 0.035, STEEL);
    let along = towards_road.cross(DVec3::Z);
    // The lamp's head hangs over the road.
    let head_size_m = DVec3::new(0.13, 0.34, 0.09);
    // A block has four sides and a lid: the glowing patch is its bottom, and looks down.
    let glow = Patch {
        center_m: head_m + 0.30 * towards_road - 0.012 * DVec3::Z,
        edge_u_m: 0.5 * towards_road,
        edge_v_m: 0.2 * along,
    };
    // A lamp belongs to its pole.
    painter.labelled(SemanticClass::Pole, |painter| {
        block(painter, head_m + 0.30 * towards_road, along, head_size_m, STEEL);
        painter.patch(&glow, Paint::glowing(0.97, 0.95, 0.86));
    });
}

/// A pole with the heads of a traffic light: each looks along a direction, and is green or red.
pub(super) fn traffic_light(painter: &mut Painter, foot_m: DVec3, heads: [(DVec3, bool); 2]) {
    pole(painter, [foot_m, foot_m + 3.6 * DVec3::Z], 0.065, STEEL);
    for (facing, green) in heads {
        painter.labelled(SemanticClass::TrafficLight, |painter| {
            traffic_light_head(painter, foot_m + 2.45 * DVec3::Z + 0.19 * facing, facing, green);
        });
    }
}

/// Three lamps in a box, each below a visor; the one that is on shines.
fn traffic_light_head(painter: &mut Painter, base_m: DVec3, facing: DVec3, green: bool) {
    let right = DVec3::Z.cross(facing);
    let case = Paint::matt(0.10, 0.11, 0.11);
    block(painter, base_m, right, DVec3::new(0.17, 0.12, 1.02), case);
    // From top to bottom: red, yellow, green.
    let lamps = [
        (0.83, !green, [1.0, 0.20, 0.12], Paint::matt(0.34, 0.08, 0.07)),
        (0.51, false, [1.0, 0.7, 0.1], Paint::matt(0.36, 0.27, 0.08)),
        (0.19, green, [0.20, 1.0, 0.55], Paint::matt(0.07, 0.26, 0.16)),
    ];
    for (height_m, is_on, [r, g, b], dark) in lamps {
        let center_m = base_m + height_m * DVec3::Z + 0.16 * facing;
        let shining = Paint::glowing(r, g, b);
        disc(painter, center_m, facing, 0.115, |part| match (is_on, part < 0.5) {
            (true, true) => Paint::glowing(r.max(0.75), g.max(0.75), b.max(0.75)),
            (true, false) => shining,
            (false, _) => dark,
        });
        let visor = |angle_rad: f64| {
            let (sin, cos) = angle_rad.sin_cos();
            center_m + 0.135 * (cos * DVec3::Z + sin * right) + 0.05 * facing
        };
        let arc: Vec<DVec3> = (-2..=2).map(|part| visor(0.7 * f64::from(part))).collect();
        painter.polyline(&arc, facing, [0.03, 1.0], case.times(0.7));
        if is_on {
            let axes = DMat3::from_cols(right, DVec3::Z, right.cross(DVec3::Z));
            let rgb = DVec3::new(r, g, b);
            let sigmas_m = DVec3::new(0.14, 0.14, 0.02);
            // A halo in front of the lamp: wide, flat and half transparent.
            let at_m = center_m + 0.12 * facing;
            painter.gaussian(at_m, DQuat::from_mat3(&axes), sigmas_m, 0.51, rgb, DVec3::ZERO);
        }
    }
}

/// A round sign on a pole: white in a red ring.
pub(super) fn sign(painter: &mut Painter, foot_m: DVec3, facing: DVec3) {
    pole(painter, [foot_m, foot_m + 2.75 * DVec3::Z], 0.035, STEEL.times(1.3));
    let center_m = foot_m + 2.5 * DVec3::Z;
    painter.labelled(SemanticClass::TrafficSign, |painter| {
        disc(painter, center_m + 0.05 * facing, facing, 0.31, |r| {
            if r > 0.72 { Paint::matt(0.80, 0.10, 0.11) } else { Paint::matt(0.93, 0.93, 0.92) }
        });
        disc(painter, center_m - 0.05 * facing, -facing, 0.31, |_| Paint::matt(0.55, 0.56, 0.57));
    });
}

/// A litter bin, 0.95 m high with its rim.
pub(super) fn bin(painter: &mut Painter, foot_m: DVec3) {
    let green = Paint::matt(0.17, 0.30, 0.24);
    tube(painter, [foot_m, foot_m + 0.85 * DVec3::Z], 0.21, green);
    tube(painter, [foot_m + 0.85 * DVec3::Z, foot_m + 0.95 * DVec3::Z], 0.23, green.times(0.6));
}

/// A short post that keeps cars off the pavement.
pub(super) fn bollard(painter: &mut Painter, foot_m: DVec3) {
    let dark = Paint::matt(0.22, 0.22, 0.23);
    pole(painter, [foot_m, foot_m + 0.72 * DVec3::Z], 0.06, dark);
    pole(painter, [foot_m + 0.72 * DVec3::Z, foot_m + 0.90 * DVec3::Z], 0.062, dark.times(3.6));
    pole(painter, [foot_m + 0.90 * DVec3::Z, foot_m + 0.98 * DVec3::Z], 0.06, dark);
}

/// A box of concrete with a hedge in it, `half_m` long to either side.
pub(super) fn planter(
    painter: &mut Painter,
    base_m: DVec3,
    along: DVec3,
    half_m: f64,
    random: &mut Random,
) {
    let concrete = Paint::matt(0.62, 0.61, 0.58);
    block(painter, base_m, along, DVec3::new(half_m, 0.32, 0.5), concrete);
    // Within the box of 0.32 m and 0.5 m height: the hedge begins 8 cm below its rim.
    let size_m = DVec3::new(half_m - 0.05, 0.30, 0.75);
    painter.labelled(SemanticClass::Vegetation, |painter| {
        plants::hedge(painter, base_m + 0.42 * DVec3::Z, along, size_m, random);
    });
}

/// A round pole from end to end.
fn pole(painter: &mut Painter, ends_m: [DVec3; 2], radius_m: f64, paint: Paint) {
    painter.labelled(SemanticClass::Pole, |painter| tube(painter, ends_m, radius_m, paint));
}

/// The surface of a cylinder without its ends.
fn tube(painter: &mut Painter, ends_m: [DVec3; 2], radius_m: f64, paint: Paint) {
    let axis = (ends_m[1] - ends_m[0]).normalize();
    let (side, front) = axis.any_orthonormal_pair();
    // Six cells around at the usual spacing: TAU/1.05.
    let around = painter.even(0.0, std::f64::consts::TAU, 1.05);
    let step_m = (5.0 * radius_m).clamp(0.15, 0.40);
    let along = painter.even(0.0, ends_m[0].distance(ends_m[1]), step_m);
    let place = |angle_rad: f64, z_m: f64| {
        let (sin, cos) = angle_rad.sin_cos();
        ends_m[0] + z_m * axis + radius_m * (cos * side + sin * front)
    };
    painter.sheet(&around, &along, place, |_, _| Some(paint));
}

/// Four sides and a lid: `size_m` is half length, half depth and height.
fn block(painter: &mut Painter, base_m: DVec3, along: DVec3, size_m: DVec3, paint: Paint) {
    let across = DVec3::Z.cross(along);
    let corner = |i: f64, j: f64| base_m + i * size_m.x * along + j * size_m.y * across;
    // Counter-clockwise from above, so that every side looks outwards.
    let corners = [corner(-1.0, -1.0), corner(1.0, -1.0), corner(1.0, 1.0), corner(-1.0, 1.0)];
    let vs = painter.graded(0.0, size_m.z, 0.10, 0.22);
    for side in 0..4 {
        let from_m = corners[side];
        let to_m = corners[(side + 1) % 4];
        let width_m = from_m.distance(to_m);
        let right = (to_m - from_m) / width_m;
        let us = painter.graded(0.0, width_m, 0.10, 0.24);
        painter.sheet(
            &us,
            &vs,
            |u_m, v_m| from_m + u_m * right + v_m * DVec3::Z,
            |_, v_m| Some(paint.open(0.75 + 0.25 * (v_m / size_m.z))),
        );
    }
    let us = [-1.0, -0.4, 0.4, 1.0];
    let vs = [-1.0, 0.0, 1.0];
    let lid = |i: f64, j: f64| corner(i, j) + size_m.z * DVec3::Z;
    painter.sheet(&us, &vs, lid, |_, _| Some(paint));
}

/// A round plate that faces along `facing`. `paint` gives the colour at a fraction of the radius.
fn disc(
    painter: &mut Painter,
    center_m: DVec3,
    facing: DVec3,
    radius_m: f64,
    paint: impl Fn(f64) -> Paint,
) {
    let right = DVec3::Z.cross(facing);
    let around: Vec<_> = (0..=12).map(|i| f64::from(i) * std::f64::consts::TAU / 12.0).collect();
    let rings = [0.0, 0.38, 0.72, 1.0];
    let place = |angle_rad: f64, r: f64| {
        let (sin, cos) = angle_rad.sin_cos();
        // Turning from up to the right and outwards: u × v looks along `facing`.
        center_m + r * radius_m * (cos * DVec3::Z + sin * right)
    };
    painter.sheet(&around, &rings, place, |_, r| Some(paint(r)));
}
