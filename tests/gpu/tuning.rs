//! Kernels of which a device chooses one by a threshold: all of them draw the same bytes. Here each
//! runs on every device.

use std::sync::Arc;

use glam::DMat3;
use wildcity_render::gpu::shaders::Shaders;
use wildcity_render::gpu::{Gpu, Scatter, Tuning};
use wildcity_render::{Backend, Frame, Target, View};
use wildcity_scene::{RenderProfile, Scene, Sky};

use crate::cameras::lens_views;
use crate::gpu::{Watched, gpu, gpu_with_tuning};
use crate::images::{Image, render};
use crate::mutations::{misty_street, wide_views};
use crate::skies::{appearance, demo_model, sky};
use crate::streets::{demo_street, street, street_views};
use crate::{placed, shared_gpu};

/// The kernels that software devices run.
pub(crate) const PLAIN: Tuning = Tuning { long_tile_splats: u32::MAX, scatter: Scatter::Plain };

/// The kernel of hardware that moves the keys of a sort, if the device can run it.
const BALLOTS: Tuning = Tuning { scatter: Scatter::EmulatedBallots, ..PLAIN };

/// Every tile has the kernel of long lists.
const LONG: Tuning = Tuning { long_tile_splats: 0, ..PLAIN };

/// Other choices, beside [`PLAIN`].
const CHOICES: [Tuning; 3] = [
    LONG,
    BALLOTS,
    // Some tiles have it and others not.
    Tuning { long_tile_splats: 40, ..BALLOTS },
];

fn tuned(tuning: Tuning) -> Watched {
    gpu_with_tuning(Shaders::default(), tuning)
}

/// A frame that is drawn by each choice of kernels.
struct Drawn {
    name: &'static str,
    scene: Scene,
    profile: RenderProfile,
    views: Vec<View>,
}

fn frames() -> Vec<Drawn> {
    let drawn = |name, scene, views| Drawn { name, scene, profile: RenderProfile::DEFAULT, views };
    let (demo, demo_views) = demo_street();
    let (actors, _) = placed::street_with_actors();
    let actor_views = placed::views().into_iter().map(|(_, view)| view).collect();
    let with_sky = |sky: Arc<Sky>| {
        let mut scene = Scene::from_gaussians(&street(4_000, 1, 82));
        scene.sky = Some(sky);
        scene
    };
    let exact = RenderProfile { sky_error: 0.0, ..RenderProfile::DEFAULT };
    let network = Arc::new(Sky::new(demo_model(None), DMat3::IDENTITY));
    vec![
        drawn("mist", Scene::from_gaussians(&misty_street(7_000)), wide_views()),
        drawn("street", Scene::from_gaussians(&street(60_000, 3, 81)), street_views().to_vec()),
        drawn("demo", Scene::from_gaussians(&demo), demo_views.to_vec()),
        drawn("lenses, shutters, sky of images", with_sky(sky()), lens_views()),
        Drawn { profile: exact, ..drawn("network", with_sky(network), street_views().to_vec()) },
        drawn("actors", actors, actor_views),
        drawn("nothing", Scene::default(), street_views().to_vec()),
    ]
}

/// Every output of a frame, with instance ids and appearances in a frame of their own.
fn draw(gpu: &Gpu, frame: &Drawn) -> (Vec<Image>, Vec<Vec<u8>>, Vec<Vec<u16>>) {
    let Drawn { scene, profile, views, .. } = frame;
    let images = render(gpu, scene, profile, views);
    let seen: Vec<_> = views.iter().map(|view| appearance(*view)).collect();
    let pixels = || views.iter().map(|view| view.camera.pixels());
    let mut colors: Vec<Vec<u8>> = pixels().map(|count| vec![7; 3 * count]).collect();
    let mut ids: Vec<Vec<u16>> = pixels().map(|count| vec![77; count]).collect();
    let mut targets: Vec<Target<'_>> = colors
        .iter_mut()
        .zip(&mut ids)
        .zip(&seen)
        .map(|((rgb8, ids), seen)| Target {
            rgb8: Some(rgb8),
            instances: Some(ids),
            appearance: Some(seen),
            ..Target::default()
        })
        .collect();
    gpu.render(&Frame { scene, profile, views }, &mut targets, &|_, _| {}).unwrap();
    drop(targets);
    (images, colors, ids)
}

#[test]
fn every_choice_of_kernels_draws_the_same_bytes() {
    let plain = tuned(PLAIN);
    let frames = frames();
    let truths: Vec<_> = frames.iter().map(|frame| draw(&plain, frame)).collect();
    let check = |gpu: &Gpu, choice: &str| {
        for (frame, truth) in frames.iter().zip(&truths) {
            assert!(draw(gpu, frame) == *truth, "{}, {choice}", frame.name);
        }
    };
    check(&gpu(), "the device's own choice");
    for tuning in CHOICES {
        check(&tuned(tuning), &format!("{tuning:?}"));
    }
}

/// Two thousand batches of long lists, in which the pixels stop at different times.
#[test]
fn a_hundred_frames_of_long_tiles_are_equal() {
    let scene = Scene::from_gaussians(&street(20_000, 1, 83));
    let gpu = tuned(Tuning { long_tile_splats: 40, ..PLAIN });
    let profile = RenderProfile::default();
    let first = render(&gpu, &scene, &profile, &street_views());
    for repeat in 1..100 {
        assert!(render(&gpu, &scene, &profile, &street_views()) == first, "repeat {repeat}");
    }
}

/// More tiles than have room: the rest are blended as those with short lists.
#[test]
fn tiles_beyond_the_room_for_long_ones() {
    let scene = Scene::from_gaussians(&misty_street(2_000));
    let views: Vec<View> = wide_views().into_iter().cycle().take(8).collect();
    let profile = RenderProfile::default();
    let draw = |tuning| render(&tuned(tuning), &scene, &profile, &views);
    assert!(draw(LONG) == draw(PLAIN));
}

/// Mutations of the kernels that software devices do not run. Which tiles have the kernel of long lists, and which splats
/// a thread walks over without blending them, changes only the time.
const MUTATIONS: &[(&str, &str, &str)] = &[
    ("long_tiles", "place = index + 1u", "place = index"),
    ("rasterize_long", "after > frame.stop", "after > 100.0 * frame.stop"),
    ("rasterize_long", "region % 2u * 8u", "region % 2u * 4u"),
    ("rasterize_long", "range.x + thread", "range.x"),
    ("rasterize_long", "first + BATCH + thread", "first + thread"),
    ("rasterize_long", "& 1u) << i", "& 1u) << (15u - i)"),
    ("rasterize_long", "blend(alphas.z, color_depths[c]", "blend(alphas.z, color_depths[d]"),
    ("rasterize_long", "(mean_factor.z, offset_px, first_u)", "(mean_factor.z, 0.0, first_u)"),
    ("rasterize_long", "min(index, max(range.y, 1u) - 1u)", "min(index, range.x)"),
    ("rasterize_long", "select(transmittance, after, counts)", "after"),
    ("rasterize_long", "own.x / 4u * 4u", "own.x"),
    ("rasterize", "at + 4u * plane", "at + 3u * plane"),
    ("rasterize", "(place - 1u) * LONG_TILE_WORDS", "place * LONG_TILE_WORDS"),
    ("sort_ballots_emulated", "select(~votes, votes, is_set)", "votes"),
    ("sort_ballots_emulated", "& below.x", "& ~below.x"),
    ("sort_ballots_emulated", "held && own_rank == 0u", "held"),
    ("sort_ballots_emulated", "before += sums[k]", "before += 0u"),
    ("sort_ballots_emulated", "before += starts[k]", "before += 0u"),
    ("sort_ballots_emulated", "before += counted", "before = counted"),
    ("sort_ballots_emulated", "let to = starts[digit(key)] + place", "let to = place"),
    ("sort_ballots_emulated", "totals[group.x] = before", "totals[group.x] = 0u"),
    ("sort_ballots_emulated", "store(place_3, values[first + ", "store(place_3, values["),
    ("sort_ballots_emulated", "at_5 = own + 5u", "at_5 = own + 4u"),
];

#[test]
fn a_mutation_of_these_kernels_changes_the_image() {
    let scene = Scene::from_gaussians(&misty_street(7_000));
    let profile = RenderProfile::default();
    let truth = render(&*shared_gpu(), &scene, &profile, &wide_views());
    let is_detected = |&(shader, original, replacement): &(&str, &str, &str)| {
        let broken = Shaders::default().with_mutation(shader, original, replacement);
        let broken = broken.unwrap_or_else(|| panic!("{shader} has no text {original:?}"));
        let choices: &[Tuning] = match shader {
            "sort_ballots_emulated" => &[BALLOTS],
            // Some tiles have long lists and others not, or all have.
            _ => &[Tuning { long_tile_splats: 40, ..PLAIN }, LONG],
        };
        choices.iter().any(|tuning| {
            let gpu = gpu_with_tuning(broken.clone(), *tuning);
            render(&gpu, &scene, &profile, &wide_views()) != truth
        })
    };
    let undetected: Vec<_> = MUTATIONS.iter().filter(|mutation| !is_detected(mutation)).collect();
    assert!(undetected.is_empty(), "{undetected:#?}");
}
