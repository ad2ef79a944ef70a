//! Decoding messages by the schema in the file.
//!
//! | message / schema encoding | what is read |
//! |---|---|
//! | `cdr` / `ros2msg` | ROS 2: CDR version 1, little or big endian |
//! | `ros1` / `ros1msg` | ROS 1 |
//! | `protobuf` / `protobuf` | Protocol Buffers, Foxglove's messages among them |
//! | `json` / `jsonschema` or none | JSON |
//!
//! A [`Decoder`] is made once for each channel. [`Decoder::decode`] gives a whole message as a tree;
//! [`Plan::extract`] takes a few fields of it without an allocation for each message.

mod extract;
mod path;
mod value;

use arrow::datatypes::DataType;

use super::container::{Channel, Message};
use crate::error::{DatasetError, Result};

pub use extract::{Extracted, Slot};
pub use path::FieldPath;
pub use value::Value;

/// Decodes the messages of a channel.
#[derive(Debug, Clone)]
pub struct Decoder {}

impl Decoder {
    /// Parses the channel's schema.
    ///
    /// # Errors
    /// [`DatasetError::Unsupported`] for an encoding that is not read: skip the channel, with a warning.
    /// [`DatasetError::Corrupt`] for a schema that cannot be understood.
    pub fn new(channel: &Channel) -> Result<Self> {
        Err(DatasetError::Unsupported {
            what: format!("messages of encoding \"{}\"", channel.message_encoding),
        })
    }

    /// The whole message as a tree, members in the order of the schema.
    ///
    /// # Errors
    /// [`DatasetError::Message`] if the bytes do not fit the schema.
    pub fn decode(&self, message: &Message<'_>) -> Result<Value> {
        Err(message.error("not supported yet"))
    }

    /// The fields, flattened, in the order of the schema. Empty for JSON without a schema.
    pub fn fields(&self) -> Vec<FieldDescription> {
        Vec::new()
    }

    /// Compiles the extraction of some fields: slot `i` of [`Extracted`] is `paths[i]`.
    ///
    /// # Errors
    /// [`DatasetError::MissingKey`] for a path that the schema does not have (for JSON that shows only in the
    /// messages: there the slot is absent), [`DatasetError::WrongType`] for one that ends at a struct.
    pub fn plan(&self, _paths: &[FieldPath]) -> Result<Plan> {
        Err(DatasetError::Unsupported {
            what: "MCAP".to_owned(),
        })
    }
}

/// A field that can be extracted.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FieldDescription {
    /// Where it is: the text of a [`FieldPath`]. Members of an array of structs are `array[].member`.
    pub path: String,
    /// What it holds.
    pub kind: FieldKind,
    /// How many it holds.
    pub length: FieldLength,
}

/// What a field holds.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum FieldKind {
    /// Numbers of this type; enums of Protobuf are `Int32`.
    Number(DataType),
    /// Flags; extracted as the numbers 0 and 1.
    Bool,
    /// Text.
    Text,
    /// A sequence of bytes (`uint8[]`, `bytes`): its length is that of the data. With an index, a number.
    Bytes,
    /// A point in time: `builtin_interfaces/Time`, `time` of ROS 1, `google.protobuf.Timestamp`, or
    /// a JSON object with `sec` and `nsec`. Its members can be reached too (`header.stamp.sec`).
    Time,
    /// A span of time.
    Duration,
    /// JSON whose schema does not say.
    Any,
}

/// How many values a field holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FieldLength {
    /// One.
    One,
    /// As many as this, always.
    Fixed(usize),
    /// Any number, or up to a bound.
    Variable {
        /// The bound, if the schema has one.
        max: Option<usize>,
    },
}

/// A compiled extraction of some fields of a message type.
#[derive(Debug, Clone)]
pub struct Plan {}

impl Plan {
    /// Takes the fields out of a message. What `out` held before is gone; its buffers are reused.
    ///
    /// # Errors
    /// [`DatasetError::Message`] if the bytes do not fit the schema as far as they had to be read, or a wanted
    /// integer cannot be represented as `f64`. `out` is then in no useful state.
    pub fn extract(&self, message: &Message<'_>, _out: &mut Extracted) -> Result<()> {
        Err(message.error("not supported yet"))
    }
}
