//! MCAP recordings: the container ([`container`]) and its messages, decoded at run time from the schemas in
//! the file ([`decode`]).

mod align;
mod base64;
mod bind;
mod container;
mod decode;
mod describe;
mod feeds;
mod fields;
mod guess;
mod inspect;
mod mapping;
mod numbered;
mod opening;
mod paths;
mod picture;
mod plan;
mod propose;
mod rows;
mod scan;
mod source;
mod spans;
mod steps;
mod survey;
mod track;
mod values;
mod write;

pub(crate) use source::McapSource;
pub(crate) use write::McapSink;

pub use container::{
    AttachmentEntry, Channel, ChunkEntry, Message, MessageOptions, MessageSchema, Messages,
    Metadata, Recording, Statistics, Summary,
};
pub use decode::{
    Decoder, Extracted, FieldDescription, FieldKind, FieldLength, FieldPath, Plan, Slot, Value,
};
pub use inspect::{Inspection, TopicInspection, inspect};
