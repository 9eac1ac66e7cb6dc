//! Gaussians centimetres ahead, around and behind the camera, over ten kilometres of depth, and far
//! from the origin.

use glam::DVec3;

use super::{Case, CaseBody, CaseRun};
use wildcity_render::compare::gaussians::{GaussianSpec, forward_view, scene_from_specs};
use wildcity_render::compare::images::{max_difference, view_along};
use wildcity_render::{RenderError, View};
use wildcity_scene::chunk::column;
use wildcity_scene::record::round_trip;
use wildcity_scene::{RecordFormat, RenderProfile, Scene};

pub(super) const T4: Case = Case {
    number: "T4",
    what: "centres 0.01 to 0.21 m ahead, near 0.01 and 0.2 m",
    bound: "agrees with f64; drawn if and only if beyond near",
    body: CaseBody::Light(t4),
};

fn t4(run: &mut CaseRun<'_>) -> Result<(), RenderError> {
    for near in [0.01, 0.2] {
        let profile = RenderProfile { near, ..RenderProfile::default() };
        // The first is 1e-7 m beyond the nearer plane: a hundred steps of f32 at 1 cm.
        for z in [0.0100001, 0.011, 0.05, 0.19, 0.21] {
            let close = scene_from_specs(&[GaussianSpec {
                mean_m: DVec3::new(0.002, -0.001, z),
                // Longer than it is far: a part of it is behind the camera.
                sigma_m: DVec3::new(0.003, 0.02, 0.1),
                ..GaussianSpec::default()
            }]);
            let what = format!("{z} m, near {near} m");
            let view = forward_view([160, 120], 1800.0);
            let image = run.render_and_compare(what.clone(), &close, &profile, view)?;
            let drawn = image.opacity.iter().any(|&o| o > 0.0);
            // The centre alone decides, however far the Gaussian reaches.
            run.check(format!("{what}: drawn as near says"), drawn == (z > near));
        }
    }
    Ok(())
}

pub(super) const T5: Case = Case {
    number: "T5",
    what: "the camera inside a Gaussian; a centre behind it",
    bound: "agrees with f64; the centre behind is not drawn",
    body: CaseBody::Light(t5),
};

fn t5(run: &mut CaseRun<'_>) -> Result<(), RenderError> {
    let profile = RenderProfile::default();
    let view = forward_view([160, 120], 100.0);
    let at = |z, sigma_m| GaussianSpec {
        mean_m: DVec3::new(0.1, 0.0, z),
        sigma_m: DVec3::splat(sigma_m),
        ..GaussianSpec::default()
    };
    let inside =
        run.render_and_compare("inside", &scene_from_specs(&[at(0.3, 2.0)]), &profile, view)?;
    run.check("inside: seen", inside.opacity.iter().any(|&o| o > 0.5));
    // The ball reaches past the camera: only its centre is behind.
    let behind =
        run.render_and_compare("behind", &scene_from_specs(&[at(-1.0, 3.0)]), &profile, view)?;
    let most = behind.opacity.iter().fold(0.0_f32, |most, &o| most.max(o));
    run.check_at_most("behind: opacity", most.into(), 0.0);
    Ok(())
}

pub(super) const T7: Case = Case {
    number: "T7",
    what: "pairs one step of f32 apart, from 1 cm to 10 km",
    bound: "agrees with f64; the nearer one of each pair is in front",
    body: CaseBody::Light(t7),
};

fn t7(run: &mut CaseRun<'_>) -> Result<(), RenderError> {
    let mut specs = Vec::new();
    let mut centers = Vec::new();
    // The pairs lie along +x, where each chunk holds its own part, so that centres keep their f32
    // values.
    for (i, x) in [0.0101_f32, 0.5, 3.0, 70.0, 1000.0, 9999.0].into_iter().enumerate() {
        // Slopes of -0.75 to 0.75 put the pairs side by side, 30 px apart.
        let slope = (i as f64 - 2.5) * 0.3;
        // The farther one first, so that the order in the scene is the wrong one.
        for (x, rgb) in [(x.next_up(), [0.0, 1.0, 0.0]), (x, [1.0, 0.0, 0.0])] {
            let x = f64::from(x);
            specs.push(GaussianSpec {
                // The view looks along +x with +z up, so that its right is -y.
                mean_m: DVec3::new(x, -slope * x, 0.0),
                // The size grows with the distance: each has a standard deviation of 2 px in the
                // image.
                sigma_m: DVec3::splat(0.02 * x),
                rgb,
                opacity: 0.95,
                ..GaussianSpec::default()
            });
        }
        // Row 50 is the middle of an image of 200 x 100 px. Column 100 is straight ahead, and a
        // slope of 1 is 100 px.
        centers.push((x, 200 * 50 + (slope * 100.0 + 100.0) as usize));
    }
    let view = view_along([200, 100], 100.0, DVec3::ZERO, DVec3::X, DVec3::NEG_Z);
    let image = run.render_and_compare(
        "pairs",
        &scene_from_specs(&specs),
        &RenderProfile::default(),
        view,
    )?;
    for (x, pixel) in centers {
        let [red, green] = [0, 1].map(|channel| image.rgba[4 * pixel + channel]);
        run.check(format!("{x} m: the nearer one is in front"), red > 0.8 && green < 0.2);
    }
    Ok(())
}

pub(super) const T9: Case = Case {
    number: "T9",
    what: "the twin's origin 1e4, 5e5 and 4.5e6 m away",
    bound: "equal to the image at the origin within 1/255",
    body: CaseBody::Light(t9),
};

fn t9(run: &mut CaseRun<'_>) -> Result<(), RenderError> {
    let near = wildcity_generate::canyon(10_000, &mut |_, _| {});
    let view = street_view([200, 120]);
    let profile = RenderProfile::default();
    let here = run.render(&Scene::from_gaussians(&near), &profile, view)?;
    run.check("something is seen", here.opacity.iter().any(|&o| o > 0.9));
    // At 4.5e6 m a step of f32 is half a metre: a backend that placed Gaussians in world
    // coordinates would show it.
    for away_m in [1e4, 5e5, 4.5e6] {
        // Multiples of a cell's size, so that the chunks hold the same numbers.
        let away = DVec3::new(1.0, -1.0, 1.0) * (away_m / 64.0_f64).round() * 64.0;
        let mut far = near.clone();
        for mean in &mut far.means_m {
            *mean = (DVec3::from_array(*mean) + away).to_array();
        }
        let mut moved = view;
        moved.world_from_camera.position_m += away;
        let there = run.render(&Scene::from_gaussians(&far), &profile, moved)?;
        let off = max_difference(&here.rgba, &there.rgba);
        run.check_at_most(format!("{away_m:e} m: off by"), off.into(), 1.0 / 255.0);
    }
    Ok(())
}

pub(super) const T10: Case = Case {
    number: "T10",
    what: "a street 1,000 km from the origin, encoded in the record of 32 B",
    bound: "centres within half a step of 2^-16 m, drawn at 60 dB or more",
    body: CaseBody::Light(t10),
};

fn t10(run: &mut CaseRun<'_>) -> Result<(), RenderError> {
    encoded_street(run, RecordFormat::Q32)
}

/// T10 with any record.
fn encoded_street(run: &mut CaseRun<'_>, record: RecordFormat) -> Result<(), RenderError> {
    let mut street = wildcity_generate::canyon(20_000, &mut |_, _| {});
    // 15,625 cells of 64 m are 1,000 km: the cells cut the street at the same places as at the
    // origin.
    let away = DVec3::new(64.0 * 15_625.0, 64.0 * 15_625.0, 0.0);
    for mean in &mut street.means_m {
        *mean = (DVec3::from_array(*mean) + away).to_array();
    }
    let scene = Scene::from_gaussians(&street);
    let coded = round_trip(&scene, record).scene;
    let mut off_m = 0.0_f32;
    for (chunk, again) in scene.chunks.iter().zip(&coded.chunks) {
        for (index, axis) in (0..chunk.len()).flat_map(|i| [0, 1, 2].map(|axis| (i, axis))) {
            let column = column::MEAN + axis;
            off_m = off_m.max((chunk.value(index, column) - again.value(index, column)).abs());
        }
    }
    // A cell is 64 m wide, centred on its origin, and the range of centres is a power of two. The
    // bound is half a step of 128 m / 2^23 = 2^-16 m.
    run.check_at_most("centres off by m", off_m.into(), 0.5 * 128.0 / f64::from(1 << 23));
    let mut view = street_view([200, 120]);
    view.world_from_camera.position_m += away;
    let profile = RenderProfile::default();
    let right = run.render(&scene, &profile, view)?;
    let drawn = run.render(&coded, &profile, view)?;
    let pairs = right.rgba.iter().zip(&drawn.rgba).map(|(a, b)| f64::from(a - b));
    run.check_at_least_db("drawn: dB", wildcity_render::compare::psnr::psnr_db(pairs), 60.0);
    Ok(())
}

/// A camera in the middle of [`wildcity_generate::canyon`] that looks along it.
pub(super) fn street_view(size_px: [u32; 2]) -> View {
    let focal_px = 0.75 * f64::from(size_px[0]);
    view_along(size_px, focal_px, DVec3::new(-20.0, 0.3, 1.6), DVec3::X, DVec3::NEG_Z)
}

#[cfg(test)]
mod tests {
    use super::*;
    use wildcity_render::reference::Reference;

    #[test]
    fn a_coarser_record_misses_the_bound_of_centres() {
        let mut run = CaseRun::new(&Reference);
        // 20 bits instead of 23 have steps eight times as large.
        encoded_street(&mut run, RecordFormat::Q24).unwrap();
        let missed: Vec<String> =
            run.into_checks().into_iter().filter(|c| !c.holds()).map(|c| c.what).collect();
        assert!(missed.contains(&"centres off by m".to_owned()), "{missed:?}");
    }
}
