//! A pedestrian in mid-stride: limbs, trunk and head are tubes along a curve.

use glam::DVec3;

use super::surface::{Paint, Painter};

/// Edge of a cell, in metres.
const CELL_M: f64 = 0.016;

/// A ring of a tube: where its middle is, and its half width (along y) and half depth (along x), in
/// metres.
#[derive(Clone, Copy, Debug)]
pub(super) struct Ring {
    center_m: DVec3,
    half_width_m: f64,
    half_depth_m: f64,
}

pub(super) const fn ring(x: f64, y: f64, z: f64, half_width_m: f64, half_depth_m: f64) -> Ring {
    Ring { center_m: DVec3::new(x, y, z), half_width_m, half_depth_m }
}

pub(super) const TROUSERS: Paint = Paint::matt(0.20, 0.24, 0.36);
pub(super) const COAT: Paint = Paint::matt(0.52, 0.20, 0.16);
const SHIRT: Paint = Paint::matt(0.86, 0.85, 0.82);
pub(super) const SKIN: Paint = Paint::matt(0.80, 0.62, 0.52);
const HAIR: Paint = Paint::matt(0.20, 0.15, 0.12);
pub(super) const SHOES: Paint = Paint::matt(0.15, 0.14, 0.14);

/// Paints a person of 1.75 m in mid-stride along x: the left foot and the right arm are in front.
pub(super) fn paint(painter: &mut Painter) {
    for (side, ahead) in [(1.0, 1.0), (-1.0, -1.0)] {
        leg(painter, side, ahead);
        arm(painter, side, -ahead);
    }
    trunk(painter);
    head(painter);
}

/// A leg from the hip to the shoe; `ahead` is 1 for the one in front.
fn leg(painter: &mut Painter, side: f64, ahead: f64) {
    let y = 0.085 * side;
    // The rear knee is bent, and its heel is off the ground.
    let lifted_m = if ahead > 0.0 { 0.0 } else { 0.09 };
    let [knee_x, ankle_x] = if ahead > 0.0 { [0.16, 0.22] } else { [0.02, -0.24] };
    let rings = [
        ring(0.00, y, 0.93, 0.085, 0.100),
        ring(0.05 * ahead, y, 0.80, 0.080, 0.092),
        ring(0.7 * knee_x, y, 0.62, 0.076, 0.082),
        ring(knee_x, y, 0.49, 0.062, 0.066),
        ring(0.5 * (knee_x + ankle_x), y, 0.34 + 0.5 * lifted_m, 0.060, 0.066),
        ring(ankle_x, y, 0.11 + lifted_m, 0.048, 0.052),
        ring(ankle_x, y, 0.075 + lifted_m, 0.050, 0.054),
    ];
    tube(painter, &rings, |_| TROUSERS);
    let pitch = if ahead > 0.0 { 0.10 } else { -0.45 };
    let toe = |along_m: f64, up_m: f64| {
        [ankle_x + along_m, 0.03 + 0.8 * lifted_m + pitch * (along_m - 0.05) + up_m]
    };
    // No ring below the ground: at least its own half height above it.
    let shoe = |along_m: f64, up_m: f64, half_width_m: f64, half_m: f64| {
        let [x, z] = toe(along_m, up_m);
        ring(x, y, z.max(half_m + 0.004), half_width_m, half_m)
    };
    let rings = [
        shoe(-0.075, 0.02, 0.010, 0.012),
        shoe(-0.065, 0.02, 0.036, 0.040),
        shoe(0.02, 0.02, 0.042, 0.045),
        shoe(0.12, 0.01, 0.046, 0.032),
        shoe(0.175, 0.005, 0.036, 0.022),
        shoe(0.19, 0.005, 0.010, 0.010),
    ];
    tube(painter, &rings, |_| SHOES);
}

/// An arm from the shoulder to the hand; `ahead` is 1 for the one in front.
fn arm(painter: &mut Painter, side: f64, ahead: f64) {
    let elbow_x = if ahead > 0.0 { 0.06 } else { -0.13 };
    let wrist_x = if ahead > 0.0 { 0.24 } else { -0.12 };
    let wrist_z = if ahead > 0.0 { 0.97 } else { 0.88 };
    let rings = [
        ring(0.0, 0.175 * side, 1.455, 0.030, 0.040),
        ring(0.0, 0.210 * side, 1.42, 0.052, 0.062),
        ring(0.3 * elbow_x, 0.228 * side, 1.32, 0.050, 0.058),
        ring(elbow_x, 0.245 * side, 1.14, 0.044, 0.048),
        ring(0.5 * (elbow_x + wrist_x), 0.24 * side, 0.5 * (1.14 + wrist_z), 0.040, 0.043),
        ring(wrist_x, 0.232 * side, wrist_z, 0.034, 0.036),
    ];
    tube(painter, &rings, |_| COAT);
    let hand = |along: f64, half_width_m: f64, half_depth_m: f64| {
        let down_m = -0.13 * along;
        let x = wrist_x + 0.05 * along * ahead.max(0.2);
        ring(x, 0.23 * side, wrist_z + 0.01 + down_m, half_width_m, half_depth_m)
    };
    let rings = [
        hand(0.0, 0.022, 0.026),
        hand(0.35, 0.024, 0.040),
        hand(0.75, 0.020, 0.038),
        hand(1.0, 0.008, 0.014),
    ];
    tube(painter, &rings, |_| SKIN);
}

/// A coat to the middle of the thighs, open at the neck.
fn trunk(painter: &mut Painter) {
    let rings = [
        ring(0.0, 0.0, 0.76, 0.205, 0.185),
        ring(0.0, 0.0, 0.90, 0.190, 0.160),
        ring(0.0, 0.0, 1.06, 0.165, 0.118),
        ring(0.0, 0.0, 1.22, 0.185, 0.122),
        ring(0.0, 0.0, 1.36, 0.200, 0.118),
        ring(-0.005, 0.0, 1.45, 0.165, 0.092),
        ring(-0.008, 0.0, 1.50, 0.085, 0.066),
        ring(-0.005, 0.0, 1.525, 0.060, 0.060),
    ];
    tube(painter, &rings, |at_m| {
        // The seam of the coat in front, a belt, and the shirt at the neck.
        let front = at_m.x > 0.05;
        if front && at_m.z > 1.36 && at_m.y.abs() < 0.75 * (at_m.z - 1.34) {
            SHIRT
        } else if (1.055..1.085).contains(&at_m.z) || front && at_m.y.abs() < 0.009 {
            COAT.times(0.6)
        } else {
            COAT
        }
    });
}

/// Neck, face and hair.
fn head(painter: &mut Painter) {
    let rings = [
        ring(0.000, 0.0, 1.485, 0.054, 0.056),
        ring(0.005, 0.0, 1.540, 0.052, 0.056),
        ring(0.020, 0.0, 1.560, 0.058, 0.074),
        ring(0.018, 0.0, 1.600, 0.070, 0.094),
        ring(0.008, 0.0, 1.655, 0.077, 0.100),
        ring(0.000, 0.0, 1.700, 0.073, 0.094),
        ring(-0.004, 0.0, 1.730, 0.052, 0.068),
        ring(-0.004, 0.0, 1.746, 0.012, 0.018),
    ];
    tube(painter, &rings, |at_m| {
        let behind_m = 0.035 - at_m.x;
        let hair =
            at_m.z > 1.69 || at_m.z > 1.56 && behind_m > 0.0 || at_m.z > 1.66 && at_m.x < 0.07;
        let eyes = (1.640..1.656).contains(&at_m.z)
            && at_m.x > 0.06
            && (0.018..0.046).contains(&at_m.y.abs());
        let mouth = (1.588..1.596).contains(&at_m.z) && at_m.x > 0.09 && at_m.y.abs() < 0.026;
        if hair {
            HAIR
        } else if eyes {
            HAIR.times(0.8)
        } else if mouth {
            SKIN.times(0.72)
        } else {
            SKIN
        }
    });
    // The nose.
    let rings = [
        ring(0.100, 0.0, 1.650, 0.008, 0.008),
        ring(0.114, 0.0, 1.622, 0.015, 0.014),
        ring(0.106, 0.0, 1.606, 0.014, 0.008),
    ];
    tube(painter, &rings, |_| SKIN.times(0.97));
}

/// Covers a tube through rings, from one end to the other.
///
/// Rings lie in planes of constant arc length: across the tube's own direction in the plane of x
/// and z, and along y.
pub(super) fn tube(painter: &mut Painter, rings: &[Ring], paint: impl Fn(DVec3) -> Paint) {
    // Break points along the tube, by index of the ring.
    let mut along = vec![0.0];
    for (index, pair) in rings.windows(2).enumerate() {
        // A tube that widens quickly, such as a shoulder, needs cells along its slope.
        let grows_m = pair[1].half_width_m - pair[0].half_width_m;
        let length_m = pair[0].center_m.distance(pair[1].center_m).hypot(grows_m);
        let count = (length_m / CELL_M).ceil().max(1.0);
        along.extend((1..=count as usize).map(|k| index as f64 + k as f64 / count));
    }
    let widest_m = rings.iter().fold(0.0_f64, |most, ring| most.max(ring.half_width_m));
    // As many cells around as the widest ring needs; narrow rings have smaller ones.
    let count = (std::f64::consts::TAU * widest_m / CELL_M).ceil().max(8.0);
    let turns: Vec<f64> =
        (0..=count as usize).map(|k| std::f64::consts::TAU * k as f64 / count).collect();
    // Rings are interpolated by Catmull and Rom's cubic, so that limbs have no edges.
    let at = |position: f64| {
        let index = (position.floor() as usize).min(rings.len() - 2);
        let t = position - index as f64;
        // Beyond the ends the last ring is repeated.
        let ring = |offset: isize| {
            let index = (index as isize + offset).clamp(0, rings.len() as isize - 1);
            rings[index as usize]
        };
        let [a, b, c, d] = [-1, 0, 1, 2].map(ring);
        let cubic = |a: f64, b: f64, c: f64, d: f64| {
            b + 0.5
                * t
                * (c - a + t * (2.0 * a - 5.0 * b + 4.0 * c - d + t * (3.0 * (b - c) + d - a)))
        };
        let of = |value: fn(&Ring) -> f64| cubic(value(&a), value(&b), value(&c), value(&d));
        let center_m = DVec3::new(of(|r| r.center_m.x), of(|r| r.center_m.y), of(|r| r.center_m.z));
        Ring {
            center_m,
            // The cubic may overshoot below 0 where a tube ends in a point.
            half_width_m: of(|r| r.half_width_m).max(0.002),
            half_depth_m: of(|r| r.half_depth_m).max(0.002),
        }
    };
    let last = (rings.len() - 1) as f64;
    let place = |turn_rad: f64, position: f64| {
        let Ring { center_m, half_width_m, half_depth_m } = at(position);
        // The direction as a central difference of a tenth of a ring, one-sided at the ends.
        let ahead_m = at((position + 0.05).min(last)).center_m;
        let behind_m = at((position - 0.05).max(0.0)).center_m;
        let direction = (ahead_m - behind_m).normalize_or(DVec3::Z);
        let depth = DVec3::Y.cross(direction).normalize_or(DVec3::X);
        let (sin, cos) = turn_rad.sin_cos();
        center_m + half_depth_m * cos * depth + half_width_m * sin * DVec3::Y
    };
    // Outwards: around the tube times along it, since depth is y times the direction.
    painter
        .sheet(&turns, &along, place, |turn_rad, position| Some(paint(place(turn_rad, position))));
}
