//! A sweep by definition, in f64: every beam against every Gaussian.

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use super::project::Gaussian;
use crate::lidar::{Body, HALF, LidarView, Sweep, THINNEST_M, chunks, luminance, reach2};
use wildcity_scene::{Chunk, RenderProfile, Scene};

/// A Gaussian in its body's axes.
struct Ellipsoid {
    mean_m: DVec3,
    /// Takes a vector in the body's axes to one in standard deviations.
    whiten: DMat3,
    opacity: f64,
    /// Squared standard deviations from the mean at which alpha falls below the cut.
    reach2: f64,
    luminance: f32,
}

/// Where a beam meets a Gaussian.
#[derive(Clone, Copy)]
struct Hit {
    range_m: f64,
    alpha: f64,
    luminance: f32,
    instance: u16,
    /// Its number among all Gaussians of the scene.
    gaussian: u32,
}

/// The sweep of a LiDAR.
pub(super) fn sweep(scene: &Scene, profile: &RenderProfile, view: &LidarView) -> Sweep {
    let bodies: Vec<(Body<'_>, Vec<Ellipsoid>)> =
        chunks(scene).map(|(body, chunk)| (body, ellipsoids(&body, chunk, profile))).collect();
    let lidar = &*view.lidar;
    let columns = lidar.columns();
    // Column by column, since those share their rays' start; transposed afterwards.
    let by_column: Vec<Vec<Option<Hit>>> = (0..columns)
        .into_par_iter()
        .map(|column| {
            (0..lidar.rows()).map(|row| beam(&bodies, profile, view, row, column)).collect()
        })
        .collect();
    let mut sweep = Sweep::empty(lidar.beams());
    for (column, hits) in by_column.iter().enumerate() {
        for (row, hit) in hits.iter().enumerate() {
            let Some(hit) = hit else { continue };
            let at = row * columns + column;
            sweep.range_m[at] = hit.range_m as f32;
            sweep.intensity[at] = hit.luminance;
            sweep.instance[at] = hit.instance;
            sweep.gaussian[at] = hit.gaussian;
        }
    }
    sweep
}

fn ellipsoids(body: &Body<'_>, chunk: &Chunk, profile: &RenderProfile) -> Vec<Ellipsoid> {
    let ellipsoid = |index| {
        let gaussian = Gaussian::from_chunk(chunk, index);
        let axes = DMat3::from_quat(gaussian.rotation.normalize());
        let per_m = gaussian.scale_m.max(DVec3::splat(THINNEST_M)).recip();
        Ellipsoid {
            mean_m: gaussian.mean_m,
            whiten: DMat3::from_diagonal(per_m) * axes.transpose(),
            opacity: gaussian.log2_opacity.exp2(),
            reach2: reach2(gaussian.log2_opacity, profile),
            luminance: luminance(body, |column| chunk.value(index, column)),
        }
    };
    (0..chunk.len()).map(ellipsoid).collect()
}

/// The return of a beam.
fn beam(
    bodies: &[(Body<'_>, Vec<Ellipsoid>)],
    profile: &RenderProfile,
    view: &LidarView,
    row: usize,
    column: usize,
) -> Option<Hit> {
    let mut hits = Vec::new();
    let mut first = 0;
    for (body, ellipsoids) in bodies {
        let pose = body.body_from_lidar(view, column);
        let direction = pose.rotation * view.lidar.direction(row, column);
        hits.extend(ellipsoids.iter().zip(first..).filter_map(|(ellipsoid, gaussian)| {
            let [range_m, alpha] = ellipsoid.meet(pose.position_m, direction, profile)?;
            let is_within =
                range_m > view.lidar.min_range_m() && range_m <= view.lidar.max_range_m();
            let Ellipsoid { luminance, .. } = *ellipsoid;
            let instance = body.instance;
            is_within.then_some(Hit { range_m, alpha, luminance, instance, gaussian })
        }));
        first += ellipsoids.len() as u32;
    }
    // Stable: Gaussians at the same range keep the order of their ids.
    hits.sort_by(|a, b| a.range_m.total_cmp(&b.range_m));
    let mut transmittance = 1.0;
    let mut luminance = 0.0;
    for hit in hits {
        luminance += transmittance * hit.alpha * f64::from(hit.luminance);
        transmittance *= 1.0 - hit.alpha;
        if transmittance <= HALF {
            // The weights of all hits up to the return add up to 1 - T.
            let luminance = (luminance / (1.0 - transmittance)) as f32;
            return Some(Hit { luminance, ..hit });
        }
    }
    None
}

impl Ellipsoid {
    /// The distance along a ray of its point that is closest in standard deviations, and the alpha
    /// there; `None` if that is below the cut.
    fn meet(&self, origin_m: DVec3, direction: DVec3, profile: &RenderProfile) -> Option<[f64; 2]> {
        let to_mean = self.whiten * (self.mean_m - origin_m);
        let step = self.whiten * direction;
        let range_m = to_mean.dot(step) / step.length_squared();
        let squared = to_mean.cross(step).length_squared() / step.length_squared();
        let alpha = (self.opacity * (-0.5 * squared).exp()).min(profile.alpha_cap);
        (squared <= self.reach2).then_some([range_m, alpha])
    }
}
