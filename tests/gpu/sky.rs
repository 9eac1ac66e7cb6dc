//! Skies on the device against the cpu backend. Without a sky, nothing for skies is compiled.

use std::sync::Arc;

use glam::{DMat3, DVec3};
use wildcity_render::gpu::shaders::Shaders;
use wildcity_render::gpu::{AdapterChoice, Gpu};
use wildcity_render::reference::Reference;
use wildcity_render::{Backend, Frame, RenderError, Target, View};
use wildcity_scene::appearance::{Appearance, Overlay};
use wildcity_scene::geometry::Camera;
use wildcity_scene::geometry::camera::{Lens, OpenCv, Pinhole};
use wildcity_scene::sky::{CubeMap, SkyModel};
use wildcity_scene::{RenderProfile, Scene, Sky};

use crate::cameras::lens_views;
use crate::gpu::{bindings, gpu, gpu_with, gpu_with_limits};
use crate::images::{agree, cpu, max_difference, render, render_one, try_render, view_along};
use crate::shared_gpu;
use crate::skies::{SKY_FROM_WORLD, appearance, demo_model, draw_seen, empty, network, sky};
use crate::streets::{street, street_views};

const EXACT: RenderProfile = RenderProfile { sky_error: 0.0, ..RenderProfile::DEFAULT };

fn all_around() -> Vec<View> {
    let down = DVec3::new(0.1, 0.1, -1.0);
    let forwards =
        [DVec3::X, DVec3::NEG_X, DVec3::Y, DVec3::NEG_Y, DVec3::new(0.2, 0.1, 1.0), DVec3::NEG_Z];
    let sizes = [[64, 48], [33, 17], [48, 48], [20, 50], [64, 64], [16, 16]];
    let views = forwards.into_iter().zip(sizes);
    views.map(|(forward, size_px)| view_along(size_px, 20.0, DVec3::ZERO, forward, down)).collect()
}

/// Largest difference from the cpu backend in all views.
fn difference(scene: &Scene, profile: &RenderProfile) -> f32 {
    images_off(scene, profile, &all_around())
}

fn images_off(scene: &Scene, profile: &RenderProfile, views: &[View]) -> f32 {
    let images = render(&*shared_gpu(), scene, profile, views);
    let truths = render(&cpu(), scene, profile, views);
    let pairs = images.iter().zip(&truths);
    pairs.map(|(a, b)| max_difference(&a.rgba, &b.rgba)).fold(0.0, f32::max)
}

#[test]
fn a_baked_sky() {
    assert!(difference(&empty(sky()), &RenderProfile::DEFAULT) < 2e-5);
    let scene = empty(Arc::new(Sky::new(demo_model(None), DMat3::IDENTITY)));
    assert!(difference(&scene, &RenderProfile::DEFAULT) < 2e-5);
}

/// Largest difference of colours from those that the reference backend finds, in f64.
fn off_truth(scene: &Scene, profile: &RenderProfile, views: &[View]) -> f32 {
    let images = render(&*shared_gpu(), scene, profile, views);
    let truths = render(&Reference, scene, profile, views);
    let pairs = images.iter().zip(&truths);
    pairs.map(|(a, b)| max_difference(&a.rgba, &b.rgba)).fold(0.0, f32::max)
}

#[test]
fn an_evaluated_sky_is_that_of_the_definition() {
    for (identity, octaves, appearance, skip) in
        [(true, 3, 4, true), (false, 6, 0, false), (true, 0, 0, true), (true, 10, 3, false)]
    {
        let model = SkyModel::network(network(identity, octaves, appearance, skip));
        let scene = empty(Arc::new(Sky::new(model, SKY_FROM_WORLD)));
        let off = off_truth(&scene, &EXACT, &all_around());
        eprintln!("{octaves} octaves: off by {off:e}");
        // 512 times a direction of f32 is off by 3e-5 rad.
        let most = if octaves == 10 { 3e-5 } else { 1e-5 };
        assert!(off < most, "{identity} {octaves} {appearance} {skip}: off by {off}");
    }
    let scene = empty(Arc::new(Sky::new(demo_model(None), DMat3::IDENTITY)));
    let off = off_truth(&scene, &EXACT, &all_around());
    eprintln!("the demo's sky: off by {off:e}");
    assert!(off < 1e-5, "the demo's sky: off by {off}");
}

#[test]
fn a_sky_behind_lenses_and_shutters() {
    let demo = empty(Arc::new(Sky::new(demo_model(None), DMat3::IDENTITY)));
    // At half the size: the sky is evaluated for each pixel, and has no finer detail.
    let half = |view: View| View { camera: view.camera.scaled(80, 50).unwrap(), ..view };
    let mut views: Vec<View> = lens_views().into_iter().map(half).collect();
    views.push(half(street_views()[1]));
    // Newton's steps alone do not converge here, neither from the middle nor from the end.
    let far = OpenCv::new([0.75, -0.27, -0.096, 0.0, 0.0, 0.0], [0.0; 2], [0.0; 4]);
    let pinhole = Pinhole { fx: 33.0, fy: 33.0, cx: 50.0, cy: 50.0 };
    let far = Camera { lens: Lens::opencv(far), ..Camera::from_pinhole(100, 100, pinhole) };
    views.push(half(View::new(far, views[0].world_from_camera)));
    for (what, scene) in [("small", empty(sky())), ("demo", demo)] {
        let exact = off_truth(&scene, &EXACT, &views);
        let baked = images_off(&scene, &RenderProfile::DEFAULT, &views);
        eprintln!("{what}: evaluated off by {exact:e}, baked by {baked:e} of the cpu's");
        assert!(exact < 2e-5 && baked < 2e-5, "{what}: {exact}, {baked}");
    }
    // Behind a street, and again without lenses on the same device.
    let street = Scene::from_gaussians(&street(5_000, 1, 6));
    let scene = Scene { sky: Some(sky()), ..street };
    let gpu = shared_gpu();
    for views in [&views[..], &street_views()] {
        for profile in [RenderProfile::DEFAULT, EXACT] {
            let truths = render(&cpu(), &scene, &profile, views);
            for (image, truth) in render(&*gpu, &scene, &profile, views).iter().zip(&truths) {
                agree(image, truth).unwrap();
            }
        }
    }
}

#[test]
fn images_and_a_background() {
    // A colour for every direction, so that edges of faces are not seams.
    let mut rgb8 = Vec::new();
    for face in 0..6 {
        for k in 0..81 {
            let at = |k: usize| (k as f64 + 0.5) / 9.0;
            let away = CubeMap::direction(face, [at(k % 9), at(k / 9)]).normalize();
            rgb8.extend((away * 120.0 + 128.0).to_array().map(|c| c as u8));
        }
    }
    let model = SkyModel::cube(CubeMap::from_faces(9, &rgb8).unwrap());
    let scene = empty(Arc::new(Sky::new(model, DMat3::IDENTITY)));
    assert!(difference(&scene, &RenderProfile::DEFAULT) < 5e-3);
    let background = RenderProfile { background: [0.2, 0.4, 0.9], ..RenderProfile::DEFAULT };
    assert!(difference(&Scene::default(), &background) < 1e-6);
    // One sky after another, on one device.
    let (gpu, views) = (gpu(), all_around());
    for scene in [empty(sky()), Scene::default(), scene, empty(sky())] {
        for profile in [RenderProfile::DEFAULT, background] {
            let images = render(&gpu, &scene, &profile, &views);
            let truths = render(&cpu(), &scene, &profile, &views);
            for (image, truth) in images.iter().zip(&truths) {
                assert!(max_difference(&image.rgba, &truth.rgba) < 5e-3);
            }
        }
    }
}

#[test]
fn a_sky_behind_gaussians() {
    let street = Scene::from_gaussians(&street(20_000, 1, 6));
    let scene = Scene { sky: Some(sky()), ..street };
    let gpu = gpu();
    let images = render(&gpu, &scene, &RenderProfile::DEFAULT, &street_views());
    let truths = render(&cpu(), &scene, &RenderProfile::DEFAULT, &street_views());
    for (image, truth) in images.iter().zip(&truths) {
        agree(image, truth).unwrap();
    }
    // A frame that is drawn in parts has the same bytes.
    let small = gpu_with_limits(bindings(2 << 20));
    let at_once = render(&gpu, &scene, &RenderProfile::DEFAULT, &street_views());
    assert!(render(&small, &scene, &RenderProfile::DEFAULT, &street_views()) == at_once);
}

#[test]
fn a_sky_larger_than_a_binding_is_refused() {
    let view = all_around()[0];
    let small = gpu_with_limits(bindings(64 << 10));
    let refused = try_render(&small, &empty(sky()), &RenderProfile::DEFAULT, &[view]);
    let what = "bytes of a sky in one binding of the GPU";
    assert_eq!(refused, Err(RenderError::TooMany { what, limit: 64 << 10 }));
}

#[test]
fn exposures_and_overlays() {
    let views = street_views();
    let street = Scene::from_gaussians(&street(10_000, 1, 4));
    let gpu = gpu();
    for scene in [street.clone(), Scene { sky: Some(sky()), ..street }] {
        for view in views {
            let seen = appearance(view);
            let [image, truth] =
                [&*gpu as &dyn Backend, &cpu()].map(|b| draw_seen(b, &scene, view, &seen));
            agree(&image, &truth).unwrap();
            // Another overlay of the same size replaces it.
            let hood = seen.overlay.as_ref().unwrap();
            let rgba8 = hood.rgba8().iter().map(|value| 255 - value).collect();
            let other = Arc::new(Overlay::new(hood.size_px()[0], rgba8).unwrap());
            let other = Appearance { overlay: Some(other), ..seen };
            let [image, truth] =
                [&*gpu as &dyn Backend, &cpu()].map(|b| draw_seen(b, &scene, view, &other));
            agree(&image, &truth).unwrap();
            // Without an overlay, none of them remains.
            let plain = render_one(&*gpu, &scene, &RenderProfile::DEFAULT, view);
            let truth = render_one(&cpu(), &scene, &RenderProfile::DEFAULT, view);
            agree(&plain, &truth).unwrap();
        }
    }
}

/// A compiler may contract products and sums in one variant of the shader and not in another:
/// graphics cards do.
#[test]
fn colours_have_the_same_bytes_whatever_else_is_requested() {
    let street = Scene::from_gaussians(&street(3_000, 1, 4));
    let scene = Scene { sky: Some(sky()), ..street };
    let profile = RenderProfile::DEFAULT;
    let view = street_views()[0];
    let seen = appearance(view);
    let pixels = view.camera.pixels();
    let draw = |with_maps: bool| {
        let mut rgb8 = vec![77; 3 * pixels];
        let mut depth_m = vec![f32::NAN; pixels];
        let mut instances = vec![77; pixels];
        let target = Target {
            rgb8: Some(&mut rgb8),
            depth_m: with_maps.then_some(&mut depth_m),
            instances: with_maps.then_some(&mut instances),
            appearance: Some(&seen),
            ..Target::default()
        };
        let frame = Frame { scene: &scene, profile: &profile, views: &[view] };
        shared_gpu().render(&frame, &mut [target], &|_, _| {}).unwrap();
        rgb8
    };
    assert!(draw(false) == draw(true));
}

/// A shader that is not compiled cannot fail. Here the variant of `rasterize` with a sky does not
/// parse.
#[test]
fn without_a_sky_nothing_of_it_is_compiled() {
    let broken = || {
        let shaders = Shaders::default();
        shaders.with_mutation("rasterize_map", "fn sky(view: u32", "fn sky(view: Nothing").unwrap()
    };
    let view = all_around()[0];
    render_one(&gpu_with(broken()), &Scene::default(), &RenderProfile::DEFAULT, view);
    // Without the log watch of `gpu_with`, since this one must fail.
    let gpu = Gpu::with_shaders(&AdapterChoice::Best, 0, broken()).unwrap();
    let failed = try_render(&gpu, &empty(sky()), &RenderProfile::DEFAULT, &[view]);
    assert!(matches!(failed, Err(RenderError::Device { .. })), "{failed:?}");
}

/// A comparison that cannot fail proves nothing.
#[test]
fn mutations_are_detected() {
    // One shader with all mutations of a variant, which is compiled once. A frame chooses one by
    // its profile's `far`.
    let far = |number: usize| 50_000.0 + number as f32;
    let detects = |variant, profile: &RenderProfile, views: &[View], mutations: &[(&str, &str)]| {
        let mut shaders = Shaders::default();
        for (number, (original, other)) in mutations.iter().enumerate() {
            let chosen = format!("select({original}, {other}, frame.far_m == {:?})", far(number));
            shaders = shaders.with_mutation(variant, original, &chosen).expect(original);
        }
        let gpu = gpu_with(shaders);
        let truths = render(&cpu(), &empty(sky()), profile, views);
        let off = |number: usize| {
            let profile = RenderProfile { far: far(number).into(), ..*profile };
            let images = render(&gpu, &empty(sky()), &profile, views);
            let off = images.iter().zip(&truths).map(|(a, b)| max_difference(&a.rgba, &b.rgba));
            off.fold(0.0, f32::max)
        };
        let without = off(mutations.len());
        assert!(without < 2e-5, "{variant} without a mutation: off by {without}");
        for (number, (original, _)) in mutations.iter().enumerate() {
            assert!(off(number) > 1e-3, "{original} was not detected");
        }
    };
    let map = [
        ("bits.x >> 16u", "bits.x >> 17u"),
        ("select(vec4u(3u), vec4u(2u), north)", "vec4u(2u)"),
        ("v[k] - row[k]", "u[k] - column[k]"),
        ("fma(row.y, y, row.z)", "fma(row.x, y, row.z)"),
    ];
    detects("rasterize_map", &RenderProfile::DEFAULT, &all_around(), &map);
    let network = [
        ("values[index + 3u]", "values[index + 2u]"),
        ("select(0u, encoded, background.skip != 0u)", "0u"),
        ("select(0.0, 0.5, wave >= background.octaves)", "0.0"),
        ("wave % background.octaves", "wave % 1u"),
    ];
    detects("rasterize_network", &EXACT, &all_around(), &network);
    let lens = [
        ("lenses[view_index].non_pinhole == 0u", "true"),
        ("vec2f(f32(k), 0.0)", "vec2f(0.0)"),
        ("-remaining_exposure(view_index, pixel_px)", "remaining_exposure(view_index, pixel_px)"),
        ("distort(view_index, next) - plane", "distort(view_index, next)"),
        (
            "off_axis_by(polynomial_inverse(view_index, length(plane)), plane)",
            "off_axis_by(length(plane), plane)",
        ),
        (
            "off_axis_by(polynomial_extrapolated(view_index, length(plane)), plane)",
            "off_axis_by(length(plane), plane)",
        ),
        (
            "through_windshield(view_index, inside, BACKWARD)",
            "through_windshield(view_index, inside, FORWARD)",
        ),
    ];
    detects("rasterize_map_lens", &RenderProfile::DEFAULT, &lens_views(), &lens);
}
