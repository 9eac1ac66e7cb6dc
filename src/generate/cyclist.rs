//! A cyclist on a bicycle that points along x.

use std::f64::consts::TAU;

use glam::DVec3;

use super::pedestrian::{COAT, Ring, SHOES, SKIN, TROUSERS, ring, tube};
use super::surface::{Paint, Painter};

const FRAME: Paint = Paint::matt(0.16, 0.34, 0.42);
const RUBBER: Paint = Paint::matt(0.13, 0.13, 0.14);
const HELMET: Paint = Paint::matt(0.82, 0.80, 0.30);

/// Radius of the wheels, and where their axles are along x, in metres.
const WHEEL_M: f64 = 0.34;
const AXLES_M: [f64; 2] = [-0.52, 0.54];

/// Paints a cyclist of 1.8 m x 0.6 m x 1.75 m.
pub(super) fn paint(painter: &mut Painter) {
    for x_m in AXLES_M {
        wheel(painter, x_m);
    }
    frame(painter);
    rider(painter);
}

/// A tyre, seen from both sides, and its spokes.
fn wheel(painter: &mut Painter, x_m: f64) {
    for side in [1.0, -1.0] {
        // Forwards for the left face and backwards for the right, so that both look outwards.
        let turns: Vec<f64> = (0..=96).map(|k| side * TAU * f64::from(k) / 96.0).collect();
        let place = |turn_rad: f64, radius_m: f64| {
            let (sin, cos) = turn_rad.sin_cos();
            DVec3::new(x_m + radius_m * cos, side * 0.018, WHEEL_M + radius_m * sin)
        };
        painter
            .sheet(&turns, &[WHEEL_M - 0.05, WHEEL_M - 0.025, WHEEL_M], place, |_, _| Some(RUBBER));
        painter.sheet(&turns, &[0.03, 0.15, WHEEL_M - 0.05], place, |turn_rad, _| {
            // 16 spokes, each a fifth of its sector; between them is nothing.
            let is_spoke = (turn_rad.abs() * 16.0 / TAU).fract() < 0.2;
            is_spoke.then_some(Paint::matt(0.6, 0.6, 0.62))
        });
    }
}

/// A straight bar of a radius.
fn bar(painter: &mut Painter, from: [f64; 3], to: [f64; 3], radius_m: f64, paint: Paint) {
    let along = |t: f64| {
        let [x, y, z] = [0, 1, 2].map(|axis| from[axis] + t * (to[axis] - from[axis]));
        ring(x, y, z, radius_m, radius_m)
    };
    tube(painter, &[0.0, 0.33, 0.67, 1.0].map(along), |_| paint);
}

fn frame(painter: &mut Painter) {
    let [rear, front] = AXLES_M.map(|x_m| [x_m, 0.0, WHEEL_M]);
    let pedals = [-0.05, 0.0, 0.30];
    let saddle = [-0.22, 0.0, 0.92];
    let head = [0.38, 0.0, 0.86];
    for (from, to) in
        [(rear, pedals), (rear, saddle), (pedals, saddle), (pedals, head), (front, head)]
    {
        bar(painter, from, to, 0.020, FRAME);
    }
    // Top tube, stem and saddle; then both halves of the handlebar.
    bar(painter, [-0.21, 0.0, 0.80], head, 0.020, FRAME);
    bar(painter, head, [0.36, 0.0, 1.04], 0.016, RUBBER);
    bar(painter, [-0.36, 0.0, 0.95], [-0.12, 0.0, 0.95], 0.045, RUBBER);
    for side in [1.0, -1.0] {
        bar(painter, [0.36, 0.0, 1.04], [0.30, 0.27 * side, 1.06], 0.015, RUBBER);
    }
}

/// Legs on the pedals, trunk, arms to the handlebar, and head with helmet.
fn rider(painter: &mut Painter) {
    // The feet are on opposite sides of the pedals' axle, which is at (-0.05, 0.30).
    for (side, knee, foot) in
        [(1.0, [0.18, 0.80], [0.05, 0.46]), (-1.0, [0.10, 0.60], [-0.14, 0.18])]
    {
        let y = 0.10 * side;
        let rings: [Ring; 5] = [
            ring(-0.22, y, 0.98, 0.085, 0.100),
            ring(0.5 * (knee[0] - 0.22), y, 0.5 * (knee[1] + 0.98), 0.078, 0.085),
            ring(knee[0], y, knee[1], 0.062, 0.066),
            ring(0.5 * (knee[0] + foot[0]), y, 0.5 * (knee[1] + foot[1]), 0.056, 0.062),
            ring(foot[0], y, foot[1], 0.046, 0.050),
        ];
        tube(painter, &rings, |_| TROUSERS);
        bar(
            painter,
            [foot[0] - 0.06, y, foot[1] - 0.05],
            [foot[0] + 0.18, y, foot[1] - 0.06],
            0.042,
            SHOES,
        );
        let rings: [Ring; 4] = [
            // An arm, from the shoulder to the grip at (0.30, 0.27, 1.06).
            ring(0.10, 0.17 * side, 1.40, 0.050, 0.060),
            ring(0.16, 0.22 * side, 1.24, 0.046, 0.050),
            ring(0.22, 0.25 * side, 1.14, 0.040, 0.043),
            ring(0.31, 0.26 * side, 1.08, 0.034, 0.036),
        ];
        tube(painter, &rings, |_| COAT);
    }
    let rings: [Ring; 6] = [
        ring(-0.26, 0.0, 0.92, 0.165, 0.130),
        ring(-0.20, 0.0, 1.04, 0.170, 0.130),
        ring(-0.08, 0.0, 1.20, 0.185, 0.130),
        ring(0.04, 0.0, 1.36, 0.195, 0.115),
        ring(0.10, 0.0, 1.45, 0.130, 0.080),
        ring(0.12, 0.0, 1.49, 0.060, 0.060),
    ];
    tube(painter, &rings, |_| COAT);
    let rings: [Ring; 6] = [
        // Neck and head; from 1.62 m up it is the helmet.
        ring(0.13, 0.0, 1.47, 0.054, 0.056),
        ring(0.17, 0.0, 1.53, 0.060, 0.078),
        ring(0.17, 0.0, 1.60, 0.076, 0.098),
        ring(0.16, 0.0, 1.66, 0.086, 0.112),
        ring(0.15, 0.0, 1.72, 0.074, 0.096),
        ring(0.15, 0.0, 1.75, 0.014, 0.020),
    ];
    tube(painter, &rings, |at_m| if at_m.z > 1.62 { HELMET } else { SKIN });
}
