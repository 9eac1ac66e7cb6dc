//! The background between the street and the sky: distant roofs, and the surrounding land.

use glam::{DMat3, DQuat, DVec3};

use super::random::{Random, noise, smooth};
use super::route::Route;
use super::surface::{Paint, Painter};
use wildcity_scene::SemanticClass;

/// Extent of the land, in metres.
const LAND_TO_M: f64 = 560.0;
/// Land nearer to the centre line than this is painted by other modules, in metres.
const LAND_FROM_M: f64 = 27.0;

/// Paints the whole background around the middle of the street.
pub(super) fn paint(painter: &mut Painter, route: &Route, seed: u64) {
    let middle_m = route.at(0.5 * route.driven_m[1]).point_m;
    painter.labelled(SemanticClass::Building, |painter| skyline(painter, middle_m, seed));
    painter.labelled(SemanticClass::Terrain, |painter| land(painter, route, middle_m, seed));
}

/// Roofs and towers in the haze.
fn skyline(painter: &mut Painter, middle_m: DVec3, seed: u64) {
    let mut random = Random::new(seed, "skyline", 0);
    let mut azimuth_rad = 0.0;
    while azimuth_rad < std::f64::consts::TAU {
        // Widths of 9 to 35 m: the angle times the distance.
        let width_rad = random.range(0.03, 0.08);
        let away_m = random.range(300.0, 440.0);
        // One in ten is a tower.
        let height_m = random.range(12.0, 26.0) + if random.chance(0.1) { 22.0 } else { 0.0 };
        let haze = smooth((away_m - 220.0) / 420.0);
        let tone = random.range(0.90, 1.06);
        let wall = DVec3::new(0.60, 0.58, 0.57).lerp(DVec3::new(0.80, 0.84, 0.88), haze) * tone;
        let (sin, cos) = (azimuth_rad + 0.5 * width_rad).sin_cos();
        // Seen from the middle, to the right and towards it: right x up looks inwards.
        let right = DVec3::new(sin, -cos, 0.0);
        let inwards = DVec3::new(-cos, -sin, 0.0);
        // 3 m below the road, so that there is no gap at its foot.
        let foot_m = middle_m - away_m * inwards - 3.0 * DVec3::Z;
        let half_m = 0.5 * width_rad * away_m;
        let us = painter.even(-half_m, half_m, 4.5);
        let vs = painter.even(0.0, height_m, 4.5);
        painter.sheet(
            &us,
            &vs,
            |u_m, v_m| foot_m + u_m * right + v_m * DVec3::Z,
            |u_m, v_m| {
                let rgb = wall * (1.0 + 0.05 * noise(seed + 23, 0.3 * u_m, 0.3 * v_m));
                // The haze is in its colour already: it takes no light.
                Some(Paint::glowing(rgb.x, rgb.y, rgb.z))
            },
        );
        // Neighbours overlap by a tenth: no sky between them.
        azimuth_rad += 0.9 * width_rad;
    }
}

/// Grass and yards beyond the houses, coarser with the distance, fading into the haze.
fn land(painter: &mut Painter, route: &Route, middle_m: DVec3, seed: u64) {
    let turn = std::f64::consts::TAU / 96.0;
    let mut radius_m = 12.0;
    while radius_m < LAND_TO_M {
        // Rings of 6.5 % of the distance, as wide as the 96 sectors: 2 pi/96 = 0.065.
        let step_m = (0.065 * radius_m).max(5.0);
        for i in 0..96 {
            let (sin, cos) = (turn * f64::from(i)).sin_cos();
            let away = DVec3::new(cos, sin, 0.0);
            // 0.35 m below the road, which hides the land where both are.
            let center_m = middle_m + (radius_m + 0.5 * step_m) * away - 0.35 * DVec3::Z;
            let edge_m = step_m.max(turn * radius_m);
            let (s_m, t_m) = route.project(center_m);
            // The street, the 80 m beyond either end of its drive, and a margin.
            let on_street = (-130.0..route.driven_m[1] + 130.0).contains(&s_m);
            if on_street && t_m.abs() < LAND_FROM_M + 1.5 * edge_m {
                continue;
            }
            let haze = smooth((radius_m - 150.0) / 420.0);
            let tone = 1.0 + 0.12 * noise(seed + 24, 0.05 * center_m.x, 0.05 * center_m.y);
            let grass = DVec3::new(0.42, 0.50, 0.30) * tone;
            let rgb = grass.lerp(DVec3::new(0.78, 0.82, 0.85), haze);
            let left = DVec3::new(-sin, cos, 0.0);
            let rotation = DQuat::from_mat3(&DMat3::from_cols(away, left, DVec3::Z));
            // 0.7 of the cell's edges: neighbours overlap, as surfels do.
            let sigmas_m = DVec3::new(0.7 * step_m, 0.7 * turn * (radius_m + step_m), 0.02);
            painter.gaussian(center_m, rotation, sigmas_m, 0.98, rgb, DVec3::ZERO);
        }
        radius_m += step_m;
    }
}
