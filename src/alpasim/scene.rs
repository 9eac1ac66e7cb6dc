//! Scenes: AlpaSim's name for a piece of a recorded drive.
//!
//! The id `TWIN@VERSION+TRAJECTORY+START_M`, such as `demo@1+log+100`, is complete, so that the
//! server keeps no table. Names cannot have `@` and `+`, and AlpaSim creates folders for a `/`.
//!
//! The local frame of a scene has the axes of the world. Its origin is the drive's position at
//! START_M, rounded to whole metres, so that f32 poses lose nothing.

use std::fmt;
use std::str::FromStr;

use glam::DVec3;

use wildcity_scene::geometry::{Pose, PoseError};
use wildcity_scene::rig::is_name;
use wildcity_scene::route::Route;
use wildcity_scene::{Manifest, Trajectory};

use crate::limits;
use crate::wire::common;

/// The id of a scene.
#[derive(Clone, Debug, PartialEq)]
pub struct SceneId {
    /// Name of the twin.
    pub twin: String,
    /// Version of the twin.
    pub version: u64,
    /// Name of the recorded drive.
    pub trajectory: String,
    /// Where the scene starts, in metres along the drive.
    pub start_m: f64,
}

/// Why an id or a pose was refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum SceneError {
    /// The text is not an id.
    #[error("{id:?} is no scene: expected TWIN@VERSION+TRAJECTORY+START_M, as demo@1+log+0")]
    Id { id: String },
    /// The version has no such drive.
    #[error("twin {twin:?} has no trajectory {trajectory:?}")]
    Trajectory {
        twin: String,
        /// The drive asked for.
        trajectory: String,
    },
    /// The start is not on the drive.
    #[error("{start_m} m is not on trajectory {trajectory:?}, which is {length_m} m long")]
    Start {
        /// The start asked for, in metres.
        start_m: f64,
        trajectory: String,
        /// Its length, in metres.
        length_m: f64,
    },
    /// A pose is missing or invalid.
    #[error("{field}: {cause}")]
    Pose { field: &'static str, cause: PoseError },
    /// A pose is missing.
    #[error("{field} is missing")]
    Missing { field: &'static str },
}

impl FromStr for SceneId {
    type Err = SceneError;

    fn from_str(id: &str) -> Result<Self, SceneError> {
        // A longer text is no id, and is not repeated as a whole.
        let end = id.floor_char_boundary(limits::SCENE_ID_BYTES);
        let refused = || SceneError::Id { id: id[..end].to_owned() };
        if end < id.len() {
            return Err(refused());
        }
        // Names have neither `@` nor `+`, so the first ones are the separators.
        let (twin, rest) = id.split_once('@').ok_or_else(refused)?;
        let (version, rest) = rest.split_once('+').ok_or_else(refused)?;
        let (trajectory, start_m) = rest.split_once('+').ok_or_else(refused)?;
        let version = version.parse().map_err(|_| refused())?;
        let start_m: f64 = start_m.parse().map_err(|_| refused())?;
        // Rust parses `nan` and `inf` as numbers, which are no places.
        if !is_name(twin) || !is_name(trajectory) || !start_m.is_finite() {
            return Err(refused());
        }
        Ok(Self { twin: twin.to_owned(), version, trajectory: trajectory.to_owned(), start_m })
    }
}

impl fmt::Display for SceneId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { twin, version, trajectory, start_m } = self;
        write!(f, "{twin}@{version}+{trajectory}+{start_m}")
    }
}

impl SceneId {
    /// The drive of the scene.
    ///
    /// # Errors
    /// The version has no such drive, or the start is not on it.
    pub fn drive<'a>(&self, manifest: &'a Manifest) -> Result<&'a Trajectory, SceneError> {
        let found = manifest.trajectories.iter().find(|drive| drive.name == self.trajectory);
        let drive = found.ok_or_else(|| SceneError::Trajectory {
            twin: self.twin.clone(),
            trajectory: self.trajectory.clone(),
        })?;
        let length_m = drive.length_m();
        // Both ends belong to the drive: a scene at its end has one pose.
        if !(0.0..=length_m).contains(&self.start_m) {
            let Self { trajectory, start_m, .. } = self.clone();
            return Err(SceneError::Start { start_m, trajectory, length_m });
        }
        Ok(drive)
    }

    /// The local frame.
    ///
    /// # Errors
    /// As [`SceneId::drive`].
    pub fn local_frame(&self, manifest: &Manifest) -> Result<LocalFrame, SceneError> {
        let start = self.drive(manifest)?.at_station(self.start_m);
        Ok(LocalFrame { origin_m: start.position_m.round() })
    }
}

/// The starts of a drive that are listed: every [`limits::SCENE_SPACING_M`] metres.
pub fn listed_starts_m(length_m: f64) -> impl Iterator<Item = f64> {
    // A drive of length 0 has one start, at 0.
    let last = (length_m / limits::SCENE_SPACING_M).floor().max(0.0) as u32;
    (0..=last).map(|k| f64::from(k) * limits::SCENE_SPACING_M)
}

/// The frame of a scene's poses: the axes of the world, with another origin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LocalFrame {
    /// Its origin in the world, in metres.
    pub origin_m: DVec3,
}

impl LocalFrame {
    /// Converts a pose from this frame to the world.
    ///
    /// # Errors
    /// It is missing or invalid; the error names `field`.
    pub fn world_from(
        &self,
        field: &'static str,
        pose: Option<&common::Pose>,
    ) -> Result<Pose, SceneError> {
        let pose = pose.ok_or(SceneError::Missing { field })?;
        // A pose without a quaternion is not taken for the identity: the field was forgotten.
        let Some((vec, quat)) = pose.vec.zip(pose.quat) else {
            return Err(SceneError::Missing { field });
        };
        // To f64 before the origin is added, in which 100 km have 1e-11 m.
        let xyz_m = [vec.x, vec.y, vec.z].map(f64::from);
        let q_wxyz = [quat.w, quat.x, quat.y, quat.z].map(f64::from);
        let local =
            Pose::checked(xyz_m, q_wxyz).map_err(|cause| SceneError::Pose { field, cause })?;
        Ok(Pose { position_m: local.position_m + self.origin_m, ..local })
    }

    /// Converts a pose from the world to this frame.
    pub fn local_from(&self, world: &Pose) -> common::Pose {
        pose_to_wire(&Pose { position_m: world.position_m - self.origin_m, ..*world })
    }
}

/// A pose as the wire has it.
pub fn pose_to_wire(pose: &Pose) -> common::Pose {
    // Within 1 km of the origin f32 has 0.06 mm.
    let [x, y, z] = pose.position_m.to_array().map(|m| m as f32);
    let [w, qx, qy, qz] = pose.q_wxyz().map(|c| c as f32);
    common::Pose {
        vec: Some(common::Vec3 { x, y, z }),
        quat: Some(common::Quat { w, x: qx, y: qy, z: qz }),
    }
}

/// The part of a drive that a scene shows: poses in its local frame, with times from
/// [`limits::EPOCH_US`].
///
/// # Errors
/// As [`SceneId::drive`].
pub fn trajectory(id: &SceneId, manifest: &Manifest) -> Result<common::Trajectory, SceneError> {
    let drive = id.drive(manifest)?;
    let frame = id.local_frame(manifest)?;
    let missing =
        |_| SceneError::Trajectory { twin: id.twin.clone(), trajectory: id.trajectory.clone() };
    let route = Route::new(drive).map_err(missing)?;
    let start = route.at(id.start_m);
    // The start is interpolated, and what follows are recorded keyframes: after the start, so that
    // no time comes twice.
    let end_us = start.time_us + (limits::SCENE_S * 1e6) as i64;
    let recorded =
        drive.keyframes.iter().filter(|key| (start.time_us + 1..=end_us).contains(&key.time_us));
    let pose_at_time = |time_us: i64, pose: &Pose| common::PoseAtTime {
        pose: Some(frame.local_from(pose)),
        // The difference of times within a scene is not negative.
        timestamp_us: limits::EPOCH_US + (time_us - start.time_us).unsigned_abs(),
    };
    let first = pose_at_time(start.time_us, &start.world_from_rig);
    let rest = recorded.map(|key| pose_at_time(key.time_us, &key.world_from_rig));
    Ok(common::Trajectory { poses: std::iter::once(first).chain(rest).collect() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ids_are_read_as_they_are_written() {
        for text in ["demo@1+log+0", "a.b-c@12+drive_2+1200", "demo@3+log+12.5"] {
            assert_eq!(text.parse::<SceneId>().unwrap().to_string(), text);
        }
        for text in [
            "",
            "demo",
            "demo@1",
            "demo@1+log",
            "demo@x+log+0",
            "de/mo@1+log+0",
            "demo@1+log+nan",
            "demo@-1+log+0",
            "demo@1+log+0+1",
        ] {
            assert!(text.parse::<SceneId>().is_err(), "{text}");
        }
    }

    #[test]
    fn starts_are_listed_up_to_the_end() {
        assert_eq!(listed_starts_m(0.0).collect::<Vec<_>>(), [0.0]);
        assert_eq!(listed_starts_m(250.0).collect::<Vec<_>>(), [0.0, 100.0, 200.0]);
    }

    #[test]
    fn poses_in_the_local_frame_are_exact_metres_from_the_world() {
        // f32 at 100 km has 8 mm; in the local frame 12.5 and -0.25 are exact.
        let frame = LocalFrame { origin_m: DVec3::new(100_000.0, -7.0, 3.0) };
        let world = Pose { position_m: DVec3::new(100_012.5, -7.25, 3.0), ..Pose::IDENTITY };
        let local = frame.local_from(&world);
        assert_eq!(local.vec, Some(common::Vec3 { x: 12.5, y: -0.25, z: 0.0 }));
        assert_eq!(frame.world_from("pose", Some(&local)).unwrap(), world);
        assert!(frame.world_from("pose", None).is_err());
    }
}
