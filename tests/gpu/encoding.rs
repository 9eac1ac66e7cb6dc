//! Stress case T10: error bounds of the mirror's encoding.

use std::f64::consts::{PI, TAU};

use glam::{DQuat, DVec3};
use wildcity_render::gpu::Gpu;
use wildcity_render::gpu::shaders::Shaders;
use wildcity_render::stage::Stage;
use wildcity_render::{Frame, View};
use wildcity_scene::chunk::{CLUSTER, column};
use wildcity_scene::{RenderProfile, Scene, sh};

use crate::definition::{self, Splat};
use crate::gaussians::{GaussianSpec, forward_view, scene_from_specs};
use crate::gpu::{gpu, gpu_with};
use crate::scene_files::Random;

/// Three clusters side by side in one chunk, all in front of the camera, with colours of an SH
/// degree.
fn wall(sh_degree: u8) -> wildcity_scene::Gaussians {
    let mut random = Random(71);
    let mut wall = crate::gaussians::gaussians_from_specs(&[]);
    wall.sh_degree = sh_degree;
    for i in 0..3 * CLUSTER {
        let (x, y) = ((i % 32) as f64, (i / 32) as f64);
        wall.means_m.push([0.1 * (x - 15.5), 0.1 * (y - 11.5), 5.0]);
        wall.quats_wxyz.push([1.0, 0.0, 0.0, 0.0]);
        wall.ln_scales.push([-3.0; 3]);
        wall.logit_opacities.push(2.0);
        wall.sh.extend([0; 3].map(|_| random.between(-1.5, 1.5)));
        wall.sh.extend((3..3 * sh::coefficients(sh_degree)).map(|_| random.between(-0.3, 0.3)));
    }
    wall
}

/// The splats of a scene of which every Gaussian is visible: by the gpu's stage project, and by
/// definition.
fn projected(gpu: &Gpu, scene: &Scene, view: View) -> (Vec<Splat>, Vec<Splat>) {
    let profile = RenderProfile::default();
    let views = [view];
    let frame = Frame { scene, profile: &profile, views: &views };
    let found = definition::splats(&gpu.run_through(&frame, None, Stage::Project).unwrap());
    let truths = definition::project(&frame);
    assert_eq!((found.len(), truths.len()), (scene.gaussians(), scene.gaussians()));
    (found, truths)
}

/// Compares colours with a bound. Returns the clusters whose colours exceed it, with their errors,
/// and the largest error of the second cluster.
///
/// A 16-bit fraction of a cluster's largest value is off by at most half a step of
/// `largest / 32,767`. In any direction, the absolute values of the `2 l + 1` basis functions of
/// band `l` sum to at most `(2 l + 1) C0`, since their squares sum to `(2 l + 1) C0²`. So a colour
/// is off by at most
///
/// ```text
/// C0 (largest of coefficient 0 + ((degree + 1)² - 1) largest of the others) / 65,534
/// ```
///
/// plus the rounding of f32, 1e-4 for values up to 50.
fn beyond_the_bound(gpu: &Gpu, scene: &Scene) -> (Vec<String>, f64) {
    let (found, truths) = projected(gpu, scene, forward_view([640, 480], 600.0));
    let chunk = &scene.chunks[0];
    let values = 3 * sh::coefficients(scene.sh_degree());
    assert_eq!(scene.chunks.len(), 1);
    let mut beyond = Vec::new();
    let mut second = 0.0;
    for cluster in 0..3 {
        let of_cluster = cluster * CLUSTER..(cluster + 1) * CLUSTER;
        let largest = |columns: std::ops::Range<usize>| {
            let of = |i| columns.clone().map(move |c| chunk.value(i, column::SH + c).abs());
            of_cluster.clone().flat_map(of).fold(0.0, f32::max)
        };
        let directional = (values / 3 - 1) as f64 * f64::from(largest(3..values));
        let bound = sh::C0 * (f64::from(largest(0..3)) + directional) / 65_534.0 + 1e-4;
        let off = of_cluster.clone().map(|i| {
            let differences = (0..3).map(|c| (found[i].rgb[c] - truths[i].rgb[c]).abs());
            differences.fold(0.0, f64::max)
        });
        let off = off.fold(0.0, f64::max);
        if off > bound {
            beyond.push(format!("cluster {cluster}: off by {off:e}, beyond {bound:e}"));
        }
        if cluster == 1 {
            second = off;
        }
    }
    (beyond, second)
}

#[test]
fn t10_a_colour_is_off_by_at_most_half_a_step_of_its_clusters_largest_value() {
    let nothing: [String; 0] = [];
    let gpu = gpu();
    for degree in 0..=3 {
        let plain = Scene::from_gaussians(&wall(degree));
        assert_eq!(beyond_the_bound(&gpu, &plain).0, nothing, "degree {degree}");
        // One value of 50 in the second cluster: it enlarges the steps of this cluster only.
        let mut outlier = wall(degree);
        let chunk = &plain.chunks[0];
        let place = |i: usize, axis| f64::from(chunk.value(i, column::MEAN + axis));
        let at = [0, 1].map(|axis| place(CLUSTER + CLUSTER / 2, axis));
        let is_there = |m: &[f64; 3]| (0..2).all(|axis| (m[axis] - at[axis]).abs() < 1e-3);
        let index = outlier.means_m.iter().position(is_there).unwrap();
        outlier.sh[3 * sh::coefficients(degree) * index + 1] = 50.0;
        let outlier = Scene::from_gaussians(&outlier);
        let (beyond, second) = beyond_the_bound(&gpu, &outlier);
        assert_eq!(beyond, nothing, "degree {degree}, with an outlier");
        // 50 C0 / 65,534 is 2.2e-4: the error comes close to its bound.
        assert!(second > 1.5e-4, "degree {degree}: off by {second:e} only: was the outlier drawn?");
    }
    let broken = Shaders::default().with_mutation("project", "0.28209479177387814 *", "0.2815 *");
    let (beyond, _) =
        beyond_the_bound(&gpu_with(broken.unwrap()), &Scene::from_gaussians(&wall(0)));
    assert_eq!(beyond.len(), 3, "an error of two thousandths was not detected: {beyond:?}");
}

/// An encoded quaternion is off by at most 7e-7 in each of four components: 1.4e-6, or 2.8e-6 rad.
/// The rounding of the covariance to f32 adds about as much.
#[test]
fn t10_a_needle_is_turned_by_less_than_six_millionths() {
    let mut random = Random(72);
    let needles: Vec<GaussianSpec> = (0..1_000)
        .map(|_| GaussianSpec {
            rotation: DQuat::from_rotation_z(TAU * random.unit())
                * DQuat::from_rotation_x(TAU * random.unit()),
            sigma_m: DVec3::new(1.0, 1e-3, 1e-3),
            ..GaussianSpec::default()
        })
        .collect();
    let (found, truths) =
        projected(&gpu(), &scene_from_specs(&needles), forward_view([640, 480], 1000.0));
    // Angle, modulo pi, of the axis along which the conic `(l0 dx + l1 dy)² + (l2 dy)²` rises
    // least.
    let angle_rad = |splat: &Splat| {
        let [l0, l1, l2] = splat.factor;
        0.5 * (2.0 * l0 * l1).atan2(l0 * l0 - l1 * l1 - l2 * l2)
    };
    let turned = found.iter().zip(&truths).map(|(found, truth)| {
        let turn = (angle_rad(found) - angle_rad(truth)).rem_euclid(PI);
        turn.min(PI - turn)
    });
    let worst_rad = turned.fold(0.0, f64::max);
    assert!(worst_rad <= 6e-6, "{worst_rad:e} rad");
}
