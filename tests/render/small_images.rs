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
use wildcity_scene::{Rays, RenderProfile, Rig, Scene, Shrink};

use crate::captures::{dense_capture, dense_view};
use crate::data::real;
use crate::expansion::{paired, step_ms};
use crate::images::{Image, agree, cpu, psnr, render_one, view_along};
use crate::lenses::{lenses, rolling_view, street_scene};
use crate::placed;
use crate::truths::read;

/// The profile whose small images have one sample a pixel.
const FILTER: RenderProfile = RenderProfile { shrink: Shrink::Filter, ..RenderProfile::DEFAULT };

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

/// PSNR in dB of an image at a share of the native size against the native image averaged: by
/// samples, by the filter, and with the blur of its own pixels.
fn against_native(scene: &Scene, native: View, whole: &Colors, divisor: u32) -> [f64; 3] {
    let [shrunk, own] = small(native, divisor);
    let samples = RenderProfile::default();
    [(samples, shrunk), (FILTER, shrunk), (samples, own)].map(|(profile, view)| {
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

/// Captures and the demo street, each with a view whose sides 2, 3 and 4 divide.
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
    let dense = Scene::from_gaussians(&dense_capture(3_000_000));
    scenes.push(("a dense capture", dense, dense_view()));
    scenes
}

#[test]
fn a_small_image_is_the_native_image_shrunk() {
    for (name, scene, view) in scenes() {
        let whole = colors(view, &render_one(&cpu(), &scene, &RenderProfile::default(), view));
        for divisor in [2, 3, 4] {
            let [db, filter_db, own_db] = against_native(&scene, view, &whole, divisor);
            let what = format!("{name} at 1/{divisor}");
            eprintln!("{what}: {db:.1} dB, filter {filter_db:.1} dB, own blur {own_db:.1} dB");
            assert!(db >= 40.0, "{what}: {db:.1} dB");
            assert!(filter_db >= 36.0 && filter_db > own_db, "{what}, filter: {filter_db:.1} dB");
            // At a half the filter alone is as good.
            let least_db = if divisor == 2 { filter_db } else { filter_db + 7.0 };
            assert!(db >= least_db, "{what}: {db:.1} dB, filter {filter_db:.1} dB");
        }
    }
}

/// A half, two thirds and three quarters of the native size have one sample a pixel.
#[test]
fn images_of_half_their_native_size_have_one_sample() {
    for (name, scene, view) in scenes() {
        let whole = colors(view, &render_one(&cpu(), &scene, &FILTER, view));
        for [parts, of] in [[1, 2], [2, 3], [3, 4]] {
            let [width, height] =
                [view.camera.width_px, view.camera.height_px].map(|px| u64::from(px) * parts / of);
            let camera = view.camera.scaled(width, height).unwrap();
            let small = View { camera, ..view };
            let [one, two] = [RenderProfile::default(), FILTER]
                .map(|profile| render_one(&cpu(), &scene, &profile, small));
            assert!(one == two, "{name} at {parts}/{of}");
            let db = psnr(
                &colors(small, &one).rgb,
                &whole.averaged([width, height].map(|px| px as u32)).rgb,
            );
            eprintln!("{name} at {parts}/{of}: {db:.1} dB");
            // A part of a native pixel counts as if the whole were there: 36 dB of dense captures.
            assert!(db >= 35.0, "{name} at {parts}/{of}: {db:.1} dB");
        }
    }
}

/// Every camera: the mean of 2 x 2 pixels of the image of twice the size.
#[test]
fn a_pixel_is_the_mean_of_its_samples() {
    let (street, pose) = street_scene();
    let (actors, _) = placed::street_with_actors();
    let profile = RenderProfile::default();
    let labelled = placed::labelled(&Scene { placed: actors.placed.clone(), ..street.clone() });
    let mut sampled = 0;
    let mut mixed = 0;
    for (name, view) in small_views(pose) {
        let Camera { width_px, height_px, .. } = view.camera;
        if view.camera.native_scale().max_element() > 0.45 {
            continue;
        }
        sampled += 1;
        let camera = view.camera.scaled((2 * width_px).into(), (2 * height_px).into()).unwrap();
        let fine_view = View { camera, ..view };
        let fine = render_one(&cpu(), &street, &FILTER, fine_view);
        let [(fine_ids, fine_classes), owners] = [fine_view, view].map(|view| {
            let (mut owners, _) = placed::owners(&cpu(), &labelled, &[view]);
            owners.remove(0)
        });
        let image = render_one(&cpu(), &street, &profile, view);
        let width = width_px as usize;
        let corner = |i: usize| 2 * (i / width * 2 * width + i % width);
        let four = |i: usize| [0, 1, 2 * width, 2 * width + 1].map(|step| corner(i) + step);
        // Samples outside of a lens' field count, and are masked in the larger image.
        let is_inside = |i: usize| four(i).iter().all(|&at| fine.opacity[at] > 0.0);
        let inside: Vec<usize> = (0..view.camera.pixels()).filter(|&i| is_inside(i)).collect();
        assert!(inside.len() > 100, "{name}: {} pixels", inside.len());
        for i in inside {
            for channel in 0..4 {
                let mean = four(i).map(|at| fine.rgba[4 * at + channel]).iter().sum::<f32>() / 4.0;
                let off = (image.rgba[4 * i + channel] - mean).abs();
                assert!(off < 1e-6, "{name}, pixel {i}, channel {channel}: off by {off}");
            }
            let weighted = four(i).map(|at| fine.depth_m[at] * fine.opacity[at]);
            let opacity: f32 = four(i).map(|at| fine.opacity[at]).iter().sum();
            let depth_m = weighted.iter().sum::<f32>() / opacity;
            assert!((image.depth_m[i] / depth_m - 1.0).abs() < 1e-4, "{name}, pixel {i}: depth");
            let ids = four(i).map(|at| fine_ids[at]);
            let count = |of: u16| ids.iter().filter(|&&other| other == of).count();
            let most = ids.map(count).into_iter().max().unwrap();
            assert_eq!(count(owners.0[i]), most, "{name}, pixel {i}: {ids:?}");
            let classes = four(i).map(|at| fine_classes[at]);
            assert!(classes.contains(&owners.1[i]), "{name}, pixel {i}: {classes:?}");
            mixed += usize::from(most < 4);
        }
    }
    assert!(sampled > 10 && mixed > 1_000, "{sampled} views, {mixed} pixels of several owners");
}

/// Cameras of every model at rest and rolling, with images of less than half the native width and a third
/// of its height.
fn small_views(pose: Pose) -> Vec<(String, View)> {
    let mut views = Vec::new();
    for (name, camera) in lenses() {
        let camera = camera.scaled(70, 33).unwrap();
        views.push((name.to_owned(), View::new(camera, pose)));
        let rolling = rolling_view(camera, pose, ShutterDirection::TopToBottom);
        views.push((format!("{name}, rolling"), rolling));
    }
    let ideal = view_along([240, 150], 130.0, DVec3::ZERO, DVec3::Z, DVec3::Y).camera;
    for [width, height] in [[120, 75], [240, 75], [80, 150], [80, 50]] {
        let camera = ideal.scaled(width, height).unwrap();
        views.push((format!("pinhole, {width} x {height}"), View::new(camera, pose)));
    }
    views
}

#[test]
fn every_camera_is_shrunk_as_defined() {
    let (street, pose) = street_scene();
    for profile in ["lens_error_px=0", "antialiased=true", "blur=0.05", "shrink=filter"] {
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
    for divisor in [2, 4] {
        let [width, height] = [160 / divisor, 100 / divisor];
        let small = native.scaled(width, height).unwrap();
        let [at_px, size_px] = [[40, 20], [80, 60]];
        let part = native.cropped(at_px, size_px).unwrap();
        let part = part.scaled(80 / divisor, 60 / divisor).unwrap();
        let [at_px, size_px] = [at_px, size_px].map(|px| px.map(|px| px / divisor));
        assert_eq!(part, small.cropped(at_px, size_px).unwrap());
        let image = render_one(&cpu(), &street, &profile, View::new(part, pose));
        let whole = render_one(&cpu(), &street, &profile, View::new(small, pose));
        let [at_px, size_px] = [at_px, size_px].map(|px| px.map(|px| px as u32));
        let cut = crop_rgba(&whole, width as u32, at_px, size_px);
        let db = psnr(&image.rgba, &cut);
        assert!(db > 90.0, "1/{divisor}: {db:.1} dB");
    }
}

/// Small images against images of the same size with the blur of their own pixels.
#[test]
#[ignore = "times: cargo test -p wildcity-render --test render small_images_cost -- --ignored --nocapture"]
fn small_images_cost_nothing() {
    let backend = cpu();
    let profile = FILTER;
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

/// Processor time of this process, in ms.
fn processor_ms() -> f64 {
    let of_thread = |thread: std::fs::DirEntry| {
        // The first number is the time on a core, in ns.
        let text = std::fs::read_to_string(thread.path().join("schedstat")).unwrap_or_default();
        text.split_whitespace().next().and_then(|ns| ns.parse::<f64>().ok()).unwrap_or(0.0) * 1e-6
    };
    std::fs::read_dir("/proc/self/task").unwrap().map(|thread| of_thread(thread.unwrap())).sum()
}

/// What samples cost at 576 x 320 px: processor time, in turn with the filter.
#[test]
#[ignore = "times: cargo test -p wildcity-render --test render samples_cost -- --ignored --nocapture"]
fn samples_cost() {
    let backend = cpu();
    let street = wildcity_generate::street(&StreetSettings::default()).unwrap();
    let world_from_rig = street.trajectory.at_station(60.0);
    let captures = scenes().into_iter().filter(|(name, ..)| *name != "the demo street");
    let mut steps: Vec<(&str, Scene, Vec<View>)> =
        captures.map(|(name, scene, view)| (name, scene, vec![view])).collect();
    for rig in ["alpamayo2", "vehicle6"] {
        let views = View::from_rig(&Rig::preset(rig).unwrap().cameras, world_from_rig);
        steps.push((rig, Scene::from_gaussians(&street.gaussians), views));
    }
    for (name, scene, mut views) in steps {
        for view in &mut views {
            view.camera = view.camera.scaled(576, 320).unwrap();
        }
        let time_ms = |profile: &RenderProfile| {
            let before_ms = processor_ms();
            step_ms(&backend, &scene, profile, &views);
            processor_ms() - before_ms
        };
        let both = || [&RenderProfile::DEFAULT, &FILTER].map(time_ms);
        both();
        let mut pairs: Vec<[f64; 2]> = (0..15).map(|_| both()).collect();
        // The pair with the median ratio.
        pairs.sort_by(|[a, b], [c, d]| (a / b).total_cmp(&(c / d)));
        let [samples_ms, filter_ms] = pairs[7];
        let ratio = samples_ms / filter_ms;
        eprintln!("{name}: {samples_ms:.1} against {filter_ms:.1} ms of processors, {ratio:.2}");
        assert!(ratio <= 2.0, "{name}: {ratio:.2}");
    }
}
