//! Every opacity, what slips past the gate, the stop rule, and more layers than a driver counts.

use glam::DVec3;

use super::places::street_view;
use super::{Case, CaseRun, Run};
use wildcity_render::RenderError;
use wildcity_render::compare::gaussians::{GaussianSpec, forward_view, gaussians_of, scene_of};
use wildcity_render::compare::images::max_difference;
use wildcity_scene::{Gaussians, RenderProfile, Scene};

pub(super) const T11: Case = Case {
    number: "T11",
    what: "opacities of 0, 1/255, just around it, and 1; logits of ±100 and ±inf",
    bound: "agrees with f64; monotone; nothing below 1/255, at 1/255 that or nothing, at most the cap",
    run: Run::Light(t11),
};

fn t11(trial: &mut CaseRun<'_>) -> Result<(), RenderError> {
    let (profile, view) = (RenderProfile::default(), forward_view([65, 65], 100.0));
    let peak = |trial: &mut CaseRun<'_>, logit: f32| {
        let mut g = gaussians_of(&[GaussianSpec::default()]);
        g.logit_opacities[0] = logit;
        let scene = Scene::from_gaussians(&g);
        let drawing = trial.agreed(format!("logit {logit}"), &scene, &profile, view)?;
        Ok::<f32, RenderError>(drawing.opacity.iter().fold(0.0_f32, |most, &o| most.max(o)))
    };
    // ln(1/254) is the logit of 1/255: seen just above, not below.
    let cut = (1.0_f32 / 254.0).ln();
    let mut peaks = Vec::new();
    for logit in [f32::NEG_INFINITY, -100.0, -6.0, cut - 1e-3] {
        let most = peak(trial, logit)?;
        trial.at_most(format!("logit {logit}: opacity"), most.into(), 0.0);
        peaks.push(most);
    }
    // At the cut itself the last bit of a backend's arithmetic decides, between these two and no other.
    let at_cut = peak(trial, cut)?;
    let off = f64::from(at_cut).min((f64::from(at_cut) - 1.0 / 255.0).abs());
    trial.at_most("the logit of 1/255: off 0 and 1/255 by", off, 1e-7);
    peaks.push(at_cut);
    for logit in [cut + 1e-3, -5.0, 0.0, 2.0, 6.0, 100.0, f32::INFINITY] {
        peaks.push(peak(trial, logit)?);
    }
    trial.holds("1e-3 above the logit of 1/255: seen", peaks[5] > 0.0);
    trial.holds("monotone", peaks.is_sorted());
    let cap_off = f64::from(peaks[peaks.len() - 1]) - profile.alpha_cap;
    trial.at_most("logit inf: off the cap by", cap_off.abs(), 1e-6);
    Ok(())
}

pub(super) const T12: Case = Case {
    number: "T12",
    what: "NaN, infinity, no rotation and a colour of a million, injected past the gate",
    bound: "not drawn, neighbours within 1e-4 (the gate itself: tests/ingest)",
    run: Run::Light(t12),
};

fn t12(trial: &mut CaseRun<'_>) -> Result<(), RenderError> {
    let (good, view) = (wildcity_generate::canyon(2_000, &mut |_, _| {}), street_view([160, 100]));
    let profile = RenderProfile::default();
    let right = trial.draw(&Scene::from_gaussians(&good), &profile, view)?;
    let more = with_one_more(&good, [-18.0, 0.3, 1.6]);
    let seen = trial.draw(&Scene::from_gaussians(&more), &profile, view)?;
    let apart = max_difference(&seen.rgba, &right.rgba);
    trial.holds("unpoisoned, it is seen", apart > 0.1);
    for (poison, poisoned) in poisoned(&more) {
        let scene = Scene::from_gaussians(&poisoned);
        let drawing = trial.agreed(poison.clone(), &scene, &profile, view)?;
        // One place further, a Gaussian may be in the next cluster, whose colours have other steps on
        // a device: 1.5 / 32,767 of each coefficient.
        let off = max_difference(&drawing.rgba, &right.rgba);
        trial.at_most(format!("{poison}: neighbours off by"), off.into(), 1e-4);
    }
    Ok(())
}

/// The same Gaussians of SH degree 1, and one more before all others of the file: nearly opaque, of
/// 14 cm.
fn with_one_more(good: &Gaussians, mean_m: [f64; 3]) -> Gaussians {
    let mut more = good.clone();
    more.means_m.insert(0, mean_m);
    more.quats_wxyz.insert(0, [1.0, 0.0, 0.0, 0.0]);
    more.ln_scales.insert(0, [-2.0; 3]);
    more.logit_opacities.insert(0, 4.0);
    more.sh.splice(0..0, [1.0; 12]);
    more
}

type Poison = fn(&mut Gaussians, f32);

const POISONS: [(&str, Poison); 5] = [
    ("mean", |g, bad| g.means_m[0][1] = bad.into()),
    ("quaternion", |g, bad| g.quats_wxyz[0][2] = bad),
    ("scale", |g, bad| g.ln_scales[0][0] = bad),
    ("colour", |g, bad| g.sh[0] = bad),
    ("colour by direction", |g, bad| g.sh[4] = bad),
];

/// The same Gaussians with each poison in the first one, by name.
fn poisoned(more: &Gaussians) -> Vec<(String, Gaussians)> {
    let mut all = Vec::new();
    let mut add = |name: String, poison: &dyn Fn(&mut Gaussians)| {
        let mut poisoned = more.clone();
        poison(&mut poisoned);
        all.push((name, poisoned));
    };
    for (name, poison) in POISONS {
        for bad in [f32::NAN, f32::INFINITY] {
            add(format!("{name} {bad}"), &|g| poison(g, bad));
        }
    }
    add("opacity NaN".to_owned(), &|g| g.logit_opacities[0] = f32::NAN);
    add("colour of a million".to_owned(), &|g| g.sh[0] = 1e6);
    add("no rotation".to_owned(), &|g| g.quats_wxyz[0] = [0.0; 4]);
    all
}

pub(super) const T19: Case = Case {
    number: "T19",
    what: "layers whose transmittance lands on the stop, and layers at the cap; 10,000 of them",
    bound: "agrees with f64; the layer that would reach it is left out, within 1e-6",
    run: Run::Light(t19),
};

fn t19(trial: &mut CaseRun<'_>) -> Result<(), RenderError> {
    // Layers of alpha 0.9 at the centre: the transmittance is 0.1, 0.01, 0.001, then 1e-4: the
    // fourth would reach the stop and is left out. Ten thousand layers change nothing. Layers of opacity 1
    // are capped at 0.99: 0.01, then 1e-4, and no more than the cap's rounding to f32 off, 2e-6 of it.
    let layer = |i: i32| GaussianSpec {
        mean_m: DVec3::new(0.0, 0.0, 5.0 + 1e-3 * f64::from(i)),
        sigma_m: DVec3::splat(20.0),
        rgb: [1.0; 3],
        ..GaussianSpec::default()
    };
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
        let layers = scene_of(&(0..count).map(layer).collect::<Vec<_>>());
        let what = format!("{count} layers of {opacity}, stop {stop:e}");
        let drawing = trial.agreed(what.clone(), &layers, &profile, view)?;
        let off = (1.0 - f64::from(drawing.opacity[4 * 9 + 4]) - left).abs();
        trial.at_most(format!("{what}: transmittance off by"), off, 1e-6);
    }
    // Once stopped, a pixel stays stopped, though what follows would fit, and its neighbours go on.
    let dot = |i| GaussianSpec { sigma_m: DVec3::splat(0.015), ..layer(i) };
    let thin = |i| GaussianSpec { opacity: 0.1, ..layer(10 + i) };
    let layers = scene_of(&(0..4).map(dot).chain((0..50).map(thin)).collect::<Vec<_>>());
    let profile = RenderProfile { stop: 1.0001e-4, ..RenderProfile::default() };
    let drawing = trial.agreed("thin layers", &layers, &profile, view)?;
    let off = (1.0 - f64::from(drawing.opacity[4 * 9 + 4]) - 1e-3).abs();
    trial.at_most("thin layers: transmittance off by", off, 1e-5);
    Ok(())
}

pub(super) const T28: Case = Case {
    number: "T28",
    what: "70,000 layers of fog in one tile",
    bound: "agrees with f64, or a device refuses it with the number that fits (software Vulkan counts to 65,535)",
    run: Run::Light(t28),
};

fn t28(trial: &mut CaseRun<'_>) -> Result<(), RenderError> {
    let fog = (0..70_000).map(|i| GaussianSpec {
        mean_m: DVec3::new(0.0, 0.0, 5.0 + 1e-4 * f64::from(i)),
        // 80 px, so that all of the tile is just above the cut; no pixel stops before the last of them.
        sigma_m: DVec3::splat(100.0),
        opacity: 1.05 / 255.0,
        ..GaussianSpec::default()
    });
    let fog = scene_of(&fog.collect::<Vec<_>>());
    let profile = RenderProfile { stop: 1e-300, ..RenderProfile::default() };
    match trial.agreed("the fog", &fog, &profile, forward_view([16, 16], 4.0)) {
        Err(error) => trial.refused(error)?,
        Ok(drawing) => {
            let least = drawing.opacity.iter().fold(1.0_f32, |least, &o| least.min(o));
            trial.at_most("the fog lets through", 1.0 - f64::from(least), 1e-3);
        }
    }
    Ok(())
}
