//! Sweeps of LiDARs: the cpu backend against the definition, and both against surfaces.

use std::sync::Arc;

use glam::{DQuat, DVec3};
use wildcity_generate::StreetSettings;
use wildcity_options::LidarBeams;
use wildcity_render::cpu::{Cpu, Simd};
use wildcity_render::lidar::LidarView;
use wildcity_render::reference::Reference;
use wildcity_render::{FIRST_ACTOR_INSTANCE, TWIN_INSTANCE};
use wildcity_scene::geometry::{Lidar, Pose};
use wildcity_scene::random::Random;
use wildcity_scene::{Gaussians, Scene};

use crate::images::cpu;
use crate::lidars::{
    check_classes, check_intensities, check_same, cloud, coincident, dense_street, extremes, grid,
    in_motion, random_scene, spinning, stack, sweep, tables, turning, upright, with_actor,
};

#[test]
fn a_sweep_is_that_of_the_definition() {
    let lidar = spinning(48, 256);
    for seed in 0..3 {
        let scene = with_actor(seed);
        for view in [LidarView::at_rest(Arc::new(lidar.clone()), upright()), in_motion(&lidar)] {
            let wanted = sweep(&Reference, &scene, &view);
            let found = sweep(&cpu(), &scene, &view);
            check_same(&found, &wanted, &format!("seed {seed}"));
            check_classes(&scene, &found, &wanted);
            for instance in [TWIN_INSTANCE, FIRST_ACTOR_INSTANCE + 3] {
                let count = found.instance.iter().filter(|one| **one == instance).count();
                assert!(count > 10, "{count} beams see {instance}");
            }
        }
    }
}

#[test]
fn the_tables_of_real_lidars_are_cast() {
    let Some(tables) = tables(16) else { return };
    let scene = random_scene(4_000, 7);
    for (name, lidar) in tables {
        let view = in_motion(&lidar);
        check_same(&sweep(&cpu(), &scene, &view), &sweep(&Reference, &scene, &view), &name);
    }
}

/// Instruction sets differ in the last bit and threads in nothing.
#[test]
fn threads_do_not_change_a_sweep() {
    let scene = with_actor(5);
    let view = in_motion(&spinning(64, 512));
    let of = |threads: usize| {
        let backend = Cpu::new(threads, Simd::Best).unwrap();
        sweep(&backend, &scene, &view)
    };
    let one = of(1);
    assert!([2, 3, 7].into_iter().all(|threads| of(threads) == one));
}

/// Needles, sheets, points, an opacity of exactly the cut, the LiDAR inside of a Gaussian, Gaussians
/// behind it, above it, and far away.
#[test]
fn extreme_gaussians_are_met_as_by_the_definition() {
    for (scene, view) in extremes() {
        let wanted = sweep(&Reference, &scene, &view);
        check_same(&sweep(&cpu(), &scene, &view), &wanted, "extremes");
        assert!(wanted.range_m.iter().all(|range_m| range_m.is_finite()));
    }
}

/// Beams that are aimed at single Gaussians: every one of them has to return, and from the same
/// place as by the definition.
#[test]
fn beams_that_are_aimed_at_a_gaussian_meet_it() {
    let cases: [([f64; 3], [f32; 3]); 6] = [
        ([8.0, 2.0, 0.0], [-6.0, 0.5, -6.0]),
        ([4.0, -3.0, 0.5], [-7.0; 3]),
        ([-12.0, 1.0, -2.0], [-16.0, 1.0, 1.0]),
        ([0.0, 0.0, 0.7], [-1.0, -1.0, -7.0]),
        ([0.0, 0.0, -0.7], [-1.0, -1.0, -7.0]),
        ([150.0, -90.0, 3.0], [-3.0; 3]),
    ];
    for (mean, ln_scale) in cases {
        let [x, y, z] = mean;
        let azimuth = f64::atan2(y, x);
        let elevation = f64::atan2(z, f64::hypot(x, y));
        let scene = stack(1, mean, ln_scale, 9.0);
        for (rows, columns) in [(1, 1), (3, 3), (1, 40), (40, 1)] {
            // A hundredth of a standard deviation of the smallest to both sides.
            let off = 1e-5;
            let rise = if elevation > 0.0 { -off } else { off };
            let elevations = [elevation, elevation + rise];
            let lidar = grid(elevations, rows, [azimuth - off, azimuth + off], columns);
            let view = LidarView::at_rest(Arc::new(lidar), Pose::IDENTITY);
            let wanted = sweep(&Reference, &scene, &view);
            let found = sweep(&cpu(), &scene, &view);
            for (at, wanted_m) in wanted.range_m.iter().enumerate() {
                let found_m = found.range_m[at];
                assert!(
                    *wanted_m > 0.0 && (found_m - wanted_m).abs() < 1e-3,
                    "{mean:?}: {found_m}"
                );
            }
        }
    }
}

/// A LiDAR of few columns is one sector, and turns by half a radian within it.
#[test]
fn few_columns_of_a_turning_lidar_meet_what_they_pass() {
    for (scene, view) in turning() {
        let wanted = sweep(&Reference, &scene, &view);
        let found = sweep(&cpu(), &scene, &view);
        let missed: Vec<usize> = (0..wanted.range_m.len())
            .filter(|at| (found.range_m[*at] - wanted.range_m[*at]).abs() > 1e-3)
            .collect();
        assert!(missed.is_empty(), "{missed:?}");
        assert!(wanted.range_m.iter().filter(|range_m| **range_m > 0.0).count() > 100);
    }
}

/// The same LiDAR passes small Gaussians by: it moves by more than they are large, along each axis.
#[test]
fn few_columns_of_a_moving_lidar_meet_small_gaussians() {
    let mut random = Random::new(3, "small", 0);
    let mut gaussians = Gaussians::with_capacity(0, 3_000);
    for _ in 0..3_000 {
        let place = [random.range(2.0, 16.0), random.range(-8.0, 8.0), random.range(-4.0, 4.0)];
        gaussians.means_m.push(place);
        gaussians.ln_scales.push([-2.5, -2.0, -4.0]);
        gaussians.quats_wxyz.push([0.9, 0.3, -0.2, random.range(-0.3, 0.3) as f32]);
        gaussians.logit_opacities.push(5.0);
        gaussians.sh.extend([0.3; 3]);
    }
    let scene = Scene::from_gaussians(&gaussians);
    let lidar = Arc::new(grid([0.3, -0.3], 61, [0.3, -0.3], 16));
    for moved_m in [DVec3::X, DVec3::Y, DVec3::Z].map(|axis| 2.0 * axis) {
        let view = LidarView {
            lidar: lidar.clone(),
            world_from_lidar: Pose { position_m: 0.5 * moved_m, ..Pose::IDENTITY },
            world_from_lidar_first: Pose { position_m: -0.5 * moved_m, ..Pose::IDENTITY },
        };
        let wanted = sweep(&Reference, &scene, &view);
        check_same(&sweep(&cpu(), &scene, &view), &wanted, &format!("{moved_m}"));
    }
}

/// Coincident Gaussians are blended in the order of their ids, whichever a beam meets first.
#[test]
fn coincident_gaussians_keep_their_order() {
    let (scene, view) = coincident();
    check_intensities(&sweep(&cpu(), &scene, &view), &sweep(&Reference, &scene, &view));
}

/// What is hidden is not searched, and nothing else is left out.
#[test]
fn a_cloud_is_met_as_by_the_definition() {
    let (scene, view) = cloud();
    check_same(&sweep(&cpu(), &scene, &view), &sweep(&Reference, &scene, &view), "cloud");
}

/// 4,500 km from the origin a sweep is the same.
#[test]
fn a_sweep_does_not_depend_on_the_origin() {
    let near = dense_street(4_000, 2);
    let mut far = near.clone();
    let offset = DVec3::new(4.5e6, -3e5, 1e3);
    let moved = |mean: &[f64; 3]| (DVec3::from_array(*mean) + offset).to_array();
    far.means_m = near.means_m.iter().map(moved).collect();
    let view = in_motion(&spinning(48, 256));
    let place = |pose: Pose| Pose { position_m: pose.position_m + offset, ..pose };
    let far_view = LidarView {
        world_from_lidar: place(view.world_from_lidar),
        world_from_lidar_first: place(view.world_from_lidar_first),
        ..view.clone()
    };
    let found = sweep(&cpu(), &Scene::from_gaussians(&far), &far_view);
    check_same(&found, &sweep(&cpu(), &Scene::from_gaussians(&near), &view), "far away");
}

/// The columns of a sweep of a LiDAR in motion are those of LiDARs at rest where it was then.
#[test]
fn each_column_is_fired_where_the_lidar_is_then() {
    let scene = with_actor(9);
    let view = in_motion(&spinning(32, 128));
    let whole = sweep(&cpu(), &scene, &view);
    for column in [0, 1, 63, 127] {
        let lidar = view.lidar.clone();
        let mut still = scene.clone();
        let placed = &mut still.placed[0];
        let at = placed
            .world_from_actor_at_start
            .interpolate(&placed.world_from_actor, lidar.fraction(column));
        placed.world_from_actor = at;
        placed.world_from_actor_at_start = at;
        let then = LidarView::at_rest(lidar.clone(), view.world_from_lidar_at(column));
        let at_rest = sweep(&cpu(), &still, &then);
        for row in 0..lidar.rows() {
            let at = row * lidar.columns() + column;
            let [one, other] = [&whole, &at_rest].map(|sweep| sweep.range_m[at]);
            assert!((one - other).abs() < 1e-3, "row {row}, column {column}: {one}, {other}");
        }
    }
}

/// A flat Gaussian of the generator as the rectangle that it stands for.
struct Surface {
    middle_m: DVec3,
    normal: DVec3,
    /// Unit edges, and half of their lengths.
    edges: [(DVec3, f64); 2],
}

/// Standard deviation of a surfel as a fraction of its rectangle's edge, as the generator has it.
const OVERLAP: f64 = 0.66;

fn surfaces(gaussians: &Gaussians, around_m: DVec3, reach_m: f64) -> Vec<Surface> {
    let surface = |at: usize| {
        let middle_m = DVec3::from_array(gaussians.means_m[at]);
        let scale_m = gaussians.ln_scales[at].map(|ln| f64::from(ln).exp());
        let [w, x, y, z] = gaussians.quats_wxyz[at].map(f64::from);
        let rotation = DQuat::from_xyzw(x, y, z, w).normalize();
        let axes = [DVec3::X, DVec3::Y, DVec3::Z].map(|axis| rotation * axis);
        let thin = (0..3).min_by(|a, b| scale_m[*a].total_cmp(&scale_m[*b]))?;
        let is_near = middle_m.distance(around_m) < reach_m && scale_m[thin] < 5e-3;
        let edge = |k: usize| {
            let axis = (thin + k) % 3;
            (axes[axis], 0.5 * scale_m[axis] / OVERLAP)
        };
        is_near.then(|| Surface { middle_m, normal: axes[thin], edges: [edge(1), edge(2)] })
    };
    (0..gaussians.len()).filter_map(surface).collect()
}

impl Surface {
    fn range_m(&self, origin_m: DVec3, direction: DVec3) -> Option<f64> {
        let range_m = (self.middle_m - origin_m).dot(self.normal) / direction.dot(self.normal);
        let from_middle = origin_m + range_m * direction - self.middle_m;
        let is_inside = self.edges.iter().all(|(edge, half)| from_middle.dot(*edge).abs() <= *half);
        (range_m > 0.5 && is_inside).then_some(range_m)
    }
}

/// The demo street's own surfaces, by rays against rectangles, and not its Gaussians.
#[test]
fn ranges_are_those_of_the_streets_surfaces() {
    let settings = StreetSettings { seed: 7, length_m: 150.0, crossing_m: 75.0, density: 1.0 };
    let street = wildcity_generate::street(&settings).unwrap();
    let frame = &street.trajectory.keyframes[100];
    let origin_m = frame.world_from_rig.position_m + DVec3::Z * 1.9;
    let pose = Pose { position_m: origin_m, ..frame.world_from_rig };
    let reach_m = 60.0;
    let lidar = Lidar::from_options(&LidarBeams {
        max_range_m: Some(reach_m),
        ..spinning(64, 1024).to_options()
    })
    .unwrap();
    let view = LidarView::at_rest(Arc::new(lidar), pose);
    let found = sweep(&cpu(), &Scene::from_gaussians(&street.gaussians), &view);
    let surfaces = surfaces(&street.gaussians, origin_m, reach_m + 5.0);
    let mut errors = Vec::new();
    let mut missed = 0;
    let columns = view.lidar.columns();
    for at in (0..view.lidar.beams()).step_by(31) {
        let direction = pose.rotation * view.lidar.direction(at / columns, at % columns);
        let hits = surfaces
            .iter()
            .filter_map(|surface| Some((surface.range_m(origin_m, direction)?, surface.normal)));
        let Some((wanted_m, normal)) = hits.min_by(|a, b| a.0.total_cmp(&b.0)) else { continue };
        if wanted_m > reach_m {
            continue;
        }
        let kind = match normal.z.abs() {
            z if z > 0.95 => "road",
            z if z < 0.05 => "facades",
            _ => "others",
        };
        let found_m = f64::from(found.range_m[at]);
        if found_m == 0.0 {
            missed += 1;
            continue;
        }
        let incidence_deg = normal.dot(direction).abs().acos().to_degrees();
        let error_m = (found_m - wanted_m).abs();
        errors.push(RangeError { kind, range_m: wanted_m, incidence_deg, error_m });
    }
    for kind in ["road", "facades", "others"] {
        let all = |_: &RangeError| true;
        check_errors(&errors, kind, "all", &all);
        for [from, to] in [[0.0, 10.0], [10.0, 25.0], [25.0, 60.0]] {
            let is_there = |error: &RangeError| (from..to).contains(&error.range_m);
            check_errors(&errors, kind, &format!("{from} to {to} m"), &is_there);
        }
        for [from, to] in [[0.0, 45.0], [45.0, 75.0], [75.0, 85.0], [85.0, 90.0]] {
            let is_there = |error: &RangeError| (from..to).contains(&error.incidence_deg);
            check_errors(&errors, kind, &format!("{from} to {to} deg"), &is_there);
        }
    }
    eprintln!("{missed} beams without a return");
    assert!(missed < 40, "{missed} beams have no return");
}

/// A beam against the surface that it meets.
struct RangeError {
    kind: &'static str,
    range_m: f64,
    /// Between the beam and the normal of the surface.
    incidence_deg: f64,
    error_m: f64,
}

/// Prints the errors of some beams, and requires a median of 2 cm on road and facades.
fn check_errors(
    errors: &[RangeError],
    kind: &str,
    which: &str,
    is_one: &dyn Fn(&RangeError) -> bool,
) {
    let of_kind = errors.iter().filter(|error| error.kind == kind && is_one(error));
    let mut errors_m: Vec<f64> = of_kind.map(|error| error.error_m).collect();
    errors_m.sort_by(f64::total_cmp);
    if errors_m.len() < 20 {
        assert!(which != "all", "{} beams on {kind} test too little", errors_m.len());
        return;
    }
    let quantile = |q: f64| errors_m[(q * (errors_m.len() - 1) as f64) as usize];
    let [median, most, worst] = [0.5, 0.9, 0.99].map(quantile);
    eprintln!(
        "{kind:8} {which:12} {:5} beams, median {median:.4} m, 90 % {most:.4} m, 99 % {worst:.3} m",
        errors_m.len()
    );
    assert!(kind == "others" || median <= 0.02, "{kind}, {which}: {median}");
}
