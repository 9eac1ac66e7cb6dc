//! Actors: Gaussians that move and rotate as one.

use glam::{DQuat, DVec3};

use super::order::low_discrepancy;
use super::{Case, CaseBody, CaseRun};
use wildcity_render::RenderError;
use wildcity_render::compare::gaussians::{GaussianSpec, forward_view, gaussians_of};
use wildcity_render::compare::images::max_difference;
use wildcity_scene::geometry::Pose;
use wildcity_scene::{Gaussians, RenderProfile, Scene, sh};

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
        // A device quantizes each of 16 coefficients in steps of 1/32,767 of the largest one of its cluster
        // of 256, which is below 5e-4 in sum. The other backends keep f32.
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
    let mut actor = gaussians_of(&balls.collect::<Vec<_>>());
    actor.raise_sh_degree(3);
    for (i, colour) in actor.sh.chunks_exact_mut(3 * sh::coefficients(3)).enumerate() {
        for (k, value) in colour[3..].iter_mut().enumerate() {
            *value = (0.4 * (low_discrepancy(i * 45 + k)[3] - 0.5)) as f32;
        }
    }
    actor
}
