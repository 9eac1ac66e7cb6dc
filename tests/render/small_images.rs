//! Images below the native size are the native image shrunk.

use glam::DVec3;
use wildcity_generate::StreetSettings;
use wildcity_render::View;
use wildcity_render::compare::errors::Image as Colors;
use wildcity_render::compare::images::crop_rgba;
use wildcity_render::reference::Reference;
use wildcity_scene::chunk::column;
use wildcity_scene::geometry::camera::ShutterDirection;
use wildcity_scene::geometry::{Camera, Pose};
use wildcity_scene::{Rays, RenderProfile, Rig, Scene};

use crate::data::real;
use crate::expansion::{paired, step_ms};
use crate::images::{Image, agree, cpu, psnr, render_one, view_along};
use crate::lenses::{lenses, rolling_view, street_scene};
use crate::truths::read;

/// The view with its image at a share of its size: as the native image shrunk, and with the blur of
/// its own pixels.
fn small(view: View, divisor: u32) -> [View; 2] {
    let sides = [view.camera.width_px / divisor, view.camera.height_px / divisor].map(u64::from);
    let shrunk = View { camera: view.camera.scaled(sides[0], sides[1]).unwrap(), ..view };
    let mut own = shrunk;
    own.camera.native_size_px = None;
    [shrunk, own]
}

/// An image as the report compares it.
fn colors(view: View, image: &Image) -> Colors {
    Colors {
        size_px: [view.camera.width_px, view.camera.height_px],
        rgb: image.rgba.chunks_exact(4).flat_map(|rgba| [rgba[0], rgba[1], rgba[2]]).collect(),
        depth_m: image.depth_m.clone(),
        opacity: image.opacity.clone(),
    }
}

/// PSNR in dB of an image at a share of the native size against the native image averaged: shrunk,
/// and with the blur of its own pixels.
fn against_native(scene: &Scene, native: View, divisor: u32) -> [f64; 2] {
    let profile = RenderProfile::default();
    let whole = colors(native, &render_one(&cpu(), scene, &profile, native));
    small(native, divisor).map(|view| {
        let image = colors(view, &render_one(&cpu(), scene, &profile, view));
        assert!(image.opacity.iter().any(|&o| o > 0.5), "the view is empty");
        psnr(&image.rgb, &whole.averaged(image.size_px).rgb)
    })
}

/// A view along -z, with +y up, of the middle half of a capture along each axis.
fn facing(scene: &Scene) -> View {
    let mut means_m = Vec::new();
    for chunk in &scene.chunks {
        let at = |i: usize| [0, 1, 2].map(|axis| f64::from(chunk.value(i, column::MEAN + axis)));
        means_m.extend((0..chunk.len()).map(|i| chunk.origin_m() + DVec3::from_array(at(i))));
    }
    let quartiles = [0, 1, 2].map(|axis| {
        means_m.sort_by(|a, b| a[axis].total_cmp(&b[axis]));
        [1, 2, 3].map(|quarter| means_m[quarter * means_m.len() / 4][axis])
    });
    let middle_m = DVec3::from_array(quartiles.map(|[_, middle, _]| middle));
    let size_m = quartiles.map(|[low, _, high]| high - low);
    let away_m = 2.0 * size_m.into_iter().fold(0.0, f64::max);
    let at_m = middle_m + away_m * DVec3::Z;
    view_along([1920, 1080], 1600.0, at_m, DVec3::NEG_Z, DVec3::NEG_Y)
}

/// Two captures and the demo street, each with a view whose sides 2, 3 and 4 divide.
fn scenes() -> Vec<(&'static str, Scene, View)> {
    let mut scenes = Vec::new();
    let street = wildcity_generate::street(&StreetSettings::default()).unwrap();
    let rig = Rig::preset("vehicle6").unwrap();
    let camera = rig.cameras[0].camera.cropped([0, 0], [1440, 924]).unwrap();
    let world_from_camera = street.trajectory.at_station(60.0) * rig.cameras[0].rig_from_camera;
    let view = View::new(camera, world_from_camera);
    scenes.push(("the demo street", Scene::from_gaussians(&street.gaussians), view));
    if let Some(path) = real("scenes/playbot/lod-meta.json") {
        let at_m = DVec3::new(0.0, -0.5, -2.5);
        let view = view_along([1920, 1080], 1600.0, at_m, DVec3::Z, DVec3::Y);
        scenes.push(("playbot", read(&path), view));
    }
    if let Some(path) = real("scenes/biker/biker.compressed.ply") {
        let scene = read(&path);
        let view = facing(&scene);
        scenes.push(("biker", scene, view));
    }
    scenes
}

#[test]
fn a_small_image_is_the_native_image_shrunk() {
    for (name, scene, view) in scenes() {
        for divisor in [2, 3, 4] {
            let [shrunk_db, own_db] = against_native(&scene, view, divisor);
            eprintln!("{name} at 1/{divisor}: {shrunk_db:.1} dB, with its own blur {own_db:.1} dB");
            assert!(shrunk_db >= 40.0, "{name} at 1/{divisor}: {shrunk_db:.1} dB");
            assert!(shrunk_db > own_db, "{name} at 1/{divisor}");
        }
    }
}

/// Cameras of every model at rest and rolling, with images of half the native width and a third of
/// its height.
fn small_views(pose: Pose) -> Vec<(String, View)> {
    let mut views = Vec::new();
    for (name, camera) in lenses() {
        let camera = camera.scaled(80, 33).unwrap();
        views.push((name.to_owned(), View::new(camera, pose)));
        let rolling = rolling_view(camera, pose, ShutterDirection::TopToBottom);
        views.push((format!("{name}, rolling"), rolling));
    }
    let ideal = view_along([240, 150], 130.0, DVec3::ZERO, DVec3::Z, DVec3::Y).camera;
    for [width, height] in [[120, 75], [240, 75], [80, 150]] {
        let camera = ideal.scaled(width, height).unwrap();
        views.push((format!("pinhole, {width} x {height}"), View::new(camera, pose)));
    }
    views
}

#[test]
fn every_camera_is_shrunk_as_defined() {
    let (street, pose) = street_scene();
    for profile in ["lens_error_px=0", "antialiased=true", "blur=0.05"] {
        let mut changed = RenderProfile { lens_error_px: 0.0, ..RenderProfile::default() };
        changed.set(profile).unwrap();
        for (name, view) in small_views(pose) {
            let truth = render_one(&Reference, &street, &changed, view);
            let image = render_one(&cpu(), &street, &changed, view);
            agree(&image, &truth).unwrap_or_else(|e| panic!("{name}, {profile}: {e}"));
        }
    }
}

/// The definition by rays knows nothing of projected splats.
#[test]
fn small_splats_are_what_each_pixels_ray_meets() {
    let (street, pose) = street_scene();
    let exact = RenderProfile { rays: Rays::Exact, ..RenderProfile::default() };
    for (name, view) in small_views(pose).into_iter().step_by(4) {
        let truth = render_one(&Reference, &street, &exact, view);
        let drawn = render_one(&Reference, &street, &RenderProfile::default(), view);
        let db = psnr(&drawn.rgba, &truth.rgba);
        assert!(db >= 42.0, "{name}: {db:.1} dB");
    }
}

#[test]
fn an_image_of_native_size_or_larger_keeps_its_bytes() {
    let (street, pose) = street_scene();
    let profile = RenderProfile::default();
    for (name, camera) in lenses() {
        let native = render_one(&cpu(), &street, &profile, View::new(camera, pose));
        let back = camera.scaled(96, 50).unwrap().scaled(160, 100).unwrap();
        assert_eq!(back.native_size_px, None, "{name}");
        let larger = camera.scaled(320, 200).unwrap();
        let unscaled = Camera { native_size_px: None, ..larger };
        let [a, b] = [larger, unscaled]
            .map(|camera| render_one(&cpu(), &street, &profile, View::new(camera, pose)));
        assert!(a == b, "{name}: an enlarged image");
        // The same pixels with a native size that is said to be the image's own.
        let mut same = camera;
        same.native_size_px = Some(camera.size_px());
        assert!(render_one(&cpu(), &street, &profile, View::new(same, pose)) == native, "{name}");
    }
}

#[test]
fn a_part_of_a_small_image_is_the_image_of_the_part() {
    let (street, pose) = street_scene();
    let profile = RenderProfile::default();
    // With a pinhole, large Gaussians that reach across the edge of a part are projected for the
    // part.
    let native = lenses()[1].1;
    let part = native.cropped([40, 20], [80, 60]).unwrap().scaled(40, 30).unwrap();
    let of_part = native.scaled(80, 50).unwrap().cropped([20, 10], [40, 30]).unwrap();
    assert_eq!(part, of_part);
    let image = render_one(&cpu(), &street, &profile, View::new(part, pose));
    let whole = View::new(native.scaled(80, 50).unwrap(), pose);
    let whole = render_one(&cpu(), &street, &profile, whole);
    let cut = crop_rgba(&whole, 80, [20, 10], [40, 30]);
    assert!(psnr(&image.rgba, &cut) > 90.0);
}

/// Small images against images of the same size with the blur of their own pixels.
#[test]
#[ignore = "times: cargo test -p wildcity-render --test render small_images_cost -- --ignored --nocapture"]
fn small_images_cost_nothing() {
    let backend = cpu();
    let profile = RenderProfile::default();
    let street = wildcity_generate::street(&StreetSettings::default()).unwrap();
    let scene = Scene::from_gaussians(&street.gaussians);
    let world_from_rig = street.trajectory.at_station(60.0);
    let views = View::from_rig(&Rig::preset("vehicle6").unwrap().cameras, world_from_rig);
    for divisor in [2, 3, 4] {
        let both: Vec<[View; 2]> = views.iter().map(|view| small(*view, divisor)).collect();
        let [shrunk, own] = [0, 1].map(|k| both.iter().map(|pair| pair[k]).collect::<Vec<_>>());
        let name = format!("six images at 1/{divisor}, shrunk and with their own blur");
        let ratio = paired(&name, &|| step_ms(&backend, &scene, &profile, &shrunk), &|| {
            step_ms(&backend, &scene, &profile, &own)
        });
        assert!(ratio <= 1.02, "{name}: {ratio:.3}");
    }
}
