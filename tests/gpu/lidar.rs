//! Sweeps of LiDARs on the device against the definition.

use std::sync::Arc;

use glam::DVec3;
use wildcity_options::LidarBeams;
use wildcity_render::gpu::shaders::Shaders;
use wildcity_render::lidar::{LidarView, Sweep};
use wildcity_render::reference::Reference;
use wildcity_render::{Backend, Frame, RenderError, Target, limits};
use wildcity_scene::geometry::{Lidar, Pose};
use wildcity_scene::random::Random;
use wildcity_scene::{Gaussians, RenderProfile, Scene};

use crate::gpu::{bindings, gpu, gpu_with, gpu_with_limits};
use crate::images::{cpu, view_along};
use crate::lidars::{
    check_classes, check_intensities, check_same, cloud, coincident, extremes, grid, in_motion,
    random_scene, same, spinning, stack, sweep, tables, turning, upright, with_actor,
};
use crate::shared_gpu;

/// Scenes with actors, and LiDARs at rest and in motion.
fn streets() -> Vec<(Scene, LidarView)> {
    let offset = |row: u32| f64::from(row % 4) * 0.03;
    let lidar = Lidar::from_options(&LidarBeams {
        row_azimuth_offsets_rad: Some((0..48).map(offset).collect()),
        ..spinning(48, 256).to_options()
    })
    .unwrap();
    let views = |seed| {
        let at_rest = LidarView::at_rest(Arc::new(lidar.clone()), upright());
        [at_rest, in_motion(&lidar)].map(|view| (with_actor(seed), view))
    };
    (0..2).flat_map(views).collect()
}

#[test]
fn sweeps_are_those_of_the_definition() {
    let gpu = shared_gpu();
    let mut cases = streets();
    cases.extend(extremes());
    cases.extend(turning());
    cases.extend([faint(), crowded(), cloud()]);
    for (number, (scene, view)) in cases.iter().enumerate() {
        let wanted = sweep(&Reference, scene, view);
        check_same(&sweep(&*gpu, scene, view), &wanted, &format!("case {number}"));
    }
    for (scene, view) in streets() {
        let found = sweep(&*gpu, &scene, &view);
        check_classes(&scene, &found, &sweep(&Reference, &scene, &view));
    }
    let (scene, view) = coincident();
    check_intensities(&sweep(&*gpu, &scene, &view), &sweep(&Reference, &scene, &view));
}

#[test]
fn the_tables_of_real_lidars_are_cast() {
    let Some(tables) = tables(32) else { return };
    let scene = random_scene(4_000, 7);
    let gpu = shared_gpu();
    for (name, lidar) in tables {
        let view = in_motion(&lidar);
        check_same(&sweep(&*gpu, &scene, &view), &sweep(&Reference, &scene, &view), &name);
    }
}

/// Beams that meet as many Gaussians as they can keep, the farthest ones first.
fn faint() -> (Scene, LidarView) {
    let mut gaussians = Gaussians::with_capacity(0, 1_200);
    for at in 0..1_200 {
        // Each begins nearer than the next, and its middle is farther.
        gaussians.means_m.push([20.0 - 0.001 * at as f64, 0.0, 0.0]);
        gaussians.ln_scales.push([(4.0 - 0.003 * at as f32).ln(), 2.0, 2.0]);
        gaussians.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
        // An alpha just above 1/255.
        gaussians.logit_opacities.push(-5.52);
        gaussians.sh.extend([0.001 * at as f32; 3]);
    }
    let lidar = grid([0.1, -0.1], 16, [0.1, -0.1], 16);
    (Scene::from_gaussians(&gaussians), LidarView::at_rest(Arc::new(lidar), Pose::IDENTITY))
}

/// A wall behind so many points that a software device compares them in several dispatches; and
/// more candidates than are compared at a time.
fn crowded() -> (Scene, LidarView) {
    let mut gaussians = Gaussians::with_capacity(0, 40_001);
    let mut add = |mean: [f64; 3], ln_scale: f32, logit: f32| {
        gaussians.means_m.push(mean);
        gaussians.ln_scales.push([ln_scale.min(-3.0), ln_scale, ln_scale]);
        gaussians.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
        gaussians.logit_opacities.push(logit);
        gaussians.sh.extend([0.4; 3]);
    };
    let mut random = Random::new(1, "crowd", 0);
    for _ in 0..40_000 {
        let range_m = random.range(3.0, 12.0);
        let place = [range_m, 0.1 * range_m, 0.1].map(|scale| scale * random.range(0.9, 1.0));
        add(place, -5.0, 2.0);
    }
    add([20.0, 0.0, 0.0], 2.0, 5.0);
    let lidar = grid([0.1, -0.1], 16, [0.1, -0.1], 16);
    (Scene::from_gaussians(&gaussians), LidarView::at_rest(Arc::new(lidar), Pose::IDENTITY))
}

/// A cloud that begins within the range of a LiDAR, and is met beyond it.
fn far() -> (Scene, LidarView) {
    let lidar = Lidar::from_options(&LidarBeams {
        max_range_m: Some(40.0),
        ..grid([0.1, -0.1], 16, [0.1, -0.1], 16).to_options()
    })
    .unwrap();
    let scene = stack(1, [50.0, 0.0, 0.0], [2.0, 4.0, 4.0], 5.0);
    (scene, LidarView::at_rest(Arc::new(lidar), Pose::IDENTITY))
}

#[test]
fn the_same_sweep_has_the_same_bytes() {
    let (scene, view) = &streets()[1];
    let first = sweep(&*shared_gpu(), scene, view);
    let other_device = gpu();
    for _ in 0..3 {
        assert!(sweep(&other_device, scene, view) == first);
    }
}

/// A scene without a Gaussian, and one whose only Gaussian lies between two columns, after a sweep
/// of a LiDAR with as many sectors that has returns everywhere.
#[test]
fn nothing_is_left_of_an_earlier_sweep() {
    let gpu = gpu();
    let lidar = Arc::new(grid([0.2, -0.2], 21, [1.0, -1.0], 41));
    let view = LidarView::at_rest(lidar, Pose::IDENTITY);
    let wall = stack(200, [8.0, 0.0, 0.0], [2.0; 3], -1.0);
    let before = sweep(&gpu, &wall, &view);
    assert!(before.range_m.iter().any(|range_m| *range_m > 0.0));
    let nothing = sweep(&gpu, &Scene::default(), &view);
    assert!(nothing.range_m.iter().all(|range_m| *range_m == 0.0));
    // The middle row has elevation 0, and columns are 0.05 rad apart.
    let [sin, cos] = [0.475_f64.sin(), 0.475_f64.cos()].map(|value| 10.0 * value);
    let between = stack(1, [cos, sin, 0.0], [-7.0; 3], 5.0);
    for _ in 0..3 {
        let unseen = sweep(&gpu, &between, &view);
        assert!(unseen.range_m.iter().all(|range_m| *range_m == 0.0));
        assert!(sweep(&gpu, &wall, &view) == before);
    }
}

/// Frames and sweeps of two threads on one device.
#[test]
fn sweeps_and_frames_do_not_disturb_each_other() {
    let gpu = shared_gpu();
    let (scene, lidar) = &streets()[1];
    let profile = RenderProfile::default();
    let views = [view_along([160, 96], 90.0, DVec3::ZERO, DVec3::Z, DVec3::Y)];
    let image = || {
        let mut rgb8 = vec![0; 3 * views[0].camera.pixels()];
        let target = Target { rgb8: Some(&mut rgb8), ..Target::default() };
        let frame = Frame { scene, profile: &profile, views: &views };
        gpu.render(&frame, &mut [target], &|_, _| {}).unwrap();
        rgb8
    };
    let wanted = (sweep(&*gpu, scene, lidar), image());
    std::thread::scope(|scope| {
        let sweeps = scope.spawn(|| (0..4).all(|_| sweep(&*gpu, scene, lidar) == wanted.0));
        assert!((0..12).all(|_| image() == wanted.1));
        assert!(sweeps.join().unwrap());
    });
}

/// A device whose bindings are too small for the hits of a sector.
#[test]
fn small_bindings_leave_sweeps_to_the_cpu() -> Result<(), RenderError> {
    let (scene, view) = &streets()[0];
    let gpu = gpu_with_limits(bindings(limits::BINDING_BYTES_MIN));
    let before = gpu.usage().unwrap().totals;
    let found = gpu.sweep(scene, &RenderProfile::default(), view)?;
    assert_eq!(gpu.usage().unwrap().totals, before);
    assert!(found == cpu().sweep(scene, &RenderProfile::default(), view)?);
    Ok(())
}

/// A device has no kernel and no buffer for sweeps before the first one.
#[test]
fn a_device_without_sweeps_has_nothing_of_them() {
    let gpu = gpu();
    let before = gpu.usage().unwrap().totals;
    let (scene, view) = &streets()[0];
    sweep(&gpu, scene, view);
    let after = gpu.usage().unwrap().totals;
    assert_eq!(after.pipelines, before.pipelines + 2);
    assert!(after.buffers >= before.buffers + 10);
    sweep(&gpu, scene, view);
    let again = gpu.usage().unwrap().totals;
    assert_eq!((again.pipelines, again.buffers), (after.pipelines, after.buffers));
}

/// Faults of the shader that the comparisons above have to notice.
const MUTATIONS: &[(&str, &str)] = &[
    ("sector.is_first == 1u", "false"),
    ("sector.is_first == 1u", "true"),
    ("Beam(0u, 1.0, sector.max_range_m)", "Beam(0u, 1.0, 1e9)"),
    ("atomicMax(&farthest_bits, bitcast<u32>(seen.end_m));", "atomicMax(&farthest_bits, 0u);"),
    ("min(lists[tile + 1u], first + sector.entries)", "first"),
    ("aside2 <= candidate.reach2 * step2", "true"),
    ("row >= (rows_of & 0xFFFFu)", "row > (rows_of & 0xFFFFu)"),
    ("at.cos_azimuth * angles.w", "0.0"),
    ("angles.y * at.up", "0.0 * at.up"),
    ("beam / sector.width * sector.columns", "beam / sector.width * sector.width"),
    ("at.cos_azimuth * angles.z - at.sin_azimuth * angles.w", "at.cos_azimuth"),
    ("row < (rows_of >> 16u)", "row + 1u < (rows_of >> 16u)"),
    ("candidate.mean_m - origin_m", "candidate.mean_m"),
    ("range_m > sector.min_range_m", "true"),
    ("HALF_LOG2_E * (aside2 / step2)", "0.9 * (aside2 / step2)"),
    ("a.range_m == b.range_m && a.key < b.key", "false"),
    ("hits[place(beam, at)] = before;", ""),
    ("min(seen.hits + 1u, sector.most_hits)", "min(seen.hits + 1u, 60u)"),
    ("return Beam(i + 1u, transmittance,", "return Beam(i, transmittance,"),
    ("luminance / (1.0 - transmittance)", "luminance"),
    ("sector.first_column + beam % sector.width", "beam % sector.width"),
];

#[test]
fn faults_of_the_shader_are_noticed() {
    let mut cases = streets();
    cases.truncate(2);
    cases.extend(extremes());
    cases.extend([coincident(), faint(), crowded(), far()]);
    let wanted: Vec<Sweep> =
        cases.iter().map(|(scene, view)| sweep(&Reference, scene, view)).collect();
    for (original, replacement) in MUTATIONS {
        let shaders = Shaders::default().with_mutation("lidar", original, replacement);
        let gpu = gpu_with(shaders.unwrap_or_else(|| panic!("no text {original:?}")));
        let is_same = cases
            .iter()
            .zip(&wanted)
            .all(|((scene, view), wanted)| same(&sweep(&gpu, scene, view), wanted));
        assert!(!is_same, "{original:?} as {replacement:?} is not noticed");
    }
}
