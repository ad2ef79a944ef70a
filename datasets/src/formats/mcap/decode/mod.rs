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
mod fault;
mod json;
mod path;
mod protobuf;
mod ros;
mod value;

use std::sync::Arc;

use arrow::datatypes::DataType;

use super::container::{Channel, Message, MessageSchema};
use crate::error::{DatasetError, Result};

pub use extract::{Extracted, Slot};
pub use path::FieldPath;
pub(crate) use path::PathStep;
pub use value::Value;

/// More fields than this are not listed.
const MAX_LISTED: usize = 10_000;

/// Decodes the messages of a channel.
#[derive(Debug, Clone)]
pub struct Decoder(Kind);

#[derive(Debug, Clone)]
enum Kind {
    Ros(Arc<ros::Types>),
    Protobuf(protobuf::MessageType),
    Json(json::JsonType),
}

impl Decoder {
    /// Parses the channel's schema.
    ///
    /// # Errors
    /// [`DatasetError::Unsupported`] for an encoding that is not read: skip the channel, with a warning.
    /// [`DatasetError::Corrupt`] for a schema that cannot be understood.
    pub fn new(channel: &Channel) -> Result<Self> {
        let schema = channel.schema.as_deref();
        let encodings = (
            channel.message_encoding.as_str(),
            schema.map_or("", |schema| schema.encoding.as_str()),
        );
        let ros = |schema: &MessageSchema, flavor| {
            let types = ros::parse(&schema.name, &schema.data, flavor)?;
            Ok(Self(Kind::Ros(Arc::new(types))))
        };
        match (encodings, schema) {
            (("cdr", "ros2msg"), Some(schema)) => ros(schema, ros::Flavor::Ros2),
            (("ros1", "ros1msg"), Some(schema)) => ros(schema, ros::Flavor::Ros1),
            (("protobuf", "protobuf"), Some(schema)) => {
                let message = protobuf::MessageType::new(&schema.name, &schema.data)?;
                Ok(Self(Kind::Protobuf(message)))
            }
            (("json", "jsonschema" | ""), schema) => {
                let data = schema.map_or(&[][..], |schema| &schema.data);
                Ok(Self(Kind::Json(json::JsonType::new(data))))
            }
            ((message, encoding), _) => Err(DatasetError::Unsupported {
                what: match encoding {
                    "" => format!("\"{message}\" messages without a schema"),
                    _ => format!("\"{message}\" messages with a schema in \"{encoding}\""),
                },
            }),
        }
    }

    /// The whole message as a tree, members in the order of the schema.
    ///
    /// # Errors
    /// [`DatasetError::Message`] if the bytes do not fit the schema.
    pub fn decode(&self, message: &Message<'_>) -> Result<Value> {
        let decoded = match &self.0 {
            Kind::Ros(types) => ros::decode(types, message.data),
            Kind::Protobuf(of) => of.decode(message.data),
            Kind::Json(_) => json::decode(message.data),
        };
        decoded.map_err(|fault| message.error(fault.into_text()))
    }

    /// The fields, flattened, in the order of the schema. Empty for JSON without a schema.
    pub fn fields(&self) -> Vec<FieldDescription> {
        match &self.0 {
            Kind::Ros(types) => types.describe(),
            Kind::Protobuf(of) => of.describe(),
            Kind::Json(of) => of.describe(),
        }
    }

    /// Compiles the extraction of some fields: slot `i` of [`Extracted`] is `paths[i]`.
    ///
    /// # Errors
    /// [`DatasetError::MissingKey`] for a path that the schema does not have (for JSON that shows only in the
    /// messages: there the slot is absent), [`DatasetError::WrongType`] for one that ends at a struct.
    pub fn plan(&self, paths: &[FieldPath]) -> Result<Plan> {
        let of = match &self.0 {
            Kind::Ros(types) => PlanKind::Ros(ros::RosPlan::new(Arc::clone(types), paths)?),
            Kind::Protobuf(of) => PlanKind::Protobuf(protobuf::ProtobufPlan::new(of, paths)?),
            Kind::Json(_) => PlanKind::Json(paths.to_vec()),
        };
        Ok(Plan {
            n_slots: paths.len(),
            of,
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
    /// A sequence of bytes (`uint8[]`, `bytes`): its length is that of the data. ROS: with an index, a number.
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
pub struct Plan {
    n_slots: usize,
    of: PlanKind,
}

#[derive(Debug, Clone)]
enum PlanKind {
    Ros(ros::RosPlan),
    Protobuf(protobuf::ProtobufPlan),
    Json(Vec<FieldPath>),
}

impl Plan {
    /// Takes the fields out of a message. What `out` held before is gone; its buffers are reused.
    ///
    /// # Errors
    /// [`DatasetError::Message`] if the bytes do not fit the schema as far as they had to be read, or a wanted
    /// integer cannot be represented as `f64`. `out` is then in no useful state.
    pub fn extract(&self, message: &Message<'_>, out: &mut Extracted) -> Result<()> {
        let extracted = match &self.of {
            PlanKind::Ros(plan) => plan.extract(message.data, out.start(self.n_slots, 0).0),
            PlanKind::Protobuf(plan) => {
                let (slots, counters) = out.start(self.n_slots, plan.n_counters());
                plan.extract(message.data, slots, counters)
            }
            PlanKind::Json(paths) => {
                json::extract(message.data, paths, out.start(self.n_slots, 0).0)
            }
        };
        extracted.map_err(|fault| message.error(fault.into_text()))
    }
}
