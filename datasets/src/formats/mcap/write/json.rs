//! Rows as JSON messages, and the JSON Schema that goes into the file.

use arrow::datatypes::DataType;
use serde_json::{Map, Value, json};

use super::cells::Cell;
use super::groups::{Group, Member};
use crate::formats::mcap::base64;

/// The JSON Schema of a group's messages. NaN and infinities are the strings `NaN`, `Infinity`, `-Infinity`;
/// bytes are base64.
pub(super) fn schema(group: &Group) -> Value {
    let properties: Map<String, Value> = group
        .members
        .iter()
        .map(|member| (member.name.clone(), property(member)))
        .collect();
    json!({ "title": group.message, "type": "object", "properties": properties })
}

fn property(member: &Member) -> Value {
    let one = match member.value_type {
        DataType::Boolean => json!({ "type": "boolean" }),
        DataType::Utf8 => json!({ "type": "string" }),
        DataType::Binary => json!({ "type": "string", "contentEncoding": "base64" }),
        DataType::Float16 | DataType::Float32 | DataType::Float64 => json!({ "type": "number" }),
        _ => json!({ "type": "integer" }),
    };
    match member.is_vector {
        true => json!({ "type": "array", "items": one }),
        false => one,
    }
}

/// The value of a member.
pub(super) fn value(is_vector: bool, cell: &Cell<'_>) -> Value {
    let mut values: Vec<Value> = match cell {
        Cell::F64(values) => values.iter().map(|value| float(*value)).collect(),
        Cell::F32(values) => values
            .iter()
            .map(|value| float(f64::from(*value)))
            .collect(),
        Cell::Signed(values) => values.iter().map(|value| json!(value)).collect(),
        Cell::Unsigned(values) => values.iter().map(|value| json!(value)).collect(),
        Cell::Octets(values) => values.iter().map(|value| json!(value)).collect(),
        Cell::Flags(values) => values.iter().map(|value| json!(value)).collect(),
        Cell::Text(text) => return json!(text),
        Cell::Bytes(bytes) => return json!(base64::encode(bytes)),
    };
    match is_vector {
        true => Value::Array(values),
        false => values.pop().unwrap_or(Value::Null),
    }
}

fn float(value: f64) -> Value {
    match value {
        _ if value.is_nan() => json!("NaN"),
        f64::INFINITY => json!("Infinity"),
        f64::NEG_INFINITY => json!("-Infinity"),
        _ => json!(value),
    }
}
