//! The files of a scene that AlpaSim's runtime reads itself: rig, cameras, tracks and map.
//!
//! The runtime reads them from a zip archive named `.usdz`. Poses are in the scene's local frame,
//! so that `world_to_nre` is the identity. There is no mesh: the runtime's physics is disabled, or
//! the physics of this package.

use std::collections::BTreeMap;
use std::fmt::Write as _;

use glam::{DMat4, DVec2, DVec3};
use serde_json::{Value, json};

use wildcity_scene::actor::PlacedChunk;
use wildcity_scene::geometry::Pose;
use wildcity_scene::geometry::camera::Shutter;
use wildcity_scene::rig::RigCamera;
use wildcity_scene::route::{Route, RouteError};
use wildcity_scene::{ActorBox, ActorClass, Manifest};
use wildcity_sim::scenario::{FileError, TrackSection, TracksFile};

use crate::camera::logical_id;
use crate::limits;
use crate::object::{centre_of_actor, id_of_asset, id_of_box};
use crate::scene::{LocalFrame, SceneError, SceneId};

/// Name of the one sequence of a scene.
const SEQUENCE: &str = "drive";

/// Time between two poses, in microseconds.
const PERIOD_US: i64 = 100_000;

/// The pose at which the first frame of each camera ends, where AlpaSim's runtime begins. The step
/// before it and the exposure, with the shutter of the runtime's own configuration, must not begin
/// before the first pose: a period for the step, and one for the longest shutter.
const FIRST_FRAME: usize = 2;
const _: () = assert!(Shutter::MAX_US <= PERIOD_US);

/// Fewest poses of a scene: those up to the end of the runtime's first step.
const LEAST_POSES: usize = FIRST_FRAME + 2;

/// Width of a lane, in metres.
const LANE_M: f64 = 3.5;

/// Distance between two points of the map's road, in metres.
const ROAD_STEP_M: f64 = 2.0;

/// Length of the road after the end of the scene, in metres, because a driver plans beyond the end.
const BEYOND_M: f64 = 120.0;

/// Length, width and height of the ego's box, and the box's centre in the rig frame, in metres: a
/// car with the wheelbase of the simulated one, 2.85 m.
const BOX_M: [f64; 3] = [4.85, 1.9, 1.6];
const BOX_CENTRE_M: [f64; 3] = [1.4, 0.0, 0.8];

/// Why a scene was not exported.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    /// There is no such scene.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// The drive is damaged.
    #[error(transparent)]
    Route(#[from] RouteError),
    /// A recorded actor is damaged.
    #[error(transparent)]
    Tracks(#[from] FileError),
    /// The drive ends before the first step of the runtime.
    #[error(
        "{scene} has {poses} poses, one each {PERIOD_US} us, and AlpaSim needs {LEAST_POSES}: choose an earlier \
         start, or longer scenes"
    )]
    Short { scene: String, poses: usize },
    /// More recorded actors are present at the same time than an image may show.
    #[error(
        "{scene} has {count} recorded actors at {since_us} us; an image shows at most {most}: leave some out of the \
         tracks, or choose other starts",
        most = PlacedChunk::MAX_ACTORS
    )]
    Crowded {
        scene: String,
        /// The first such time, in microseconds since the scene's start.
        since_us: i64,
        /// The actors at this time.
        count: usize,
    },
}

/// Parts of a scene in addition to its twin.
#[derive(Clone, Copy, Debug)]
pub struct SceneContent<'a> {
    /// The cameras that it offers.
    pub cameras: &'a [RigCamera],
    /// Its recorded traffic. A track with an asset has the size of the asset.
    pub tracks: Option<&'a TracksFile>,
    pub length_s: f64,
}

/// The files of a scene, by name. `hash` is that of the version's manifest.
///
/// # Errors
/// The manifest has no such scene, or it is too short, or a track is damaged, or too many actors
/// are present at once.
pub fn files(
    id: &SceneId,
    manifest: &Manifest,
    hash: &str,
    content: SceneContent<'_>,
) -> Result<Vec<(&'static str, String)>, ExportError> {
    let SceneContent { cameras, tracks, length_s } = content;
    let drive = id.drive(manifest)?;
    let frame = id.local_frame(manifest)?;
    let route = Route::new(drive)?;
    let start_us = route.at(id.start_m).time_us;
    let last_us = drive.keyframes.last().map_or(start_us, |last| last.time_us);
    // A drive may end before the scene's length. The cast saturates, as does the sum.
    let end_us = last_us.min(start_us.saturating_add((length_s * 1e6) as i64));
    let mut poses = Vec::new();
    let mut time_us = start_us;
    // At 10 Hz, 20 s have 201 poses, the first one at 0.
    while time_us <= end_us {
        let world = route.pose_at(time_us)?;
        let local = Pose { position_m: world.position_m - frame.origin_m, ..world };
        poses.push((time_us - start_us, local));
        time_us += PERIOD_US;
    }
    if poses.len() < LEAST_POSES {
        return Err(ExportError::Short { scene: id.to_string(), poses: poses.len() });
    }
    let times_us: Vec<i64> = poses.iter().map(|(since_us, _)| *since_us).collect();
    let sections = tracks.map_or(&[][..], |file| &file.tracks);
    // Tracks are sampled at the times of the ego, so that each time has a pose of all that are
    // present.
    let mut tracks = Vec::new();
    for section in sections {
        tracks.extend(track(section, start_us, &times_us, frame)?);
    }
    if let Some((since_us, count)) = crowded(&tracks) {
        return Err(ExportError::Crowded { scene: id.to_string(), since_us, count });
    }
    Ok(vec![
        ("metadata.yaml", pretty(&metadata(id, hash, cameras, &poses))),
        ("rig_trajectories.json", pretty(&rig_trajectories(cameras, &poses))),
        ("sequence_tracks.json", pretty(&sequence_tracks(&tracks))),
        ("map.xodr", road(&poses)),
    ])
}

/// The configuration of AlpaSim's wizard for the scenes of a folder, which is absolute, with the
/// server at `address`: a file of its group `deploy`.
///
/// The server is an external renderer and physics, so that the wizard starts neither. The rig of
/// AlpaSim's own hoods is unset, because the overlays are those of the twin.
pub fn deploy(scenes: &str, address: &str) -> String {
    let addresses = json!([address]);
    // Not as JSON: the wizard computes its value.
    let filesystem = "defines: {filesystem: \"${repo-relative:'data'}\"}";
    let wizard = json!({
        "run_sim_services": ["driver", "trafficsim", "controller", "runtime"],
        "external_services": { "renderer": addresses, "physics": addresses },
        "debug_flags": { "use_localhost": true },
    });
    let scenes = json!({ "scene_ids": null, "local_usdz_dir": scenes });
    let runtime = json!({ "simulation_config": { "ego_mask_rig_config_id": null } });
    format!(
        "# @package _global_\n{filesystem}\nwizard: {wizard}\nscenes: {scenes}\nruntime: {runtime}\n"
    )
}

/// JSON, which is YAML as well.
fn pretty(value: &Value) -> String {
    // Numbers, texts and lists always have JSON.
    serde_json::to_string_pretty(value).unwrap_or_default() + "\n"
}

fn metadata(id: &SceneId, hash: &str, cameras: &[RigCamera], poses: &[(i64, Pose)]) -> Value {
    // 1.7e15 us are below 2^53, so that f64 holds them exactly.
    let seconds = |since_us: i64| 1e-6 * (limits::EPOCH_US as i64 + since_us) as f64;
    let last_us = poses.last().map_or(0, |(since_us, _)| *since_us);
    let camera_ids: Vec<String> = cameras.iter().map(|camera| logical_id(&camera.name)).collect();
    json!({
        "scene_id": id.to_string(),
        "version_string": format!("wildcity {}", env!("CARGO_PKG_VERSION")),
        // A constant, so that the same version gives the same file.
        "training_date": "1970-01-01",
        "dataset_hash": hash,
        "uuid": id.to_string(),
        "is_resumable": false,
        "sensors": { "camera_ids": camera_ids, "lidar_ids": [] },
        "logger": {},
        "time_range": { "start": seconds(0), "end": seconds(last_us) },
    })
}

/// How long an exposure lasts, in microseconds. The runtime requires an end after the start, even
/// for global shutters.
fn open_us(camera: &RigCamera) -> i64 {
    camera.shutter.map_or(1, |shutter| shutter.duration_us)
}

fn rig_trajectories(cameras: &[RigCamera], poses: &[(i64, Pose)]) -> Value {
    // All poses are in the local frame already.
    let identity = rows(&Pose::IDENTITY);
    let times: Vec<i64> =
        poses.iter().map(|(since_us, _)| limits::EPOCH_US as i64 + since_us).collect();
    // The runtime joins calibrations and frames by this id.
    let unique_id = |camera: &RigCamera| format!("{}@{SEQUENCE}", logical_id(&camera.name));
    let calibrations: serde_json::Map<_, _> = cameras
        .iter()
        .map(|camera| {
            let name = json!({ "logical_sensor_name": logical_id(&camera.name) });
            (unique_id(camera), name)
        })
        .collect();
    let frames: serde_json::Map<_, _> = cameras
        .iter()
        .map(|camera| {
            let ends = times.iter().skip(FIRST_FRAME);
            let ranges: Vec<[i64; 2]> = ends.map(|&end| [end - open_us(camera), end]).collect();
            (unique_id(camera), json!(ranges))
        })
        .collect();
    json!({
        "T_world_base": identity,
        "world_to_nre": { "matrix": identity },
        "camera_calibrations": calibrations,
        "rig_trajectories": [{
            "sequence_id": SEQUENCE,
            "T_rig_world_timestamps_us": times,
            "T_rig_worlds": poses.iter().map(|(_, pose)| rows(pose)).collect::<Vec<_>>(),
            "cameras_frame_timestamps_us": frames,
            "rig_bbox": { "centroid": BOX_CENTRE_M, "dim": BOX_M, "rot": [0.0, 0.0, 0.0] },
        }],
    })
}

/// A recorded actor within a scene.
struct SceneTrack {
    id: String,
    label: &'static str,
    size_m: [f64; 3],
    /// Times in microseconds since 1970, and poses of the middle of its box: x, y, z and a
    /// quaternion x, y, z, w.
    poses: Vec<(i64, [f64; 7])>,
}

/// The part of a recorded actor's track that a scene shows, at the scene's times since `start_us`;
/// `None` if it is present at fewer than two of them.
fn track(
    section: &TrackSection,
    start_us: i64,
    times_us: &[i64],
    frame: LocalFrame,
) -> Result<Option<SceneTrack>, FileError> {
    let [length_m, width_m, height_m] = section.size;
    let size = ActorBox { length_m, width_m, height_m };
    let track = section.shifted(start_us)?;
    let pose = |time_us: i64| {
        let centre = centre_of_actor(&track.at(time_us)?.world_from_actor, &size);
        let [x, y, z] = (centre.position_m - frame.origin_m).to_array();
        // The file has the scalar last.
        let [qw, qx, qy, qz] = centre.q_wxyz();
        Some((limits::EPOCH_US as i64 + time_us, [x, y, z, qx, qy, qz, qw]))
    };
    let poses: Vec<_> = times_us.iter().filter_map(|&time_us| pose(time_us)).collect();
    let id = match &section.asset {
        Some(hash) => id_of_asset(&section.id, hash),
        None => id_of_box(&section.id, &size),
    };
    // The names of the classes of AlpaSim's tracks.
    let label = match section.class {
        ActorClass::Vehicle => "automobile",
        ActorClass::Pedestrian => "person",
        ActorClass::Bicycle => "bicycle",
        ActorClass::Object => "other",
    };
    // A spline needs at least two poses.
    let is_shown = poses.len() >= 2;
    Ok(is_shown.then_some(SceneTrack { id, label, size_m: section.size, poses }))
}

/// The first time, in microseconds since the scene's start, at which more actors are present than
/// an image may show, and their number.
fn crowded(tracks: &[SceneTrack]) -> Option<(i64, usize)> {
    let mut counts: BTreeMap<i64, usize> = BTreeMap::new();
    for (time_us, _) in tracks.iter().flat_map(|track| &track.poses) {
        // Sorted by time, so that the first hit below is the earliest.
        *counts.entry(time_us - limits::EPOCH_US as i64).or_default() += 1;
    }
    counts.into_iter().find(|&(_, count)| count > PlacedChunk::MAX_ACTORS)
}

/// One sequence with the tracks of a scene.
fn sequence_tracks(tracks: &[SceneTrack]) -> Value {
    let listed = |of: &dyn Fn(&SceneTrack) -> Value| tracks.iter().map(of).collect::<Vec<_>>();
    let times = |track: &SceneTrack| -> Vec<i64> { track.poses.iter().map(|at| at.0).collect() };
    let poses =
        |track: &SceneTrack| -> Vec<[f64; 7]> { track.poses.iter().map(|at| at.1).collect() };
    json!({ SEQUENCE: {
        "tracks_data": {
            "tracks_id": listed(&|track| json!(track.id)),
            "tracks_label_class": listed(&|track| json!(track.label)),
            // The runtime may replace its recorded motion.
            "tracks_flags": listed(&|_| json!("CONTROLLABLE")),
            "tracks_timestamps_us": listed(&|track| json!(times(track))),
            "tracks_poses": listed(&|track| json!(poses(track))),
        },
        "cuboidtracks_data": { "cuboids_dims": listed(&|track| json!(track.size_m)) },
    } })
}

/// A transform as a 4x4 matrix, row by row.
fn rows(pose: &Pose) -> [[f64; 4]; 4] {
    // glam's arrays are columns; the columns of the transposed matrix are the rows.
    DMat4::from_rotation_translation(pose.rotation, pose.position_m).transpose().to_cols_array_2d()
}

/// One OpenDRIVE road along the poses: straight lines with an elevation, the ego's lane and an
/// adjacent one. It has no `geoReference`, so that its coordinates are those of the local frame.
fn road(poses: &[(i64, Pose)]) -> String {
    // Points at least 2 m apart in the plane: a car at rest would give lines of length 0, which
    // have no heading.
    let mut points: Vec<DVec3> = Vec::new();
    for (_, pose) in poses {
        let far =
            |last: &DVec3| last.truncate().distance(pose.position_m.truncate()) >= ROAD_STEP_M;
        if points.last().is_none_or(far) {
            points.push(pose.position_m);
        }
    }
    let last = poses.last().map_or(Pose::IDENTITY, |(_, pose)| *pose);
    // The added piece is level and straight in the direction of the last pose.
    let ahead = (last.rotation * DVec3::X).with_z(0.0).normalize_or(DVec3::X);
    let from = points.last().copied().unwrap_or(last.position_m);
    points.push(from + BEYOND_M * ahead);

    let mut lines = String::new();
    let mut elevations = String::new();
    let mut s_m = 0.0;
    // Each line begins where the one before ends: `s_m` is the sum of their lengths in the plane.
    // No length is 0, so the slope is finite.
    for pair in points.windows(2) {
        let along: DVec2 = (pair[1] - pair[0]).truncate();
        let length_m = along.length();
        let heading = along.y.atan2(along.x);
        let [x, y, z] = pair[0].to_array();
        // The elevation of a piece is a + b ds, with the slope as b.
        let slope = (pair[1].z - z) / length_m;
        // Writing to a text cannot fail.
        let _ = writeln!(
            lines,
            "      <geometry s=\"{s_m}\" x=\"{x}\" y=\"{y}\" hdg=\"{heading}\" length=\"{length_m}\"><line/></geometry>"
        );
        let _ = writeln!(
            elevations,
            "      <elevation s=\"{s_m}\" a=\"{z}\" b=\"{slope}\" c=\"0\" d=\"0\"/>"
        );
        s_m += length_m;
    }
    let lane = |id: i32| {
        format!(
            "<lane id=\"{id}\" type=\"driving\" level=\"false\"><width sOffset=\"0\" a=\"{LANE_M}\" b=\"0\" c=\"0\" d=\"0\"/></lane>"
        )
    };
    // The reference line is shifted by half a lane, so that the drive runs in the middle of lane
    // -1.
    format!(
        r#"<?xml version="1.0" encoding="UTF-8"?>
<OpenDRIVE>
  <header revMajor="1" revMinor="6" name="wildcity"/>
  <road name="drive" length="{s_m}" id="1" junction="-1">
    <type s="0" type="town"/>
    <planView>
{lines}    </planView>
    <elevationProfile>
{elevations}    </elevationProfile>
    <lanes>
      <laneOffset s="0" a="{half}" b="0" c="0" d="0"/>
      <laneSection s="0">
        <left>{left}</left>
        <center><lane id="0" type="none" level="false"/></center>
        <right>{right}</right>
      </laneSection>
    </lanes>
  </road>
</OpenDRIVE>
"#,
        half = LANE_M / 2.0,
        left = lane(1),
        right = lane(-1),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn more_actors_at_once_than_an_image_shows_are_refused() {
        let at = |since_us: i64| (limits::EPOCH_US as i64 + since_us, [0.0; 7]);
        let track = |times_us: [i64; 2]| SceneTrack {
            id: String::new(),
            label: "other",
            size_m: [1.0; 3],
            poses: times_us.map(at).to_vec(),
        };
        let most = PlacedChunk::MAX_ACTORS;
        // As many actors as an image may show at the times 0 and 1 period; one more is refused at
        // the second time only.
        let mut tracks: Vec<SceneTrack> = (0..most).map(|_| track([0, PERIOD_US])).collect();
        // Not at the same time.
        tracks.push(track([2 * PERIOD_US, 3 * PERIOD_US]));
        assert_eq!(crowded(&tracks), None);
        tracks.push(track([PERIOD_US, 2 * PERIOD_US]));
        assert_eq!(crowded(&tracks), Some((PERIOD_US, most + 1)));
    }
}
