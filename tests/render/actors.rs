//! Actors, drawn by the cpu and reference backends.

use std::sync::Arc;

use glam::DVec3;
use wildcity_render::compare::psnr::psnr_db;
use wildcity_render::cpu::{Cpu, Simd};
use wildcity_render::reference::Reference;
use wildcity_render::{Backend, Frame, RenderError, Target, View};
use wildcity_scene::actor::{ContactShadow, PlacedChunk};
use wildcity_scene::geometry::camera::ShutterDirection;
use wildcity_scene::{Rays, RenderProfile, Scene};

use crate::images::{cpu, render, render_one};
use crate::placed;
use crate::vectors::{cases, number, numbers};

#[test]
fn an_actor_is_drawn_as_if_the_twin_contained_it() {
    placed::check_merged(&cpu());
    placed::check_merged(&Reference);
}

#[test]
fn an_actor_is_drawn_through_every_lens_as_if_the_twin_contained_it() {
    placed::check_merged_lenses(&cpu());
}

#[test]
fn a_moving_actor_is_drawn_as_by_a_moving_camera() {
    placed::check_motion(&cpu());
    placed::check_motion(&Reference);
}

#[test]
fn tints_and_contact_shadows_are_those_of_the_reference() {
    placed::check_light(&cpu(), &Reference);
}

#[test]
fn contact_shadows_are_as_in_the_vectors() {
    let Some(cases) = cases("own", "contact shadow") else { return };
    for case in cases {
        let [length_m, width_m] =
            ["length", "width"].map(|field| number(&case.input[field]) as f32);
        let at_m = DVec3::from_slice(&numbers(&case.input["at"]));
        let found = ContactShadow { length_m, width_m }.factor(at_m);
        let wanted = number(&case.expected["factor"]);
        // The size is in f32.
        assert!((found - wanted).abs() < 1e-6, "{}: {found}, not {wanted}", case.name);
    }
}

/// On all cores, and with so little memory that views are drawn one after the other.
#[test]
fn each_view_draws_what_was_selected_for_it() {
    let small = Cpu::new(1, Simd::Best).unwrap();
    small.limit_frame_bytes(0);
    let backends: [&dyn Backend; 3] = [&cpu(), &small, &Reference];
    backends.into_iter().for_each(placed::check_selection);
}

#[test]
fn actors_leave_nothing_behind() {
    placed::check_ghosts(&cpu());
}

#[test]
fn instances_are_those_of_the_reference() {
    placed::check_instances(&cpu(), &Reference);
}

#[test]
fn classes_are_those_of_the_reference() {
    placed::check_semantics(&cpu(), &Reference);
}

#[test]
fn instances_are_those_of_the_vectors() {
    placed::check_instance_vectors(&cpu());
    placed::check_instance_vectors(&Reference);
}

/// Every instruction set, and any number of threads.
#[test]
fn actors_do_not_depend_on_threads_and_agree_on_instruction_sets() {
    let (scene, _) = placed::street_with_actors();
    let views: Vec<View> = placed::views().into_iter().map(|(_, view)| view).collect();
    let profile = RenderProfile::default();
    let alone = render(&Cpu::new(1, Simd::Best).unwrap(), &scene, &profile, &views);
    let many = render(&Cpu::new(7, Simd::Best).unwrap(), &scene, &profile, &views);
    assert_eq!(alone, many);
    for simd in [Simd::Sse42, Simd::Avx2, Simd::Avx512] {
        let Ok(backend) = Cpu::new(0, simd) else { continue };
        for (image, truth) in render(&backend, &scene, &profile, &views).iter().zip(&alone) {
            let differences = image.rgba.iter().zip(&truth.rgba).map(|(a, b)| f64::from(a - b));
            let db = psnr_db(differences);
            assert!(db > 70.0, "{simd:?}: {db} dB");
        }
    }
}

/// An actor that crosses at 30 m/s while a camera at rest exposes its rows in 30 ms: against the
/// ray of every pixel at its own moment.
#[test]
fn a_crossing_actor_agrees_with_exact_rays() {
    let pose = placed::on_street(27.0, 0.5, 1.5);
    let mut start = pose;
    start.position_m += DVec3::new(0.9, 0.0, 0.0);
    let chunk = placed::chunk(&placed::actor(1_000, 1, 7));
    let placed_chunk =
        PlacedChunk { world_from_actor_at_start: start, ..PlacedChunk::at_rest(chunk, pose, 0) };
    let scene = Scene { placed: vec![placed_chunk], ..Scene::default() };
    let readout = Some(ShutterDirection::TopToBottom);
    let view = View { readout, ..placed::views()[0].1 };
    let exact = RenderProfile { rays: Rays::Exact, ..RenderProfile::default() };
    let truth = render_one(&Reference, &scene, &exact, view);
    let image = render_one(&cpu(), &scene, &RenderProfile::default(), view);
    let db = crate::images::psnr(&image.rgba, &truth.rgba);
    assert!(db > 38.0, "{db} dB");
    let frozen = render_one(&cpu(), &scene, &RenderProfile::default(), placed::views()[0].1);
    let without = crate::images::psnr(&frozen.rgba, &truth.rgba);
    assert!(without < db - 10.0, "{without} dB without the motion");
}

#[test]
fn more_actors_than_are_drawn_are_refused() {
    let chunk = placed::chunk(&placed::actor(10, 0, 1));
    let one = PlacedChunk::at_rest(Arc::clone(&chunk), placed::on_street(30.0, 0.0, 0.0), 0);
    let scene = Scene { placed: vec![one; PlacedChunk::MAX_ACTORS + 1], ..Scene::default() };
    let view = placed::views()[0].1;
    let mut rgb8 = vec![0; 3 * view.camera.pixels()];
    let target = Target { rgb8: Some(&mut rgb8), ..Target::default() };
    let profile = RenderProfile::default();
    let frame = Frame { scene: &scene, profile: &profile, views: &[view] };
    let error = cpu().render(&frame, &mut [target], &|_, _| {}).unwrap_err();
    assert_eq!(error, RenderError::Actors { placed: 257, limit: 256 });
}
