//! What a scenario refers to, and how its parts look that up.

use glam::DVec3;

use wildcity_scene::geometry::Pose;
use wildcity_scene::{ActorBox, ActorClass, Trajectory};

use super::error::{FileError, in_range, listed};
use super::tracks::TracksFile;
use crate::map::Map;
use crate::{Ground, limits};

/// The objects that a scenario refers to.
#[derive(Clone, Copy)]
pub struct Surroundings<'a> {
    /// Recorded drives of the twin.
    pub drives: &'a [Trajectory],
    /// The tracks file that the scenario names.
    pub tracks: Option<&'a TracksFile>,
    /// The map that the scenario names.
    pub map: Option<&'a Map>,
    /// The assets of actors.
    pub assets: &'a dyn Assets,
}

/// The assets that actors may have.
pub trait Assets {
    /// Looks up an asset by its hash or its name.
    ///
    /// # Errors
    /// The reason if it cannot be used.
    fn find(&self, name: &str) -> Result<AssetInfo, String>;

    /// The asset of an actor that names none, by its class and its size; `None` if there is none of
    /// the class.
    ///
    /// # Errors
    /// The reason if assets cannot be read.
    fn default_for(&self, class: ActorClass, box_: &ActorBox) -> Result<Option<AssetInfo>, String>;
}

/// No asset at all: actors without one are not drawn, and others are refused.
#[derive(Clone, Copy, Debug)]
pub struct NoAssets;

impl Assets for NoAssets {
    fn find(&self, name: &str) -> Result<AssetInfo, String> {
        Err(format!("there is no asset {name:?}"))
    }

    fn default_for(&self, _: ActorClass, _: &ActorBox) -> Result<Option<AssetInfo>, String> {
        Ok(None)
    }
}

/// The properties of an asset that a scenario needs.
#[derive(Clone, Debug, PartialEq)]
pub struct AssetInfo {
    /// Its hash, 64 lower-case hex digits.
    pub hash: String,
    pub class: ActorClass,
    pub box_: ActorBox,
}

/// Where the ego starts.
#[derive(Clone, Debug, PartialEq)]
pub enum EgoStart {
    /// At a pose, `world_from_rig`.
    Pose(Pose),
    /// Along a recorded trajectory.
    Station {
        trajectory: String,
        /// Distance along it, in metres.
        station_m: f64,
    },
}

impl Surroundings<'_> {
    /// The ground that cars and pedestrians stand on.
    pub(super) fn ground(&self) -> Ground<'_> {
        Ground::from_drives(self.drives).and_lanes(self.map.map(Map::surface))
    }
}

impl std::fmt::Debug for Surroundings<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        // The counts only: a twin has thousands of keyframes, and `dyn Assets` cannot be printed.
        f.debug_struct("Surroundings").field("drives", &self.drives.len()).finish_non_exhaustive()
    }
}

/// A recorded drive by its name.
pub(super) fn drive_named<'a>(
    path: &str,
    name: &str,
    drives: &'a [Trajectory],
) -> Result<&'a Trajectory, FileError> {
    let found = drives.iter().find(|drive| drive.name == *name);
    found.ok_or_else(|| {
        let known = listed(drives.iter().map(|drive| drive.name.as_str()));
        FileError::new(path, format!("the twin has no trajectory {name:?}; it has {known}"))
    })
}

/// Points of a file.
pub(super) fn checked_points(path: &str, points: &[[f64; 3]]) -> Result<Vec<DVec3>, FileError> {
    if !(2..=limits::COURSE_POINTS).contains(&points.len()) {
        let message =
            format!("{} points; 2 to {} are accepted", points.len(), limits::COURSE_POINTS);
        return Err(FileError::new(path, message));
    }
    let most_m = Pose::MAX_COORDINATE_M;
    let mut points_m = Vec::with_capacity(points.len());
    for (index, point) in points.iter().enumerate() {
        for (axis, value) in point.iter().enumerate() {
            in_range(&format!("{path}[{index}][{axis}]"), *value, [-most_m, most_m])?;
        }
        points_m.push(DVec3::from_array(*point));
    }
    Ok(points_m)
}
