//! Reads what the writer wrote, and refuses what is wrong.

use std::fs;
use std::path::Path;

use glam::DVec3;
use wildcity_log::{
    GpsRow, Header, ImageRow, ImuRow, LidarMount, Log, LogError, LogWriter, Source, SweepPoints,
    SweepRow, TrackRow,
};
use wildcity_scene::geometry::Pose;
use wildcity_scene::trajectory::Keyframe;
use wildcity_scene::{ActorClass, Rig};

fn header() -> Header {
    let source = Source {
        kind: "test".into(),
        id: "1".into(),
        licence: "none".into(),
        converter: "test".into(),
    };
    let lidar = LidarMount { name: "top".into(), rig_from_lidar: Pose::IDENTITY };
    Header { lidars: vec![lidar], ..Header::new("street", source) }
}

fn image(time_us: i64, camera: &str) -> ImageRow {
    ImageRow {
        time_us,
        camera: camera.into(),
        file: format!("images/{camera}/{time_us}.jpg"),
        mask: None,
        ground_mask: None,
        sky_mask: None,
        exposure_stops: Some(-0.5),
        exposure_us: None,
        held_out: false,
    }
}

fn pose(time_us: i64) -> Keyframe {
    let world_from_rig = Pose { position_m: time_us as f64 * 1e-5 * DVec3::X, ..Pose::IDENTITY };
    Keyframe { time_us, world_from_rig }
}

fn points() -> SweepPoints {
    SweepPoints {
        points_m: vec![[1.0, 2.0, 3.0], [4.0, f32::NAN, 6.0]],
        time_us: vec![10, 10],
        intensity: Some(vec![0.5, 1.0]),
        ring: Some(vec![3, 65_535]),
    }
}

fn track(time_us: i64) -> TrackRow {
    TrackRow {
        time_us,
        track: "7".into(),
        class: ActorClass::Bicycle,
        size: [1.8, 0.6, 1.7],
        world_from_box: Pose::IDENTITY,
        velocity: Some([3.0, 0.0, 0.0]),
    }
}

/// A log with a row or two in each table.
fn write(out: &Path) {
    let rig = Rig::preset("vehicle6").unwrap();
    let mut log = LogWriter::create(out, &header(), &rig).unwrap();
    for time_us in [0, 100_000] {
        log.add(&pose(time_us)).unwrap();
        log.add(&image(time_us, "front")).unwrap();
        log.add(&image(time_us, "rear")).unwrap();
        log.add(&track(time_us)).unwrap();
    }
    let sweep = SweepRow {
        time_us: 0,
        until_us: 99_999,
        lidar: "top".into(),
        file: "lidar/0.safetensors".into(),
        compensated_to_us: None,
    };
    log.put(&sweep.file, &points().bytes(Path::new("sweep")).unwrap()).unwrap();
    log.add(&sweep).unwrap();
    let at_rest = ImuRow {
        time_us: 5,
        angular_velocity_rad_per_s: [0.0; 3],
        acceleration_m_per_s2: [0.0, 0.0, 9.81],
    };
    log.add(&at_rest).unwrap();
    let fix = GpsRow { time_us: 7, latitude_deg: 48.1, longitude_deg: 11.5, altitude_m: 500.0 };
    log.add(&fix).unwrap();
    log.finish().unwrap();
}

/// The text of the error of reading all of a changed log; empty if it is accepted.
fn refusal(file: &str, change: impl Fn(&str) -> String) -> String {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path().join("log");
    write(&at);
    let path = at.join(file);
    let text = fs::read_to_string(&path).unwrap();
    let changed = change(&text);
    assert_ne!(changed, text, "the change of {file} changes something");
    fs::write(&path, changed).unwrap();
    read_all(&at).map_or_else(|error| error.to_string(), |()| String::new())
}

fn read_all(at: &Path) -> Result<(), LogError> {
    let log = Log::open(at)?;
    log.poses()?;
    for row in log.images()?.unwrap() {
        log.camera_index(&row?.camera)?;
    }
    for row in log.sweeps()?.unwrap() {
        let row = row?;
        log.rig_from_lidar(&row.lidar)?;
        log.points(&row)?;
    }
    log.tracks()?.unwrap().try_for_each(|row| row.map(drop))?;
    log.imu()?.unwrap().try_for_each(|row| row.map(drop))?;
    log.gps()?.unwrap().try_for_each(|row| row.map(drop))
}

#[test]
fn a_log_is_read_as_it_was_written() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path().join("log");
    write(&at);
    assert!(Log::is_log(&at) && !Log::is_log(dir.path()));
    let log = Log::open(&at).unwrap();
    assert_eq!(log.header, header());
    assert_eq!(log.rig, Rig::preset("vehicle6").unwrap());
    let poses = log.poses().unwrap();
    assert_eq!(poses.keyframes(), [pose(0), pose(100_000)]);
    assert_eq!(poses.at(50_000).unwrap().position_m, DVec3::new(0.5, 0.0, 0.0));
    let images: Vec<ImageRow> = log.images().unwrap().unwrap().map(Result::unwrap).collect();
    let wanted = [0, 100_000].map(|time_us| [image(time_us, "front"), image(time_us, "rear")]);
    assert_eq!(images, wanted.as_flattened());
    let tracks: Vec<TrackRow> = log.tracks().unwrap().unwrap().map(Result::unwrap).collect();
    assert_eq!(tracks, [track(0), track(100_000)]);
    let sweep = log.sweeps().unwrap().unwrap().next().unwrap().unwrap();
    let read = log.points(&sweep).unwrap();
    assert!(read.points_m[1][1].is_nan());
    assert_eq!((read.points_m[0], read.len()), ([1.0, 2.0, 3.0], 2));
    assert_eq!((read.intensity, read.ring), (points().intensity, points().ring));
    assert_eq!(log.map().unwrap(), None);
    read_all(&at).unwrap();
}

#[test]
fn an_error_names_file_line_field_and_what_is_right() {
    for (file, from, to, expected) in [
        ("images.jsonl", "\"file\"", "\"path\"", "images.jsonl line 1: path: unknown field"),
        ("images.jsonl", "-0.5", "99", "line 1: exposure_stops: 99.0; give -16 to 16"),
        ("images.jsonl", "\"rear\"", "\"Rear\"", "line 2: camera: \"Rear\" is no name"),
        ("images.jsonl", "\"rear\"", "\"side\"", "rig.json: cameras: there is no \"side\""),
        ("poses.jsonl", "100000,", "0,", "poses.jsonl line 2: time_us: the table has two rows"),
        ("poses.jsonl", "100000,", "-9,", "line 2: time_us: -9 is before that of the row above, 0"),
        ("poses.jsonl", "[1.0,0.0,0.0,0.0]", "[9,0,0,0]", "world_from_rig: q has length 9.0"),
        ("lidar.jsonl", "99999", "-1", "until_us: -1 is before time_us, 0"),
        ("lidar.jsonl", "\"top\"", "\"left\"", "log.json: lidars: there is no \"left\""),
        ("tracks.jsonl", "1.8", "0", "tracks.jsonl line 1: size: 0.0; a side is more than 0"),
        ("tracks.jsonl", "bicycle", "plane", "tracks.jsonl line 1: class: unknown variant"),
        ("gps.jsonl", "48.1", "481", "latitude_deg: 481.0; give degrees from -90 to 90"),
        ("imu.jsonl", "[0.0,0.0,9.81]", "[0.0,9.81]", "acceleration_m_per_s2: invalid length 2"),
        ("log.json", "wildcity.log/1", "wildcity.log/2", "format: \"wildcity.log/2\" is not"),
        ("log.json", "\"licence\"", "\"license\"", "log.json: source.license: unknown field"),
        ("log.json", "\"street\"", "\"../street\"", "name: \"../street\" is no name"),
        ("rig.json", "\"rear\"", "\"front\"", "rig.json: \"front\" occurs twice"),
    ] {
        let said = refusal(file, |text| text.replace(from, to));
        assert!(said.contains(expected), "{file}: {from} as {to}: {said:?} lacks {expected:?}");
    }
    let said = refusal("poses.jsonl", |text| format!("{text}{{\"time_us\": 1"));
    assert!(said.contains("line 3: ") && said.contains("EOF"), "{said}");
    let long = refusal("poses.jsonl", |text| format!("{text}\"{}\"\n", "a".repeat(1 << 20)));
    assert!(long.contains("line 3: longer than 65536 bytes"), "{long}");
    let empty = refusal("poses.jsonl", |_| "\n".to_owned());
    assert!(empty.contains("poses.jsonl: it has no pose"), "{empty}");
}

#[test]
fn a_folder_lacks_what_is_needed() {
    let dir = tempfile::tempdir().unwrap();
    let said = Log::open(dir.path()).unwrap_err().to_string();
    assert!(said.contains("is no log: it has no log.json"), "{said}");
    for (file, expected) in [
        ("rig.json", "has no rig.json: images need the lenses"),
        ("poses.jsonl", "has no poses.jsonl: a log is placed"),
    ] {
        let at = dir.path().join(file);
        write(&at);
        fs::remove_file(at.join(file)).unwrap();
        let said = read_all(&at).unwrap_err().to_string();
        assert!(said.contains(expected), "{said}");
    }
    let at = dir.path().join("without");
    write(&at);
    fs::remove_file(at.join("tracks.jsonl")).unwrap();
    assert!(Log::open(&at).unwrap().tracks().unwrap().is_none());
}

#[test]
fn a_sweep_with_a_wrong_tensor_is_refused() {
    let said = |sweep: &SweepPoints, change: fn(&mut Vec<u8>)| {
        let path = Path::new("sweep.safetensors");
        let mut bytes = sweep.bytes(path).unwrap();
        change(&mut bytes);
        SweepPoints::parse(&bytes, path).map_or_else(|error| error.to_string(), |_| String::new())
    };
    let rename = |bytes: &mut Vec<u8>| {
        let at = bytes.windows(4).position(|word| word == b"ring").unwrap();
        bytes[at..at + 4].copy_from_slice(b"wing");
    };
    assert!(said(&points(), rename).contains("tensor \"wing\" is unknown; a sweep has points_m"));
    let late = SweepPoints { time_us: vec![11, 10], ..points() };
    assert!(said(&late, |_| ()).contains("sweep.safetensors: time_us: decreases"));
    assert!(said(&points(), |bytes| bytes.truncate(20)).contains("no safetensors file"));
    assert_eq!(said(&points(), |_| ()), "");
    let short = SweepPoints { time_us: vec![1], ..points() };
    let refused = short.bytes(Path::new("short.safetensors")).unwrap_err().to_string();
    assert!(refused.contains("short.safetensors: time_us: "), "{refused}");
    // The bytes of three F32 are those of six U16.
    let retyped = |bytes: &mut Vec<u8>| {
        let at = bytes.windows(3).position(|word| word == b"U16").unwrap();
        bytes[at..at + 3].copy_from_slice(b"I16");
    };
    assert!(said(&points(), retyped).contains("ring: is I16 [2]; U16 [2] is needed"));
}

#[test]
fn an_unfinished_log_leaves_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path().join("log");
    let rig = Rig::preset("vehicle6").unwrap();
    let mut log = LogWriter::create(&at, &header(), &rig).unwrap();
    log.add(&pose(5)).unwrap();
    let said = LogWriter::create(&at, &header(), &rig).unwrap_err().to_string();
    assert!(said.contains("log.partial exists"), "{said}");
    let said = log.add(&pose(4)).unwrap_err().to_string();
    assert!(said.contains("line 2: time_us: 4 is before"), "{said}");
    assert!(!at.exists(), "the folder has its name when it is complete");
    drop(log);
    assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 0);
    write(&at);
    let said = LogWriter::create(&at, &header(), &rig).unwrap_err().to_string();
    assert!(said.contains("log exists: give another folder"), "{said}");
}

#[test]
fn a_fifo_is_no_sweep() {
    let dir = tempfile::tempdir().unwrap();
    let at = dir.path().join("log");
    write(&at);
    let log = Log::open(&at).unwrap();
    let row = log.sweeps().unwrap().unwrap().next().unwrap().unwrap();
    let path = log.path(&row.file);
    fs::remove_file(&path).unwrap();
    assert!(std::process::Command::new("mkfifo").arg(&path).status().unwrap().success());
    // Nothing writes into it: a reader would wait for ever.
    let said = log.points(&row).unwrap_err().to_string();
    assert!(said.contains("it is not a file"), "{said}");
}
