//! Export as MCAP: what a reader finds, and how large the file is.

use std::io::{Cursor, Write as _};
use std::path::Path;
use std::time::{Duration, SystemTime};

use prost::Message as _;
use serde_json::{Value, json};
use wildcity_episode::{
    EpisodeExport, EpisodeFile, ExportError, ExportedImage, export, export_file, mcap_path,
    remove_leftovers, write_whole,
};

use crate::written::{self, Made};

fn exported(episode: &EpisodeFile) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    export(episode, None, &mut bytes).unwrap();
    bytes.into_inner()
}

#[test]
fn a_reader_finds_every_message_with_its_schema() {
    let bytes = exported(&Made { steps: 20, ..Made::default() }.read());
    let mut counts = std::collections::BTreeMap::new();
    let mut last_ns = 0;
    // The reader checks the CRC of each chunk.
    for message in mcap::MessageStream::new(&bytes).unwrap() {
        let message = message.unwrap();
        let schema = message.channel.schema.as_ref().unwrap();
        *counts.entry((message.channel.topic.clone(), schema.name.clone())).or_insert(0) += 1;
        last_ns = last_ns.max(message.log_time);
        if schema.encoding == "protobuf" {
            let set = prost_types::FileDescriptorSet::decode(&*schema.data).unwrap();
            let name = schema.name.strip_prefix("foxglove.").unwrap();
            let known = set.file.iter().flat_map(|file| &file.message_type);
            assert!(known.clone().any(|message| message.name() == name), "{name}");
        }
    }
    let count = |topic: &str, schema: &str| counts[&(topic.to_owned(), schema.to_owned())];
    assert_eq!(count("/tf", "foxglove.FrameTransforms"), 21);
    assert_eq!(count("/actors", "foxglove.SceneUpdate"), 21);
    assert_eq!(count("/route", "foxglove.PosesInFrame"), 1);
    assert_eq!(count("/ego/path", "foxglove.PosesInFrame"), 1);
    assert_eq!(count("/ego/odometry", "foxglove.Odometry"), 21);
    assert_eq!(count("/ego/pose", "foxglove.PoseInFrame"), 21);
    assert_eq!(count("/actors/poses", "foxglove.PosesInFrame"), 21);
    assert_eq!(count("/wildcity/step", "wildcity.Step"), 21);
    assert_eq!(count("/wildcity/episode", "wildcity.Episode"), 1);
    // 2 s after the begin, which is at 1,000 s.
    assert_eq!(last_ns, 1_002_000_000_000);
}

#[test]
fn the_file_is_indexed_and_small() {
    let episode = Made { steps: 200, actors: 30, plan_poses: 64, ..Made::default() }.read();
    let bytes = exported(&episode);
    assert!(bytes.len() < 1_000_000, "{} bytes", bytes.len());
    eprintln!("{} bytes as MCAP", bytes.len());
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    assert!(summary.chunk_indexes.len() > 3, "{} chunks", summary.chunk_indexes.len());
    assert_eq!(summary.stats.unwrap().message_count, 201 * 6 + 200 + 3);
    // A chunk that is damaged is noticed.
    let mut damaged = bytes;
    let at = summary.chunk_indexes[1].chunk_start_offset as usize + 200;
    damaged[at] ^= 0x40;
    let read = mcap::MessageStream::new(&damaged).unwrap();
    assert!(read.into_iter().any(|message| message.is_err()));
}

/// The poses of a plan are in one message, their times in the other.
#[test]
fn a_plan_is_exported_once() {
    let bytes = exported(&Made { steps: 3, plan_poses: 64, ..Made::default() }.read());
    let messages: Vec<_> =
        mcap::MessageStream::new(&bytes).unwrap().map(|message| message.unwrap()).collect();
    let of = |topic: &str| -> Vec<_> {
        messages.iter().filter(|message| message.channel.topic == topic).collect()
    };
    assert_eq!(of("/plan").len(), 3);
    let step: Value = serde_json::from_slice(&of("/wildcity/step")[2].data).unwrap();
    let trajectory = &step["command"]["trajectory"];
    assert_eq!(trajectory["poses"], "/plan");
    let times_us = trajectory["times_us"].as_array().unwrap();
    assert_eq!((times_us.len(), &times_us[63]), (64, &Value::from(6_400_000)));
    // It is in the rig of the begin of its step: the first one at the begin of the episode.
    let at_ns: Vec<u64> = of("/plan").iter().map(|message| message.log_time).collect();
    assert_eq!(at_ns, [1_000_000_000_000, 1_000_100_000_000, 1_000_200_000_000]);
}

#[test]
fn a_full_disk_is_an_error_and_no_panic() {
    for steps in [1, 400] {
        let episode = Made { steps, actors: 30, ..Made::default() }.read();
        let full = std::fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
        let error = export(&episode, None, std::io::BufWriter::new(full)).unwrap_err().to_string();
        assert!(error.contains("cannot write the MCAP file: No space left"), "{error}");
    }
    let dir = tempfile::tempdir().unwrap();
    let record = dir.path().join("made-1.jsonl");
    written::write(&record, &Made { steps: 2, ..Made::default() }.lines());
    let nowhere = dir.path().join("nowhere/made-1.mcap");
    let error = export_file(&record, &nowhere).unwrap_err().to_string();
    assert!(error.contains("nowhere/made-1.mcap"), "{error}");
    let exported = export_file(&record, &mcap_path(&record)).unwrap();
    let bytes = std::fs::read(dir.path().join("made-1.mcap")).unwrap();
    assert_eq!(mcap::MessageStream::new(&bytes).unwrap().count() as u64, exported.messages);
}

#[test]
fn an_episode_without_frames_is_refused() {
    let mut lines = Made::default().lines();
    lines.truncate(2);
    let error = export(&written::read(&lines), None, Cursor::new(Vec::new())).unwrap_err();
    assert!(error.to_string().contains("no frame"), "{error}");
}

/// As a reader without this package sees it.
#[derive(Clone, PartialEq, prost::Message)]
struct Xyz {
    #[prost(double, tag = "1")]
    x: f64,
    #[prost(double, tag = "2")]
    y: f64,
    #[prost(double, tag = "3")]
    z: f64,
}

#[derive(Clone, PartialEq, prost::Message)]
struct Odometry {
    #[prost(string, tag = "2")]
    frame_id: String,
    #[prost(string, tag = "3")]
    child_frame_id: String,
    #[prost(message, optional, tag = "5")]
    linear_velocity: Option<Xyz>,
    #[prost(message, optional, tag = "6")]
    angular_velocity: Option<Xyz>,
}

fn messages(bytes: &[u8], topic: &str) -> Vec<mcap::Message<'static>> {
    let all = mcap::MessageStream::new(bytes).unwrap().map(|message| message.unwrap());
    let of_topic = all.filter(|message| message.channel.topic == topic);
    let owned = of_topic.map(|message| mcap::Message {
        data: std::borrow::Cow::Owned(message.data.into_owned()),
        ..message
    });
    owned.collect()
}

#[test]
fn odometry_has_the_motion_of_the_ego() {
    let episode = Made { steps: 20, ..Made::default() }.read();
    let bytes = exported(&episode);
    let odometry = Odometry::decode(&*messages(&bytes, "/ego/odometry")[10].data).unwrap();
    assert_eq!((odometry.frame_id.as_str(), odometry.child_frame_id.as_str()), ("world", "rig"));
    let [velocity, turning] = [odometry.linear_velocity, odometry.angular_velocity];
    let [velocity, turning] = [velocity.unwrap(), turning.unwrap()];
    // 10 m/s along x, while the heading is 0.01 rad at 10 m and turns by 0.01 rad/s.
    assert!((velocity.x - 10.0 * 0.01_f64.cos()).abs() < 1e-9, "{velocity:?}");
    assert!((velocity.y + 10.0 * 0.01_f64.sin()).abs() < 1e-9, "{velocity:?}");
    assert!((turning.z - 0.01).abs() < 1e-9, "{turning:?}");

    let mut lines = Made { steps: 3, ..Made::default() }.lines();
    lines.remove(7);
    let bytes = exported(&written::read(&lines));
    let odometry = Odometry::decode(&*messages(&bytes, "/ego/odometry")[1].data).unwrap();
    assert_eq!(odometry.linear_velocity, None, "a record that skips a step says no speed");
}

#[test]
fn the_map_has_the_outline_of_each_lane() {
    #[derive(Clone, PartialEq, prost::Message)]
    struct Update {
        #[prost(message, repeated, tag = "2")]
        entities: Vec<Entity>,
    }
    #[derive(Clone, PartialEq, prost::Message)]
    struct Entity {
        #[prost(string, tag = "2")]
        frame_id: String,
        #[prost(message, repeated, tag = "11")]
        lines: Vec<Line>,
    }
    #[derive(Clone, PartialEq, prost::Message)]
    struct Line {
        #[prost(int32, tag = "1")]
        kind: i32,
        #[prost(message, repeated, tag = "5")]
        points: Vec<Xyz>,
    }
    let mut lines = Made { steps: 3, ..Made::default() }.lines();
    lines[1]["lanes"] = json!([
        { "outline": [[0, -2], [90, -2], [90, 2]], "route": true },
        { "outline": [[0, 2], [90, 2], [90, 6], [0, 6]] },
    ]);
    let bytes = exported(&written::read(&lines));
    let found = messages(&bytes, "/map");
    assert_eq!(found.len(), 1);
    let update = Update::decode(&*found[0].data).unwrap();
    let [entity] = &update.entities[..] else { panic!("{update:?}") };
    assert_eq!(entity.frame_id, "world");
    let points: Vec<usize> = entity.lines.iter().map(|line| line.points.len()).collect();
    assert_eq!((points, entity.lines[0].kind), (vec![3, 4], 1));
    // At the height of the route.
    assert_eq!(entity.lines[0].points[2], Xyz { x: 90.0, y: 2.0, z: 0.1 });
}

#[test]
fn images_are_between_the_steps_in_the_order_of_time() {
    let episode = Made { steps: 3, ..Made::default() }.read();
    let mut bytes = Cursor::new(Vec::new());
    let mut writing = EpisodeExport::begin(&episode, None, &mut bytes).unwrap();
    for time_us in [0, 100_000, 300_000] {
        let jpeg = [0xff, 0xd8, 0xff];
        writing.image(&ExportedImage { camera: 1, time_us, jpeg: &jpeg }).unwrap();
    }
    writing.finish().unwrap();
    let bytes = bytes.into_inner();
    let images = messages(&bytes, "/camera/1/image");
    assert_eq!(images.len(), 3);
    let schema = images[0].channel.schema.as_ref().unwrap();
    assert_eq!(schema.name, "foxglove.CompressedImage");
    let stream = mcap::MessageStream::new(&bytes).unwrap();
    let times: Vec<u64> = stream.map(|message| message.unwrap().log_time).collect();
    assert!(times.is_sorted(), "{times:?}");
}

/// All of them write at the same time: each closure waits for the others. One begins and ends while
/// another is under way: in one thread, so that a fault in their names fails and waits for nothing.
#[test]
fn exports_to_one_name_at_once_do_not_meet() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.mcap");
    // More than is buffered.
    let half = vec![b'a'; 25_000];
    let written = write_whole(&path, |out| {
        out.write_all(&half).map_err(ExportError::Output)?;
        write_whole(&path, |inner| {
            inner.write_all(&vec![b'b'; 40_000]).map_err(ExportError::Output)
        })?;
        assert_eq!(std::fs::read(&path).unwrap(), vec![b'b'; 40_000]);
        out.write_all(&half).map_err(ExportError::Output)
    });
    written.unwrap();
    assert_eq!(std::fs::read(&path).unwrap(), vec![b'a'; 50_000], "the last one, whole");
    let left = std::fs::read_dir(dir.path()).unwrap().count();
    assert_eq!(left, 1, "no temporary file");
}

#[cfg(unix)]
#[test]
fn an_export_has_the_rights_of_any_new_file() {
    use std::os::unix::fs::PermissionsExt as _;
    let dir = tempfile::tempdir().unwrap();
    let [by_hand, exported] = ["by-hand", "a.mcap"].map(|name| dir.path().join(name));
    std::fs::write(&by_hand, b"").unwrap();
    write_whole(&exported, |_| Ok(())).unwrap();
    let mode = |path: &Path| std::fs::metadata(path).unwrap().permissions().mode();
    assert_eq!(mode(&exported), mode(&by_hand));
}

#[test]
fn an_export_that_fails_leaves_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let fails = |out: &mut std::io::BufWriter<&mut std::fs::File>| {
        out.write_all(b"half").map_err(ExportError::Output)?;
        Err::<(), _>(ExportError::Empty)
    };
    assert!(write_whole(&dir.path().join("a.mcap"), fails).is_err());
    std::fs::create_dir(dir.path().join("taken.mcap")).unwrap();
    let error = write_whole(&dir.path().join("taken.mcap"), |_| Ok(())).unwrap_err().to_string();
    assert!(error.contains("cannot write") && error.contains("taken.mcap"), "{error}");
    let nowhere = write_whole(&dir.path().join("none/a.mcap"), |_| Ok(())).unwrap_err();
    assert!(nowhere.to_string().contains("none/a.mcap"), "{nowhere}");
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1);
}

#[test]
fn only_old_temporary_files_of_exports_are_leftovers() {
    let dir = tempfile::tempdir().unwrap();
    let now = SystemTime::now();
    let [old, new] = [3700, 3500].map(|age_s| now - Duration::from_secs(age_s));
    let files = [
        ("a-1.mcap.Xy12Zw.tmp", old, false),
        ("a-1.mcap.tmp", old, false),
        ("b-1.mcap.Xy12Zw.tmp", new, true),
        ("a-1.mcap", old, true),
        ("a-1.jsonl", old, true),
        ("a-1.jsonl.Xy12Zw.tmp", old, true),
        ("mcap.tmp", old, true),
    ];
    for (name, modified, _) in files {
        let file = std::fs::File::create(dir.path().join(name)).unwrap();
        file.set_modified(modified).unwrap();
    }
    assert_eq!(remove_leftovers(dir.path(), now).unwrap(), 2);
    for (name, _, stays) in files {
        assert_eq!(dir.path().join(name).exists(), stays, "{name}");
    }
    assert_eq!(remove_leftovers(&dir.path().join("none"), now).unwrap(), 0);
}
