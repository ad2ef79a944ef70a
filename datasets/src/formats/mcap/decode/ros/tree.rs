//! Whole ROS messages as trees.

use std::sync::Arc;

use super::cursor::Cursor;
use super::types::{Count, Field, Kind, Primitive, Struct, Types};
use crate::formats::mcap::decode::Value;
use crate::formats::mcap::decode::fault::Fault;

/// Decodes a message to its end.
pub(crate) fn decode(types: &Types, data: &[u8]) -> Result<Value, Fault> {
    let mut cursor = Cursor::new(data, types.flavor)?;
    let value = match types.root() {
        Some(root) => decode_struct(types, root, &mut cursor)?,
        None => Value::Null,
    };
    cursor.finish()?;
    Ok(value)
}

fn decode_struct(types: &Types, of: &Struct, cursor: &mut Cursor<'_>) -> Result<Value, Fault> {
    if of.min_size == 0 {
        return Ok(Value::Struct(Vec::new()));
    }
    if of.fields.is_empty() {
        cursor.dummy();
    }
    let mut members = Vec::with_capacity(of.fields.len());
    for field in &of.fields {
        let value =
            decode_field(types, field, cursor).map_err(|fault| fault.in_member(&field.name))?;
        members.push((Arc::clone(&field.name), value));
    }
    Ok(Value::Struct(members))
}

fn decode_field(types: &Types, field: &Field, cursor: &mut Cursor<'_>) -> Result<Value, Fault> {
    if field.count == Count::One {
        return decode_one(types, field.kind, cursor);
    }
    let n = cursor.count(field.count, types.min_size(field.kind))?;
    let mut items = Vec::new();
    match field.kind {
        Kind::Primitive(Primitive::U8) => return Ok(Value::Bytes(cursor.byte_array(n)?.to_vec())),
        Kind::Primitive(primitive) => {
            cursor.values(primitive, n, &mut items)?;
        }
        kind => {
            for _ in 0..n {
                items.push(decode_one(types, kind, cursor)?);
            }
        }
    }
    Ok(Value::List(items))
}

fn decode_one(types: &Types, kind: Kind, cursor: &mut Cursor<'_>) -> Result<Value, Fault> {
    match kind {
        Kind::Primitive(primitive) => {
            let mut one = Vec::with_capacity(1);
            cursor.values(primitive, 1, &mut one)?;
            Ok(one.pop().unwrap_or(Value::Null))
        }
        Kind::Text(bound) => Ok(Value::Text(cursor.text(bound)?.to_owned())),
        Kind::Struct(place) => match types.get(place) {
            Some(of) => decode_struct(types, of, cursor),
            None => Ok(Value::Null),
        },
    }
}
