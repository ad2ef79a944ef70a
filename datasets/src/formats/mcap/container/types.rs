//! What the records of a recording say.

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::error::DatasetError;

/// A stream of messages of one type.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Channel {
    /// Number of the channel in the file.
    pub id: u16,
    /// Topic; several channels may have the same.
    pub topic: String,
    /// Encoding of the messages: `cdr`, `ros1`, `protobuf`, `json`, ...
    pub message_encoding: String,
    /// What the writer noted, such as ROS quality-of-service settings.
    pub metadata: BTreeMap<String, String>,
    /// Type of the messages; `None` if the channel has none (schema id 0).
    pub schema: Option<Arc<MessageSchema>>,
}

/// The type of messages, as the file describes it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MessageSchema {
    /// Number of the schema in the file; not 0.
    pub id: u16,
    /// Name of the type, such as `sensor_msgs/msg/JointState` or `foxglove.JointStates`.
    pub name: String,
    /// Encoding of `data`: `ros2msg`, `ros1msg`, `protobuf`, `jsonschema`, ...
    pub encoding: String,
    /// The description.
    pub data: Vec<u8>,
}

/// A message, borrowed from the reader.
#[derive(Debug, Clone, Copy)]
pub struct Message<'a> {
    /// Its channel.
    pub channel: &'a Arc<Channel>,
    /// Count by the publisher; need not be consecutive.
    pub sequence: u32,
    /// When it was recorded, in ns since the writer's epoch (mostly that of Unix).
    pub log_time: u64,
    /// When it was published, in ns; the log time if unknown.
    pub publish_time: u64,
    /// The payload.
    pub data: &'a [u8],
}

impl Message<'_> {
    /// What is wrong with this message, with its place.
    pub(crate) fn error(&self, what: impl Into<String>) -> DatasetError {
        DatasetError::Message {
            topic: self.channel.topic.clone(),
            log_time: self.log_time,
            what: what.into(),
        }
    }
}

/// A metadata record.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Metadata {
    /// Its name.
    pub name: String,
    /// Its entries.
    pub entries: BTreeMap<String, String>,
}

/// An attachment without its data.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AttachmentEntry {
    /// Its name: any text, not to be trusted as a path.
    pub name: String,
    /// Its media type.
    pub media_type: String,
    /// When it was recorded, in ns.
    pub log_time: u64,
    /// When it was made, in ns.
    pub create_time: u64,
    /// Bytes of its data.
    pub size: u64,
    /// Where its record starts in the file.
    pub(crate) offset: u64,
}

/// The counts a writer noted.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Statistics {
    /// Messages.
    pub message_count: u64,
    /// Schemas.
    pub schema_count: u16,
    /// Channels.
    pub channel_count: u32,
    /// Attachments.
    pub attachment_count: u32,
    /// Metadata records.
    pub metadata_count: u32,
    /// Chunks.
    pub chunk_count: u32,
    /// Earliest log time, in ns; 0 without messages.
    pub message_start_time: u64,
    /// Latest log time, in ns; 0 without messages.
    pub message_end_time: u64,
    /// Messages of each channel; may be empty.
    pub channel_message_counts: BTreeMap<u16, u64>,
}

/// An entry of the chunk index.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ChunkEntry {
    /// Where the chunk starts in the file.
    pub offset: u64,
    /// Bytes of its record.
    pub length: u64,
    /// Earliest log time in it, in ns.
    pub message_start_time: u64,
    /// Latest log time in it, in ns.
    pub message_end_time: u64,
    /// `zstd`, `lz4` or nothing.
    pub compression: String,
    /// Bytes of its records as they are in the file.
    pub compressed_size: u64,
    /// Bytes of its records.
    pub uncompressed_size: u64,
    /// Channels with messages in it; empty if the writer made no message index.
    pub channels: Vec<u16>,
}

/// What the end of a file says about the rest, for reading parts of it.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Summary {
    /// The counts, if noted.
    pub statistics: Option<Statistics>,
    /// Channels by id; may be empty though the file has some.
    pub channels: Vec<Arc<Channel>>,
    /// Schemas by id; may be empty though the file has some.
    pub schemas: Vec<Arc<MessageSchema>>,
    /// Chunks in file order; empty without an index.
    pub chunks: Vec<ChunkEntry>,
    /// Attachments as the index lists them.
    pub(crate) attachments: Vec<AttachmentEntry>,
    /// Name and offset of metadata records as the index lists them.
    pub(crate) metadata: Vec<(String, u64)>,
}
