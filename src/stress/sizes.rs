//! Nothing at all, one pixel, 8K, buffers that must grow, and crops.

use glam::DVec3;

use super::order::evenly;
use super::places::street_view;
use super::{Case, CaseRun, Run};
use wildcity_render::RenderError;
use wildcity_render::compare::gaussians::{GaussianSpec, forward_view, scene_of};
use wildcity_render::compare::images::{crop_rgba, crop_view, max_difference};
use wildcity_scene::{RenderProfile, Scene};

pub(super) const T14: Case = Case {
    number: "T14",
    what: "splats that end on the edges of tiles, an ulp this way or that",
    bound: "agrees with f64; the same bytes 20 times: no slot that was counted and not written",
    run: Run::Light(t14),
};

fn t14(trial: &mut CaseRun<'_>) -> Result<(), RenderError> {
    // At 5 m and 160 px focal length a centre of 0.5 m x k lies on the edge of a tile of 16 px, and
    // reaches 16 px and so the next edge with a sigma of 16 px / √(2 ln(255 · 0.9)).
    let exact_m = 16.0 * 5.0 / 160.0 / (2.0 * (255.0_f64 * 0.9).ln()).sqrt();
    let splats = (0..800_i32).map(|i| {
        let ulps = f64::from(i % 41 - 20) * f64::from(f32::EPSILON);
        let [x, y] = [f64::from(i % 16 - 8), f64::from(i / 16 % 10 - 5)];
        GaussianSpec {
            mean_m: DVec3::new(0.5 * x * (1.0 + ulps), 0.5 * y, 5.0),
            sigma_m: DVec3::splat(exact_m * (1.0 + ulps)),
            ..GaussianSpec::default()
        }
    });
    let splats = scene_of(&splats.collect::<Vec<_>>());
    let (profile, view) = (RenderProfile::default(), forward_view([256, 160], 160.0));
    let drawing = trial.agreed("edges", &splats, &profile, view)?;
    let mut equal = true;
    for _ in 1..20 {
        equal &= trial.draw(&splats, &profile, view)? == drawing;
    }
    trial.holds("20 drawings have the same bytes", equal);
    Ok(())
}

pub(super) const T15: Case = Case {
    number: "T15",
    what: "a frame that takes a thousand times as much room as the ones before and after",
    bound: "agrees with f64; the frames around it have the same bytes",
    run: Run::Light(t15),
};

fn t15(trial: &mut CaseRun<'_>) -> Result<(), RenderError> {
    let profile = RenderProfile::default();
    let small = (scene_of(&[GaussianSpec::default()]), forward_view([64, 48], 50.0));
    let before = trial.agreed("a small frame", &small.0, &profile, small.1)?;
    let mut street = wildcity_generate::canyon(40_000, &mut |_, _| {});
    // Mist over many tiles, so that instances grow faster than splats.
    for i in (0..street.len()).step_by(200) {
        street.ln_scales[i] = [1.0; 3];
        street.logit_opacities[i] = -4.0;
    }
    let street = Scene::from_gaussians(&street);
    let large = trial.agreed("a large one", &street, &profile, street_view([400, 225]))?;
    let after = trial.draw(&small.0, &profile, small.1)?;
    trial.holds("the small frame after it has the same bytes", after == before);
    let again = trial.draw(&street, &profile, street_view([400, 225]))?;
    trial.holds("and so has the large one", again == large);
    Ok(())
}

pub(super) const T16: Case = Case {
    number: "T16",
    what: "no Gaussian, one, none that is visible; one pixel; more tiles than instances",
    bound: "black to the bit, a colour in its bytes and within half a step of 16 bits; agrees with f64",
    run: Run::Light(t16),
};

fn t16(trial: &mut CaseRun<'_>) -> Result<(), RenderError> {
    let (profile, view) = (RenderProfile::default(), forward_view([50, 40], 40.0));
    // 51, 89.25 and 216.75 of 255.
    let background = [0.2, 0.35, 0.85];
    let at = |mean_m| scene_of(&[GaussianSpec { mean_m, ..GaussianSpec::default() }]);
    for (what, empty) in [
        ("none", Scene::default()),
        ("one behind", at(DVec3::new(0.0, 0.0, -5.0))),
        ("one far beside", at(DVec3::new(500.0, 0.0, 5.0))),
    ] {
        let drawing = trial.draw(&empty, &profile, view)?;
        let is_black = drawing.rgb8.iter().all(|&byte| byte == 0);
        let mut values = drawing.rgba.iter().chain(&drawing.depth_m).chain(&drawing.opacity);
        trial.holds(format!("{what}: every value is 0"), is_black && values.all(|&v| v == 0.0));

        // Cube maps have 16 bits, whose half step is 1 / 131,070, and f32 a last bit.
        let coloured = trial.draw(&empty, &RenderProfile { background, ..profile }, view)?;
        let is_colour = coloured.rgb8.chunks_exact(3).all(|rgb| rgb == [51, 89, 217]);
        trial.holds(format!("{what}: every byte is the background's"), is_colour);
        let mut alone = coloured.opacity.iter().chain(&coloured.depth_m);
        let no_opacity =
            alone.all(|&v| v == 0.0) && coloured.rgba.chunks_exact(4).all(|p| p[3] == 0.0);
        trial.holds(format!("{what}: no opacity and no depth"), no_opacity);
        let [r, g, b] = background.map(|c| c as f32);
        let wanted: Vec<f32> = [r, g, b, 0.0].repeat(view.camera.pixels());
        let off = max_difference(&coloured.rgba, &wanted);
        trial.at_most(format!("{what}: off the background by"), off.into(), 0.5 / 65_535.0 + 1e-7);
    }
    let one = trial.agreed("one", &at(GaussianSpec::default().mean_m), &profile, view)?;
    trial.holds("one: seen", one.opacity.iter().any(|&o| o > 0.5));
    trial.agreed(
        "one pixel",
        &at(GaussianSpec::default().mean_m),
        &profile,
        forward_view([1, 1], 1.0),
    )?;
    Ok(())
}

pub(super) const T17: Case = Case {
    number: "T17",
    what: "an image of 7681 x 4321 px: 130,351 tiles, no multiple of 16",
    bound: "three parts of it, its corners too, as f64 draws them: 2e-3, and 1/255 for what is at the cut \
            (of the definition a quarter of the sides)",
    run: Run::Light(t17),
};

fn t17(trial: &mut CaseRun<'_>) -> Result<(), RenderError> {
    // The definition has no tiles, and would take 40 B a pixel: of it a quarter of the sides.
    let size_px = if trial.is_reference() { [1921, 1081] } else { [7681, 4321] };
    if trial.is_reference() {
        trial.reduce_to(format!("{} x {} px", size_px[0], size_px[1]));
    }
    let focal_px = 0.52 * f64::from(size_px[0]);
    let balls = balls();
    let (profile, whole) = (RenderProfile::default(), forward_view(size_px, focal_px));
    let drawing = trial.draw(&balls, &profile, whole)?;
    let (part_px, margin_px) = ([401, 300], 32);
    let [right, bottom] = [0, 1].map(|axis| size_px[axis] - part_px[axis]);
    for at in [[0, 0], [right / 2 + 3, bottom / 2 + 5], [right, bottom]] {
        // The slope clamp follows an image's own edges (gsplat's rule), so that an image draws otherwise
        // what is centred beyond its edges: a margin, which is not compared, takes what that changes.
        let padded_at = at.map(|px| px as i32 - margin_px as i32);
        let padded = crop_view(whole, padded_at, part_px.map(|px| px + 2 * margin_px));
        let truth = trial.truth(&balls, &profile, padded)?;
        let truth = crop_rgba(&truth, padded.camera.width_px, [margin_px; 2], part_px);
        let own = crop_rgba(&drawing, size_px[0], at, part_px);
        let what = format!("at {at:?}");
        let seen = own.chunks_exact(4).any(|rgba| rgba[3] > 0.2);
        trial.holds(format!("{what}: something is seen"), seen);
        trial.at_most(format!("{what}: off by"), max_difference(&own, &truth).into(), CROP_OFF);
    }
    Ok(())
}

/// How far off a crop may be of the whole: f32, and one alpha that is at the cut of 1/255.
const CROP_OFF: f64 = 2e-3 + 1.0 / 255.0;

/// 3,000 balls of 6 px at 1,000 px of focal length, 4 to 64 m ahead.
fn balls() -> Scene {
    let balls = (0..3_000).map(|i| {
        let [x, y, z, red, green, blue] = evenly(i);
        let z_m = 4.0 + 60.0 * z;
        GaussianSpec {
            mean_m: DVec3::new(1.9 * z_m * (x - 0.5), 1.1 * z_m * (y - 0.5), z_m),
            sigma_m: DVec3::splat(0.006 * z_m),
            opacity: 0.2 + 0.7 * red,
            rgb: [red, green, blue],
            ..GaussianSpec::default()
        }
    });
    scene_of(&balls.collect::<Vec<_>>())
}

pub(super) const T18: Case = Case {
    number: "T18",
    what: "a principal point far off the image's centre",
    bound: "agrees with f64; as a crop of the larger image: 2e-3, and 1/255 for what is at the cut",
    run: Run::Light(t18),
};

fn t18(trial: &mut CaseRun<'_>) -> Result<(), RenderError> {
    let (profile, whole) = (RenderProfile::default(), forward_view([600, 400], 320.0));
    let balls = balls();
    let drawing = trial.draw(&balls, &profile, whole)?;
    for at in [[0, 0], [430, 300]] {
        let part = crop_view(whole, at.map(|px| px as i32), [170, 100]);
        let own = trial.agreed(format!("crop at {at:?}"), &balls, &profile, part)?;
        // The margin: see T17.
        let own = crop_rgba(&own, 170, [40, 20], [90, 60]);
        let of_whole = crop_rgba(&drawing, 600, [at[0] + 40, at[1] + 20], [90, 60]);
        trial.holds(format!("crop at {at:?}: seen"), own.chunks_exact(4).any(|rgba| rgba[3] > 0.2));
        let off = max_difference(&own, &of_whole);
        trial.at_most(format!("crop at {at:?}: off the whole by"), off.into(), CROP_OFF);
    }
    Ok(())
}
