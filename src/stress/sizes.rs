//! Empty scenes, one pixel, 8K, buffers that must grow, and crops.

use glam::{DQuat, DVec3};

use super::order::low_discrepancy;
use super::places::street_view;
use super::{Case, CaseBody, CaseRun};
use wildcity_render::RenderError;
use wildcity_render::compare::gaussians::{GaussianSpec, forward_view, scene_from_specs};
use wildcity_render::compare::images::{RenderedImage, crop_rgba, crop_view, max_difference};
use wildcity_render::compare::psnr::psnr_db;
use wildcity_scene::{RenderProfile, Scene};

pub(super) const T14: Case = Case {
    number: "T14",
    what: "splats that end on the edges of tiles, up to 20 ulp on either side",
    bound: "agrees with f64; byte-identical in 20 images: every counted slot is written",
    body: CaseBody::Light(t14),
};

fn t14(run: &mut CaseRun<'_>) -> Result<(), RenderError> {
    // At a distance of 5 m and with a focal length of 160 px, a centre at a multiple of 0.5 m lies
    // on the edge of a tile of 16 px. With a sigma of 16 px / √(2 ln(255 · 0.9)) the splat reaches
    // the next edge.
    let exact_m = 16.0 * 5.0 / 160.0 / (2.0 * (255.0_f64 * 0.9).ln()).sqrt();
    let specs = (0..800_i32).map(|i| {
        // From -20 to 20 ulp, in a different order from that of the places.
        let ulps = f64::from(i % 41 - 20) * f64::from(f32::EPSILON);
        let x = f64::from(i % 16 - 8);
        let y = f64::from(i / 16 % 10 - 5);
        GaussianSpec {
            mean_m: DVec3::new(0.5 * x * (1.0 + ulps), 0.5 * y, 5.0),
            sigma_m: DVec3::splat(exact_m * (1.0 + ulps)),
            ..GaussianSpec::default()
        }
    });
    let splats = scene_from_specs(&specs.collect::<Vec<_>>());
    let profile = RenderProfile::default();
    let view = forward_view([256, 160], 160.0);
    let image = run.render_and_compare("edges", &splats, &profile, view)?;
    let mut equal = true;
    for _ in 1..20 {
        equal &= run.render(&splats, &profile, view)? == image;
    }
    run.check("20 images have the same bytes", equal);
    Ok(())
}

pub(super) const T15: Case = Case {
    number: "T15",
    what: "a frame that takes a thousand times the memory of the ones before and after",
    bound: "agrees with f64; the frames before and after it have the same bytes",
    body: CaseBody::Light(t15),
};

fn t15(run: &mut CaseRun<'_>) -> Result<(), RenderError> {
    let profile = RenderProfile::default();
    let small = (scene_from_specs(&[GaussianSpec::default()]), forward_view([64, 48], 50.0));
    let before = run.render_and_compare("a small frame", &small.0, &profile, small.1)?;
    let mut street = wildcity_generate::canyon(40_000, &mut |_, _| {});
    // Fog over many tiles, so that (Gaussian, tile) pairs grow faster than splats.
    // One in 200 becomes fog: 2.7 m wide, nearly transparent.
    for i in (0..street.len()).step_by(200) {
        street.ln_scales[i] = [1.0; 3];
        street.logit_opacities[i] = -4.0;
    }
    let street = Scene::from_gaussians(&street);
    let large =
        run.render_and_compare("a large one", &street, &profile, street_view([400, 225]))?;
    // A buffer that grew for the large frame must not show its content in the small one.
    let after = run.render(&small.0, &profile, small.1)?;
    run.check("the small frame after it has the same bytes", after == before);
    let again = run.render(&street, &profile, street_view([400, 225]))?;
    run.check("and so has the large one", again == large);
    Ok(())
}

pub(super) const T16: Case = Case {
    number: "T16",
    what: "no Gaussian, one, none that is visible; one pixel; more tiles than instances",
    bound: "exactly 0; a background is exact in 8 bits, and within half a step of 16 bits; agrees with f64",
    body: CaseBody::Light(t16),
};

fn t16(run: &mut CaseRun<'_>) -> Result<(), RenderError> {
    let profile = RenderProfile::default();
    let view = forward_view([50, 40], 40.0);
    // In 8 bits 51, 89.25 and 216.75.
    let background = [0.2, 0.35, 0.85];
    let at = |mean_m| scene_from_specs(&[GaussianSpec { mean_m, ..GaussianSpec::default() }]);
    for (what, empty) in [
        ("none", Scene::default()),
        ("one behind", at(DVec3::new(0.0, 0.0, -5.0))),
        ("one far beside", at(DVec3::new(500.0, 0.0, 5.0))),
    ] {
        let image = run.render(&empty, &profile, view)?;
        let is_black = image.rgb8.iter().all(|&byte| byte == 0);
        let mut values = image.rgba.iter().chain(&image.depth_m).chain(&image.opacity);
        run.check(format!("{what}: every value is 0"), is_black && values.all(|&v| v == 0.0));

        // Cube maps have 16 bits; half a step is 1 / 131,070. 1e-7 more for f32.
        let coloured = run.render(&empty, &RenderProfile { background, ..profile }, view)?;
        let is_colour = coloured.rgb8.chunks_exact(3).all(|rgb| rgb == [51, 89, 217]);
        run.check(format!("{what}: every byte is the background's"), is_colour);
        let mut alone = coloured.opacity.iter().chain(&coloured.depth_m);
        let no_opacity =
            alone.all(|&v| v == 0.0) && coloured.rgba.chunks_exact(4).all(|p| p[3] == 0.0);
        run.check(format!("{what}: no opacity and no depth"), no_opacity);
        let [r, g, b] = background.map(|c| c as f32);
        let wanted: Vec<f32> = [r, g, b, 0.0].repeat(view.camera.pixels());
        let off = max_difference(&coloured.rgba, &wanted);
        run.check_at_most(
            format!("{what}: off the background by"),
            off.into(),
            0.5 / 65_535.0 + 1e-7,
        );
    }
    let one = run.render_and_compare("one", &at(GaussianSpec::default().mean_m), &profile, view)?;
    run.check("one: seen", one.opacity.iter().any(|&o| o > 0.5));
    run.render_and_compare(
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
    bound: "three parts of it, with two corners, as f64: within 2e-3, and 1/255 for a splat at the cut \
            (the reference backend draws an image with a quarter of the sides)",
    body: CaseBody::Light(t17),
};

fn t17(run: &mut CaseRun<'_>) -> Result<(), RenderError> {
    // The reference backend has no tiles, and would take 40 B a pixel: it draws a quarter of the
    // sides.
    let size_px = if run.is_reference() { [1921, 1081] } else { [7681, 4321] };
    if run.is_reference() {
        run.reduce_to(format!("{} x {} px", size_px[0], size_px[1]));
    }
    // 0.52 of the width: a horizontal field of 88 degrees.
    let focal_px = 0.52 * f64::from(size_px[0]);
    let balls = balls();
    let profile = RenderProfile::default();
    let whole = forward_view(size_px, focal_px);
    let image = run.render(&balls, &profile, whole)?;
    let part_px = [401, 300];
    let margin_px = 32;
    let [right, bottom] = [0, 1].map(|axis| size_px[axis] - part_px[axis]);
    for at in [[0, 0], [right / 2 + 3, bottom / 2 + 5], [right, bottom]] {
        // The slope clamp depends on an image's own edges (gsplat's rule), so that a part draws
        // splats that are centred beyond its edges differently. The part is rendered with a margin,
        // which is not compared.
        let padded_at = at.map(|px| px as i32 - margin_px as i32);
        let padded = crop_view(whole, padded_at, part_px.map(|px| px + 2 * margin_px));
        let padded_truth = run.render_reference(&balls, &profile, padded)?;
        let truth = crop_rgba(&padded_truth, padded.camera.width_px, [margin_px; 2], part_px);
        let own = crop_rgba(&image, size_px[0], at, part_px);
        let what = format!("at {at:?}");
        let seen = own.chunks_exact(4).any(|rgba| rgba[3] > 0.2);
        run.check(format!("{what}: something is seen"), seen);
        run.check_at_most(
            format!("{what}: off by"),
            max_difference(&own, &truth).into(),
            MAX_CROP_DIFFERENCE,
        );
    }
    Ok(())
}

/// How far a crop may differ from the whole image: f32, and one splat with alpha at the cut of
/// 1/255.
const MAX_CROP_DIFFERENCE: f64 = 2e-3 + 1.0 / 255.0;

/// 3,000 balls, 4 to 64 m ahead, each 6 px wide at a focal length of 1,000 px.
fn balls() -> Scene {
    let balls = (0..3_000).map(|i| {
        let [x, y, z, red, green, blue] = low_discrepancy(i);
        let z_m = 4.0 + 60.0 * z;
        GaussianSpec {
            mean_m: DVec3::new(1.9 * z_m * (x - 0.5), 1.1 * z_m * (y - 0.5), z_m),
            sigma_m: DVec3::splat(0.006 * z_m),
            opacity: 0.2 + 0.7 * red,
            rgb: [red, green, blue],
            ..GaussianSpec::default()
        }
    });
    scene_from_specs(&balls.collect::<Vec<_>>())
}

pub(super) const T18: Case = Case {
    number: "T18",
    what: "a principal point far from the image's centre",
    bound: "agrees with f64; equal to a crop of the larger image: within 2e-3, and 1/255 for a splat at the cut",
    body: CaseBody::Light(t18),
};

fn t18(run: &mut CaseRun<'_>) -> Result<(), RenderError> {
    let profile = RenderProfile::default();
    let whole = forward_view([600, 400], 320.0);
    let balls = balls();
    let image = run.render(&balls, &profile, whole)?;
    for at in [[0, 0], [430, 300]] {
        let part = crop_view(whole, at.map(|px| px as i32), [170, 100]);
        let drawn = run.render_and_compare(format!("crop at {at:?}"), &balls, &profile, part)?;
        // The margin is explained in T17.
        let own = crop_rgba(&drawn, 170, [40, 20], [90, 60]);
        let of_whole = crop_rgba(&image, 600, [at[0] + 40, at[1] + 20], [90, 60]);
        run.check(format!("crop at {at:?}: seen"), own.chunks_exact(4).any(|rgba| rgba[3] > 0.2));
        let off = max_difference(&own, &of_whole);
        run.check_at_most(
            format!("crop at {at:?}: off the whole by"),
            off.into(),
            MAX_CROP_DIFFERENCE,
        );
    }
    Ok(())
}

pub(super) const T31: Case = Case {
    number: "T31",
    what: "images of a half to a quarter of the native size, of dust and of large Gaussians",
    bound: "agrees with f64; 2 dB nearer to the native image shrunk than with the blur of its own pixels",
    body: CaseBody::Light(t31),
};

fn t31(run: &mut CaseRun<'_>) -> Result<(), RenderError> {
    let profile = RenderProfile::default();
    let scene = scene_from_specs(&(0..3_000).map(random_size).collect::<Vec<_>>());
    let native = forward_view([192, 144], 150.0);
    // Native and small images are compared in f64: only the shrinking is under test.
    let native_rgb = rgb(&run.render_reference(&scene, &profile, native)?);
    for [wide, high] in [[96, 72], [64, 48], [48, 36], [96, 36]] {
        let what = format!("{wide} x {high}");
        let mut small = native;
        small.camera = match native.camera.scaled(wide, high) {
            Ok(camera) => camera,
            // A refused size is a failed check and not the end of the case: the other sizes still
            // run.
            Err(error) => {
                run.check(format!("{what}: {error}"), false);
                continue;
            }
        };
        let image = run.render_and_compare(what.clone(), &scene, &profile, small)?;
        let shrunk = mean_color(&native_rgb, [192 / wide as usize, 144 / high as usize]);
        let db = |image: &RenderedImage| {
            let differences = rgb(image).into_iter().zip(&shrunk).map(|(a, b)| f64::from(a - b));
            psnr_db(differences)
        };
        // Without a native size the image has the blur of its own pixels.
        small.camera.native_size_px = None;
        let own_blur = run.render_reference(&scene, &profile, small)?;
        let better_db = db(&image) - db(&own_blur);
        run.check_at_least_db(format!("{what}: nearer to native by dB"), better_db, 2.0);
    }
    Ok(())
}

/// Gaussians with standard deviations of 0.05 to 6 native px in the view of T31, thin ones among
/// them.
fn random_size(i: usize) -> GaussianSpec {
    let [x, y, z, size, flat, ..] = low_discrepancy(i);
    let away_m = 4.0 + 8.0 * z;
    let sigma_m = away_m / 150.0 * 0.05 * 120.0_f64.powf(size.powi(2));
    GaussianSpec {
        mean_m: away_m * DVec3::new(1.4 * x - 0.7, 1.1 * y - 0.55, 1.0),
        rotation: DQuat::from_rotation_z(6.0 * flat) * DQuat::from_rotation_x(2.0 * x),
        sigma_m: sigma_m * DVec3::new(1.0, 0.05 + flat, 0.3),
        opacity: 0.3 + 0.65 * y,
        rgb: [x, flat, z],
    }
}

/// The colours of an image.
fn rgb(image: &RenderedImage) -> Vec<f32> {
    image.rgba.chunks_exact(4).flat_map(|rgba| [rgba[0], rgba[1], rgba[2]]).collect()
}

/// The colours of an image of 192 px width with the mean of `columns` by `rows` pixels in each of
/// its own.
fn mean_color(image: &[f32], [columns, rows]: [usize; 2]) -> Vec<f32> {
    let row = 3 * 192;
    let height = image.len() / row;
    let mut mean = Vec::with_capacity(image.len() / (columns * rows));
    for top in (0..height).step_by(rows) {
        for left in (0..192).step_by(columns) {
            for channel in 0..3 {
                let values = (0..columns * rows)
                    .map(|i| image[(top + i / columns) * row + (left + i % columns) * 3 + channel]);
                mean.push(values.sum::<f32>() / (columns * rows) as f32);
            }
        }
    }
    mean
}
