//! An MCAP file with a channel for each topic and a schema for each kind of message.

use std::collections::BTreeMap;
use std::io::{Seek, Write};

use mcap::records::MessageHeader;
use mcap::{Compression, WriteOptions, Writer};
use prost::Message;
use serde::Serialize;

use super::ExportError;
use super::convert::nanoseconds;
use super::descriptors::descriptor_set;
use super::output::{Failure, Output};

/// Bytes of a chunk before compression: about a second of 30 actors at 10 Hz.
// 64 KiB / (10 x 30) = 218 bytes, about one box of an actor.
const CHUNK_BYTES: u64 = 64 << 10;

/// The topic of ROS 2 whose last message subscribers get that come later.
const LATCHED: &str = "/tf_static";

/// Where `rosbag2` keeps the quality of service of a topic.
const QOS_FIELD: &str = "offered_qos_profiles";

/// Reliable and transient local, as `rosbag2` writes it: what subscribers of `/tf_static` ask for.
const LATCHED_QOS: &str = "\
- history: 1
  depth: 1
  reliability: 1
  durability: 1
  deadline: {sec: 9223372036, nsec: 854775807}
  lifespan: {sec: 9223372036, nsec: 854775807}
  liveliness: 1
  liveliness_lease_duration: {sec: 9223372036, nsec: 854775807}
  avoid_ros_namespace_conventions: false
";

pub(super) struct McapFile<W: Write + Seek> {
    writer: Writer<Output<W>>,
    failure: Failure,
    /// Channel of each topic.
    channels: BTreeMap<String, u16>,
    /// Schema of each name.
    schemas: BTreeMap<&'static str, u16>,
    descriptors: Vec<u8>,
    messages: u64,
}

impl<W: Write + Seek> McapFile<W> {
    pub(super) fn create(out: W) -> Result<Self, ExportError> {
        Self::create_with(out, "")
    }

    /// A file of ROS 2: all of its messages are CDR.
    pub(super) fn create_ros2(out: W) -> Result<Self, ExportError> {
        Self::create_with(out, "ros2")
    }

    fn create_with(out: W, profile: &str) -> Result<Self, ExportError> {
        let options = WriteOptions::new()
            .profile(profile)
            .compression(Some(Compression::Zstd))
            .chunk_size(Some(CHUNK_BYTES))
            // No additional threads, because a record is small.
            .compression_threads(0)
            .library(concat!("wildcity ", env!("CARGO_PKG_VERSION")));
        let failure = Failure::default();
        let writer = options.create(Output::new(out, failure.clone()))?;
        let descriptors = descriptor_set();
        let channels = BTreeMap::new();
        let schemas = BTreeMap::new();
        Ok(Self { writer, failure, channels, schemas, descriptors, messages: 0 })
    }

    /// Writes a message of Foxglove's.
    pub(super) fn proto(
        &mut self,
        topic: &str,
        schema: &'static str,
        time_us: i64,
        message: &impl Message,
    ) -> Result<(), ExportError> {
        let channel = match self.channels.get(topic) {
            Some(&channel) => channel,
            None => {
                let descriptors = self.descriptors.clone();
                self.new_channel(topic, schema, ["protobuf", "protobuf"], &descriptors)?
            }
        };
        self.write(channel, time_us, &message.encode_to_vec())
    }

    /// Writes a message of this project.
    pub(super) fn json(
        &mut self,
        topic: &str,
        schema: &'static str,
        time_us: i64,
        message: &impl Serialize,
    ) -> Result<(), ExportError> {
        // The lines of the record are read by their keys. A schema of their fields would have to
        // follow every field that the record gets.
        let definition = br#"{"type":"object"}"#;
        let channel = match self.channels.get(topic) {
            Some(&channel) => channel,
            None => self.new_channel(topic, schema, ["jsonschema", "json"], definition)?,
        };
        self.write(channel, time_us, &serde_json::to_vec(message)?)
    }

    /// Writes a message of ROS 2's. `definition` is called for the first one of a topic.
    pub(super) fn cdr(
        &mut self,
        topic: &str,
        schema: &'static str,
        definition: fn(&str) -> String,
        time_us: i64,
        message: &[u8],
    ) -> Result<(), ExportError> {
        let channel = match self.channels.get(topic) {
            Some(&channel) => channel,
            None => {
                let definition = definition(schema);
                self.new_channel(topic, schema, ["ros2msg", "cdr"], definition.as_bytes())?
            }
        };
        self.write(channel, time_us, message)
    }

    /// Writes the index. Returns the number of messages.
    pub(super) fn finish(mut self) -> Result<u64, ExportError> {
        self.writer.finish()?;
        // `finish` succeeds even if the output failed, since `Output` reports only successes to
        // mcap.
        self.check()?;
        Ok(self.messages)
    }

    /// Ends the export after a failure of the output.
    fn check(&self) -> Result<(), ExportError> {
        self.failure.take().map_or(Ok(()), |cause| Err(ExportError::Output(cause)))
    }

    /// The channel of a topic, with its first message. `encodings` are those of the schema and of
    /// the messages.
    fn new_channel(
        &mut self,
        topic: &str,
        schema: &'static str,
        encodings: [&str; 2],
        definition: &[u8],
    ) -> Result<u16, ExportError> {
        let [schema_encoding, encoding] = encodings;
        let schema_id = match self.schemas.get(schema) {
            Some(&id) => id,
            None => {
                let id = self.writer.add_schema(schema, schema_encoding, definition)?;
                self.schemas.insert(schema, id);
                id
            }
        };
        let mut metadata = BTreeMap::new();
        if topic == LATCHED {
            metadata.insert(QOS_FIELD.to_owned(), LATCHED_QOS.to_owned());
        }
        let channel = self.writer.add_channel(schema_id, topic, encoding, &metadata)?;
        self.channels.insert(topic.to_owned(), channel);
        Ok(channel)
    }

    fn write(&mut self, channel_id: u16, time_us: i64, data: &[u8]) -> Result<(), ExportError> {
        let log_time = nanoseconds(time_us);
        // The number is only for information. It stays at its largest value, rather than begin
        // again at 0.
        let sequence = u32::try_from(self.messages).unwrap_or(u32::MAX);
        let header = MessageHeader { channel_id, sequence, log_time, publish_time: log_time };
        self.writer.write_to_known_channel(&header, data)?;
        self.messages += 1;
        self.check()
    }
}
