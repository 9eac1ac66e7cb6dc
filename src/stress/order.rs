//! Equal depths, duplicates, popping, and the largest number of sort keys.

use glam::{DQuat, DVec3};

use super::places::street_view;
use super::{Case, CaseBody, CaseRun};
use wildcity_render::compare::gaussians::{GaussianSpec, forward_view, scene_from_specs};
use wildcity_render::compare::images::{max_difference, view_along};
use wildcity_render::{RenderError, View};
use wildcity_scene::{Gaussians, RenderProfile, Scene};

pub(super) const T6: Case = Case {
    number: "T6",
    what: "two walls of duplicates in one plane",
    bound: "the lower id in front; byte-identical in 100 images",
    body: CaseBody::Light(t6),
};

fn t6(run: &mut CaseRun<'_>) -> Result<(), RenderError> {
    let grid = |rgb: [f64; 3]| {
        (0..100).map(move |i| GaussianSpec {
            mean_m: DVec3::new(0.1 * f64::from(i % 10), 0.1 * f64::from(i / 10), 5.0),
            rgb,
            ..GaussianSpec::default()
        })
    };
    let specs: Vec<GaussianSpec> = grid([1.0, 0.0, 0.0]).chain(grid([0.0, 1.0, 0.0])).collect();
    let scene = scene_from_specs(&specs);
    let profile = RenderProfile::default();
    let view = forward_view([200, 150], 150.0);
    let image = run.render_and_compare("the walls", &scene, &profile, view)?;
    // Row 80, column 110: within both walls, to the right of and below the image's centre.
    let center = 4 * (80 * 200 + 110);
    let [red, green] = [0, 1].map(|channel| image.rgba[center + channel]);
    run.check("the first of each pair is in front", red > green);
    let mut equal = true;
    // An order that depends on the timing of threads need not differ in the second image.
    for _ in 1..100 {
        equal &= run.render(&scene, &profile, view)? == image;
    }
    run.check("100 images have the same bytes", equal);
    Ok(())
}

pub(super) const T8: Case = Case {
    number: "T8",
    what: "a camera that rotates in place before two crossing ellipsoids (popping)",
    bound: "every frame agrees with f64; the largest jump is that of f64 within 2/255",
    body: CaseBody::Light(t8),
};

fn t8(run: &mut CaseRun<'_>) -> Result<(), RenderError> {
    // Half-way through the rotation the depth order of the two centres changes, and the image jumps
    // ("pops"), since whole Gaussians are sorted. The jump must be as large as that of the
    // reference backend.
    let bar = |angle: f64, x: f64, rgb| GaussianSpec {
        mean_m: DVec3::new(x, 0.0, 5.0),
        rotation: DQuat::from_rotation_y(angle),
        sigma_m: DVec3::new(1.0, 0.3, 0.1),
        rgb,
        ..GaussianSpec::default()
    };
    let crossing =
        scene_from_specs(&[bar(0.8, 0.02, [1.0, 0.2, 0.1]), bar(-0.8, -0.02, [0.1, 0.3, 1.0])]);
    let profile = RenderProfile::default();
    let mut pops = [0.0_f32; 2];
    let mut last = None;
    for step in -10..=10 {
        // From -0.5 to 0.5 degrees: the order changes at 0.
        let yaw = (0.05 * f64::from(step)).to_radians();
        let forward = DVec3::new(yaw.sin(), 0.0, yaw.cos());
        let view = view_along([160, 120], 150.0, DVec3::ZERO, forward, DVec3::Y);
        let image = run.render_and_compare(format!("step {step}"), &crossing, &profile, view)?;
        let truth = run.render_reference(&crossing, &profile, view)?;
        if let Some((image_before, truth_before)) = &last {
            let jump = |before: &Vec<f32>, now: &Vec<f32>| max_difference(before, now);
            pops[0] = pops[0].max(jump(image_before, &image.rgba));
            pops[1] = pops[1].max(jump(truth_before, &truth.rgba));
        }
        last = Some((image.rgba, truth.rgba));
    }
    let [pop, popped_truth] = pops.map(f64::from);
    // If nothing jumped, the bound below would hold in any order.
    run.check("it pops", pop > 0.1);
    let what = format!("pops by {pop:.3}, by definition {popped_truth:.3}: apart");
    run.check_at_most(what, (pop - popped_truth).abs(), 2.0 / 255.0);
    Ok(())
}

pub(super) const T20: Case = Case {
    number: "T20",
    what: "sort and scan over dozens of blocks, with the subgroup size of the device",
    bound: "agrees with f64 (4, 8 and 16 threads: tests/gpu/determinism.rs)",
    body: CaseBody::Light(t20),
};

fn t20(run: &mut CaseRun<'_>) -> Result<(), RenderError> {
    let street = Scene::from_gaussians(&wildcity_generate::canyon(60_000, &mut |_, _| {}));
    run.render_and_compare(
        "a street",
        &street,
        &RenderProfile::default(),
        street_view([240, 135]),
    )?;
    Ok(())
}

pub(super) const T21: Case = Case {
    number: "T21",
    what: "70 million sort keys in one frame",
    bound: "sixteen views equal to each view alone, one of them as f64; or a device refuses it and names its limit",
    body: CaseBody::Heavy(t21),
};

/// Sixteen views of 4,400,000 Gaussians in one frame, and each view alone.
fn t21(run: &mut CaseRun<'_>) -> Result<(), RenderError> {
    // In sixteen views 70.4 million keys.
    let n = 4_400_000;
    let mut dust = Gaussians::with_capacity(0, n);
    for i in 0..n {
        let [x, y, z, red, green, blue] = low_discrepancy(i);
        let z_m = 5.0 + 100.0 * z;
        // The positions fill the view's pyramid, so that every Gaussian makes keys in every view.
        dust.means_m.push([0.8 * (x - 0.5) * z_m, 0.8 * (y - 0.5) * z_m, z_m]);
        dust.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
        dust.ln_scales.push([-4.0; 3]);
        // An opacity of 1.7 / 255: above the cut, without which there would be no key.
        dust.logit_opacities.push(-5.0);
        dust.sh.extend([red, green, blue].map(|c| (2.0 * c - 1.0) as f32));
    }
    let scene = Scene::from_gaussians(&dust);
    // The scene has copies of all values. Both together would double the memory of the case.
    drop(dust);
    let views: Vec<View> = (0..16)
        .map(|i| {
            // Few pixels, since the keys are under test, and the reference backend draws all
            // Gaussians of one view.
            view_along([16, 16], 15.0, DVec3::new(0.0, 0.0, 0.1 * f64::from(i)), DVec3::Z, DVec3::Y)
        })
        .collect();
    let profile = RenderProfile::default();
    let together = match run.render_all(&scene, &profile, &views) {
        Ok(together) => together,
        Err(error) => return run.accept_limit(error),
    };
    for (index, (view, image)) in views.iter().zip(&together).enumerate() {
        let alone = run.render(&scene, &profile, *view)?;
        run.check(format!("view {index} as alone"), alone == *image);
    }
    let truth = run.render_reference(&scene, &profile, views[7])?;
    run.check_agreement("view 7", &together[7], &truth);
    Ok(())
}

pub(super) const T27: Case = Case {
    number: "T27",
    what: "thousands of surfels of one facade perpendicular to the view",
    bound: "agrees with f64: surfels are ordered by depth and id, not by rounding errors",
    body: CaseBody::Light(t27),
};

fn t27(run: &mut CaseRun<'_>) -> Result<(), RenderError> {
    // All depths are equal in exact arithmetic, and differ as sums in f32.
    let turn = DQuat::from_rotation_y(0.7) * DQuat::from_rotation_x(0.3);
    let surfels = (0..4_000).map(|i| {
        let [x, y, red, green, blue, _] = low_discrepancy(i);
        GaussianSpec {
            mean_m: turn * DVec3::new(8.0 * x - 4.0, 6.0 * y - 3.0, 5.0)
                + DVec3::new(21.3, 17.7, 9.1),
            rotation: turn,
            sigma_m: DVec3::new(0.15, 0.15, 0.002),
            opacity: 0.7,
            rgb: [red, green, blue],
        }
    });
    let facade = scene_from_specs(&surfels.collect::<Vec<_>>());
    let mut view = forward_view([240, 180], 180.0);
    view.world_from_camera.position_m = DVec3::new(21.3, 17.7, 9.1);
    view.world_from_camera.rotation = turn;
    let profile = RenderProfile::default();
    let image = run.render_and_compare("the facade", &facade, &profile, view)?;
    run.check("it is covered", image.opacity.iter().all(|&o| o > 0.5));
    Ok(())
}

/// A low-discrepancy sequence in [0, 1)⁶: multiples of powers of the root of x⁷ = x + 1, modulo 1
/// (Roberts 2018).
pub(super) fn low_discrepancy(i: usize) -> [f64; 6] {
    // i + 1, because the first multiple would be 0 for every power.
    [1, 2, 3, 4, 5, 6].map(|power| (0.5 + (i + 1) as f64 * 1.112_775_684_f64.powi(-power)).fract())
}
