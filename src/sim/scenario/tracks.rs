//! The file `wildcity.tracks/1`: recorded actors.

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};

use wildcity_scene::{ActorBox, ActorClass};

use super::error::{FileError, check_format, json, named, typed};
use super::pose::PoseSection;
use super::pose::pose_from;
use crate::limits;
use crate::traffic::{Track, TrackKeyframe};

/// Recorded actors.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct TracksFile {
    /// `wildcity.tracks/1`.
    pub format: String,
    /// The actors.
    pub tracks: Vec<TrackSection>,
}

/// One recorded actor.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct TrackSection {
    /// Id within the file, `[a-z0-9._-]+`.
    pub id: String,
    /// Its kind.
    #[cfg_attr(feature = "schema", schemars(with = "super::actor_file::ClassSchema"))]
    pub class: ActorClass,
    /// Length, width and height, in metres.
    pub size: [f64; 3],
    /// The name of its asset, or its BLAKE3, 64 lower-case hex digits; `none` if it is not drawn.
    /// If absent, the generated asset of its class whose size is the nearest.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub asset: Option<String>,
    /// Its poses, by rising time. It is absent before the first and after the last.
    pub keyframes: Vec<KeyframeSection>,
}

/// A pose at a time.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct KeyframeSection {
    /// Time on the clock of the recorded drive, in microseconds.
    pub time_us: i64,
    /// Pose of the actor's box in the world: its origin is on the ground under the middle.
    pub pose: PoseSection,
}

impl TracksFile {
    /// The format that this build reads and writes.
    pub const FORMAT: &str = "wildcity.tracks/1";

    /// Reads and checks a tracks file.
    ///
    /// # Errors
    /// Names the place of the first mistake.
    pub fn parse(bytes: &[u8]) -> Result<Self, FileError> {
        let value = json(bytes, "tracks", limits::MAP_BYTES)?;
        let file: Self = typed(value, "tracks")?;
        file.check()?;
        Ok(file)
    }

    /// Checks ids, sizes, poses and times.
    ///
    /// # Errors
    /// Names the place of the first mistake.
    pub fn check(&self) -> Result<(), FileError> {
        check_format(Some(&self.format), Self::FORMAT)?;
        // Before any track is built, so that the count bounds the memory of the check.
        let keyframes: usize = self.tracks.iter().map(|track| track.keyframes.len()).sum();
        if keyframes > limits::TRACK_KEYFRAMES {
            let message =
                format!("{keyframes} keyframes; at most {} are accepted", limits::TRACK_KEYFRAMES);
            return Err(FileError::new("tracks", message));
        }
        let mut ids = BTreeSet::new();
        for (index, track) in self.tracks.iter().enumerate() {
            let within = |error: FileError| error.within(&format!("tracks[{index}]"));
            named("id", &track.id).map_err(within)?;
            if !ids.insert(&track.id) {
                let message = format!("{:?} is there twice; give each track its own id", track.id);
                return Err(within(FileError::new("id", message)));
            }
            // Hashes and `none` have the form of a name, too.
            if let Some(asset) = &track.asset {
                named("asset", asset).map_err(within)?;
            }
            box_from("size", track.size).map_err(within)?;
            // For its checks only: when the episode starts is not known yet.
            track.shifted(0).map_err(within)?;
        }
        Ok(())
    }
}

impl TrackSection {
    /// The track with `start_us` as time 0.
    ///
    /// # Errors
    /// Names the first keyframe that is no pose or out of order.
    pub fn shifted(&self, start_us: i64) -> Result<Track, FileError> {
        let mut keyframes = Vec::with_capacity(self.keyframes.len());
        for (index, keyframe) in self.keyframes.iter().enumerate() {
            let path = format!("keyframes[{index}]");
            // Both times are any 64-bit numbers of a file.
            let Some(time_us) = keyframe.time_us.checked_sub(start_us) else {
                let message = format!("{}; too far from the episode's start", keyframe.time_us);
                return Err(FileError::new(format!("{path}.time_us"), message));
            };
            let pose = pose_from(&format!("{path}.pose"), &keyframe.pose)?;
            keyframes.push(TrackKeyframe { time_us, world_from_actor: pose });
        }
        Track::new(keyframes).map_err(|error| FileError::new("keyframes", error.to_string()))
    }
}

/// A box of length, width and height.
pub(super) fn box_from(
    path: &str,
    [length_m, width_m, height_m]: [f64; 3],
) -> Result<ActorBox, FileError> {
    let box_ = ActorBox { length_m, width_m, height_m };
    box_.check().map_err(|error| FileError::new(path, error.to_string()))?;
    Ok(box_)
}
