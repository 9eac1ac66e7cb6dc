//! Synthetic reconstruction errors, like those of captures: small on the recorded drive, large off
//! the trajectory.
//!
//! A capture is trained on images from one line, the drive. Training cannot determine what those
//! images do not constrain. Consider the plane through a Gaussian and the segment of the drive from
//! which the cameras saw it: all viewing rays lie in this plane. So the images do not constrain how
//! the colour changes along the plane's normal, and they do not show a thin sheet in this plane,
//! which they see edge-on. They constrain positions along the rays better, so displacements are a
//! small part of the damage.

use std::ops::Range;

use glam::{DMat3, DQuat, DVec3};

use wildcity_scene::chunk::cell_at;
use wildcity_scene::random::mix;
use wildcity_scene::{Gaussians, Trajectory, sh};

use super::GenerateError;
use super::random::{Random, noise};

/// Height of the cameras above the origin of the rig, in metres.
const CAMERA_HEIGHT_M: f64 = 1.6;
/// Edge of a patch of Gaussians that are displaced and tinted in the same way, in metres.
const PATCH_M: f64 = 0.7;
/// The search for the nearest camera position tests every `STRIDE`-th one first.
const STRIDE: usize = 8;

/// Lateral distance of the side cameras from the middle of the rig, in metres. They saw what lies
/// to the side.
const SIDE_CAMERA_M: f64 = 0.3;
/// A Gaussian is assumed to be seen from a point of the drive that lies 4 m + 0.8 x distance behind
/// the point that is nearest to it, at most [`VIEWED_FROM_BEHIND_MAX_M`]. This is the constant
/// part, in metres.
const VIEWED_FROM_BEHIND_M: f64 = 4.0;
/// The part per metre of distance from the nearest point: see [`VIEWED_FROM_BEHIND_M`].
const VIEWED_FROM_BEHIND_PER_M: f64 = 0.8;
/// The largest value of the sum, in metres: see [`VIEWED_FROM_BEHIND_M`].
const VIEWED_FROM_BEHIND_MAX_M: f64 = 60.0;

// Sizes of the damage at an amount of 1. With 0.5, images of a city have 30 dB on the drive, and
// 27, 21 and 19 dB at 1, 3 and 5 m off it (the three front cameras at 360 x 232 pixels).
/// Share of the Gaussians that are missing.
const LOST: f64 = 0.02;
/// Largest displacement along the ray, as a share of the distance.
const MOVED: f64 = 0.014;
/// Largest change of a colour (1 is white) from the plane to its normal; the smallest is
/// [`TINT_LEAST`] of it.
const TINT: f64 = 4.0;
const TINT_LEAST: f64 = 0.4;
/// Share of the change that is equal in all three channels; the rest is drawn for each channel.
const TINT_GREY: f64 = 0.8;
/// Share of the change that a whole patch has; the rest is drawn for each Gaussian.
const TINT_PATCH: f64 = 0.9;
/// Share of the Gaussians that are needles along the ray, up to [`NEEDLE_LENGTH`] times as long as
/// they were wide.
const NEEDLES: f64 = 0.05;
const NEEDLE_LENGTH: f64 = 4.0;
/// Number of floating sheets per Gaussian.
const SHEETS: f64 = 0.06;
/// Standard deviation of a sheet along the ray, in metres, for a Gaussian that is 15 m away.
const SHEET_M: f64 = 0.4;

/// Spoils the Gaussians of a street or of parts of it.
#[derive(Clone, Debug)]
pub struct Spoil {
    amount: f64,
    seed: u64,
    cameras: Vec<CameraPosition>,
}

/// A position of the recording cameras.
#[derive(Clone, Copy, Debug)]
struct CameraPosition {
    at_m: DVec3,
    left: DVec3,
    station_m: f64,
}

/// The ray along which a camera saw a Gaussian.
#[derive(Clone, Copy, Debug)]
struct ViewingRay {
    camera_m: DVec3,
    /// Vector from the camera to the Gaussian, in metres.
    ray_m: DVec3,
    /// Unit normal of the plane in which the Gaussian and the drive lie.
    normal: DVec3,
}

impl Spoil {
    /// Damage by `amount`, from 0 (none) to 1, to what was recorded along `drive`. The same
    /// arguments spoil the same Gaussian in the same way, whichever other Gaussians are given.
    ///
    /// # Errors
    /// The amount is out of range.
    pub fn new(amount: f64, seed: u64, drive: &Trajectory) -> Result<Self, GenerateError> {
        let holds = (0.0..=1.0).contains(&amount);
        super::first_refused([("spoil", amount, holds, "a twin is spoiled by 0 to 1")])?;
        let mut cameras: Vec<CameraPosition> = Vec::with_capacity(drive.keyframes.len());
        for keyframe in &drive.keyframes {
            let pose = &keyframe.world_from_rig;
            let at_m = pose.transform_point(CAMERA_HEIGHT_M * DVec3::Z);
            let station_m =
                cameras.last().map(|camera| camera.station_m + camera.at_m.distance(at_m));
            let left = pose.rotation * DVec3::Y;
            cameras.push(CameraPosition { at_m, left, station_m: station_m.unwrap_or(0.0) });
        }
        Ok(Self { amount, seed, cameras })
    }

    /// The damaged Gaussians, of SH degree 1 at least. None leaves its cell
    /// ([`wildcity_scene::chunk::CELL_M`]).
    pub fn apply(&self, gaussians: &Gaussians) -> Gaussians {
        let mut whole = gaussians.clone();
        if self.amount == 0.0 || whole.is_empty() {
            return whole;
        }
        whole.raise_sh_degree(1);
        let near = self.near(&whole.means_m);
        let mut spoiled = Gaussians::with_capacity(whole.sh_degree, whole.len());
        for index in 0..whole.len() {
            self.spoil(near.clone(), &whole, index, &mut spoiled);
        }
        spoiled
    }

    /// Indices of a range of camera positions that contains the nearest one of each point.
    fn near(&self, means_m: &[[f64; 3]]) -> Range<usize> {
        let mut low_m = DVec3::INFINITY;
        let mut high_m = DVec3::NEG_INFINITY;
        for mean_m in means_m {
            let mean_m = DVec3::from_array(*mean_m);
            (low_m, high_m) = (low_m.min(mean_m), high_m.max(mean_m));
        }
        // From the middle of the box. Any point lies within half the diagonal of it, so a camera
        // that is nearest to some point is at most a whole diagonal farther than the nearest one.
        let distance_m = |camera: &CameraPosition| camera.at_m.distance(0.5 * (low_m + high_m));
        let nearest_m = self.cameras.iter().map(distance_m).fold(f64::INFINITY, f64::min);
        let is_near =
            |camera: &CameraPosition| distance_m(camera) <= nearest_m + low_m.distance(high_m);
        let first = self.cameras.iter().position(is_near).unwrap_or(0);
        let last = self.cameras.iter().rposition(is_near).unwrap_or(0);
        // Aligned to the stride, so that the coarse search tests the same positions for
        // every range.
        first.saturating_sub(STRIDE) / STRIDE * STRIDE..(last + STRIDE).min(self.cameras.len())
    }

    /// The nearest of some camera positions to a point.
    fn nearest(&self, near: Range<usize>, point_m: DVec3) -> CameraPosition {
        let squared_m2 = |index: &usize| self.cameras[*index].at_m.distance_squared(point_m);
        let by_distance = |a: &usize, b: &usize| squared_m2(a).total_cmp(&squared_m2(b));
        // Every eighth position first, then those around the best one.
        let coarse = near.clone().step_by(STRIDE).min_by(by_distance).unwrap_or(0);
        let fine = coarse.saturating_sub(STRIDE)..(coarse + STRIDE).min(self.cameras.len());
        self.cameras[fine.min_by(by_distance).unwrap_or(coarse)]
    }

    fn viewing_ray(&self, near: Range<usize>, mean_m: DVec3) -> ViewingRay {
        let nearest = self.nearest(near, mean_m);
        let behind_m =
            VIEWED_FROM_BEHIND_M + VIEWED_FROM_BEHIND_PER_M * nearest.at_m.distance(mean_m);
        let station_m = nearest.station_m - behind_m.min(VIEWED_FROM_BEHIND_MAX_M);
        let at = self.cameras.partition_point(|camera| camera.station_m < station_m);
        let seen = self.cameras[at.min(self.cameras.len() - 1)];
        let along = (nearest.at_m - seen.at_m).normalize_or(seen.left.cross(DVec3::Z));
        let aside = ((mean_m - seen.at_m).dot(seen.left) / 4.0).clamp(-1.0, 1.0);
        let camera_m = seen.at_m + SIDE_CAMERA_M * aside * seen.left;
        let ray_m = mean_m - camera_m;
        ViewingRay { camera_m, ray_m, normal: along.cross(ray_m).normalize_or(DVec3::Z) }
    }

    /// Appends a Gaussian with its damage, and perhaps a sheet in front of it, or nothing.
    fn spoil(&self, near: Range<usize>, whole: &Gaussians, index: usize, out: &mut Gaussians) {
        let mean_m = whole.means_m[index];
        // The Gaussian's own place is its seed: no other Gaussian has a part in it.
        let key = mean_m.iter().fold(self.seed, |key, m| mix(key ^ m.to_bits()));
        let mut random = Random::new(key, "spoil", 0);
        if random.chance(LOST * self.amount) {
            return;
        }
        out.push_from(whole, index);
        let at = out.len() - 1;
        let viewing = self.viewing_ray(near, DVec3::from_array(mean_m));
        let ray = viewing.ray_m.normalize_or(DVec3::X);
        let axes = DMat3::from_cols(ray, viewing.normal.cross(ray), viewing.normal);

        let growth = 1.0 + MOVED * self.amount * self.patch(1, mean_m);
        let moved_m = (viewing.camera_m + growth * viewing.ray_m).to_array();
        // A Gaussian that would leave its cell stays where it is: cells are spoiled one by one.
        if cell_at(&moved_m) == cell_at(&mean_m) {
            // As large in the image as before.
            out.means_m[at] = moved_m;
            out.ln_scales[at] = out.ln_scales[at].map(|ln| ln + growth.ln() as f32);
        }

        // A log-uniform share from TINT_LEAST to 1.
        let strength = self.amount * TINT * TINT_LEAST.powf(random.unit());
        let mixed = |stream: u64, own: f64| {
            TINT_PATCH * 2.0 * self.patch(stream, mean_m) + (1.0 - TINT_PATCH) * own
        };
        let own = random.range(-1.0, 1.0);
        let first = at * 3 * sh::coefficients(out.sh_degree);
        for channel in 0..3 {
            let channels_own = random.range(-1.0, 1.0);
            let change = TINT_GREY * mixed(2, own)
                + (1.0 - TINT_GREY) * mixed(3 + channel as u64, channels_own);
            let slope = strength * change / sh::C1 * viewing.normal;
            // The basis of degree 1 is C1 (-y, z, -x).
            for (coefficient, value) in [-slope.y, slope.z, -slope.x].into_iter().enumerate() {
                out.sh[first + 3 * (coefficient + 1) + channel] += value as f32;
            }
        }

        if random.chance(NEEDLES * self.amount) {
            let mut ln_scales = out.ln_scales[at];
            ln_scales.sort_by(f32::total_cmp);
            // The middle one of the three: a surfel's smaller width, not its thickness.
            let sigma_m = f64::from(ln_scales[1]).exp();
            let long_m = (sigma_m * random.range(1.0, NEEDLE_LENGTH)).min(1.0);
            shape(out, at, axes, [long_m, 0.7 * sigma_m, 0.7 * sigma_m]);
        }
        if random.chance(SHEETS * self.amount) {
            let share = random.range(0.5, 0.95);
            let sheet_m = (viewing.camera_m + share * viewing.ray_m).to_array();
            if cell_at(&sheet_m) == cell_at(&mean_m) {
                let at_15_m = SHEET_M * random.range(0.5, 1.5);
                // As large in the image at any distance, within limits.
                let long_m = at_15_m * (viewing.ray_m.length() / 15.0).clamp(0.3, 2.0);
                out.push_from(whole, index);
                out.means_m[at + 1] = sheet_m;
                shape(out, at + 1, axes, [long_m, 0.5 * long_m, 0.002]);
            }
        }
    }

    /// Smooth noise in [-1, 1] that changes within [`PATCH_M`].
    fn patch(&self, stream: u64, [x, y, z]: [f64; 3]) -> f64 {
        // Noise of the plane; no surface of a street lies along the direction in which it is
        // constant.
        noise(mix(self.seed ^ stream), (x + 0.37 * z) / PATCH_M, (y + 0.61 * z) / PATCH_M)
    }
}

/// Gives a Gaussian principal axes and standard deviations along them, in metres.
fn shape(gaussians: &mut Gaussians, at: usize, axes: DMat3, sigmas_m: [f64; 3]) {
    let DQuat { x, y, z, w } = DQuat::from_mat3(&axes);
    gaussians.quats_wxyz[at] = [w, x, y, z].map(|c| c as f32);
    gaussians.ln_scales[at] = sigmas_m.map(|sigma_m| sigma_m.ln() as f32);
}
