//! What the cameras of a capture say of its ground: it is below all of them, and the rows of their
//! images are level.

use glam::DVec3;

use crate::geometry::Pose;

use super::median;
use super::plane::{GroundPlane, fit};

/// The cameras of a capture, in the axes and the unit of its scene.
#[derive(Clone, Debug, PartialEq)]
pub struct CaptureCameras {
    /// Directions that may be up; at least one.
    ups: Vec<DVec3>,
    /// Whether up is across the rows of images in several directions.
    has_level_rows: bool,
    /// Where they are; at least one.
    positions: Vec<DVec3>,
}

/// Why cameras say nothing of the ground.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CamerasError {
    /// They are turned in all directions, or there are none.
    #[error("the {count} cameras have no common direction that is up: give --up, too")]
    NoCommonUp { count: usize },
}

/// Least length of the mean of the cameras' up directions: level photographs that are tilted by up
/// to 45 degrees have 0.7 and more.
const LEAST_COMMON: f64 = 0.7;

/// Largest length of the mean of the directions along the cameras' rows that say where up is: they
/// are spread by 8 degrees. Photographs in one direction do not say how far they are tilted.
const MOST_PARALLEL: f64 = 0.99;

/// Least cosine between up by the rows and by the mean: rows that are spread by rolled cameras are
/// not level.
const LEAST_AGREEMENT: f64 = 0.7;

/// Share of the cameras that are above the ground: COLMAP may place one of them wrongly, and a road
/// may have a crest.
const ABOVE_SHARE: f64 = 0.9;

impl CaptureCameras {
    /// Cameras with these poses: x right, y down, z forward, of the image as it is in its file.
    ///
    /// Photographs are tilted up to the roof of a house or down to an object, and hardly ever
    /// rolled: up is across the rows of all images. Only if all look in one direction, it is the
    /// mean of their up directions. Of portrait photographs, whose files are turned by a quarter to
    /// either side, it is across the columns. A camera is carried along the ground: up is the
    /// direction of the two in which the cameras differ less.
    ///
    /// # Errors
    /// [`CamerasError::NoCommonUp`].
    pub fn new(world_from_camera: &[Pose]) -> Result<Self, CamerasError> {
        let positions: Vec<DVec3> = world_from_camera.iter().map(|pose| pose.position_m).collect();
        let landscape = up_by_axes(world_from_camera, DVec3::NEG_Y, DVec3::X);
        let portrait = up_by_axes(world_from_camera, DVec3::NEG_X, DVec3::Y);
        let is_portrait = match (landscape, portrait) {
            (Some((up, _)), Some((turned, _))) => {
                // Both are plausible: the camera moved along the ground, and hardly up and down.
                spread(&positions, turned) < spread(&positions, up)
            }
            (landscape, _) => landscape.is_none(),
        };
        let chosen = if is_portrait { portrait } else { landscape };
        let none = CamerasError::NoCommonUp { count: positions.len() };
        let (up, has_level_rows) = chosen.ok_or(none)?;
        // The files of portrait photographs do not say to which side they were turned.
        let ups = if is_portrait { vec![up, -up] } else { vec![up] };
        Ok(Self { ups, has_level_rows, positions })
    }

    /// As [`Self::new`], if it is known where up is.
    ///
    /// # Errors
    /// [`CamerasError::NoCommonUp`]: there are no cameras.
    pub fn with_up(world_from_camera: &[Pose], up: DVec3) -> Result<Self, CamerasError> {
        if world_from_camera.is_empty() {
            return Err(CamerasError::NoCommonUp { count: 0 });
        }
        let positions = world_from_camera.iter().map(|pose| pose.position_m).collect();
        Ok(Self { ups: vec![up.normalize_or_zero()], has_level_rows: false, positions })
    }

    /// Directions that may be up: two of portrait photographs.
    pub fn ups(&self) -> &[DVec3] {
        &self.ups
    }

    /// Whether up is known to a few degrees.
    pub(super) fn have_level_rows(&self) -> bool {
        self.has_level_rows
    }

    /// The middle of the cameras, by axis.
    pub(super) fn middle(&self) -> DVec3 {
        DVec3::from_array(
            [0, 1, 2]
                .map(|axis| median(self.positions.iter().map(|position| position[axis]).collect())),
        )
    }

    /// Whether nearly all cameras are above a plane.
    pub(super) fn are_above(&self, plane: &GroundPlane) -> bool {
        let above = self.heights(plane).filter(|&height| height > 0.0).count();
        above as f64 >= ABOVE_SHARE * self.positions.len() as f64
    }

    /// Median height of the cameras above a plane, in the unit of the scene.
    pub fn height_above(&self, plane: &GroundPlane) -> f64 {
        median(self.heights(plane).collect())
    }

    fn heights(&self, plane: &GroundPlane) -> impl Iterator<Item = f64> {
        let GroundPlane { point, up } = *plane;
        self.positions.iter().map(move |position| up.dot(position - point))
    }
}

/// Up, if the axis `upright` of the cameras points there and their axis `level` is horizontal, and
/// whether it is across the latter.
fn up_by_axes(world_from_camera: &[Pose], upright: DVec3, level: DVec3) -> Option<(DVec3, bool)> {
    let count = world_from_camera.len().max(1) as f64;
    let axes = |axis: DVec3| world_from_camera.iter().map(move |pose| pose.rotation * axis);
    let mean = axes(upright).sum::<DVec3>() / count;
    if mean.length() < LEAST_COMMON {
        return None;
    }
    // Unit vectors in one direction have a sum as long as their number.
    let is_spread = axes(level).sum::<DVec3>().length() <= MOST_PARALLEL * count;
    // A plane through the origin: each direction and the opposite one have their mean there.
    let rows: Vec<DVec3> = axes(level).chain(axes(-level)).collect();
    let agrees = |up: &DVec3| up.dot(mean) >= LEAST_AGREEMENT * mean.length();
    let across = fit(&rows)
        .filter(|_| is_spread)
        // The normal of a fit may point to either side.
        .map(|plane| plane.up * plane.up.dot(mean).signum())
        .filter(agrees);
    Some((across.unwrap_or(mean).normalize(), across.is_some()))
}

/// How far most positions differ along a direction: the median distance from their median.
fn spread(positions: &[DVec3], along: DVec3) -> f64 {
    let at: Vec<f64> = positions.iter().map(|position| along.dot(*position)).collect();
    let middle = median(at.clone());
    median(at.into_iter().map(|at| (at - middle).abs()).collect())
}
