//! Protocol Buffers messages, by the descriptors in the file.

mod plan;
#[cfg(test)]
mod tests;
mod wire;

use arrow::datatypes::DataType;
use prost_reflect::{
    DescriptorPool, DynamicMessage, FieldDescriptor, Kind, MapKey, MessageDescriptor,
    ReflectMessage, Value as Reflected,
};

use super::fault::{Fault, fault};
use super::{FieldDescription, FieldKind, FieldLength, MAX_LISTED, Value};
use crate::error::{DatasetError, Result};
use crate::guard;

pub(super) use plan::ProtobufPlan;

/// Submessages nested deeper than this are not listed (a type may hold itself).
const MAX_LISTED_DEPTH: usize = 16;

/// A type of messages.
#[derive(Debug, Clone)]
pub(super) struct MessageType(MessageDescriptor);

impl MessageType {
    /// Reads a `FileDescriptorSet`.
    pub(super) fn new(name: &str, data: &[u8]) -> Result<Self> {
        let bad = |reason: &dyn std::fmt::Display| {
            DatasetError::corrupt(format!("the schema of message type \"{name}\": {reason}"))
        };
        let pool = guard::decode(|| DescriptorPool::decode(data).map_err(|error| bad(&error)))?;
        let message = pool.get_message_by_name(name);
        message
            .map(Self)
            .ok_or_else(|| bad(&"it does not describe that type"))
    }

    /// Decodes a message.
    pub(super) fn decode(&self, data: &[u8]) -> std::result::Result<Value, Fault> {
        let message = DynamicMessage::decode(self.0.clone(), data)
            .map_err(|error| fault(error.to_string()))?;
        Ok(tree_of_message(&message))
    }

    pub(super) fn describe(&self) -> Vec<FieldDescription> {
        let mut found = Vec::new();
        describe(&self.0, "", false, 0, &mut found);
        found
    }
}

/// Members by field number.
fn tree_of_message(message: &DynamicMessage) -> Value {
    let fields = message.descriptor();
    let members = fields.fields().map(|field| {
        let value = if field.supports_presence() && !message.has_field(&field) {
            Value::Null
        } else {
            tree(&message.get_field(&field))
        };
        (field.name().into(), value)
    });
    Value::Struct(members.collect())
}

fn tree(value: &Reflected) -> Value {
    match value {
        Reflected::Bool(flag) => Value::Bool(*flag),
        Reflected::I32(value) | Reflected::EnumNumber(value) => Value::Int((*value).into()),
        Reflected::I64(value) => Value::Int(*value),
        Reflected::U32(value) => Value::Uint((*value).into()),
        Reflected::U64(value) => Value::Uint(*value),
        Reflected::F32(value) => Value::Float32(*value),
        Reflected::F64(value) => Value::Float64(*value),
        Reflected::String(text) => Value::Text(text.clone()),
        Reflected::Bytes(bytes) => Value::Bytes(bytes.to_vec()),
        Reflected::Message(message) => tree_of_message(message),
        Reflected::List(items) => Value::List(items.iter().map(tree).collect()),
        Reflected::Map(map) => {
            let mut entries: Vec<(&MapKey, &Reflected)> = map.iter().collect();
            entries.sort_by(|a, b| a.0.cmp(b.0));
            let entry = |(key, value): (&MapKey, &Reflected)| {
                Value::Struct(vec![
                    ("key".into(), tree(&key.clone().into())),
                    ("value".into(), tree(value)),
                ])
            };
            Value::List(entries.into_iter().map(entry).collect())
        }
    }
}

/// The kinds of time that are messages.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Clock {
    Time,
    Duration,
}

/// Whether it is one of the well-known times: by its name, and by its fields.
fn clock(message: &MessageDescriptor) -> Option<Clock> {
    let clock = match message.full_name() {
        "google.protobuf.Timestamp" => Clock::Time,
        "google.protobuf.Duration" => Clock::Duration,
        _ => return None,
    };
    let is = |number, kind: Kind| {
        let field = message.get_field(number);
        field.is_some_and(|field| field.kind() == kind && !field.is_list())
    };
    (is(1, Kind::Int64) && is(2, Kind::Int32)).then_some(clock)
}

fn describe(
    message: &MessageDescriptor,
    prefix: &str,
    in_array: bool,
    depth: usize,
    found: &mut Vec<FieldDescription>,
) {
    if depth >= MAX_LISTED_DEPTH {
        return;
    }
    for field in message.fields() {
        // Arrays in arrays have no path.
        if found.len() >= MAX_LISTED || field.is_map() || field.is_group() {
            continue;
        }
        if in_array && field.is_list() {
            continue;
        }
        let path = format!("{prefix}{}", field.name());
        let is_one = !field.is_list() && !in_array;
        let kind = match field.kind() {
            Kind::Message(inner) => match clock(&inner).filter(|_| is_one) {
                Some(Clock::Time) => FieldKind::Time,
                Some(Clock::Duration) => FieldKind::Duration,
                None => {
                    let each = if field.is_list() { "[]" } else { "" };
                    let prefix = format!("{path}{each}.");
                    let in_array = in_array || field.is_list();
                    describe(&inner, &prefix, in_array, depth + 1, found);
                    continue;
                }
            },
            Kind::Bytes if !is_one => continue,
            _ => kind_of(&field),
        };
        let length = match is_one && kind != FieldKind::Bytes {
            true => FieldLength::One,
            false => FieldLength::Variable { max: None },
        };
        found.push(FieldDescription { path, kind, length });
    }
}

fn kind_of(field: &FieldDescriptor) -> FieldKind {
    FieldKind::Number(match field.kind() {
        Kind::Double => DataType::Float64,
        Kind::Float => DataType::Float32,
        Kind::Int32 | Kind::Sint32 | Kind::Sfixed32 | Kind::Enum(_) => DataType::Int32,
        Kind::Int64 | Kind::Sint64 | Kind::Sfixed64 => DataType::Int64,
        Kind::Uint32 | Kind::Fixed32 => DataType::UInt32,
        Kind::Uint64 | Kind::Fixed64 => DataType::UInt64,
        Kind::Bool => return FieldKind::Bool,
        Kind::String => return FieldKind::Text,
        Kind::Bytes | Kind::Message(_) => return FieldKind::Bytes,
    })
}
