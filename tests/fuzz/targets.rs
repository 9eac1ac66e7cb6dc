//! The fuzz targets: one function per parser of bytes from outside. Each ends in an answer or an
//! error, and never in a panic, a hang or an absurd allocation.
//!
//! `cargo fuzz run --fuzz-dir tests/fuzz scene` lets libFuzzer search (nightly); the test `fuzz` of
//! this package does the same with simple mutations, for a bounded time, on stable.

use std::fs;

use wildcity_client::Observation;
use wildcity_convert::{geojson, opendrive, openscenario as xosc};
use wildcity_log::check::{self, CheckSettings};
use wildcity_log::{Log, LogError, Poses, Row, Rows, SweepPoints, Tracks};
use wildcity_protocol::message::Request;
use wildcity_scene::{Rig, Trajectory};
use wildcity_server::Tokens;
use wildcity_session::RecordedEpisode;
use wildcity_sim::map::{Map, MapFile};
use wildcity_sim::scenario::{Document, TracksFile};
use wildcity_twin::ingest::{self, capture as captures};
use wildcity_twin::store::Catalog;

/// A target: its name, which is also that of its folder in the corpus, and its function.
type Target = (&'static str, fn(&[u8]));

/// All targets.
pub(crate) const TARGETS: [Target; 13] = [
    ("scene", scene),
    ("record", record),
    ("observation", observation),
    ("request", request),
    ("episode", episode),
    ("tokens", tokens),
    ("rig", rig),
    ("trajectory", trajectory),
    ("scenario", scenario),
    ("map", map),
    ("openscenario", openscenario),
    ("capture", capture),
    ("log", log),
];

/// A scene file of any format.
pub(crate) fn scene(data: &[u8]) {
    let dir = tempfile::tempdir().expect("a directory");
    let path = dir.path().join("scene");
    fs::write(&path, data).expect("written");
    if let Ok(gaussians) = ingest::read(&path, &mut |_, _| {}) {
        let colours = 3 * wildcity_scene::sh::coefficients(gaussians.sh_degree);
        assert_eq!(gaussians.sh.len(), gaussians.len() * colours);
    }
}

/// The newest log record of a twin.
pub(crate) fn record(data: &[u8]) {
    let dir = tempfile::tempdir().expect("a directory");
    let log = dir.path().join("city/log");
    fs::create_dir_all(&log).expect("created");
    fs::write(log.join("0000000001"), data).expect("written");
    let catalog = Catalog::open(dir.path()).expect("damage of one twin is no error");
    let list = catalog.twins().expect("damage of one twin is no error");
    assert_eq!(list.twins.len() + list.damaged.len(), 1);
    assert!(catalog.version("city", None).is_err(), "it has no manifest");
}

/// An observation, as a client receives it.
pub(crate) fn observation(data: &[u8]) {
    if let Ok(observation) = Observation::decode(data.to_vec()) {
        let _ = observation.verify();
    }
}

/// A request, as the server receives it.
pub(crate) fn request(data: &[u8]) {
    let Ok(mut value) = serde_json::from_slice::<serde_json::Value>(data) else { return };
    if let Some(fields) = value.as_object_mut() {
        fields.remove("seq");
    }
    let _ = serde_json::from_value::<Request>(value);
}

/// The file of an episode.
pub(crate) fn episode(data: &[u8]) {
    let file = tempfile::NamedTempFile::new().expect("a file");
    fs::write(file.path(), data).expect("written");
    let _ = RecordedEpisode::read(file.path());
}

/// A file of tokens.
pub(crate) fn tokens(data: &[u8]) {
    if let Err(error) = Tokens::parse(data) {
        assert!(!error.to_string().contains("secret"), "the message has a token");
    }
}

/// A file of cameras.
pub(crate) fn rig(data: &[u8]) {
    if let Ok(rig) = serde_json::from_slice::<Rig>(data) {
        let _ = rig.check();
    }
}

/// A file of a recorded drive.
pub(crate) fn trajectory(data: &[u8]) {
    if let Ok(trajectory) = serde_json::from_slice::<Trajectory>(data) {
        let _ = trajectory.check();
    }
}

/// A file of a scenario, or of recorded tracks.
pub(crate) fn scenario(data: &[u8]) {
    if let Ok(document) = Document::parse(data) {
        let _ = document.with(&document.first_values());
    }
    if let Ok(tracks) = TracksFile::parse(data) {
        let _ = tracks.check();
    }
}

/// A map, of any format.
pub(crate) fn map(data: &[u8]) {
    let of_opendrive = opendrive::read(data, None).ok().map(|imported| imported.map);
    let files = [MapFile::parse(data).ok(), geojson::read(data, None).ok(), of_opendrive];
    for file in files.into_iter().flatten() {
        Map::new(file).expect("a file that was read makes a map");
    }
}

/// A scenario of OpenSCENARIO.
pub(crate) fn openscenario(data: &[u8]) {
    let [name, twin, ego] = ["drive", "city", "Ego"].map(str::to_owned);
    let settings = xosc::Settings { name, twin, ego, ..xosc::Settings::default() };
    let _ = xosc::read(data, &settings);
}

/// The cameras of a capture: transforms.json, or cameras and images of COLMAP with a line of `===`
/// between them.
pub(crate) fn capture(data: &[u8]) {
    let dir = tempfile::tempdir().expect("a directory");
    let file = |name: &str| dir.path().join(name);
    fs::write(file("transforms.json"), data).expect("written");
    let _ = captures::read_nerfstudio(&file("transforms.json"));
    let Some(at) = data.windows(4).position(|part| part == b"===\n") else { return };
    // Binary files hide those of text, and come after them.
    for ending in ["txt", "bin"] {
        fs::write(file(&format!("cameras.{ending}")), &data[..at]).expect("written");
        fs::write(file(&format!("images.{ending}")), &data[at + 4..]).expect("written");
        let _ = captures::read_colmap(dir.path());
    }
}

/// The files of a log, with a line of `===` between them.
const LOG_FILES: [&str; 10] = [
    "log.json",
    "rig.json",
    "poses.jsonl",
    "images.jsonl",
    "lidar.jsonl",
    "tracks.jsonl",
    "imu.jsonl",
    "gps.jsonl",
    "a.safetensors",
    "a.png",
];

/// A log: its tables, and what is measured of them.
pub(crate) fn log(data: &[u8]) {
    let dir = tempfile::tempdir().expect("a directory");
    let mut rest = data;
    for name in LOG_FILES {
        let end = rest.windows(4).position(|part| part == b"===\n");
        let (file, after) = end.map_or((rest, &[][..]), |at| (&rest[..at], &rest[at + 4..]));
        fs::write(dir.path().join(name), file).expect("written");
        rest = after;
    }
    let _ = SweepPoints::parse(data, dir.path());
    let Ok(log) = Log::open(dir.path()) else { return };
    are_in_order(log.images());
    are_in_order(log.sweeps());
    are_in_order(log.tracks());
    are_in_order(log.imu());
    are_in_order(log.gps());
    let Ok(poses) = log.poses() else { return };
    let _ = log.placed_images(&poses).map(|images| images.for_each(drop));
    hide_points(&log, &poses);
    let settings = CheckSettings { images_per_camera: 2 };
    if let Ok(report) = check::check(&log, &settings, &mut |_, _| {}) {
        wildcity_log::page(&report).expect("a page of a report");
        serde_json::to_string(&report).expect("numbers of a report");
    }
}

fn are_in_order<R: Row>(rows: Result<Option<Rows<R>>, LogError>) {
    let Ok(Some(rows)) = rows else { return };
    let times_us: Vec<i64> = rows.map_while(Result::ok).map(|row| row.time_us()).collect();
    assert!(times_us.is_sorted());
}

/// Looks for points in the boxes of the tracks, at the times of the poses.
fn hide_points(log: &Log, poses: &Poses) {
    let Ok(tracks) = Tracks::read(log, [i64::MIN, i64::MAX]) else { return };
    let _ = tracks.recorded_actors().check();
    for keyframe in poses.keyframes() {
        let near = tracks.near(keyframe.time_us);
        near.hides(keyframe.world_from_rig.position_m, keyframe.time_us.saturating_add(1));
    }
}
