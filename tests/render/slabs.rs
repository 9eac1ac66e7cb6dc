//! The intermediate buffers of the cpu backend are bounded, whatever the scene, and no bound
//! changes the images.

use glam::DVec3;
use wildcity_render::cpu::Cpu;
use wildcity_render::{Backend, View};
use wildcity_scene::geometry::camera::ShutterDirection;
use wildcity_scene::{Gaussians, RenderProfile, Scene};

use crate::images::{Image, cpu, render, view_along};
use crate::lenses::{lenses, rolling_view, sideways_rolling_view, street_scene};
use crate::placed;
use crate::streets::{street, turning_views};

/// The least that a frame may be given.
const LEAST_BYTES: u64 = wildcity_render::limits::LANE_BYTES_MIN;

fn limited() -> Cpu {
    let backend = cpu();
    backend.limit_frame_bytes(0);
    backend
}

/// Renders with and without a bound, and compares every output and every count.
fn check(scene: &Scene, profile: &RenderProfile, views: &[View]) {
    let [bounded, free] = [limited(), cpu()];
    let images = render(&bounded, scene, profile, views);
    assert!(images == render(&free, scene, profile, views), "{views:?}");
    assert!(images.iter().any(|image: &Image| image.rgba.iter().any(|&value| value > 0.0)));
    // Instances and classes, of a scene that has both.
    let scene = &placed::labelled(scene);
    let [(bounded_owners, bounded_stats), (free_owners, free_stats)] =
        [&bounded, &free].map(|backend| placed::owners(backend, scene, views));
    let is_written = |(ids, classes): &placed::Owners| {
        !ids.contains(&77) && !classes.contains(&77) && classes.iter().any(|&class| class > 1)
    };
    assert!(bounded_owners == free_owners && bounded_owners.iter().all(is_written), "{views:?}");
    assert_eq!(bounded_stats.visible_pairs, free_stats.visible_pairs);
    assert_eq!(bounded_stats.instances, free_stats.instances);
    assert_eq!(bounded_stats.evaluations, free_stats.evaluations);
    let most_bytes = bounded.frame_bytes(views, profile);
    assert!(bounded_stats.held_bytes <= most_bytes, "{bounded_stats:?}: {most_bytes}");
    assert!(free_stats.held_bytes > 2 * LEAST_BYTES, "nothing to cut: {free_stats:?}");
}

/// The view with an image of 0.4 of its size, of which each pixel has four samples.
fn small(view: &View) -> View {
    let [width, height] =
        [view.camera.width_px, view.camera.height_px].map(|px| (2 * px / 5).into());
    View { camera: view.camera.scaled(width, height).unwrap(), ..*view }
}

#[test]
fn slabs_of_pinholes_have_the_bytes_of_the_whole() {
    let mut scene = Scene::from_gaussians(&street(200_000, 1, 41));
    check(&scene, &RenderProfile::default(), &turning_views());
    let profile = RenderProfile { background: [0.2, 0.4, 0.9], ..RenderProfile::default() };
    check(&scene, &profile, &turning_views()[..1]);
    // Pixels of several samples.
    let small: Vec<View> = turning_views()[..2].iter().map(self::small).collect();
    check(&scene, &profile, &small);
    scene.placed = placed::street_with_actors().0.placed;
    check(&scene, &RenderProfile::default(), &small);
    check(&scene, &RenderProfile::default(), &turning_views()[..2]);
}

#[test]
fn slabs_of_lenses_and_shutters_have_the_bytes_of_the_whole() {
    let (_, pose) = street_scene();
    let scene = Scene::from_gaussians(&street(150_000, 1, 42));
    for (_, camera) in lenses() {
        let camera = camera.scaled(240, 150).unwrap();
        check(&scene, &RenderProfile::default(), &[View::new(camera, pose)]);
        let rolling = rolling_view(camera, pose, ShutterDirection::TopToBottom);
        check(&scene, &RenderProfile::default(), &[rolling]);
    }
    let rolling = sideways_rolling_view();
    let images = render(&limited(), &scene, &RenderProfile::default(), &[rolling]);
    assert!(images == render(&cpu(), &scene, &RenderProfile::default(), &[rolling]));
}

/// A wall that faces the camera: every splat has the same depth, so that slabs differ only by ids.
#[test]
fn splats_of_one_depth_are_cut_by_their_ids() {
    let n = 120_000;
    let mut wall = street(n, 0, 43);
    for (mean, index) in wall.means_m.iter_mut().zip(0..) {
        *mean = [(index % 400) as f32 * 0.02 - 4.0, (index / 400) as f32 * 0.02 - 3.0, 8.0]
            .map(f64::from);
    }
    let view = view_along([320, 200], 240.0, DVec3::ZERO, DVec3::Z, DVec3::Y);
    check(&Scene::from_gaussians(&wall), &RenderProfile::default(), &[view]);
}

/// Few Gaussians that cover the image: what they take are pairs with macro tiles, which only bin
/// knows.
#[test]
fn large_splats_are_cut_by_their_macro_tiles() {
    let n = 6_000;
    let mut veils: Gaussians = street(n, 0, 44);
    for (index, (mean, scale)) in veils.means_m.iter_mut().zip(&mut veils.ln_scales).enumerate() {
        *mean = [0.0, 0.0, 5.0 + index as f64 * 0.01];
        *scale = [1.5; 3];
    }
    veils.logit_opacities.fill(-4.0);
    let view = view_along([640, 400], 350.0, DVec3::ZERO, DVec3::Z, DVec3::Y);
    check(&Scene::from_gaussians(&veils), &RenderProfile::default(), &[view; 2]);
}
