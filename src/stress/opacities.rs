//! The whole range of opacities, invalid values, the stop rule, and more layers than the loop limit
//! of a software device.

use glam::DVec3;

use super::places::street_view;
use super::{Case, CaseBody, CaseRun};
use wildcity_render::RenderError;
use wildcity_render::compare::gaussians::{
    GaussianSpec, forward_view, gaussians_from_specs, scene_from_specs,
};
use wildcity_render::compare::images::max_difference;
use wildcity_scene::{Gaussians, RenderProfile, Scene};

pub(super) const T11: Case = Case {
    number: "T11",
    what: "opacities of 0, 1/255, just around it, and 1; logits of ±100 and ±inf",
    bound: "agrees with f64; monotone; 0 below 1/255, 0 or 1/255 at 1/255, at most the cap",
    body: CaseBody::Light(t11),
};

fn t11(run: &mut CaseRun<'_>) -> Result<(), RenderError> {
    let profile = RenderProfile::default();
    // An odd width: the centre of the middle pixel is the Gaussian's, where alpha is the whole
    // opacity.
    let view = forward_view([65, 65], 100.0);
    let peak = |run: &mut CaseRun<'_>, logit: f32| {
        // The logit is set afterwards, because a specification has opacities and no infinite
        // logits.
        let mut g = gaussians_from_specs(&[GaussianSpec::default()]);
        g.logit_opacities[0] = logit;
        let scene = Scene::from_gaussians(&g);
        let image = run.render_and_compare(format!("logit {logit}"), &scene, &profile, view)?;
        Ok::<f32, RenderError>(image.opacity.iter().fold(0.0_f32, |most, &o| most.max(o)))
    };
    // ln(1/254) is the logit of 1/255: visible just above it, and not below.
    let cut = (1.0_f32 / 254.0).ln();
    let mut peaks = Vec::new();
    for logit in [f32::NEG_INFINITY, -100.0, -6.0, cut - 1e-3] {
        let most = peak(run, logit)?;
        run.check_at_most(format!("logit {logit}: opacity"), most.into(), 0.0);
        peaks.push(most);
    }
    // At the cut itself the last bit of a backend's arithmetic decides between 0 and 1/255.
    let at_cut = peak(run, cut)?;
    let off = f64::from(at_cut).min((f64::from(at_cut) - 1.0 / 255.0).abs());
    run.check_at_most("the logit of 1/255: off 0 and 1/255 by", off, 1e-7);
    peaks.push(at_cut);
    for logit in [cut + 1e-3, -5.0, 0.0, 2.0, 6.0, 100.0, f32::INFINITY] {
        peaks.push(peak(run, logit)?);
    }
    // Four logits below the cut and the one at it come before.
    run.check("1e-3 above the logit of 1/255: seen", peaks[5] > 0.0);
    // A NaN has no order, so that the check fails for it as well.
    run.check("monotone", peaks.is_sorted());
    let cap_off = f64::from(peaks[peaks.len() - 1]) - profile.alpha_cap;
    run.check_at_most("logit inf: off the cap by", cap_off.abs(), 1e-6);
    Ok(())
}

pub(super) const T12: Case = Case {
    number: "T12",
    what: "NaN, infinity, a zero quaternion and a colour of a million, past the checks of import",
    bound: "not drawn, and the rest of the image within 1e-4 (import's checks: tests/ingest)",
    body: CaseBody::Light(t12),
};

fn t12(run: &mut CaseRun<'_>) -> Result<(), RenderError> {
    let good = wildcity_generate::canyon(2_000, &mut |_, _| {});
    let view = street_view([160, 100]);
    let profile = RenderProfile::default();
    let right = run.render(&Scene::from_gaussians(&good), &profile, view)?;
    // 2 m ahead of the camera of `street_view`.
    let more = with_one_more(&good, [-18.0, 0.3, 1.6]);
    let seen = run.render(&Scene::from_gaussians(&more), &profile, view)?;
    let apart = max_difference(&seen.rgba, &right.rgba);
    run.check("with valid values, it is seen", apart > 0.1);
    for (what, invalid) in invalidated(&more) {
        let scene = Scene::from_gaussians(&invalid);
        let image = run.render_and_compare(what.clone(), &scene, &profile, view)?;
        // With one Gaussian more, the others move by one index, and may be in the next cluster,
        // where colours are quantized in other steps on a device: 1.5 / 32,767 of each coefficient.
        let off = max_difference(&image.rgba, &right.rgba);
        run.check_at_most(format!("{what}: neighbours off by"), off.into(), 1e-4);
    }
    Ok(())
}

/// The same Gaussians, of SH degree 1, with one more before them: nearly opaque, with a standard
/// deviation of 14 cm.
fn with_one_more(good: &Gaussians, mean_m: [f64; 3]) -> Gaussians {
    // Before all others: it shifts the index of each of them by one.
    let mut more = good.clone();
    more.means_m.insert(0, mean_m);
    more.quats_wxyz.insert(0, [1.0, 0.0, 0.0, 0.0]);
    more.ln_scales.insert(0, [-2.0; 3]);
    more.logit_opacities.insert(0, 4.0);
    // Degree 1 has four coefficients of three channels.
    more.sh.splice(0..0, [1.0; 12]);
    more
}

/// Sets a field of the first Gaussian to an invalid value.
type Invalidate = fn(&mut Gaussians, f32);

const INVALIDATE: [(&str, Invalidate); 5] = [
    ("mean", |g, bad| g.means_m[0][1] = bad.into()),
    ("quaternion", |g, bad| g.quats_wxyz[0][2] = bad),
    ("scale", |g, bad| g.ln_scales[0][0] = bad),
    ("colour", |g, bad| g.sh[0] = bad),
    // The first three values are the constant coefficient; from the fourth on, colours depend on
    // the direction.
    ("colour by direction", |g, bad| g.sh[4] = bad),
];

/// The same Gaussians with each kind of invalid value in the first one, with its name.
fn invalidated(more: &Gaussians) -> Vec<(String, Gaussians)> {
    let mut all = Vec::new();
    let mut add = |name: String, edit: &dyn Fn(&mut Gaussians)| {
        let mut invalid = more.clone();
        edit(&mut invalid);
        all.push((name, invalid));
    };
    // Fields of each kind; opacities have a line of their own, because an infinite logit is valid.
    for (name, invalidate) in INVALIDATE {
        for bad in [f32::NAN, f32::INFINITY] {
            add(format!("{name} {bad}"), &|g| invalidate(g, bad));
        }
    }
    add("opacity NaN".to_owned(), &|g| g.logit_opacities[0] = f32::NAN);
    add("colour of a million".to_owned(), &|g| g.sh[0] = 1e6);
    add("no rotation".to_owned(), &|g| g.quats_wxyz[0] = [0.0; 4]);
    all
}

pub(super) const T19: Case = Case {
    number: "T19",
    what: "layers with a transmittance exactly at the stop, and layers at the cap; 10,000 of them",
    bound: "agrees with f64; the layer that would reach the stop is left out; within 1e-6",
    body: CaseBody::Light(t19),
};

fn t19(run: &mut CaseRun<'_>) -> Result<(), RenderError> {
    // Layers of alpha 0.9 at the centre: the transmittance becomes 0.1, 0.01, 0.001 and then 1e-4.
    // The fourth layer would reach the stop, and is left out; ten thousand more layers change
    // nothing. Layers of opacity 1 are capped at 0.99: 0.01, then 1e-4, off by no more than the
    // rounding of the cap to f32, 2e-6 of it.
    let layer = |i: i32| GaussianSpec {
        mean_m: DVec3::new(0.0, 0.0, 5.0 + 1e-3 * f64::from(i)),
        sigma_m: DVec3::splat(20.0),
        rgb: [1.0; 3],
        ..GaussianSpec::default()
    };
    // 9 px with a focal length of 1,000 px: layers of 20 m cover the image evenly.
    let view = forward_view([9, 9], 1000.0);
    for (count, opacity, stop, left) in [
        (3, 0.9, 1.0001e-4, 1e-3),
        (4, 0.9, 1.0001e-4, 1e-3),
        (10_000, 0.9, 1.0001e-4, 1e-3),
        (10_000, 0.9, 0.9999e-4, 1e-4),
        (1, 1.0, 1.0001e-4, 1e-2),
        (10_000, 1.0, 1.0001e-4, 1e-2),
        (10_000, 1.0, 0.9999e-4, 1e-4),
    ] {
        let profile = RenderProfile { stop, ..RenderProfile::default() };
        let layer = |i| GaussianSpec { opacity, ..layer(i) };
        let layers = scene_from_specs(&(0..count).map(layer).collect::<Vec<_>>());
        let what = format!("{count} layers of {opacity}, stop {stop:e}");
        let image = run.render_and_compare(what.clone(), &layers, &profile, view)?;
        let off = (1.0 - f64::from(image.opacity[4 * 9 + 4]) - left).abs();
        run.check_at_most(format!("{what}: transmittance off by"), off, 1e-6);
    }
    // A pixel that has stopped stays stopped, although thin layers that follow would not reach the
    // stop; its neighbours continue.
    let dot = |i| GaussianSpec { sigma_m: DVec3::splat(0.015), ..layer(i) };
    let thin = |i| GaussianSpec { opacity: 0.1, ..layer(10 + i) };
    let layers = scene_from_specs(&(0..4).map(dot).chain((0..50).map(thin)).collect::<Vec<_>>());
    let profile = RenderProfile { stop: 1.0001e-4, ..RenderProfile::default() };
    let image = run.render_and_compare("thin layers", &layers, &profile, view)?;
    let off = (1.0 - f64::from(image.opacity[4 * 9 + 4]) - 1e-3).abs();
    run.check_at_most("thin layers: transmittance off by", off, 1e-5);
    Ok(())
}

pub(super) const T28: Case = Case {
    number: "T28",
    what: "70,000 layers of fog in one tile",
    bound: "agrees with f64, or a device refuses it and names its limit (software Vulkan counts to 65,535)",
    body: CaseBody::Light(t28),
};

fn t28(run: &mut CaseRun<'_>) -> Result<(), RenderError> {
    let layers = (0..70_000).map(|i| GaussianSpec {
        mean_m: DVec3::new(0.0, 0.0, 5.0 + 1e-4 * f64::from(i)),
        // 80 px wide, so that alpha is just above the cut in the whole tile, and no pixel stops
        // before the last layer.
        sigma_m: DVec3::splat(100.0),
        opacity: 1.05 / 255.0,
        ..GaussianSpec::default()
    });
    let fog = scene_from_specs(&layers.collect::<Vec<_>>());
    let profile = RenderProfile { stop: 1e-300, ..RenderProfile::default() };
    match run.render_and_compare("the fog", &fog, &profile, forward_view([16, 16], 4.0)) {
        Err(error) => run.accept_limit(error)?,
        Ok(image) => {
            let least = image.opacity.iter().fold(1.0_f32, |least, &o| least.min(o));
            // 70,000 layers of 1.05 / 255 leave e^-288: the fog is opaque everywhere.
            run.check_at_most("the fog lets through", 1.0 - f64::from(least), 1e-3);
        }
    }
    Ok(())
}
