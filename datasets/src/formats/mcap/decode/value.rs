//! A whole message as a tree.

use std::sync::Arc;

/// A value of a message.
#[derive(Debug, Clone, PartialEq)]
pub enum Value {
    /// Unset: an `optional` field or submessage of Protobuf, or `null` of JSON.
    Null,
    /// A flag.
    Bool(bool),
    /// A signed integer, or one of JSON that fits; enums of Protobuf too.
    Int(i64),
    /// An unsigned integer, or one of JSON beyond `i64`.
    Uint(u64),
    /// A single-precision number, all its bits.
    Float32(f32),
    /// A double-precision number, all its bits.
    Float64(f64),
    /// Text.
    Text(String),
    /// Bytes (`uint8[]`, `bytes`).
    Bytes(Vec<u8>),
    /// An array.
    List(Vec<Value>),
    /// A struct: its members in order. Times are structs too.
    Struct(Vec<(Arc<str>, Value)>),
}

impl Value {
    /// A member of a struct.
    pub fn member(&self, name: &str) -> Option<&Self> {
        match self {
            Self::Struct(members) => members
                .iter()
                .find(|(key, _)| &**key == name)
                .map(|(_, value)| value),
            _ => None,
        }
    }
}
