//! Actors, drawn by the cpu and reference backends.

use std::sync::Arc;

use glam::DVec3;
use wildcity_render::compare::psnr::psnr_db;
use wildcity_render::cpu::{Cpu, Simd};
use wildcity_render::reference::Reference;
use wildcity_render::{Backend, Frame, Readout, RenderError, Target, View};
use wildcity_scene::actor::PlacedChunk;
use wildcity_scene::geometry::camera::ShutterDirection;
use wildcity_scene::{Rays, RenderProfile, Scene};

use crate::images::{cpu, render, render_one};
use crate::placed;

#[test]
fn an_actor_is_drawn_as_if_the_twin_contained_it() {
    placed::check_merged(&cpu());
    placed::check_merged(&Reference);
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
fn actors_leave_nothing_behind() {
    placed::check_ghosts(&cpu());
}

#[test]
fn instances_are_those_of_the_reference() {
    placed::check_instances(&cpu(), &Reference);
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

/// An actor that crosses at 30 m/s while a camera at rest exposes its rows in 30 ms: against the ray of every pixel at
/// its own moment.
#[test]
fn a_crossing_actor_agrees_with_exact_rays() {
    let pose = placed::on_street(27.0, 0.5, 1.5);
    let mut start = pose;
    start.position_m += DVec3::new(0.9, 0.0, 0.0);
    let chunk = placed::chunk_of(&placed::actor(1_000, 1, 7));
    let placed_chunk =
        PlacedChunk { world_from_actor_at_start: start, ..PlacedChunk::at_rest(chunk, pose, 0) };
    let scene = Scene { placed: vec![placed_chunk], ..Scene::default() };
    let readout = Some(Readout { direction: ShutterDirection::TopToBottom, share: 1.0 });
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
    let chunk = placed::chunk_of(&placed::actor(10, 0, 1));
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

/// Step time with 50 actors of 100,000 Gaussians, against the same Gaussians within the twin.
#[test]
#[ignore = "a minute and 2 GB: cargo test --release -p wildcity-render --test render fifty -- --ignored --nocapture"]
fn fifty_cars_cost_as_much_as_in_the_twin() {
    let street = wildcity_generate::street(&wildcity_generate::StreetSettings::default()).unwrap();
    let mut model = wildcity_generate::actor_models().remove(1).gaussians;
    // 100,000 Gaussians: the model again and again, each time smaller by a hundredth.
    let own = model.clone();
    while model.len() < 100_000 {
        let mut more = own.select(0..own.len().min(100_000 - model.len()));
        let share = 1.0 - 0.01 * (model.len() / own.len()) as f64;
        more.means_m.iter_mut().for_each(|mean_m| *mean_m = mean_m.map(|m| share * m));
        model.append(&more);
    }
    let chunk = Arc::new(Scene::single_chunk(&model));
    let mut merged = street.gaussians.clone();
    let mut scene = Scene::from_gaussians(&street.gaussians);
    for index in 0..50_u16 {
        let station = street.trajectory.at_station(60.0 + 2.5 * f64::from(index / 2));
        let beside = glam::DVec3::new(0.0, if index % 2 == 0 { 0.0 } else { 3.2 }, 0.0);
        let pose = wildcity_scene::geometry::Pose {
            position_m: station.transform_point(beside),
            ..station
        };
        let mut moved = model.clone();
        moved.transform(&pose);
        merged.append(&moved);
        scene.placed.push(PlacedChunk::at_rest(Arc::clone(&chunk), pose, index));
    }
    let merged = Scene::from_gaussians(&merged);
    let rig = wildcity_scene::Rig::preset("vehicle6").unwrap();
    let world_from_rig = street.trajectory.at_station(50.0);
    let views: Vec<View> = View::of_rig(&rig.cameras, world_from_rig)
        .into_iter()
        .map(|view| {
            let [width, height] = [view.camera.width_px / 2, view.camera.height_px / 2];
            let camera = view.camera.scaled(width.into(), height.into()).unwrap();
            View { camera, ..view }
        })
        .collect();
    let backend = cpu();
    let profile = RenderProfile::default();
    let mut buffers: Vec<Vec<u8>> =
        views.iter().map(|view| vec![0; 3 * view.camera.pixels()]).collect();
    let mut time_ms = |scene: &Scene| {
        let targets = buffers.iter_mut().map(|b| Target { rgb8: Some(b), ..Target::default() });
        let mut targets: Vec<Target<'_>> = targets.collect();
        let frame = Frame { scene, profile: &profile, views: &views };
        let start = std::time::Instant::now();
        let stats = backend.render(&frame, &mut targets, &|_, _| {}).unwrap();
        (start.elapsed().as_secs_f64() * 1e3, stats)
    };
    // In pairs, and the median of their ratios: the machine may be loaded.
    let mut ratios = Vec::new();
    for _ in 0..9 {
        let (baked_ms, baked) = time_ms(&merged);
        let (placed_ms, placed) = time_ms(&scene);
        eprintln!(
            "baked {baked_ms:.0} ms {:?}, placed {placed_ms:.0} ms {:?}",
            baked.stages_ms, placed.stages_ms
        );
        ratios.push(placed_ms / baked_ms);
    }
    ratios.sort_by(f64::total_cmp);
    eprintln!("ratio {:.3}", ratios[4]);
    assert!(ratios[4] <= 1.1, "{ratios:?}");
}
