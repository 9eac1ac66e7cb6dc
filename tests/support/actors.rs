//! Actors in a street, and the same Gaussians as a part of the twin.

#![allow(dead_code, reason = "every test binary uses another part of it")]

use std::sync::Arc;

use glam::{DQuat, DVec3};
use wildcity_render::compare::gaussians::{
    GaussianSpec, forward_view, gaussians_from_specs, scene_from_specs,
};
use wildcity_render::{
    Backend, FIRST_ACTOR_INSTANCE, Frame, FrameStats, RenderError, RollingShutter, TWIN_INSTANCE,
    Target, View,
};
use wildcity_scene::actor::{ContactShadow, PlacedChunk};
use wildcity_scene::geometry::camera::{Fisheye, Lens, Pinhole, ShutterDirection};
use wildcity_scene::geometry::{Camera, Pose};
use wildcity_scene::{Chunk, Gaussians, RenderProfile, Scene, Selection, SemanticClass, sh};

use crate::images::{Image, agree, max_difference, psnr, render, render_one, try_render};
use crate::lenses::{lenses, rolling_view};
use crate::scene_files::Random;
use crate::streets::street;
use crate::vectors::{cases, number};

/// Size of the actor's box, in metres.
const BOX_M: [f64; 3] = [4.4, 1.8, 1.5];

/// `n` Gaussians in a box on the ground, x forward and z up.
pub(crate) fn actor(n: usize, sh_degree: u8, seed: u64) -> Gaussians {
    let mut random = Random(seed);
    let mut g = Gaussians::with_capacity(sh_degree, n);
    for _ in 0..n {
        let [x, y, z] = [0.5, 0.5, 0.0].map(|from| random.unit() - from);
        g.means_m.push([x * BOX_M[0], y * BOX_M[1], z * BOX_M[2]]);
        g.quats_wxyz.push([0; 4].map(|_| (random.unit() - 0.5) as f32));
        g.ln_scales.push([0.1, 0.02, 0.06].map(|s: f64| (s.ln() + random.unit() - 0.5) as f32));
        g.logit_opacities.push(random.between(-1.0, 4.0));
        g.sh.extend((0..3).map(|_| random.between(-1.5, 1.5)));
        g.sh.extend((3..3 * sh::coefficients(sh_degree)).map(|_| random.between(-0.3, 0.3)));
    }
    g
}

/// The chunk of an actor.
pub(crate) fn chunk(gaussians: &Gaussians) -> Arc<Chunk> {
    let mut chunks = Scene::from_gaussians(gaussians).chunks;
    assert_eq!(chunks.len(), 1);
    chunks.remove(0)
}

/// A pose in the street of [`street`], where y is down: `ahead_m` along it, on its ground, turned
/// by `yaw_rad`.
pub(crate) fn on_street(ahead_m: f64, aside_m: f64, yaw_rad: f64) -> Pose {
    // The actor's x along the street (z), its y to the left (-x), its z up (-y).
    let axes = glam::DMat3::from_cols(DVec3::Z, DVec3::NEG_X, DVec3::NEG_Y);
    let rotation = DQuat::from_mat3(&axes) * DQuat::from_rotation_z(yaw_rad);
    Pose { position_m: DVec3::new(aside_m, 1.6, ahead_m), rotation }
}

/// A pinhole, a fisheye, and both with a shutter that rolls while the camera drives at 30 m/s in a
/// curve.
pub(crate) fn views() -> Vec<(&'static str, View)> {
    let pinhole =
        Camera::from_pinhole(160, 96, Pinhole { fx: 110.0, fy: 112.0, cx: 79.0, cy: 49.0 });
    let lens = Lens::Fisheye(Fisheye::new([-0.03, -0.005, -0.0008, 0.001], None));
    let fisheye =
        Camera { lens, pinhole: Pinhole { fx: 60.0, fy: 60.0, ..pinhole.pinhole }, ..pinhole };
    let pose = Pose { position_m: DVec3::new(0.4, 0.0, 20.0), ..Pose::IDENTITY };
    let first = Pose {
        position_m: pose.position_m - DVec3::new(0.05, 0.0, 0.9),
        rotation: DQuat::from_rotation_y(-0.01),
    };
    let rolling = |camera, direction| {
        let rolling_shutter = Some(RollingShutter { direction, world_from_camera_first: first });
        View { rolling_shutter, ..View::new(camera, pose) }
    };
    vec![
        ("pinhole", View::new(pinhole, pose)),
        ("fisheye", View::new(fisheye, pose)),
        ("rolling pinhole", rolling(pinhole, ShutterDirection::TopToBottom)),
        ("rolling fisheye", rolling(fisheye, ShutterDirection::RightToLeft)),
    ]
}

/// The twin, three actors in it (two share a chunk, two overlap), and the same scene as one set of
/// Gaussians.
pub(crate) fn street_with_actors() -> (Scene, Scene) {
    let mut twin = street(10_000, 1, 31);
    let car = actor(3_000, 3, 5);
    let other = actor(2_000, 0, 6);
    let scene = Scene::from_gaussians(&twin);
    let (car_chunk, other_chunk) = (chunk(&car), chunk(&other));
    let placed = [
        (&car, &car_chunk, on_street(26.0, 1.5, 0.3)),
        (&other, &other_chunk, on_street(27.0, 2.0, -2.0)),
        (&car, &car_chunk, on_street(30.0, -2.5, 1.4)),
    ];
    let mut in_scene = Vec::new();
    for (index, (gaussians, chunk, pose)) in placed.into_iter().enumerate() {
        let mut moved = gaussians.clone();
        moved.transform(&pose);
        twin.append(&moved);
        in_scene.push(PlacedChunk::at_rest(Arc::clone(chunk), pose, index as u16));
    }
    (Scene { placed: in_scene, ..scene }, Scene::from_gaussians(&twin))
}

/// Every lens, with a global shutter and with one that rolls.
fn lens_views() -> Vec<(String, View)> {
    let pose = views()[0].1.world_from_camera;
    let directions = [
        ShutterDirection::TopToBottom,
        ShutterDirection::RightToLeft,
        ShutterDirection::BottomToTop,
        ShutterDirection::LeftToRight,
    ];
    let both = |((name, camera), direction): ((&'static str, Camera), ShutterDirection)| {
        let rolling = rolling_view(camera, pose, direction);
        [(name.to_owned(), View::new(camera, pose)), (format!("{name}, {direction:?}"), rolling)]
    };
    lenses().into_iter().zip(directions.into_iter().cycle()).flat_map(both).collect()
}

/// Asserts that actors are drawn as if the twin contained them, by some kinds of cameras.
pub(crate) fn check_merged(backend: &dyn Backend) {
    check_merged_views(backend, views());
}

/// As [`check_merged`], for every lens and shutter.
pub(crate) fn check_merged_lenses(backend: &dyn Backend) {
    check_merged_views(backend, lens_views());
}

fn check_merged_views(backend: &dyn Backend, views: Vec<(impl std::fmt::Display, View)>) {
    let (placed, merged) = street_with_actors();
    let twin = Scene { placed: Vec::new(), ..placed.clone() };
    let profile = RenderProfile::default();
    for (name, view) in views {
        let image = render_one(backend, &placed, &profile, view);
        let truth = render_one(backend, &merged, &profile, view);
        let db = psnr(&image.rgba, &truth.rgba);
        eprintln!("{}, {name}: {db:.1} dB", backend.name());
        assert!(db >= 60.0, "{name}: {db} dB");
        // A twin without them must be far off, or the bound proves nothing.
        let without = render_one(backend, &twin, &profile, view);
        let db = psnr(&without.rgba, &truth.rgba);
        assert!(db < 30.0, "{name}: {db} dB without the actors");
    }
}

/// Asserts that in an image with a rolling shutter, the motion of an actor has the same effect as
/// the opposite motion of the camera.
pub(crate) fn check_motion(backend: &dyn Backend) {
    let chunk = chunk(&actor(3_000, 3, 7));
    let profile = RenderProfile::default();
    for (name, rolling) in views().into_iter().filter(|(_, view)| view.rolling_shutter.is_some()) {
        let shutter = rolling.rolling_shutter.unwrap();
        let pose = on_street(26.0, 0.5, 0.3);
        let still = Scene {
            placed: vec![PlacedChunk::at_rest(chunk.clone(), pose, 0)],
            ..Scene::default()
        };
        let truth = render_one(backend, &still, &profile, rolling);

        // At the start of the exposure, the actor has the same pose relative to the camera at rest
        // as to the moving camera.
        let world_from_first = shutter.world_from_camera_first;
        let world_from_actor_at_start =
            rolling.world_from_camera * world_from_first.inverse() * pose;
        let moving = Scene {
            placed: vec![PlacedChunk { world_from_actor_at_start, ..still.placed[0].clone() }],
            ..Scene::default()
        };
        let readout = Some(shutter.direction);
        let at_rest = View { rolling_shutter: None, readout, ..rolling };
        let image = render_one(backend, &moving, &profile, at_rest);
        let db = psnr(&image.rgba, &truth.rgba);
        eprintln!("{}, {name}: {db:.1} dB", backend.name());
        assert!(db >= 60.0, "{name}: {db} dB");
        let frozen = render_one(backend, &still, &profile, at_rest);
        assert!(psnr(&frozen.rgba, &truth.rgba) < 40.0, "{name}: the motion shows nothing");
    }
}

/// Asserts that tints and contact shadows are those of the reference backend, and that both show.
pub(crate) fn check_light(backend: &dyn Backend, reference: &dyn Backend) {
    let (scene, _) = street_with_actors();
    let mut lit = scene.clone();
    let shadow = Some(ContactShadow { length_m: BOX_M[0] as f32, width_m: BOX_M[1] as f32 });
    for placed in &mut lit.placed {
        placed.tint = [1.5, 0.5, 0.25];
        placed.shadow = shadow;
    }
    // Raised above the ground by the gap under a parked car.
    lit.placed[2].world_from_actor.position_m.y += 0.1;
    let profile = RenderProfile::default();
    for (name, view) in views() {
        let image = render_one(backend, &lit, &profile, view);
        let truth = render_one(reference, &lit, &profile, view);
        agree(&image, &truth).unwrap_or_else(|e| panic!("{name}: {e}"));
        // Shadows darken, and change no opacity and no depth.
        let mut tinted = lit.clone();
        tinted.placed.iter_mut().for_each(|placed| placed.shadow = None);
        let bright = render_one(backend, &tinted, &profile, view);
        let darker = bright.rgba.iter().zip(&image.rgba).filter(|(a, b)| *a - *b > 0.02).count();
        assert!(darker > 20, "{name}: {darker} darker values");
        let lighter = bright.rgba.iter().zip(&image.rgba).any(|(a, b)| *b - *a > 1e-5);
        assert!(!lighter, "{name}: a shadow lightens");
        assert_eq!((bright.opacity, bright.depth_m), (image.opacity, image.depth_m), "{name}");
    }
}

/// Asserts that each view draws what was selected for it, with the bytes that it has alone: chunks
/// of the twin, actors, and their shadows.
pub(crate) fn check_selection(backend: &dyn Backend) {
    let (mut scene, _) = street_with_actors();
    let views: Vec<View> = views().into_iter().map(|(_, view)| view).collect();
    let all = views.len();
    // Each view lacks one chunk in three, and each actor is missing in another view.
    let twice: Vec<_> =
        scene.chunks.iter().flat_map(|chunk| [chunk.clone(), chunk.clone()]).collect();
    let of_chunk =
        |index: usize| (0..all).filter(|view| !(index + view).is_multiple_of(3)).collect();
    let by_chunk = (0..twice.len()).map(of_chunk).collect();
    let shadow = Some(ContactShadow { length_m: BOX_M[0] as f32, width_m: BOX_M[1] as f32 });
    for (actor, placed) in scene.placed.iter_mut().enumerate() {
        placed.views = (0..all).filter(|view| *view != actor).collect();
        placed.shadow = shadow;
    }
    scene.chunks = twice;
    let whole = scene.clone();
    scene.selection = Some(Selection { views: all, by_chunk });
    let profile = RenderProfile::default();
    let images = render(backend, &scene, &profile, &views);
    for (index, (image, view)) in images.iter().zip(&views).enumerate() {
        let name = backend.name();
        let alone = render_one(backend, &scene.for_view(index), &profile, *view);
        assert!(alone == *image, "{name}: view {index} among others");
        let other = render_one(backend, &whole, &profile, *view);
        assert!(other != *image, "{name}: view {index} draws everything");
    }
    let refused = try_render(backend, &scene, &profile, &views[1..]).unwrap_err();
    assert_eq!(refused, RenderError::Selection { views: all - 1, selected_for: all });
}

/// Asserts that frames do not affect later frames: a frame with actors does not change a frame
/// without them. Actors outside of all views change nothing either.
pub(crate) fn check_ghosts(backend: &dyn Backend) {
    let (scene, _) = street_with_actors();
    let twin = Scene { placed: Vec::new(), ..scene.clone() };
    // A pinhole and a lens: a software device that is loaded takes long for each.
    let views = [views()[0].1, views()[3].1];
    let draw = |scene: &Scene| render(backend, scene, &RenderProfile::default(), &views);
    let before: Vec<Image> = draw(&twin);
    let with = draw(&scene);
    assert!(max_difference(&before[0].rgba, &with[0].rgba) > 0.1, "actors are drawn");
    assert_eq!(before, draw(&twin));
    assert_eq!(with, draw(&scene));
    let mut behind = scene.clone();
    for placed in &mut behind.placed {
        *placed = PlacedChunk::at_rest(placed.chunk.clone(), on_street(-40.0, 0.0, 0.0), 0);
    }
    assert_eq!(before, draw(&behind));
}

/// The instance ids of one view.
pub(crate) fn instances(backend: &dyn Backend, scene: &Scene, view: View) -> (Vec<u16>, Vec<f32>) {
    let pixels = view.camera.pixels();
    let mut ids = vec![77; pixels];
    let mut opacity = vec![f32::NAN; pixels];
    let target =
        Target { instances: Some(&mut ids), opacity: Some(&mut opacity), ..Target::default() };
    let profile = RenderProfile::default();
    let frame = Frame { scene, profile: &profile, views: &[view] };
    backend.render(&frame, &mut [target], &|_, _| {}).unwrap();
    (ids, opacity)
}

/// Asserts that instance ids are those of the reference backend, that they belong to the visible
/// actors, and that requesting them changes no other image.
pub(crate) fn check_instances(backend: &dyn Backend, reference: &dyn Backend) {
    let (mut scene, _) = street_with_actors();
    scene.placed[2].actor = 40;
    for (name, view) in views() {
        let (ids, opacity) = instances(backend, &scene, view);
        let (truth, _) = instances(reference, &scene, view);
        let differing = ids.iter().zip(&truth).filter(|(a, b)| a != b).count();
        assert!(differing * 500 < ids.len(), "{name}: {differing} of {} differ", ids.len());
        for (pixel, (&id, &opacity)) in ids.iter().zip(&opacity).enumerate() {
            // A pixel without an instance has more than half of its transmittance left.
            assert_eq!(id == 0, opacity < 0.5, "{name}: pixel {pixel} is {id} at {opacity}");
        }
        let mut seen = ids.clone();
        seen.sort_unstable();
        seen.dedup();
        assert_eq!(seen, [0, 1, 2, 3, 42], "{name}");
        let image = render_one(backend, &scene, &RenderProfile::default(), view);
        assert_eq!(image.opacity, opacity, "{name}");
    }
    // All views in one frame.
    let views: Vec<View> = views().into_iter().map(|(_, view)| view).collect();
    let mut all: Vec<Vec<u16>> = views.iter().map(|view| vec![77; view.camera.pixels()]).collect();
    let targets = all.iter_mut().map(|ids| Target { instances: Some(ids), ..Target::default() });
    let mut targets: Vec<Target<'_>> = targets.collect();
    let profile = RenderProfile::default();
    let frame = Frame { scene: &scene, profile: &profile, views: &views };
    backend.render(&frame, &mut targets, &|_, _| {}).unwrap();
    drop(targets);
    for (ids, view) in all.iter().zip(&views) {
        assert_eq!(*ids, instances(backend, &scene, *view).0);
    }
}

/// A scene whose twin has classes, a mixture of those from [`SemanticClass::Road`] to
/// [`SemanticClass::Bicycle`] and of none. The first actor is a vehicle without classes. The second
/// is a person, and every other Gaussian of it has another class. The others have neither.
pub(crate) fn labelled(scene: &Scene) -> Scene {
    let mut scene = scene.clone();
    for chunk in &mut scene.chunks {
        let class = |i: usize| SemanticClass::ALL[1 + (i / 3) % 20];
        let classes = (0..chunk.len()).map(class).collect();
        *chunk = Arc::new(Chunk::clone(chunk).with_classes(Some(classes)));
    }
    if let Some(first) = scene.placed.first_mut() {
        first.class = SemanticClass::Vehicle;
    }
    if let Some(second) = scene.placed.get_mut(1) {
        second.class = SemanticClass::Person;
        let own = [SemanticClass::Rider, SemanticClass::Unlabelled];
        let classes = (0..second.chunk.len()).map(|i| own[i % 2]).collect();
        second.chunk = Arc::new(Chunk::clone(&second.chunk).with_classes(Some(classes)));
    }
    scene
}

/// The instance ids and classes of a view.
pub(crate) type Owners = (Vec<u16>, Vec<u8>);

/// The instance ids and classes of some views.
pub(crate) fn owners(
    backend: &dyn Backend,
    scene: &Scene,
    views: &[View],
) -> (Vec<Owners>, FrameStats) {
    let pixels = views.iter().map(|view| view.camera.pixels());
    let mut owners: Vec<_> = pixels.map(|pixels| (vec![77; pixels], vec![77; pixels])).collect();
    let targets = owners.iter_mut().map(|(ids, classes)| Target {
        instances: Some(ids),
        semantics: Some(classes),
        ..Target::default()
    });
    let mut targets: Vec<Target<'_>> = targets.collect();
    let profile = RenderProfile::default();
    let frame = Frame { scene, profile: &profile, views };
    let stats = backend.render(&frame, &mut targets, &|_, _| {}).unwrap();
    drop(targets);
    (owners, stats)
}

/// Asserts that classes are those of the reference backend, that they are of the Gaussians whose
/// instance ids are there, and that requesting them changes no other image.
pub(crate) fn check_semantics(backend: &dyn Backend, reference: &dyn Backend) {
    let scene = labelled(&street_with_actors().0);
    let unlabelled = street_with_actors().0;
    let vehicle = SemanticClass::Vehicle.value();
    let views: Vec<View> = views().into_iter().map(|(_, view)| view).collect();
    let (all, _) = owners(backend, &scene, &views);
    for (index, view) in views.iter().enumerate() {
        let (ids, classes) = &owners(backend, &scene, &[*view]).0[0];
        assert!((ids, classes) == (&all[index].0, &all[index].1), "view {index} among others");
        assert_eq!(*ids, instances(backend, &unlabelled, *view).0, "view {index}");
        let (truth_ids, truth) = &owners(reference, &scene, &[*view]).0[0];
        // Where the same Gaussian decides. A neighbour decides where a transmittance is near a
        // half.
        let differing = classes.iter().zip(truth).filter(|(a, b)| a != b).count();
        assert!(differing * 500 < ids.len(), "view {index}: {differing} of {} differ", ids.len());
        for ids_and_classes in [(ids, classes), (truth_ids, truth)] {
            let (ids, classes) = ids_and_classes;
            for (&id, &class) in ids.iter().zip(classes) {
                assert_eq!(class == 0, id == 0);
                assert_eq!(class == vehicle, id == FIRST_ACTOR_INSTANCE, "{id}, {class}");
                // Person and rider are among the twin's, too.
                assert!(id != FIRST_ACTOR_INSTANCE + 1 || [13, 14].contains(&class), "{class}");
                assert!(id <= FIRST_ACTOR_INSTANCE + 1 || class == 1, "{id}, {class}");
            }
        }
        let mut seen = classes.clone();
        seen.sort_unstable();
        seen.dedup();
        assert!(seen.len() > 15, "view {index}: only {seen:?}");
        // A twin without classes: the same owners, of which only actors have a class.
        let twin = Scene { chunks: unlabelled.chunks.clone(), ..scene.clone() };
        let (bare_ids, bare) = &owners(backend, &twin, &[*view]).0[0];
        assert_eq!(bare_ids, ids);
        for (id, (bare, class)) in ids.iter().zip(bare.iter().zip(classes)) {
            assert_eq!(*bare, if *id == TWIN_INSTANCE { 1 } else { *class });
        }
    }
}

/// Asserts that layers behind each other give the instance ids of the vectors.
pub(crate) fn check_instance_vectors(backend: &dyn Backend) {
    let Some(cases) = cases("own", "instance") else { return };
    for case in cases {
        let layers: Vec<[f64; 2]> = serde_json::from_value(case.input["layers"].clone()).unwrap();
        // After each layer: whose Gaussian decides, and how much of the light from behind is left.
        let after: Vec<(u16, f64)> =
            (1..=layers.len()).map(|count| through(backend, &layers[..count])).collect();
        let decides = after.iter().position(|(id, _)| *id != 0);
        let (id, left) = after[decides.unwrap_or(layers.len() - 1)];
        assert_eq!(f64::from(id), number(&case.expected["instance"]), "{}", case.name);
        let wanted = number(&case.expected["transmittance"]);
        assert!((left - wanted).abs() < 1e-6, "{}: {left}, not {wanted}", case.name);
        // Layers behind it change nothing.
        let behind = decides.map_or(&[][..], |decides| &after[decides..]);
        assert!(behind.iter().all(|later| later.0 == id), "{}: {after:?}", case.name);
    }
}

/// The instance id, and the share of the light that is left, behind wide Gaussians: each whose, and
/// its opacity.
fn through(backend: &dyn Backend, layers: &[[f64; 2]]) -> (u16, f64) {
    let mut twin = Vec::new();
    let mut placed = Vec::new();
    for (index, &[id, opacity]) in layers.iter().enumerate() {
        let wide = GaussianSpec { sigma_m: DVec3::ONE, opacity, ..GaussianSpec::default() };
        let at_m = DVec3::Z * (10.0 + index as f64);
        if id == f64::from(TWIN_INSTANCE) {
            twin.push(GaussianSpec { mean_m: at_m, ..wide });
            continue;
        }
        let chunk = chunk(&gaussians_from_specs(&[GaussianSpec { mean_m: DVec3::ZERO, ..wide }]));
        let pose = Pose { position_m: at_m, ..Pose::IDENTITY };
        placed.push(PlacedChunk::at_rest(chunk, pose, id as u16 - FIRST_ACTOR_INSTANCE));
    }
    let scene = Scene { placed, ..scene_from_specs(&twin) };
    // The centre of the middle pixel is where all of them are.
    let (ids, opacity) = instances(backend, &scene, forward_view([33, 33], 60.0));
    let middle = 33 * 33 / 2;
    (ids[middle], 1.0 - f64::from(opacity[middle]))
}
