//! Lenses beyond a half circle, and shutters that roll.

use glam::{DQuat, DVec2, DVec3};

use super::blobs::{Blob, scene};
use super::order::evenly;
use super::{Case, Run, Trial};
use crate::geometry::camera::{Fisheye, Lens, Pinhole, Rolls};
use crate::geometry::{Camera, Pose};
use crate::render::psnr::psnr_db;
use crate::render::{RenderError, Rolling, View};
use crate::report::drawing::crop;
use crate::scene::{Rays, RenderProfile, Scene};

pub(super) const T22: Case = Case {
    number: "T22",
    what: "a Gaussian an eighth as deep as it is far, through a fisheye: six points for all of it",
    bound: "agrees with f64; centre within 0.2 px and spread within 3 % of 20,000 points of it",
    run: Run::Light(t22),
};

fn t22(trial: &mut Trial<'_>) -> Result<(), RenderError> {
    const POINTS: usize = 20_000;
    let pinhole = Pinhole { fx: 60.0, fy: 60.0, cx: 80.0, cy: 60.0 };
    let lens = Lens::Fisheye(Fisheye::new([-0.03, -0.005, -0.0008, 0.001], None));
    let camera = Camera { lens, ..Camera::ideal(160, 120, pinhole) };
    let (profile, view) = (RenderProfile::DEFAULT, View::new(camera, Pose::IDENTITY));
    let blob = Blob {
        mean_m: DVec3::new(0.8, 0.3, 2.0),
        rotation: DQuat::from_rotation_y(0.5),
        sigma_m: DVec3::new(0.2, 0.12, 0.25),
        ..Blob::default()
    };
    let drawing = trial.agreed("six points", &scene(&[blob]), &profile, view)?;
    let pixels = drawing.opacity.iter().enumerate().map(|(pixel, &opacity)| {
        let at_px = DVec2::new((pixel % 160) as f64 + 0.5, (pixel / 160) as f64 + 0.5);
        (f64::from(opacity), at_px)
    });
    let (drawn_px, drawn_px2) = moments(pixels);

    // Box and Muller's normal numbers, of fractions that fill the cube evenly.
    let normal = |u: f64, v: f64| (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * v).cos();
    let point = |i: usize| {
        let [a, b, c, d, e, f] = evenly(i);
        let unit = DVec3::new(normal(a, b), normal(c, d), normal(e, f));
        (1.0, camera.project_beyond(blob.mean_m + blob.rotation * (blob.sigma_m * unit)))
    };
    let (point_px, point_px2) = moments((0..POINTS).map(point));

    trial.at_most("centre off by px:", drawn_px.distance(point_px), 0.2);
    // What is drawn ends where alpha is below the cut, at r² = 2 ln(opacity / cut): a Gaussian up to r has
    // 1 - r²/2 e^(-r²/2) / (1 - e^(-r²/2)) of its variance. And the renderer blurs.
    let left = profile.alpha_cut / blob.opacity;
    let share = 1.0 + left.ln() * left / (1.0 - left);
    let size_px2 = point_px2[0] + point_px2[1];
    for (axis, (drawn, point)) in
        ["x", "y", "xy"].into_iter().zip(drawn_px2.into_iter().zip(point_px2))
    {
        let blur = if axis == "xy" { 0.0 } else { profile.blur };
        let off = (drawn / share - blur - point).abs() / size_px2;
        trial.at_most(format!("spread along {axis} off by"), off, 0.03);
    }
    Ok(())
}

/// Mean of weighted places, and their variances along x, along y, and mixed.
fn moments(places: impl Iterator<Item = (f64, DVec2)> + Clone) -> (DVec2, [f64; 3]) {
    let sum: f64 = places.clone().map(|(weight, _)| weight).sum();
    let mean = places.clone().map(|(weight, at)| weight * at).sum::<DVec2>() / sum;
    let variance = |of: fn(DVec2) -> f64| {
        places.clone().map(|(weight, at)| weight * of(at - mean)).sum::<f64>() / sum
    };
    (mean, [variance(|d| d.x * d.x), variance(|d| d.y * d.y), variance(|d| d.x * d.y)])
}

pub(super) const T23: Case = Case {
    number: "T23",
    what: "a fisheye of 220°, with something behind it and all around it",
    bound: "agrees with f64; what the lens does not see is exactly nothing",
    run: Run::Light(t23),
};

fn t23(trial: &mut Trial<'_>) -> Result<(), RenderError> {
    let lens = Lens::Fisheye(Fisheye::new([0.0; 4], Some(110_f64.to_radians())));
    let pinhole = Pinhole { fx: 24.0, fy: 24.0, cx: 60.0, cy: 50.0 };
    let camera = Camera { lens, ..Camera::ideal(120, 100, pinhole) };
    let (profile, view) = (RenderProfile::DEFAULT, View::new(camera, Pose::IDENTITY));
    let ball = |mean_m: DVec3| scene(&[Blob { mean_m, ..Blob::default() }]);

    let behind = trial.draw(&ball(DVec3::new(0.0, 0.0, -3.0)), &profile, view)?;
    trial.holds("nothing of what is behind", behind.opacity.iter().all(|&o| o == 0.0));
    let (sin, cos) = 100_f64.to_radians().sin_cos();
    let beside = trial.agreed("at 100°", &ball(3.0 * DVec3::new(sin, 0.0, cos)), &profile, view)?;
    trial.holds("seen at 100°", beside.opacity.iter().any(|&o| o > 0.5));

    let wall = Blob { sigma_m: DVec3::splat(50.0), mean_m: DVec3::Z, ..Blob::default() };
    let wall = trial.agreed("all around", &scene(&[wall]), &profile, view)?;
    let wrong = wall.opacity.iter().enumerate().filter(|&(pixel, &opacity)| {
        let at_px = DVec2::new((pixel % 120) as f64 + 0.5, (pixel / 120) as f64 + 0.5);
        (opacity > 0.0) != camera.unproject(at_px).is_some()
    });
    trial.at_most("pixels wrong about the lens' field:", wrong.count() as f64, 0.0);
    Ok(())
}

pub(super) const T24: Case = Case {
    number: "T24",
    what: "rolling shutter at 30 m/s and 30 ms, in a curve",
    bound: "agrees with f64; at least 42 dB of every row by itself, from where the camera then stands, by rays",
    run: Run::Light(t24),
};

fn t24(trial: &mut Trial<'_>) -> Result<(), RenderError> {
    const SIZE_PX: [u32; 2] = [96, 64];
    let pinhole = Pinhole { fx: 60.0, fy: 60.0, cx: 48.0, cy: 32.0 };
    let camera = Camera::ideal(SIZE_PX[0], SIZE_PX[1], pinhole);
    let profile = RenderProfile::DEFAULT;
    let exact = RenderProfile { rays: Rays::Exact, ..profile };
    let balls = balls();
    for direction in [Rolls::TopToBottom, Rolls::BottomToTop] {
        let world_from_camera_first = Pose {
            position_m: DVec3::new(-0.05, 0.0, -0.9),
            rotation: DQuat::from_rotation_y(-0.01),
        };
        let rolling = Some(Rolling { direction, world_from_camera_first });
        let view = View { rolling, ..View::new(camera, Pose::IDENTITY) };
        let drawing = trial.agreed(format!("{direction:?}"), &balls, &profile, view)?;
        let (mut drawn, mut truth) = (Vec::new(), Vec::new());
        for row in (0..SIZE_PX[1]).step_by(5) {
            let at_px = DVec2::splat(f64::from(row) + 0.5);
            let still = View::new(camera, view.world_from_camera_at(at_px));
            let own = crop(still, [0, row as i32], [SIZE_PX[0], 1]);
            truth.extend(trial.truth(&balls, &exact, own)?.rgba);
            let first = 4 * (row * SIZE_PX[0]) as usize;
            drawn.extend_from_slice(&drawing.rgba[first..first + 4 * SIZE_PX[0] as usize]);
        }
        let what = format!("{direction:?}, row by row: dB");
        let differences = drawn.iter().zip(&truth).map(|(a, b)| f64::from(a - b));
        trial.at_least(what, psnr_db(differences), 42.0);
    }
    Ok(())
}

/// Balls of 15 cm to 45 cm, 5 m to 20 m ahead: nothing that passes at 30 m/s is closer.
fn balls() -> Scene {
    let ball = |i: usize| {
        let [x, y, z, size, ..] = evenly(i);
        let away_m = 5.0 + 15.0 * z;
        Blob {
            mean_m: away_m * DVec3::new(1.4 * x - 0.7, 0.9 * y - 0.45, 1.0),
            sigma_m: DVec3::splat(0.15 + 0.3 * size),
            rgb: [x, y, z],
            ..Blob::default()
        }
    };
    scene(&(0..150).map(ball).collect::<Vec<_>>())
}
