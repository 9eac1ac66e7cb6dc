//! Actors: Gaussians that move and rotate as one.

use std::sync::Arc;

use glam::{DQuat, DVec3};

use super::order::low_discrepancy;
use super::{Case, CaseBody, CaseRun};
use wildcity_render::compare::gaussians::{GaussianSpec, forward_view, gaussians_from_specs};
use wildcity_render::compare::images::{RenderedImage, max_difference};
use wildcity_render::compare::psnr::psnr_db;
use wildcity_render::{RenderError, RollingShutter, View};
use wildcity_scene::actor::PlacedChunk;
use wildcity_scene::geometry::Pose;
use wildcity_scene::geometry::camera::ShutterDirection;
use wildcity_scene::{Gaussians, Rays, RenderProfile, Scene, sh};

pub(super) const T25: Case = Case {
    number: "T25",
    what: "colours of SH degree 3 that rotate with their actor",
    bound: "equal to a camera that rotates the other way, within 5e-4; agrees with f64",
    body: CaseBody::Light(t25),
};

fn t25(run: &mut CaseRun<'_>) -> Result<(), RenderError> {
    let actor = actor();
    let profile = RenderProfile::default();
    let view = forward_view([160, 120], 150.0);
    let still =
        run.render_and_compare("the actor", &Scene::from_gaussians(&actor), &profile, view)?;
    // A case in which nothing is seen would hold for any error: each one states that something is.
    run.check("seen", still.opacity.iter().any(|&o| o > 0.9));
    for (what, turn) in [
        ("turned about y", DQuat::from_rotation_y(1.1)),
        ("turned about all", DQuat::from_rotation_x(2.5) * DQuat::from_rotation_z(0.4)),
    ] {
        // The actor and the camera rotate alike about the origin, so the image must not change.
        let mut turned = actor.clone();
        turned.transform(&Pose { rotation: turn, ..Pose::IDENTITY });
        let turned = Scene::from_gaussians(&turned);
        let mut moved = view;
        moved.world_from_camera.rotation = turn * view.world_from_camera.rotation;
        let image = run.render_and_compare(what, &turned, &profile, moved)?;
        let off = max_difference(&still.rgba, &image.rgba);
        // A device quantizes each of 16 coefficients in steps of 1/32,767 of the largest one of its
        // cluster of 256, which is below 5e-4 in sum. The other backends keep f32.
        run.check_at_most(format!("{what}: off by"), off.into(), 5e-4);
    }
    Ok(())
}

/// Sixty balls of SH degree 3, 4 to 6 m ahead.
fn actor() -> Gaussians {
    let balls = (0..60).map(|i| {
        let [x, y, z, ..] = low_discrepancy(i);
        GaussianSpec {
            mean_m: DVec3::new(2.0 * x - 1.0, 1.6 * y - 0.8, 4.0 + 2.0 * z),
            sigma_m: DVec3::new(0.3, 0.1, 0.2),
            rotation: DQuat::from_rotation_y(6.0 * x),
            ..GaussianSpec::default()
        }
    });
    let mut actor = gaussians_from_specs(&balls.collect::<Vec<_>>());
    actor.raise_sh_degree(3);
    // 16 coefficients of 3 channels; the first is DC and keeps the colour of the specification.
    for (i, colour) in actor.sh.chunks_exact_mut(3 * sh::coefficients(3)).enumerate() {
        for (k, value) in colour[3..].iter_mut().enumerate() {
            // 45 values for each Gaussian: 15 coefficients beyond DC, of 3 channels. They are from
            // -0.2 to 0.2.
            *value = (0.4 * (low_discrepancy(i * 45 + k)[3] - 0.5)) as f32;
        }
    }
    actor
}

pub(super) const T29: Case = Case {
    number: "T29",
    what: "actors around the camera, under a road, 1,000 m away, and overlapping one another",
    bound: "agrees with f64; at least 60 dB against the same Gaussians within the scene",
    body: CaseBody::Light(t29),
};

fn t29(run: &mut CaseRun<'_>) -> Result<(), RenderError> {
    let profile = RenderProfile::default();
    let road = road();
    let turned = |yaw_rad: f64| DQuat::from_rotation_y(yaw_rad) * DQuat::from_rotation_x(0.3);
    let pose = |x: f64, y: f64, z: f64, yaw_rad: f64| Pose {
        position_m: DVec3::new(x, y, z),
        rotation: turned(yaw_rad),
    };
    // The balls of an actor are 4 to 6 m from its origin.
    let places: [(&str, f64, Vec<Pose>); 4] = [
        // Turned, the middle of the balls is 0.6 m ahead of the camera.
        ("around the camera", 120.0, vec![pose(-0.48, 1.48, -4.15, 0.1)]),
        ("under the road", 120.0, vec![pose(0.0, 5.0, 3.0, 0.6)]),
        ("1,000 m away", 20_000.0, vec![pose(300.0, 0.0, 1_000.0, 2.0)]),
        ("overlapping", 120.0, vec![pose(0.0, 0.0, 2.0, 0.2), pose(0.3, 0.0, 2.2, 0.5)]),
    ];
    let actor = actor();
    for (what, focal_px, poses) in places {
        let mut view = forward_view([160, 120], focal_px);
        if focal_px > 1_000.0 {
            let toward = poses[0].transform_point(DVec3::new(0.0, 0.0, 5.0)).normalize();
            view.world_from_camera.rotation = DQuat::from_rotation_arc(DVec3::Z, toward);
        }
        let (placed, merged) = placed_and_merged(&road, &actor, &poses);
        let image = run.render_and_compare(what, &placed, &profile, view)?;
        let truth = run.render(&merged, &profile, view)?;
        run.check_at_least_db(
            format!("{what}: as within the scene, dB"),
            image_psnr_db(&image, &truth),
            60.0,
        );
        let alone = run.render(&Scene::from_gaussians(&road), &profile, view)?;
        let seen = max_difference(&image.rgba, &alone.rgba) > 0.1;
        // The road hides the actor below it, and the actor must not shine through.
        run.check(format!("{what}: the actor is seen"), seen == (what != "under the road"));
    }
    Ok(())
}

pub(super) const T30: Case = Case {
    number: "T30",
    what: "actors at 30 m/s across a rolling shutter of 30 ms: a camera at rest, and one that drives along",
    bound: "agrees with f64; at least 38 dB against exact rays at each row's moment; at least 60 dB between an actor \
            that keeps pace and both at rest",
    body: CaseBody::Light(t30),
};

fn t30(run: &mut CaseRun<'_>) -> Result<(), RenderError> {
    let profile = RenderProfile::default();
    let exact = RenderProfile { rays: Rays::Exact, ..profile };
    // 30 m/s for 30 ms are 0.9 m.
    let across_m = DVec3::new(0.9, 0.0, 0.0);
    let actor = actor();
    let (at_rest, _) = placed_and_merged(&Gaussians::default(), &actor, &[Pose::IDENTITY]);
    let mut moving = at_rest.clone();
    moving.placed[0].world_from_actor_at_start.position_m = -across_m;
    let direction = ShutterDirection::TopToBottom;
    let still = forward_view([96, 64], 60.0);
    // A readout without a motion of the camera: rows are exposed in turn, and only the actor moves.
    let view = View { readout: Some(direction), ..still };

    // The camera at rest.
    let image = run.render_and_compare("across", &moving, &profile, view)?;
    let truth = run.render_reference(&moving, &exact, view)?;
    run.check_at_least_db("across: exact rays, dB", image_psnr_db(&image, &truth), 38.0);

    // The camera drives along: nothing moves.
    let mut first = view.world_from_camera;
    first.position_m -= across_m;
    let rolling_shutter = Some(RollingShutter { direction, world_from_camera_first: first });
    let along = View { rolling_shutter, ..view };
    let image = run.render_and_compare("along", &moving, &profile, along)?;
    let truth = run.render(&at_rest, &profile, still)?;
    run.check_at_least_db("along: as at rest, dB", image_psnr_db(&image, &truth), 60.0);
    Ok(())
}

/// An actor at some poses in a scene, and the same Gaussians within it.
fn placed_and_merged(scene: &Gaussians, actor: &Gaussians, poses: &[Pose]) -> (Scene, Scene) {
    let chunk = Arc::new(Scene::single_chunk(actor));
    let mut merged = scene.clone();
    let mut placed = Scene::from_gaussians(scene);
    for (index, pose) in poses.iter().enumerate() {
        let mut moved = actor.clone();
        moved.transform(pose);
        merged.append(&moved);
        placed.placed.push(PlacedChunk::at_rest(Arc::clone(&chunk), *pose, index as u16));
    }
    (placed, Scene::from_gaussians(&merged))
}

/// A closed road below the camera (y down), 8 m wide and 30 m long.
fn road() -> Gaussians {
    let surfel = |i: usize| GaussianSpec {
        // 80 columns and 300 rows, 10 cm apart; with a standard deviation of 8 cm they leave no
        // gap.
        mean_m: DVec3::new(0.1 * (i % 80) as f64 - 4.0, 1.5, 1.0 + 0.1 * (i / 80) as f64),
        sigma_m: DVec3::new(0.08, 0.004, 0.08),
        opacity: 0.99,
        rgb: [0.4, 0.4, 0.45],
        ..GaussianSpec::default()
    };
    gaussians_from_specs(&(0..80 * 300).map(surfel).collect::<Vec<_>>())
}

fn image_psnr_db(image: &RenderedImage, truth: &RenderedImage) -> f64 {
    psnr_db(image.rgba.iter().zip(&truth.rgba).map(|(a, b)| f64::from(a - b)))
}
