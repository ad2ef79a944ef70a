//! MCAP recordings: the container ([`container`]) and its messages, decoded at run time from the schemas in
//! the file ([`decode`]).

mod container;
mod decode;

pub use container::{
    AttachmentEntry, Channel, ChunkEntry, Message, MessageOptions, MessageSchema, Messages,
    Metadata, Recording, Statistics, Summary,
};
pub use decode::{
    Decoder, Extracted, FieldDescription, FieldKind, FieldLength, FieldPath, Plan, Slot, Value,
};
