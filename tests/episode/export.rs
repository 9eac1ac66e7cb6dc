//! Export as MCAP: what a reader finds, and how large the file is.

use std::io::Cursor;

use prost::Message as _;
use serde_json::Value;
use wildcity_episode::{EpisodeFile, export};

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
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    assert!(summary.chunk_indexes.len() > 3, "{} chunks", summary.chunk_indexes.len());
    assert_eq!(summary.stats.unwrap().message_count, 201 * 3 + 200 + 2);
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
}

#[test]
fn an_episode_without_frames_is_refused() {
    let mut lines = Made::default().lines();
    lines.truncate(2);
    let error = export(&written::read(&lines), None, Cursor::new(Vec::new())).unwrap_err();
    assert!(error.to_string().contains("no frame"), "{error}");
}
