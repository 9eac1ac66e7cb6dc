//! Needles, dust, walls, and Gaussians beside the view.

use glam::{DQuat, DVec3};

use super::{Case, CaseBody, CaseRun};
use wildcity_render::RenderError;
use wildcity_render::compare::gaussians::{GaussianSpec, forward_view, scene_from_specs};
use wildcity_render::compare::images::max_difference;
use wildcity_render::constants::TILE_PX;
use wildcity_scene::RenderProfile;

pub(super) const T1: Case = Case {
    number: "T1",
    what: "needles of 1,000 to 10,000 px, all angles",
    bound: "opacity within 2e-3 of f64, except for 1/255 where only one finds it above the cut; none culled",
    body: CaseBody::Light(t1),
};

fn t1(run: &mut CaseRun<'_>) -> Result<(), RenderError> {
    let profile = RenderProfile::default();
    let view = forward_view([320, 240], 500.0);
    for sigma_px in [1e3, 3e3, 1e4] {
        // After half a turn a needle looks as before.
        for degrees in (0..180).step_by(2) {
            let needle = scene_from_specs(&[GaussianSpec {
                rotation: DQuat::from_rotation_z(f64::from(degrees).to_radians()),
                // 5 m at 500 px: a standard deviation of `sigma_px` pixels.
                // Across, 0.1 mm are 0.01 px: the blur alone makes the width.
                sigma_m: DVec3::new(sigma_px * 5.0 / 500.0, 1e-4, 1e-4),
                ..GaussianSpec::default()
            }]);
            let image = run.render(&needle, &profile, view)?;
            let what = format!("{sigma_px} px at {degrees}°");
            run.check(format!("{what}: seen"), image.opacity.iter().any(|&o| o > 0.5));
            if !run.is_reference() {
                let truth = run.render_reference(&needle, &profile, view)?;
                let [drawn, decided] = apart(&image.opacity, &truth.opacity);
                run.check_at_most(format!("{what}: opacity off by"), drawn, 2e-3);
                run.check_at_most(format!("{what}: the cut off by"), decided, 1.01 / 255.0);
            }
        }
    }
    Ok(())
}

/// The largest difference where both opacities are above 0, and where only one is.
fn apart(a: &[f32], b: &[f32]) -> [f64; 2] {
    // Pixels on which one backend finds alpha above the cut and the other does not are judged
    // apart: there the difference is at least 1/255.
    let both = |(a, b): &(&f32, &f32)| (**a > 0.0) == (**b > 0.0);
    let most = |is_both: bool| {
        let pairs = a.iter().zip(b).filter(|pair| both(pair) == is_both);
        let (a, b): (Vec<f32>, Vec<f32>) = pairs.map(|(a, b)| (*a, *b)).unzip();
        f64::from(max_difference(&a, &b))
    };
    [most(true), most(false)]
}

pub(super) const T2: Case = Case {
    number: "T2",
    what: "centres beside the image, long enough to reach into it",
    bound: "agrees with f64 (70 dB, 2/255)",
    body: CaseBody::Light(t2),
};

fn t2(run: &mut CaseRun<'_>) -> Result<(), RenderError> {
    let profile = RenderProfile::default();
    let mut some_seen = false;
    for [x, y] in [[6.0, 1.6], [-6.0, 1.6], [0.5, 7.0], [9.0, -7.0]] {
        for angle in [0.0, 0.5, 1.2, 2.5] {
            let long = scene_from_specs(&[GaussianSpec {
                mean_m: DVec3::new(x, y, 4.0),
                rotation: DQuat::from_rotation_y(angle),
                sigma_m: DVec3::new(4.0, 0.05, 0.3),
                ..GaussianSpec::default()
            }]);
            let what = format!("({x}, {y}) m at {angle} rad");
            let image =
                run.render_and_compare(what, &long, &profile, forward_view([320, 240], 200.0))?;
            some_seen |= image.opacity.iter().any(|&o| o > 0.5);
        }
    }
    run.check("some reach into the image", some_seen);
    Ok(())
}

pub(super) const T3: Case = Case {
    number: "T3",
    what: "splats larger than the screen",
    bound: "agrees with f64; covers every pixel evenly; once in the list of each tile",
    body: CaseBody::Light(t3),
};

fn t3(run: &mut CaseRun<'_>) -> Result<(), RenderError> {
    let profile = RenderProfile::default();
    for sigma_m in [10.0, 1e3, 1e4] {
        let wall = GaussianSpec { sigma_m: DVec3::splat(sigma_m), ..GaussianSpec::default() };
        let what = format!("{sigma_m} m");
        let view = forward_view([333, 250], 300.0);
        let image =
            run.render_and_compare(what.clone(), &scene_from_specs(&[wall]), &profile, view)?;
        let off = image.opacity.iter().fold(0.0_f32, |most, o| most.max((o - 0.9).abs()));
        run.check_at_most(format!("{what}: opacity from 0.9"), off.into(), 0.15);
        // Forty walls on the 4 x 5 macro tiles of a device, so that a whole workgroup lists them.
        let specs = (0..40_u32).map(|i| GaussianSpec {
            mean_m: DVec3::new(0.1 * f64::from(i), 0.0, 5.0 + 0.1 * f64::from(i)),
            // 0.97^40 = 0.30 of the light is left, so that no pixel stops before the last wall.
            opacity: 0.03,
            ..wall
        });
        let walls = scene_from_specs(&specs.collect::<Vec<_>>());
        let what = format!("forty of {sigma_m} m");
        let view = forward_view([444, 280], 300.0);
        run.render_and_compare(what.clone(), &walls, &profile, view)?;
        // The reference backend has no tiles.
        if !run.is_reference() {
            let tiles = 444_u32.div_ceil(TILE_PX) * 280_u32.div_ceil(TILE_PX);
            let listed = run.stats(&walls, &profile, view)?.instances;
            let off = listed.abs_diff(u64::from(40 * tiles));
            run.check_at_most(
                format!("{what}: off once in the list of each tile by"),
                off as f64,
                0.0,
            );
        }
    }
    Ok(())
}

pub(super) const T13: Case = Case {
    number: "T13",
    what: "scales of 1e-8 m, ratios of 1e6",
    bound: "as wide as the blur: agrees with f64; the opacity at the centre is kept within 1e-4",
    body: CaseBody::Light(t13),
};

fn t13(run: &mut CaseRun<'_>) -> Result<(), RenderError> {
    let profile = RenderProfile::default();
    for sigma_m in [DVec3::splat(1e-8), DVec3::new(1.0, 1e-6, 1e-6), DVec3::new(1e-8, 1e-2, 1e-8)] {
        let thin = scene_from_specs(&[GaussianSpec { sigma_m, ..GaussianSpec::default() }]);
        run.render_and_compare(
            format!("{sigma_m} m"),
            &thin,
            &profile,
            forward_view([96, 96], 120.0),
        )?;
    }
    let dust = scene_from_specs(&[GaussianSpec {
        sigma_m: DVec3::splat(1e-8),
        ..GaussianSpec::default()
    }]);
    let image = run.render_and_compare("dust", &dust, &profile, forward_view([9, 9], 100.0))?;
    // The middle of an image of 9 px is the centre of a pixel, where alpha is the full opacity.
    let off = (image.opacity[4 * 9 + 4] - 0.9).abs();
    run.check_at_most("dust: its centre's opacity from 0.9", off.into(), 1e-4);
    Ok(())
}

pub(super) const T26: Case = Case {
    number: "T26",
    what: "a needle of two thousand million pixels",
    bound: "agrees with f64",
    body: CaseBody::Light(t26),
};

fn t26(run: &mut CaseRun<'_>) -> Result<(), RenderError> {
    // A standard deviation of 22 km along and 1 mm across, 1 cm ahead of a camera with a focal
    // length of 1,000 px: xx² is 1e37.
    for angle in [0.0, 0.4, 0.8, 1.3] {
        let needle = scene_from_specs(&[GaussianSpec {
            mean_m: DVec3::new(0.0, 0.0, 0.0101),
            rotation: DQuat::from_rotation_z(angle),
            sigma_m: DVec3::new(2.2e4, 1e-3, 1e-3),
            ..GaussianSpec::default()
        }]);
        let what = format!("at {angle} rad");
        let view = forward_view([160, 120], 1000.0);
        let image = run.render_and_compare(what, &needle, &RenderProfile::default(), view)?;
        let seen = image.opacity.iter().any(|&o| o > 0.5);
        run.check(format!("at {angle} rad: seen"), seen);
    }
    Ok(())
}
