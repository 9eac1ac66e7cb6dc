//! Equal depths, duplicates, popping, and as many keys as a sort ever sees.

use glam::{DQuat, DVec3};

use super::places::street_view;
use super::{Case, CaseRun, Run};
use wildcity_render::compare::gaussians::{GaussianSpec, forward_view, scene_of};
use wildcity_render::compare::images::{max_difference, view_along};
use wildcity_render::{RenderError, View};
use wildcity_scene::{Gaussians, RenderProfile, Scene};

pub(super) const T6: Case = Case {
    number: "T6",
    what: "two walls of duplicates in one plane",
    bound: "the lower id in front; the same bytes 100 times",
    run: Run::Light(t6),
};

fn t6(trial: &mut CaseRun<'_>) -> Result<(), RenderError> {
    let grid = |rgb: [f64; 3]| {
        (0..100).map(move |i| GaussianSpec {
            mean_m: DVec3::new(0.1 * f64::from(i % 10), 0.1 * f64::from(i / 10), 5.0),
            rgb,
            ..GaussianSpec::default()
        })
    };
    let blobs: Vec<GaussianSpec> = grid([1.0, 0.0, 0.0]).chain(grid([0.0, 1.0, 0.0])).collect();
    let (scene, profile, view) =
        (scene_of(&blobs), RenderProfile::default(), forward_view([200, 150], 150.0));
    let drawing = trial.agreed("the walls", &scene, &profile, view)?;
    let center = 4 * (80 * 200 + 110);
    let [red, green] = [0, 1].map(|channel| drawing.rgba[center + channel]);
    trial.holds("the first of each pair is in front", red > green);
    let mut equal = true;
    for _ in 1..100 {
        equal &= trial.draw(&scene, &profile, view)? == drawing;
    }
    trial.holds("100 drawings have the same bytes", equal);
    Ok(())
}

pub(super) const T8: Case = Case {
    number: "T8",
    what: "a turn on the spot before two crossing ellipsoids",
    bound: "every frame agrees with f64; what pops is what f64 pops within 2/255",
    run: Run::Light(t8),
};

fn t8(trial: &mut CaseRun<'_>) -> Result<(), RenderError> {
    // Their centres change places in depth in the middle of the turn: there one image jumps to another,
    // since whole Gaussians are sorted. It is measured, and it is no more than the definition's.
    let bar = |angle: f64, x: f64, rgb| GaussianSpec {
        mean_m: DVec3::new(x, 0.0, 5.0),
        rotation: DQuat::from_rotation_y(angle),
        sigma_m: DVec3::new(1.0, 0.3, 0.1),
        rgb,
        ..GaussianSpec::default()
    };
    let crossing = scene_of(&[bar(0.8, 0.02, [1.0, 0.2, 0.1]), bar(-0.8, -0.02, [0.1, 0.3, 1.0])]);
    let profile = RenderProfile::default();
    let (mut pops, mut last) = ([0.0_f32; 2], None);
    for step in -10..=10 {
        let yaw = (0.05 * f64::from(step)).to_radians();
        let forward = DVec3::new(yaw.sin(), 0.0, yaw.cos());
        let view = view_along([160, 120], 150.0, DVec3::ZERO, forward, DVec3::Y);
        let drawing = trial.agreed(format!("step {step}"), &crossing, &profile, view)?;
        let truth = trial.truth(&crossing, &profile, view)?;
        if let Some((drawing_before, truth_before)) = &last {
            let jump = |before: &Vec<f32>, now: &Vec<f32>| max_difference(before, now);
            pops[0] = pops[0].max(jump(drawing_before, &drawing.rgba));
            pops[1] = pops[1].max(jump(truth_before, &truth.rgba));
        }
        last = Some((drawing.rgba, truth.rgba));
    }
    let [pop, popped_truth] = pops.map(f64::from);
    trial.holds("it pops", pop > 0.1);
    let what = format!("pops by {pop:.3}, by definition {popped_truth:.3}: apart");
    trial.at_most(what, (pop - popped_truth).abs(), 2.0 / 255.0);
    Ok(())
}

pub(super) const T20: Case = Case {
    number: "T20",
    what: "sort and scan over dozens of blocks, in the subgroups that the device has",
    bound: "agrees with f64 (4, 8 and 16 threads: tests/gpu/determinism.rs)",
    run: Run::Light(t20),
};

fn t20(trial: &mut CaseRun<'_>) -> Result<(), RenderError> {
    let street = Scene::from_gaussians(&wildcity_generate::canyon(60_000, &mut |_, _| {}));
    trial.agreed("a street", &street, &RenderProfile::default(), street_view([240, 135]))?;
    Ok(())
}

pub(super) const T21: Case = Case {
    number: "T21",
    what: "70 million sort keys in one frame",
    bound: "sixteen views as each of them alone, one of them as f64; or a device refuses it with the number that fits",
    run: Run::Heavy(t21),
};

/// Sixteen views of 4,400,000 Gaussians each, and each of them alone.
fn t21(trial: &mut CaseRun<'_>) -> Result<(), RenderError> {
    let n = 4_400_000;
    let mut dust = Gaussians::with_capacity(0, n);
    for i in 0..n {
        let [x, y, z, red, green, blue] = evenly(i);
        let z_m = 5.0 + 100.0 * z;
        dust.means_m.push([0.8 * (x - 0.5) * z_m, 0.8 * (y - 0.5) * z_m, z_m]);
        dust.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
        dust.ln_scales.push([-4.0; 3]);
        dust.logit_opacities.push(-5.0);
        dust.sh.extend([red, green, blue].map(|c| (2.0 * c - 1.0) as f32));
    }
    let scene = Scene::from_gaussians(&dust);
    drop(dust);
    let views: Vec<View> = (0..16)
        .map(|i| {
            view_along([16, 16], 15.0, DVec3::new(0.0, 0.0, 0.1 * f64::from(i)), DVec3::Z, DVec3::Y)
        })
        .collect();
    let profile = RenderProfile::default();
    let together = match trial.draw_all(&scene, &profile, &views) {
        Ok(together) => together,
        Err(error) => return trial.refused(error),
    };
    for (index, (view, drawing)) in views.iter().zip(&together).enumerate() {
        let alone = trial.draw(&scene, &profile, *view)?;
        trial.holds(format!("view {index} as alone"), alone == *drawing);
    }
    let truth = trial.truth(&scene, &profile, views[7])?;
    trial.compare("view 7", &together[7], &truth);
    Ok(())
}

pub(super) const T27: Case = Case {
    number: "T27",
    what: "thousands of surfels of one facade that the camera faces head-on",
    bound: "agrees with f64: their order is that of depths, not of rounding errors",
    run: Run::Light(t27),
};

fn t27(trial: &mut CaseRun<'_>) -> Result<(), RenderError> {
    // A facade that the camera faces exactly: all depths are equal, and as sums of f32 they are not.
    let turn = DQuat::from_rotation_y(0.7) * DQuat::from_rotation_x(0.3);
    let surfels = (0..4_000).map(|i| {
        let [x, y, red, green, blue, _] = evenly(i);
        GaussianSpec {
            mean_m: turn * DVec3::new(8.0 * x - 4.0, 6.0 * y - 3.0, 5.0)
                + DVec3::new(21.3, 17.7, 9.1),
            rotation: turn,
            sigma_m: DVec3::new(0.15, 0.15, 0.002),
            opacity: 0.7,
            rgb: [red, green, blue],
        }
    });
    let facade = scene_of(&surfels.collect::<Vec<_>>());
    let mut view = forward_view([240, 180], 180.0);
    view.world_from_camera.position_m = DVec3::new(21.3, 17.7, 9.1);
    view.world_from_camera.rotation = turn;
    let profile = RenderProfile::default();
    let drawing = trial.agreed("the facade", &facade, &profile, view)?;
    trial.holds("it is covered", drawing.opacity.iter().all(|&o| o > 0.5));
    Ok(())
}

/// Six fractions that fill [0, 1)⁶ evenly: multiples of powers of the root of x⁷ = x + 1 (Roberts 2018).
pub(super) fn evenly(i: usize) -> [f64; 6] {
    [1, 2, 3, 4, 5, 6].map(|power| (0.5 + (i + 1) as f64 * 1.112_775_684_f64.powi(-power)).fract())
}
