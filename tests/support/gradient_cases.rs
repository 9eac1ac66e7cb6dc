//! Scenes whose gradients the fast backends have in common with `reference`.

#![allow(dead_code, reason = "every test binary uses another part of it")]

use std::sync::Arc;

use wildcity_render::compare::gradients::{GroupError, group_errors, waves};
use wildcity_render::gradient::{Differentiate, GaussianImages, GradientError, Gradients};
use wildcity_render::reference::Reference;
use wildcity_render::{Frame, View};
use wildcity_scene::actor::{ContactShadow, PlacedChunk};
use wildcity_scene::geometry::Camera;
use wildcity_scene::geometry::camera::{Fisheye, Lens, ShutterDirection};
use wildcity_scene::{RenderProfile, Scene};

use crate::lenses::{lenses, rolling_view, street_scene};
use crate::placed::{actor, chunk, on_street, views as placed_views};
use crate::streets::{street, turning_views};

/// The images that the loss was asked about, and the gradients.
pub(crate) fn differentiate(
    backend: &dyn Differentiate,
    scene: &Scene,
    profile: &RenderProfile,
    views: &[View],
) -> (Vec<GaussianImages>, Gradients) {
    let mut gradients = Gradients::default();
    let mut seen = Vec::new();
    let frame = Frame { scene, profile, views };
    backend
        .differentiate(
            &frame,
            true,
            &mut |images| {
                seen = images.to_vec();
                waves(images)
            },
            &mut gradients,
        )
        .expect("gradients");
    (seen, gradients)
}

/// The gradients of a backend against those of `reference`: within 1e-4 of the largest entry of
/// each group of parameters, and with a cosine above 0.99999.
pub(crate) fn check_against_reference(
    case: &str,
    backend: &dyn Differentiate,
    scene: &Scene,
    profile: &RenderProfile,
    views: &[View],
) {
    let (our_images, ours) = differentiate(backend, scene, profile, views);
    let (their_images, theirs) = differentiate(&Reference, scene, profile, views);
    for (ours, theirs) in our_images.iter().zip(&their_images) {
        check_image(case, &ours.rgb, &theirs.rgb);
        check_image(case, &ours.opacity, &theirs.opacity);
        check_image(case, &ours.depth_sum_m, &theirs.depth_sum_m);
    }
    for GroupError { group, error, cosine } in group_errors(&ours, &[theirs]) {
        eprintln!("{case:20} {group:10} {error:.1e} {:.1e}", 1.0 - cosine);
        assert!(error < 1e-4 && cosine > 0.99999, "{case}: {group} is off by {error:e}, {cosine}");
    }
}

/// An image that a loss is given against that of `reference`, which is 0 outside of a lens' field:
/// within what one splat at the cut of alpha changes.
fn check_image(case: &str, ours: &[f32], theirs: &[f32]) {
    assert_eq!(ours.len(), theirs.len(), "{case}");
    let most = theirs.iter().fold(0.0_f32, |most, value| most.max(value.abs()));
    for (index, (ours, theirs)) in ours.iter().zip(theirs).enumerate() {
        let is_close = (ours - theirs).abs() <= most / 255.0;
        assert!(is_close, "{case}: value {index} is {ours} for {theirs}");
    }
}

/// Static pinholes at their native size and smaller, classic and antialiased.
pub(crate) fn check_pinholes(backend: &dyn Differentiate) {
    let scene = Scene::from_gaussians(&street(3_000, 3, 5));
    let small = |view: &View| View { camera: view.camera.scaled(120, 80).unwrap(), ..*view };
    let views: Vec<View> = turning_views().iter().map(small).collect();
    let native = |view: &View| {
        let camera = Camera { native_size_px: None, ..view.camera };
        View { camera, ..*view }
    };
    let native: Vec<View> = views.iter().map(native).collect();
    let classic = RenderProfile::default();
    let antialiased = RenderProfile { antialiased: true, ..classic };
    check_against_reference("classic", backend, &scene, &classic, &native);
    check_against_reference("antialiased", backend, &scene, &antialiased, &native);
    check_against_reference("shrunk", backend, &scene, &antialiased, &views);
}

/// Every lens, each at rest and with a rolling shutter.
pub(crate) fn check_lenses(backend: &dyn Differentiate) {
    let scene = Scene::from_gaussians(&street(1_500, 1, 6));
    let (_, pose) = street_scene();
    let directions = [
        ShutterDirection::TopToBottom,
        ShutterDirection::RightToLeft,
        ShutterDirection::BottomToTop,
        ShutterDirection::LeftToRight,
    ];
    let profile = RenderProfile { antialiased: true, ..RenderProfile::default() };
    // A field whose edge cuts splats: without the mask the images would be seen beyond it.
    let narrow = Lens::Fisheye(Fisheye::new([0.0; 4], Some(0.35)));
    let narrow = ("narrow fisheye", Camera { lens: narrow, ..lenses()[1].1 });
    let cases = lenses().into_iter().chain([narrow]);
    for ((name, camera), direction) in cases.zip(directions.into_iter().cycle()) {
        let camera = Camera { native_size_px: None, ..camera.scaled(80, 50).unwrap() };
        let views = [View::new(camera, pose), rolling_view(camera, pose, direction)];
        check_against_reference(name, backend, &scene, &profile, &views);
    }
}

/// Actors on a street, one of them tinted.
pub(crate) fn check_actors(backend: &dyn Differentiate) {
    let car = chunk(&actor(400, 2, 5));
    let place = |pose, index, tint| PlacedChunk {
        tint,
        ..PlacedChunk::at_rest(Arc::clone(&car), pose, index)
    };
    let placed = vec![
        place(on_street(26.0, 1.5, 0.3), 0, [1.0; 3]),
        place(on_street(30.0, -2.5, 1.4), 1, [0.4, 1.0, 0.7]),
    ];
    let scene = Scene { placed, ..Scene::from_gaussians(&street(1_000, 1, 7)) };
    for (name, view) in placed_views() {
        let camera = Camera { native_size_px: None, ..view.camera.scaled(80, 48).unwrap() };
        let view = View { camera, ..view };
        check_against_reference(name, backend, &scene, &RenderProfile::default(), &[view]);
    }
}

/// Losses that no backend accepts, and a scene that none differentiates.
pub(crate) fn check_refusals(backend: &dyn Differentiate) {
    let scene = Scene::from_gaussians(&street(100, 1, 5));
    let profile = RenderProfile::default();
    let view = turning_views()[0];
    let views = [View { camera: view.camera.scaled(40, 30).unwrap(), ..view }];
    let refused = |scene: &Scene, edit: &(dyn Fn(&mut Vec<GaussianImages>) + Sync)| {
        let frame = Frame { scene, profile: &profile, views: &views };
        let mut loss = |images: &[GaussianImages]| {
            let mut by = images.to_vec();
            edit(&mut by);
            by
        };
        backend.differentiate(&frame, true, &mut loss, &mut Gradients::default())
    };
    assert!(refused(&scene, &|_| {}).is_ok());
    // Derivatives by depth may be left out.
    assert!(refused(&scene, &|by| by[0].depth_sum_m.clear()).is_ok());
    assert_eq!(
        refused(&scene, &|by| by.clear()),
        Err(GradientError::Views { given: 0, wanted: 1 })
    );
    let given = 3 * 1_200 - 1;
    assert_eq!(
        refused(&scene, &|by| by[0].rgb.truncate(given)),
        Err(GradientError::Size { view: 0, image: "rgb", given, wanted: 3 * 1_200 })
    );
    assert_eq!(
        refused(&scene, &|by| by[0].opacity[17] = f32::INFINITY),
        Err(GradientError::NotFinite {
            view: 0,
            image: "opacity",
            index: 17,
            value: f32::INFINITY
        })
    );
    let nan = refused(&scene, &|by| by[0].depth_sum_m[1_199] = f32::NAN);
    let named = matches!(
        nan,
        Err(GradientError::NotFinite { view: 0, image: "depth_sum_m", index: 1_199, .. })
    );
    assert!(named, "{nan:?}");
    let mut shadowed = scene.clone();
    let car = PlacedChunk::at_rest(chunk(&actor(10, 0, 5)), on_street(26.0, 1.5, 0.3), 0);
    let shadow = Some(ContactShadow { length_m: 4.0, width_m: 2.0 });
    shadowed.placed.push(PlacedChunk { shadow, ..car });
    assert_eq!(refused(&shadowed, &|_| {}), Err(GradientError::Shadows));
    // And what was refused has left nothing behind.
    assert!(refused(&scene, &|_| {}).is_ok());
}

/// A scene in which every formula matters: views smaller than their native size, of which each sees
/// what the others do, a twin and a tinted actor with all spherical harmonics, antialiased.
pub(crate) struct MutationCase {
    scene: Scene,
    profile: RenderProfile,
    views: Vec<View>,
}

pub(crate) fn mutation_case() -> MutationCase {
    let car = chunk(&actor(300, 3, 5));
    let tint = [0.4, 1.0, 0.7];
    let placed =
        vec![PlacedChunk { tint, ..PlacedChunk::at_rest(car, on_street(24.0, 1.5, 0.3), 0) }];
    let scene = Scene { placed, ..Scene::from_gaussians(&street(800, 3, 7)) };
    let small = |(_, view): (_, View)| View { camera: view.camera.scaled(96, 64).unwrap(), ..view };
    let pinholes = placed_views().into_iter().filter(|(_, view)| view.is_static_pinhole());
    let mut views: Vec<View> =
        pinholes.map(small).chain(turning_views().into_iter().map(|v| small(("", v)))).collect();
    // One of native size: below it, the root of the determinant after the native blur cancels.
    views.extend(turning_views().first());
    // So low that many pixels reach it.
    let profile = RenderProfile { antialiased: true, alpha_cap: 0.8, ..RenderProfile::default() };
    MutationCase { scene, profile, views }
}

impl MutationCase {
    pub(crate) fn frame(&self) -> Frame<'_> {
        Frame { scene: &self.scene, profile: &self.profile, views: &self.views }
    }
}
