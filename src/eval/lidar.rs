//! Rendered depth against LiDAR.
//!
//! A LiDAR turns while the vehicle drives, so each point has its own time, and is transformed into
//! the world with the vehicle's pose at that time: `p_world = T_ego(t) T_lidar p`. It is then
//! projected into the image.

use std::collections::HashMap;

use glam::{DMat3, DMat4, DQuat, DVec2, DVec3, DVec4};
use safetensors::tensor::{Dtype, SafeTensorError, SafeTensors};
use serde::Serialize;

use super::mean::mean;
use wildcity_render::compare::json_numbers::serialize_number;
use wildcity_scene::align::Alignment;
use wildcity_scene::geometry::{Camera, Pose, PoseError};
use wildcity_scene::trajectory::Keyframe;

/// Largest time between two poses for them to be interpolated, in microseconds.
pub(crate) const LARGEST_GAP_US: i64 = 200_000;

/// Among points within this distance on the image, only the nearest counts, in pixels.
pub(crate) const SAME_PX: f64 = 2.0;

/// Pixels with less opacity have no depth.
pub(crate) const LEAST_OPACITY: f32 = 0.5;

/// Limits of the bins of depth, in metres. Points beyond the last do not count.
pub const BINS_M: [f64; 4] = [0.0, 10.0, 30.0, 80.0];

/// Why no depth was compared.
pub const NO_LIDAR_POINT: &str = "no LiDAR point was compared: none is within an image, less than 80 m away, at a time near the \
                                  image's (--lidar-window), where the scene is opaque and pixels count";

/// Points of a LiDAR with their times.
#[derive(Clone, Debug, PartialEq)]
pub struct LidarPoints {
    /// Positions in the LiDAR's axes, in metres.
    points_m: Vec<DVec3>,
    /// Time of each point, in microseconds, not decreasing.
    time_us: Vec<i64>,
    rig_from_lidar: Pose,
    /// The poses of the rig in the file, if it has any.
    pub poses: Option<Vec<Keyframe>>,
}

/// Why a LiDAR file was refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum LidarError {
    /// It is not a safetensors file.
    #[error("not a safetensors file: {0}; `safetensors.numpy.save_file` writes one")]
    File(String),
    /// A tensor is missing.
    #[error("there is no tensor {0:?}; points_m [n, 3] and time_us [n] are needed")]
    Missing(&'static str),
    /// A tensor has another type or shape.
    #[error("tensor {name:?} is {found}; {must}")]
    Tensor {
        name: &'static str,
        /// Its type and shape.
        found: String,
        /// The accepted type and shape.
        must: &'static str,
    },
    /// A matrix is not a rigid transform.
    #[error(
        "{name}[{index}] is no pose: {reason}; give rotation and translation in metres, last row 0 0 0 1"
    )]
    Pose { name: &'static str, index: usize, reason: String },
    /// Poses are not in order of time.
    #[error("pose_time_us[{0}] is not after the one before it")]
    Time(usize),
    /// There is no pose to transform points into the world.
    #[error(
        "there is no pose of the vehicle: give pose_time_us and world_from_rig in the file, or a twin with a drive"
    )]
    NoPoses,
}

/// Points in the world.
#[derive(Clone, Debug, PartialEq)]
pub struct WorldPoints {
    /// Positions in metres, in order of time.
    pub points_m: Vec<DVec3>,
    /// Times in microseconds, not decreasing.
    pub time_us: Vec<i64>,
    /// Points that were left out, because no two poses at most 0.2 s apart enclose their time.
    pub skipped: usize,
}

/// A rendered image that is compared with LiDAR. Maps are `[height, width]`.
#[derive(Clone, Copy, Debug)]
pub struct DepthMap<'a> {
    pub camera: &'a Camera,
    pub world_from_camera: &'a Pose,
    /// Depth of each pixel, as in [`Camera::depth_m`].
    pub depth_m: &'a [f32],
    /// Opacity of each pixel, 0 to 1.
    pub opacity: &'a [f32],
    /// The pixels that count; all without it.
    pub counts: Option<&'a [bool]>,
}

/// Depth of one image against LiDAR.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LidarDepth {
    /// Number of points that were compared.
    pub points: usize,
    /// Mean absolute difference of the rendered depth to the point's, in metres; NaN without
    /// points.
    #[serde(serialize_with = "serialize_number")]
    pub mean_m: f64,
    /// Median of this difference, in metres.
    #[serde(serialize_with = "serialize_number")]
    pub median_m: f64,
    /// The differences by the depth of the point.
    pub bins: [LidarBin; 3],
}

/// The points in a range of depths.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct LidarBin {
    /// Least depth, in metres.
    pub from_m: f64,
    /// End of the range, exclusive, in metres.
    pub to_m: f64,
    pub points: usize,
    /// Mean absolute difference, in metres; NaN without points.
    #[serde(serialize_with = "serialize_number")]
    pub mean_m: f64,
}

/// Means over the images that LiDAR points were compared with.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct LidarMeans {
    /// Number of images with points.
    pub images: usize,
    /// Points of all images.
    pub points: usize,
    /// Mean of the images' means, in metres.
    #[serde(serialize_with = "serialize_number")]
    pub mean_m: f64,
    /// Mean of the images' medians, in metres.
    #[serde(serialize_with = "serialize_number")]
    pub median_m: f64,
    /// The differences of the points of all images together, by depth.
    pub bins: [LidarBin; 3],
}

impl LidarPoints {
    /// Reads a safetensors file: `points_m` `[n, 3]` (f32 or f64), `time_us` `[n]` (i64); and
    /// perhaps `rig_from_lidar` `[4, 4]` (f64, identity without it), `pose_time_us` `[m]` (i64) and
    /// `world_from_rig` `[m, 4, 4]` (f64).
    ///
    /// # Errors
    /// Names the tensor that is missing or cannot be used. Points that are not finite are left out.
    pub fn parse(bytes: &[u8]) -> Result<Self, LidarError> {
        let file = SafeTensors::deserialize(bytes)
            .map_err(|error: SafeTensorError| LidarError::File(error.to_string()))?;
        let points =
            floats(&file, "points_m", &[None, Some(3)])?.ok_or(LidarError::Missing("points_m"))?;
        let times = times(&file, "time_us")?.ok_or(LidarError::Missing("time_us"))?;
        if times.len() != points.len() / 3 {
            return Err(LidarError::Tensor {
                name: "time_us",
                found: format!("[{}]", times.len()),
                must: "one time for each point is needed",
            });
        }
        let points = points.chunks_exact(3).map(|xyz| DVec3::new(xyz[0], xyz[1], xyz[2]));
        let mut timed: Vec<(i64, DVec3)> = times.into_iter().zip(points).collect();
        // Sensors write NaN where there was no return.
        timed.retain(|(_, point_m)| point_m.is_finite());
        // Sorted by time: `between_us` searches by bisection.
        timed.sort_by_key(|(time_us, _)| *time_us);
        let (time_us, points_m) = timed.into_iter().unzip();
        // Without a mount the points are in the rig's axes.
        let rig_from_lidar = match floats(&file, "rig_from_lidar", &[Some(4), Some(4)])? {
            Some(matrix) => pose("rig_from_lidar", 0, &matrix)?,
            None => Pose::IDENTITY,
        };
        Ok(Self { points_m, time_us, rig_from_lidar, poses: poses(&file)? })
    }

    /// Points in the rig's axes, in metres, with their times in microseconds, and the poses of the
    /// rig. Points that are not finite are left out.
    pub fn from_rig(points: Vec<(i64, DVec3)>, poses: Vec<Keyframe>) -> Self {
        let mut timed = points;
        timed.retain(|(_, point_m)| point_m.is_finite());
        timed.sort_by_key(|(time_us, _)| *time_us);
        let (time_us, points_m) = timed.into_iter().unzip();
        Self { points_m, time_us, rig_from_lidar: Pose::IDENTITY, poses: Some(poses) }
    }

    /// Number of points, of all times.
    pub fn len(&self) -> usize {
        self.points_m.len()
    }

    /// Whether there are no points.
    pub fn is_empty(&self) -> bool {
        self.points_m.is_empty()
    }

    /// The points in the world. The poses are those of the file, changed by `alignment`, or else
    /// `drive`, in the world's axes, with times in the same clock as the points'.
    ///
    /// # Errors
    /// [`LidarError::NoPoses`].
    pub fn in_world(
        &self,
        alignment: &Alignment,
        drive: Option<&[Keyframe]>,
    ) -> Result<WorldPoints, LidarError> {
        let aligned = |poses: &Vec<Keyframe>| -> Vec<Keyframe> {
            let pose = |key: &Keyframe| Keyframe {
                world_from_rig: alignment.pose(&key.world_from_rig),
                ..*key
            };
            poses.iter().map(pose).collect()
        };
        let own = self.poses.as_ref().map(aligned);
        // The poses of the file come first: they are in the clock of its points.
        let poses = own
            .as_deref()
            .or(drive)
            .filter(|poses| !poses.is_empty())
            .ok_or(LidarError::NoPoses)?;
        let mut world = WorldPoints { points_m: Vec::new(), time_us: Vec::new(), skipped: 0 };
        for (time_us, point_m) in self.time_us.iter().zip(&self.points_m) {
            match pose_at(poses, *time_us) {
                // p_world = T_rig(t) T_lidar p.
                Some(world_from_rig) => {
                    let rig_m = self.rig_from_lidar.transform_point(*point_m);
                    world.points_m.push(world_from_rig.transform_point(rig_m));
                    world.time_us.push(*time_us);
                }
                None => world.skipped += 1,
            }
        }
        Ok(world)
    }
}

/// The pose at a time: linear in position, SLERP in rotation; `None` outside of the poses and in a
/// gap.
fn pose_at(poses: &[Keyframe], time_us: i64) -> Option<Pose> {
    // The first pose after the time. Before the first one there is none to interpolate from.
    let after = poses.partition_point(|key| key.time_us <= time_us);
    let before = &poses[after.checked_sub(1)?];
    // On a pose, no second one is needed, not even at the end or before a gap.
    if before.time_us == time_us {
        return Some(before.world_from_rig);
    }
    let next = poses.get(after)?;
    // Times of a file may be any: the difference of two would overflow.
    let gap_us = next.time_us.abs_diff(before.time_us);
    if gap_us > LARGEST_GAP_US as u64 {
        return None;
    }
    let share = time_us.abs_diff(before.time_us) as f64 / gap_us as f64;
    let a = before.world_from_rig;
    let b = next.world_from_rig;
    let rotation = slerp(a.rotation, b.rotation, share);
    Some(Pose { position_m: a.position_m.lerp(b.position_m, share), rotation })
}

/// The rotation at a share of the shorter arc between two, by the angle itself also where it is
/// small (Shoemake 1985).
fn slerp(a: DQuat, b: DQuat, share: f64) -> DQuat {
    let a = DVec4::from(a);
    let mut b = DVec4::from(b);
    // q and -q are one rotation: the nearer of both gives the shorter arc.
    if a.dot(b) < 0.0 {
        b = -b;
    }
    // Accurate for small angles, where the arc cosine of the dot product is not.
    let angle = 2.0 * (a - b).length().atan2((a + b).length());
    let weights = match angle {
        // Below 1e-12 rad the sine divides 0 by 0, and the chord is the arc.
        angle if angle < 1e-12 => [1.0 - share, share],
        angle => [1.0 - share, share].map(|part| (part * angle).sin() / angle.sin()),
    };
    DQuat::from_vec4(a * weights[0] + b * weights[1]).normalize()
}

impl WorldPoints {
    /// The points from one time to another, both included.
    pub fn between_us(&self, from_us: i64, to_us: i64) -> &[DVec3] {
        let first = self.time_us.partition_point(|time_us| *time_us < from_us);
        let after = self.time_us.partition_point(|time_us| *time_us <= to_us);
        // `max` keeps the range valid if the times are given in the wrong order.
        &self.points_m[first..after.max(first)]
    }
}

impl LidarDepth {
    /// Compares rendered depth with points of the world, in metres.
    pub fn compare(points_m: &[DVec3], map: &DepthMap<'_>) -> Self {
        let mut errors: Vec<(f64, f64)> = Vec::new();
        for Seen { at_px, depth_m } in nearest(seen(points_m, map)) {
            // Within the image by `seen`: both casts round down to an existing pixel.
            let pixel = at_px.y as usize * map.camera.width_px as usize + at_px.x as usize;
            let is_counted = map.counts.is_none_or(|counts| counts[pixel]);
            let is_drawn = map.opacity[pixel] >= LEAST_OPACITY && map.depth_m[pixel] > 0.0;
            // The far end is exclusive, as that of each bin.
            if is_counted && is_drawn && depth_m < BINS_M[3] {
                errors.push((depth_m, (f64::from(map.depth_m[pixel]) - depth_m).abs()));
            }
        }
        let bin = |at: usize| {
            let from_m = BINS_M[at];
            let to_m = BINS_M[at + 1];
            // Bins are half-open: a point counts in one of them.
            let within = errors.iter().filter(|(depth_m, _)| (from_m..to_m).contains(depth_m));
            let points = within.clone().count();
            LidarBin { from_m, to_m, points, mean_m: mean(within.map(|(_, error_m)| *error_m)) }
        };
        let bins = [0, 1, 2].map(bin);
        // Sorted for the median; the mean does not depend on the order but for rounding.
        let mut sorted: Vec<f64> = errors.iter().map(|(_, error_m)| *error_m).collect();
        sorted.sort_by(f64::total_cmp);
        let mean_m = mean(sorted.iter().copied());
        Self { points: sorted.len(), mean_m, median_m: median(&sorted), bins }
    }
}

impl LidarMeans {
    /// `None` if there is no image.
    pub(super) fn from_images<'a>(images: impl Iterator<Item = &'a LidarDepth>) -> Option<Self> {
        let all: Vec<&LidarDepth> = images.collect();
        if all.is_empty() {
            return None;
        }
        // Images without a point have NaN as their mean, and would spoil all.
        let seen: Vec<&LidarDepth> = all.into_iter().filter(|image| image.points > 0).collect();
        let bin = |at: usize| {
            let of: Vec<LidarBin> = seen.iter().map(|image| image.bins[at]).collect();
            let points = of.iter().map(|bin| bin.points).sum();
            let with_points = of.iter().filter(|bin| bin.points > 0);
            // Weighted by points, because bins are of the points of all images together.
            let sum_m: f64 = with_points.map(|bin| bin.points as f64 * bin.mean_m).sum();
            let from_m = BINS_M[at];
            let to_m = BINS_M[at + 1];
            LidarBin { from_m, to_m, points, mean_m: sum_m / points as f64 }
        };
        Some(Self {
            images: seen.len(),
            points: seen.iter().map(|image| image.points).sum(),
            mean_m: mean(seen.iter().map(|image| image.mean_m)),
            median_m: mean(seen.iter().map(|image| image.median_m)),
            bins: [0, 1, 2].map(bin),
        })
    }
}

/// A point on the image.
#[derive(Clone, Copy, Debug)]
struct Seen {
    at_px: DVec2,
    depth_m: f64,
}

/// The points that are within the image.
fn seen(points_m: &[DVec3], map: &DepthMap<'_>) -> Vec<Seen> {
    let camera_from_world = map.world_from_camera.inverse();
    let size_px = map.camera.size_px();
    let project = |point_m: &DVec3| {
        // The projection and the depth both need the point in the camera's axes.
        let point_m = camera_from_world.transform_point(*point_m);
        let at_px = map.camera.project(point_m)?;
        let is_within = at_px.cmpge(DVec2::ZERO).all() && at_px.cmplt(size_px).all();
        // As the renderer defines depth for this lens: z or distance.
        is_within.then(|| Seen { at_px, depth_m: map.camera.depth_m(point_m) })
    };
    points_m.iter().filter_map(project).collect()
}

/// Keeps a point, from the nearest on, if no kept point is within [`SAME_PX`]: it may be hidden
/// behind that one.
fn nearest(mut seen: Vec<Seen>) -> Vec<Seen> {
    // Nearest first: a kept point can only be nearer than the ones that it hides.
    seen.sort_by(|a, b| a.depth_m.total_cmp(&b.depth_m));
    // Cells as wide as the radius: whatever is within it lies in the cell of the point or in one of
    // the eight around. This makes the search O(n) and not O(n²).
    let cell_of = |at_px: DVec2| [at_px.x, at_px.y].map(|at| (at / SAME_PX).floor() as i32);
    let mut cells: HashMap<[i32; 2], Vec<DVec2>> = HashMap::new();
    let mut kept = Vec::new();
    for one in seen {
        let [x, y] = cell_of(one.at_px);
        let mut around = (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| [x + dx, y + dy]));
        let is_hidden = around.any(|cell| {
            let of_cell = cells.get(&cell).into_iter().flatten();
            of_cell.into_iter().any(|nearer_px| nearer_px.distance(one.at_px) <= SAME_PX)
        });
        if !is_hidden {
            cells.entry([x, y]).or_default().push(one.at_px);
            kept.push(one);
        }
    }
    kept
}

fn median(sorted: &[f64]) -> f64 {
    let middle = sorted.len() / 2;
    match sorted.len() {
        0 => f64::NAN,
        count if count % 2 == 1 => sorted[middle],
        // The mean of the middle two, as NumPy has it.
        _ => 0.5 * (sorted[middle - 1] + sorted[middle]),
    }
}

/// The poses of the rig, if the file has any.
fn poses(file: &SafeTensors<'_>) -> Result<Option<Vec<Keyframe>>, LidarError> {
    let Some(times) = times(file, "pose_time_us")? else { return Ok(None) };
    let shape = [Some(times.len()), Some(4), Some(4)];
    // The shape ties the number of matrices to that of times.
    let matrices =
        floats(file, "world_from_rig", &shape)?.ok_or(LidarError::Missing("world_from_rig"))?;
    if let Some(at) = times.windows(2).position(|pair| pair[1] <= pair[0]) {
        return Err(LidarError::Time(at + 1));
    }
    let keyframe = |(index, (time_us, matrix)): (usize, (i64, &[f64]))| {
        let world_from_rig = pose("world_from_rig", index, matrix)?;
        Ok(Keyframe { time_us, world_from_rig })
    };
    let both = times.into_iter().zip(matrices.chunks_exact(16)).enumerate();
    both.map(keyframe).collect::<Result<Vec<Keyframe>, LidarError>>().map(Some)
}

/// The pose of a matrix, row by row.
fn pose(name: &'static str, index: usize, rows: &[f64]) -> Result<Pose, LidarError> {
    let wrong = |reason: String| LidarError::Pose { name, index, reason };
    let mut values = [0.0; 16];
    values.copy_from_slice(rows);
    // The file has rows and glam takes columns.
    let matrix = DMat4::from_cols_array(&values).transpose();
    let rotation = DMat3::from_mat4(matrix);
    // R Rᵀ = 1 for a rotation; the determinant tells a mirror apart.
    let off = (rotation * rotation.transpose() - DMat3::IDENTITY).to_cols_array();
    let error = off.iter().fold(0.0, |most: f64, value| most.max(value.abs()));
    // A matrix with a NaN is refused, too.
    // 1e-4 leaves room for matrices that were written with few digits.
    let is_rotation = error <= 1e-4 && rotation.determinant() > 0.0;
    if !is_rotation || matrix.row(3) != DVec4::W {
        return Err(wrong(format!(
            "off by {error:.1e} from orthonormal, determinant {:.3}",
            rotation.determinant()
        )));
    }
    let q = DQuat::from_mat3(&rotation).normalize();
    let position_m = matrix.w_axis.truncate().to_array();
    let pose = Pose::checked(position_m, [q.w, q.x, q.y, q.z]);
    pose.map_err(|error: PoseError| wrong(error.to_string()))
}

/// The values of a tensor of numbers, if there is one; `None` in the shape is any length.
fn floats(
    file: &SafeTensors<'_>,
    name: &'static str,
    shape: &[Option<usize>],
) -> Result<Option<Vec<f64>>, LidarError> {
    let Ok(tensor) = file.tensor(name) else { return Ok(None) };
    let own = tensor.shape();
    let agrees =
        |(own, wanted): (&usize, &Option<usize>)| wanted.is_none_or(|wanted| wanted == *own);
    let is_shape = own.len() == shape.len() && own.iter().zip(shape).all(agrees);
    // An unknown type has no values, and fails the check of the number below, which names the type.
    let values = match tensor.dtype() {
        Dtype::F64 => wide(tensor.data()),
        Dtype::F32 => narrow(tensor.data()),
        _ => Vec::new(),
    };
    if !is_shape || values.len() != own.iter().product::<usize>() {
        let found = format!("{:?} {own:?}", tensor.dtype());
        let must =
            "points_m is [n, 3], rig_from_lidar [4, 4], world_from_rig [m, 4, 4], of f32 or f64";
        return Err(LidarError::Tensor { name, found, must });
    }
    Ok(Some(values))
}

fn wide(bytes: &[u8]) -> Vec<f64> {
    let (values, _) = bytes.as_chunks::<8>();
    values.iter().map(|value| f64::from_le_bytes(*value)).collect()
}

fn narrow(bytes: &[u8]) -> Vec<f64> {
    let (values, _) = bytes.as_chunks::<4>();
    values.iter().map(|value| f64::from(f32::from_le_bytes(*value))).collect()
}

/// The values of a tensor of times, if there is one.
fn times(file: &SafeTensors<'_>, name: &'static str) -> Result<Option<Vec<i64>>, LidarError> {
    let Ok(tensor) = file.tensor(name) else { return Ok(None) };
    if tensor.dtype() != Dtype::I64 || tensor.shape().len() != 1 {
        let found = format!("{:?} {:?}", tensor.dtype(), tensor.shape());
        return Err(LidarError::Tensor { name, found, must: "times are i64 in one dimension" });
    }
    // The length is a multiple of 8, which safetensors checks against shape and type.
    let (values, _) = tensor.data().as_chunks::<8>();
    Ok(Some(values.iter().map(|value| i64::from_le_bytes(*value)).collect()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn poses_at_the_ends_of_time_are_a_gap() {
        let at = |time_us: i64| Keyframe { time_us, world_from_rig: Pose::IDENTITY };
        assert_eq!(pose_at(&[at(i64::MIN), at(i64::MAX)], 0), None);
        assert_eq!(pose_at(&[at(0), at(100)], 50), Some(Pose::IDENTITY));
    }
}
