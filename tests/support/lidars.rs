//! LiDARs, scenes that they sweep, and the comparison of two sweeps.

#![allow(dead_code, reason = "the tests of the backends use different parts of it")]

use std::collections::BTreeSet;
use std::f64::consts::{FRAC_PI_2, TAU};
use std::sync::Arc;

use glam::{DQuat, DVec3};
use wildcity_options::{LidarBeams, LidarColumns};
use wildcity_render::lidar::{LidarView, Sweep};
use wildcity_render::{Backend, FIRST_ACTOR_INSTANCE};
use wildcity_scene::actor::PlacedChunk;
use wildcity_scene::geometry::{Lidar, Pose};
use wildcity_scene::random::Random;
use wildcity_scene::{Chunk, Gaussians, RenderProfile, Scene, SemanticClass};

use crate::data::real;
use crate::placed::labelled;
use crate::streets::street;

/// The tables of four real LiDARs, with every `each`-th column.
pub(crate) fn tables(each: usize) -> Option<Vec<(String, Lidar)>> {
    let table = |lidar: &str| {
        let model = "row-offset-spinning-lidar-model-parameters";
        let path = real(&format!("rigs/lidar_tables/{model}{lidar}.json"))?;
        let json: serde_json::Value =
            serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
        let numbers =
            |field: &str| -> Vec<f64> { serde_json::from_value(json[field].clone()).unwrap() };
        let azimuths = numbers("column_azimuths_rad").into_iter().step_by(each);
        let beams = LidarBeams {
            row_elevations_rad: numbers("row_elevations_rad"),
            row_azimuth_offsets_rad: Some(numbers("row_azimuth_offsets_rad")),
            column_azimuths_rad: Some(azimuths.collect()),
            columns: None,
            duration_us: 100_000,
            min_range_m: None,
            max_range_m: None,
        };
        Some((lidar.to_owned(), Lidar::from_options(&beams).unwrap()))
    };
    ["", "-waymo", "-pandaset", "-hesai-at128"].into_iter().map(table).collect()
}

/// A LiDAR with rows from 10 degrees above to 30 below, and columns all around, clockwise.
pub(crate) fn spinning(rows: usize, columns: u64) -> Lidar {
    let row = |row: usize| (10.0 - 40.0 * row as f64 / (rows.max(2) - 1) as f64).to_radians();
    Lidar::from_options(&LidarBeams {
        row_elevations_rad: (0..rows).map(row).collect(),
        row_azimuth_offsets_rad: None,
        column_azimuths_rad: None,
        columns: Some(LidarColumns { count: columns, first_rad: 3.1, last_rad: 3.1 - TAU + 0.01 }),
        duration_us: 100_000,
        min_range_m: None,
        max_range_m: None,
    })
    .unwrap()
}

pub(crate) fn sweep(backend: &dyn Backend, scene: &Scene, view: &LidarView) -> Sweep {
    backend.sweep(scene, &RenderProfile::default(), view).unwrap()
}

/// The beams that return from other places, or of another luminance.
fn differing(found: &Sweep, wanted: &Sweep) -> Vec<usize> {
    let differs = |at: &usize| {
        (found.range_m[*at] - wanted.range_m[*at]).abs() > 1e-3
            || found.instance[*at] != wanted.instance[*at]
            || (found.intensity[*at] - wanted.intensity[*at]).abs() > 1e-3
    };
    (0..wanted.range_m.len()).filter(differs).collect()
}

/// Whether all but a few beams agree: see [`check_same`].
pub(crate) fn same(found: &Sweep, wanted: &Sweep) -> bool {
    differing(found, wanted).len() <= wanted.range_m.len() / 1_000
}

/// Requires that all but a few beams return from the same place, within a millimetre. A beam for
/// which half of the light is left within the rounding of f32 may return from the next Gaussian.
pub(crate) fn check_same(found: &Sweep, wanted: &Sweep, what: &str) {
    let beams = wanted.range_m.len();
    assert_eq!(found.range_m.len(), beams);
    let returns = wanted.range_m.iter().filter(|range_m| **range_m > 0.0).count();
    assert!(4 * returns > beams, "{what}: {returns} returns of {beams} beams test too little");
    let others = differing(found, wanted);
    assert!(
        same(found, wanted),
        "{what}: {} of {beams} beams differ; the first: {:?}",
        others.len(),
        others
            .iter()
            .take(5)
            .map(|at| (*at, found.range_m[*at], wanted.range_m[*at]))
            .collect::<Vec<_>>()
    );
}

/// Requires that all but a few beams return from Gaussians of the same class, and that an actor is
/// a vehicle.
pub(crate) fn check_classes(scene: &Scene, found: &Sweep, wanted: &Sweep) {
    let [classes, wanted] = [found, wanted].map(|sweep| sweep.classes(scene).unwrap());
    let others = classes.iter().zip(&wanted).filter(|(one, other)| one != other).count();
    assert!(others <= classes.len() / 500, "{others} of {} beams differ", classes.len());
    for (at, class) in classes.iter().enumerate() {
        let is_actor = found.instance[at] >= FIRST_ACTOR_INSTANCE;
        assert_eq!(*class == SemanticClass::Vehicle, is_actor, "beam {at}");
        assert_eq!(*class == SemanticClass::None, found.range_m[at] == 0.0, "beam {at}");
    }
    let kinds: BTreeSet<u8> = classes.iter().map(|class| class.value()).collect();
    assert!(kinds.len() > 10, "{} classes test too little", kinds.len());
}

/// A scene whose y points down, as a LiDAR with z up sees it, 20 m down the street.
pub(crate) fn upright() -> Pose {
    // x of the LiDAR is z of the scene, y is -x, z is -y.
    let rotation = DQuat::from_rotation_y(-FRAC_PI_2) * DQuat::from_rotation_x(FRAC_PI_2);
    Pose { position_m: DVec3::new(0.4, 0.0, 20.0), rotation }
}

/// A street whose Gaussians are so large that few gaps are left between them.
pub(crate) fn dense_street(count: usize, seed: u64) -> Gaussians {
    let mut gaussians = street(count, 1, seed);
    gaussians.ln_scales.as_flattened_mut().iter_mut().for_each(|ln| *ln += 1.5);
    gaussians
}

pub(crate) fn random_scene(count: usize, seed: u64) -> Scene {
    Scene::from_gaussians(&dense_street(count, seed))
}

/// The street with an actor of 500 Gaussians that drives and turns during the sweep.
pub(crate) fn with_actor(seed: u64) -> Scene {
    let mut scene = random_scene(6_000, seed);
    let mut body = Gaussians::with_capacity(0, 500);
    for at in 0..500 {
        let angle = 0.7 * at as f64;
        body.means_m.push([angle.cos(), angle.sin(), 0.003 * at as f64]);
        body.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
        body.ln_scales.push([-2.5; 3]);
        body.logit_opacities.push(3.0);
        body.sh.extend([0.5; 3]);
    }
    let start = Pose { position_m: DVec3::new(-1.0, 0.5, 27.0), rotation: DQuat::IDENTITY };
    let end =
        Pose { position_m: DVec3::new(1.0, 0.5, 26.0), rotation: DQuat::from_rotation_y(0.05) };
    let chunk = Arc::new(Scene::single_chunk(&body));
    let placed = PlacedChunk::at_rest(chunk, end, 3);
    scene.placed.push(PlacedChunk { world_from_actor_at_start: start, ..placed });
    labelled(&scene)
}

/// As the actor's own test, with a LiDAR at 30 m/s that turns at half a radian a second.
pub(crate) fn in_motion(lidar: &Lidar) -> LidarView {
    let last = upright();
    let first = Pose {
        position_m: last.position_m - DVec3::new(0.2, 0.0, 3.0),
        rotation: DQuat::from_rotation_y(0.05) * last.rotation,
    };
    LidarView {
        lidar: Arc::new(lidar.clone()),
        world_from_lidar: last,
        world_from_lidar_first: first,
    }
}

/// A LiDAR of some rows and columns, evenly within these angles in radians.
pub(crate) fn grid(elevations: [f64; 2], rows: usize, azimuths: [f64; 2], columns: u64) -> Lidar {
    let step = (elevations[1] - elevations[0]) / (rows.max(2) - 1) as f64;
    Lidar::from_options(&LidarBeams {
        row_elevations_rad: (0..rows).map(|row| elevations[0] + step * row as f64).collect(),
        row_azimuth_offsets_rad: None,
        column_azimuths_rad: None,
        columns: Some(LidarColumns {
            count: columns,
            first_rad: azimuths[0],
            last_rad: azimuths[1],
        }),
        duration_us: 100_000,
        min_range_m: Some(0.1),
        max_range_m: None,
    })
    .unwrap()
}

/// Equal Gaussians in one place.
pub(crate) fn stack(count: usize, mean: [f64; 3], ln_scale: [f32; 3], logit: f32) -> Scene {
    let mut gaussians = Gaussians::with_capacity(0, count);
    for _ in 0..count {
        gaussians.means_m.push(mean);
        gaussians.ln_scales.push(ln_scale);
        gaussians.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
        gaussians.logit_opacities.push(logit);
        gaussians.sh.extend([0.3; 3]);
    }
    Scene::from_gaussians(&gaussians)
}

/// Gaussians of extreme shapes, sizes and places, and LiDARs among them.
pub(crate) fn extremes() -> [(Scene, LidarView); 2] {
    let mut gaussians = Gaussians::with_capacity(0, 64);
    let mut add = |mean: [f64; 3], ln_scale: [f32; 3], quat: [f32; 4], logit: f32| {
        gaussians.means_m.push(mean);
        gaussians.ln_scales.push(ln_scale);
        gaussians.quats_wxyz.push(quat);
        gaussians.logit_opacities.push(logit);
        gaussians.sh.extend([0.3; 3]);
    };
    let upright = [1.0, 0.0, 0.0, 0.0];
    // A road, a wall far away, a needle across, one that is very thin, a point.
    add([10.0, 0.0, -1.8], [2.0, 2.0, -9.0], upright, 9.0);
    add([150.0, 0.0, 0.0], [-9.0, 4.0, 4.0], upright, 9.0);
    add([8.0, 2.0, 0.0], [-6.0, 0.5, -6.0], [0.9, 0.3, 0.1, 0.2], 9.0);
    add([-12.0, 1.0, 0.0], [-16.0, 1.0, 1.0], upright, 9.0);
    add([4.0, -3.0, 0.5], [-18.0; 3], upright, 9.0);
    // Around the LiDAR, straight above it, and just behind a sector's edge.
    add([0.1, 0.1, 0.0], [0.5; 3], upright, 2.0);
    add([0.0, 0.0, 5.0], [1.0, 1.0, -5.0], upright, 9.0);
    add([-0.5, 6.0, 0.0], [0.0, -4.0, 1.0], upright, 9.0);
    // Opacity exactly at the cut: ln((1/255) / (1 - 1/255)).
    add([6.0, -6.0, 0.0], [0.0; 3], upright, -(254.0_f32.ln()));
    // 300 faint ones in one place.
    (0..300).for_each(|_| add([-6.0, -6.0, 0.0], [0.0; 3], upright, -4.0));
    let scene = Scene::from_gaussians(&gaussians);
    let rows = (0..40).map(|row| (90.0 - 4.5 * f64::from(row)).to_radians());
    let steep = Lidar::from_options(&LidarBeams {
        row_elevations_rad: rows.collect(),
        ..spinning(40, 180).to_options()
    })
    .unwrap();
    [spinning(64, 256), steep].map(|lidar| {
        let pose = Pose { position_m: DVec3::new(0.0, 0.0, 0.01), rotation: DQuat::IDENTITY };
        (scene.clone(), LidarView::at_rest(Arc::new(lidar), pose))
    })
}

/// Gaussians in one place, of different colours, in front of a LiDAR: a cluster, and more of a second
/// one that has a bound nearer to the LiDAR, so that beams are compared with it first.
pub(crate) fn coincident() -> (Scene, LidarView) {
    let mut gaussians = Gaussians::with_capacity(0, 300);
    for at in 0..300 {
        // The last one is beside what the LiDAR sees.
        gaussians.means_m.push([6.0, if at == 299 { 20.0 } else { 0.0 }, 0.0]);
        gaussians.ln_scales.push([0.0; 3]);
        gaussians.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
        // An alpha of a fifth and less, so that a return is made of some of them, and others at its
        // place leave more than half of the light in front of it.
        gaussians.logit_opacities.push(-1.4 - 0.012 * at as f32);
        gaussians.sh.extend([0.01 * (37 * at % 100) as f32; 3]);
    }
    let lidar = Arc::new(grid([0.2, -0.2], 32, [0.2, -0.2], 32));
    (Scene::from_gaussians(&gaussians), LidarView::at_rest(lidar, Pose::IDENTITY))
}

/// A cloud of more Gaussians than are compared at a time, most of them hidden by others, and a LiDAR
/// that drives towards it.
pub(crate) fn cloud() -> (Scene, LidarView) {
    let count = 30_000;
    let mut gaussians = Gaussians::with_capacity(0, count);
    let mut random = Random::new(5, "cloud", 0);
    for _ in 0..count {
        let range_m = random.range(6.0, 30.0);
        let [y, z] = [0, 1].map(|_| 0.5 * range_m * random.range(-1.0, 1.0));
        gaussians.means_m.push([range_m, y, z]);
        let ln_scale = (0.012 * range_m as f32).ln();
        gaussians.ln_scales.push([ln_scale - 2.0, ln_scale, ln_scale]);
        gaussians.quats_wxyz.push([1.0, 0.0, 0.1, 0.05]);
        gaussians.logit_opacities.push(random.range(-1.0, 4.0) as f32);
        gaussians.sh.extend([random.range(0.0, 0.5) as f32; 3]);
    }
    let view = LidarView {
        lidar: Arc::new(grid([0.35, -0.35], 40, [0.35, -0.35], 40)),
        world_from_lidar: Pose::IDENTITY,
        world_from_lidar_first: Pose { position_m: DVec3::new(-2.0, 0.5, 0.1), ..Pose::IDENTITY },
    };
    let mut scene = Scene::from_gaussians(&gaussians);
    // Actors within the cloud, and behind it, that move during the sweep.
    for (actor, x) in [7.0, 9.0, 40.0].into_iter().enumerate() {
        let end = Pose { position_m: DVec3::new(x, 0.8, 0.0), ..Pose::IDENTITY };
        let start = Pose { position_m: DVec3::new(x, -0.8, 0.0), ..Pose::IDENTITY };
        let placed = PlacedChunk::at_rest(Arc::new(ball(500)), end, actor as u16);
        scene.placed.push(PlacedChunk { world_from_actor_at_start: start, ..placed });
    }
    (scene, view)
}

/// A ball of a radius of 0.7 m.
fn ball(count: usize) -> Chunk {
    let mut gaussians = Gaussians::with_capacity(0, count);
    let mut random = Random::new(6, "ball", 0);
    for _ in 0..count {
        let place = DVec3::from_array([0, 1, 2].map(|_| random.range(-1.0, 1.0)));
        gaussians.means_m.push((0.7 * place.normalize_or(DVec3::X)).to_array());
        gaussians.ln_scales.push([-3.0; 3]);
        gaussians.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
        gaussians.logit_opacities.push(2.0);
        gaussians.sh.extend([0.9; 3]);
    }
    Scene::single_chunk(&gaussians)
}

/// Requires that all beams see the same luminance.
pub(crate) fn check_intensities(found: &Sweep, wanted: &Sweep) {
    let returns = wanted.range_m.iter().filter(|range_m| **range_m > 0.0).count();
    assert!(returns > 500, "{returns} returns test too little");
    for (one, other) in found.intensity.iter().zip(&wanted.intensity) {
        assert!((one - other).abs() < 1e-3, "{one}, {other}");
    }
}

/// Stacks of flat Gaussians that a LiDAR of few columns passes while it turns.
pub(crate) fn turning() -> [(Scene, LidarView); 2] {
    [[5.0, 0.0, -1.8], [9.0, 6.0, -1.8]].map(|mean| {
        let view = LidarView {
            lidar: Arc::new(grid([0.3, -0.6], 61, [0.4, -0.4], 16)),
            world_from_lidar: Pose::IDENTITY,
            world_from_lidar_first: Pose {
                position_m: DVec3::new(-1.0, 0.3, 0.1),
                rotation: DQuat::from_rotation_z(0.5) * DQuat::from_rotation_y(0.1),
            },
        };
        // So many that beams return far from the middle, where one alone is too faint.
        (stack(200, mean, [2.5, 2.5, -7.0], 9.0), view)
    })
}
