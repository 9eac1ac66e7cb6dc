//! Gaussians of the ground: which they are, and the derivatives of their loss.

use glam::{DQuat, DVec3, Quat, Vec3};
use rayon::prelude::*;

use wildcity_render::gradient::{ChunkGradients, GaussianGradient};
use wildcity_scene::chunk::column;
use wildcity_scene::geometry::Pose;

use crate::loss::ground::{Gaussian, Terms};
use crate::model::Model;

/// Farthest distance of the ground from the drive that it is found by, in metres.
const MOST_DISTANCE_M: f64 = 25.0;

/// Largest height of the ground over the plane of the rig's wheels, in metres at the rig and for
/// each metre from it: a kerb counts, and a slope of 1 in 50 across the road.
const MOST_HEIGHT_M: [f64; 2] = [0.1, 0.02];

/// Whether each point lies on the ground: near the plane of the wheels of the pose of the rig that
/// is nearest to it. The origin of a rig lies on the ground.
pub fn is_ground(points_m: &[DVec3], world_from_ego: &[Pose]) -> Vec<bool> {
    let is_one = |point_m: &DVec3| {
        let distance = |pose: &&Pose| pose.position_m.distance_squared(*point_m);
        let nearest = world_from_ego.iter().min_by(|a, b| distance(a).total_cmp(&distance(b)));
        nearest.is_some_and(|pose| {
            let DVec3 { x, y, z } = pose.inverse().transform_point(*point_m);
            let away_m = x.hypot(y);
            let [at_rig_m, per_m] = MOST_HEIGHT_M;
            away_m <= MOST_DISTANCE_M && z.abs() <= at_rig_m + per_m * away_m
        })
    };
    points_m.par_iter().map(is_one).collect()
}

/// Adds the derivatives of the ground's terms by the visible Gaussians of the ground. Returns the
/// weighted sum of the terms.
pub(crate) fn add_terms(model: &Model, terms: &Terms<f32>, gradients: &mut ChunkGradients) -> f64 {
    let shows = |index: &usize| {
        let visible = gradients.visible(*index);
        visible && model.is_ground(*index)
    };
    let indices: Vec<usize> = (0..model.len()).filter(shows).collect();
    let shapes: Vec<Shape> = indices.iter().map(|&index| Shape::new(model, index)).collect();
    let gaussians: Vec<Gaussian<f32>> = shapes.iter().map(|shape| shape.gaussian).collect();
    let loss = terms.loss(&gaussians);
    for ((&index, shape), by) in indices.iter().zip(&shapes).zip(&loss.by) {
        let Shape { gaussian, rotation } = shape;
        // A turn by φ moves the axis n by φ × n and the quaternion by (0, φ) q/2, so that the
        // derivatives by φ are n × v, and those by the quaternion 2 (0, n × v) q.
        let turn = Vec3::from_array(gaussian.normal).cross(Vec3::from_array(by.normal));
        let by_quat = DQuat::from_vec4(turn.extend(0.0).as_dvec4()) * rotation.as_dquat();
        let DQuat { w, x, y, z } = by_quat * 2.0;
        let geometry = GaussianGradient {
            mean_m: by.mean_m.map(f64::from),
            quat_wxyz: [w, x, y, z],
            ln_scale: [0.0; 3],
            // The opacity is 2^x, and the derivative of 2^x by x is ln 2 times 2^x.
            log2_opacity: f64::from(by.opacity * gaussian.opacity) * std::f64::consts::LN_2,
        };
        gradients.add(index, &geometry, &[DVec3::ZERO; 16]);
    }
    loss.value
}

/// A Gaussian of the ground as its terms see it, and its rotation.
struct Shape {
    gaussian: Gaussian<f32>,
    rotation: Quat,
}

impl Shape {
    fn new(model: &Model, index: usize) -> Self {
        let [w, x, y, z] = model.get(index, column::QUAT);
        let rotation = Quat::from_xyzw(x, y, z, w).normalize();
        let ln_scale: [f32; 3] = model.get(index, column::SCALE);
        let shortest = [0, 1, 2].into_iter().min_by(|&a, &b| ln_scale[a].total_cmp(&ln_scale[b]));
        let normal = rotation * Vec3::AXES[shortest.unwrap_or(2)];
        let gaussian = Gaussian {
            mean_m: model.get(index, column::MEAN),
            normal: normal.to_array(),
            opacity: model.opacity(index),
        };
        Self { gaussian, rotation }
    }
}
