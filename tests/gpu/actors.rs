//! Actors, drawn by the gpu backend.

use wildcity_render::gpu::{AdapterChoice, Gpu};
use wildcity_render::hybrid::HybridBackend;
use wildcity_render::reference::Reference;
use wildcity_render::stage::Stage;
use wildcity_render::{Backend, Frame, Target, View};
use wildcity_scene::{RenderProfile, Scene};

use crate::gpu::{bindings, gpu, gpu_with_limits};
use crate::images::{agree, cpu, render, render_one};
use crate::{placed, shared_gpu};

#[test]
fn an_actor_is_drawn_as_if_the_twin_contained_it() {
    placed::check_merged(&*shared_gpu());
}

#[test]
fn an_actor_is_drawn_through_every_lens_as_if_the_twin_contained_it() {
    placed::check_merged_lenses(&*shared_gpu());
}

#[test]
fn a_moving_actor_is_drawn_as_by_a_moving_camera() {
    placed::check_motion(&*shared_gpu());
}

#[test]
fn tints_and_contact_shadows_are_those_of_the_reference() {
    placed::check_light(&*shared_gpu(), &Reference);
}

#[test]
fn each_view_draws_what_was_selected_for_it() {
    placed::check_selection(&*shared_gpu());
    let own = Gpu::new(&AdapterChoice::Best, 0).unwrap();
    placed::check_selection(&HybridBackend::new(cpu(), own, Stage::Project));
}

#[test]
fn actors_leave_nothing_behind() {
    placed::check_ghosts(&*shared_gpu());
}

#[test]
fn instances_are_those_of_the_reference() {
    placed::check_instances(&*shared_gpu(), &Reference);
}

#[test]
fn classes_are_those_of_the_reference() {
    placed::check_semantics(&*shared_gpu(), &Reference);
}

/// In regions, on a device with small bindings.
#[test]
fn classes_of_regions_are_those_of_the_whole() {
    let scene = placed::labelled(&placed::street_with_actors().0);
    let views: Vec<View> = placed::views().into_iter().map(|(_, view)| view).collect();
    let small = gpu_with_limits(bindings(512 << 10));
    let (in_regions, _) = placed::owners(&small, &scene, &views);
    let (whole, _) = placed::owners(&*shared_gpu(), &scene, &views);
    assert!(in_regions == whole);
    assert!(regions(&small) > 1, "the frame fitted at once");
}

#[test]
fn instances_are_those_of_the_vectors() {
    placed::check_instance_vectors(&*shared_gpu());
}

/// The cpu runs the first stages, the gpu the rest.
#[test]
fn instances_of_stages_that_ran_on_the_cpu() {
    let (scene, _) = placed::street_with_actors();
    let views: Vec<View> = placed::views().into_iter().map(|(_, view)| view).collect();
    let profile = RenderProfile::default();
    let frame = Frame { scene: &scene, profile: &profile, views: &views };
    for last in Stage::ALL {
        let mut all: Vec<Vec<u16>> =
            views.iter().map(|view| vec![77; view.camera.pixels()]).collect();
        let targets =
            all.iter_mut().map(|ids| Target { instances: Some(ids), ..Target::default() });
        let mut targets: Vec<Target<'_>> = targets.collect();
        let own = Gpu::new(&AdapterChoice::Best, 0).unwrap();
        let hybrid = HybridBackend::new(cpu(), own, last);
        hybrid.render(&frame, &mut targets, &|_, _| {}).unwrap();
        drop(targets);
        for (ids, view) in all.iter().zip(&views) {
            let (truth, _) = placed::instances(&cpu(), &scene, *view);
            let differing = ids.iter().zip(&truth).filter(|(a, b)| a != b).count();
            assert!(differing * 500 < ids.len(), "{last:?}: {differing} of {}", ids.len());
        }
    }
}

/// The cpu runs the first stages, the gpu the rest.
#[test]
fn classes_of_stages_that_ran_on_the_cpu() {
    let scene = placed::labelled(&placed::street_with_actors().0);
    let views: Vec<View> = placed::views().into_iter().map(|(_, view)| view).collect();
    let (truth, _) = placed::owners(&cpu(), &scene, &views);
    for last in Stage::ALL {
        let own = Gpu::new(&AdapterChoice::Best, 0).unwrap();
        let (owners, _) = placed::owners(&HybridBackend::new(cpu(), own, last), &scene, &views);
        for ((ids, classes), (true_ids, true_classes)) in owners.iter().zip(&truth) {
            let same = |pixel: &usize| {
                (ids[*pixel], classes[*pixel]) == (true_ids[*pixel], true_classes[*pixel])
            };
            let differing = ids.len() - (0..ids.len()).filter(same).count();
            assert!(differing * 500 < ids.len(), "{last:?}: {differing} of {}", ids.len());
        }
    }
}

/// All views in one frame: pinholes and lenses, with lenses of actors beside those of views. And in
/// regions, on a device with small bindings.
#[test]
fn all_views_at_once_and_region_by_region() {
    let (scene, _) = placed::street_with_actors();
    let views: Vec<View> = placed::views().into_iter().map(|(_, view)| view).collect();
    let profile = RenderProfile::default();
    let together = render(&*shared_gpu(), &scene, &profile, &views);
    for (image, view) in together.iter().zip(&views) {
        let truth = render_one(&Reference, &scene, &profile, *view);
        agree(image, &truth).unwrap();
    }
    let small = gpu_with_limits(bindings(512 << 10));
    let in_regions = render(&small, &scene, &profile, &views);
    for (image, truth) in in_regions.iter().zip(&together) {
        agree(image, truth).unwrap();
    }
    assert!(regions(&small) > 1, "the frame fitted at once");
}

fn regions(gpu: &Gpu) -> u64 {
    gpu.usage().unwrap().regions
}

/// Two placements of one asset take its memory once; a frame without actors uses no pipeline of
/// theirs.
#[test]
fn actors_share_memory_and_cost_nothing_when_absent() {
    let (scene, _) = placed::street_with_actors();
    let twin = Scene { placed: Vec::new(), ..scene.clone() };
    let view = placed::views()[0].1;
    let profile = RenderProfile::default();
    let gpu = gpu();
    let before = {
        render_one(&gpu, &twin, &profile, view);
        let first = gpu.usage().unwrap();
        render_one(&gpu, &twin, &profile, view);
        [first, gpu.usage().unwrap()]
    };
    let alone = before[1].totals.dispatches - before[0].totals.dispatches;
    render_one(&gpu, &scene, &profile, view);
    let with = gpu.usage().unwrap();
    assert!(with.totals.pipelines > before[1].totals.pipelines);
    // The same actor twice more, and no byte more.
    let mut more = scene.clone();
    more.placed.extend(scene.placed.clone());
    render_one(&gpu, &more, &profile, view);
    assert_eq!(gpu.usage().unwrap().mirror_bytes, with.mirror_bytes);
    let dispatches = gpu.usage().unwrap().totals.dispatches;
    render_one(&gpu, &twin, &profile, view);
    assert_eq!(gpu.usage().unwrap().totals.dispatches - dispatches, alone);
}

#[test]
fn a_chunk_that_was_dropped_is_dropped_from_the_device() {
    let (scene, _) = placed::street_with_actors();
    let view = placed::views()[0].1;
    let gpu = gpu();
    let profile = RenderProfile::default();
    let draw = |scene: &Scene| {
        render_one(&gpu, scene, &profile, view);
        gpu.usage().unwrap().mirror_bytes
    };
    let twin = Scene { placed: Vec::new(), ..scene.clone() };
    let alone = draw(&twin);
    let many = Scene {
        placed: (0..8)
            .map(|seed| {
                let chunk = placed::chunk(&placed::actor(20_000, 3, seed));
                let pose = placed::on_street(30.0, 0.0, 0.0);
                wildcity_scene::actor::PlacedChunk::at_rest(chunk, pose, seed as u16)
            })
            .collect(),
        ..twin.clone()
    };
    let with = draw(&many);
    assert!(with > alone + 8 * 20_000 * 60, "{alone} B, then {with} B");
    drop(many);
    assert!(draw(&twin) < with, "the device keeps what main memory has dropped");
}
