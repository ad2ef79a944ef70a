//! Rows as Protobuf messages, and the descriptors that go into the file.
//!
//! Wire format and `descriptor.proto` as documented by Protocol Buffers; only what these messages need.

use arrow::datatypes::DataType;

use super::cells::Cell;
use super::groups::{Group, Member};

/// Package of the message types.
const PACKAGE: &str = "ksim";

/// Full name of a group's message type.
pub(super) fn type_name(group: &Group) -> String {
    format!("{PACKAGE}.{}", group.message)
}

/// A `FileDescriptorSet` with the message type of a group (proto3; every scalar is `optional`, so that a null
/// is told from a zero).
pub(super) fn descriptors(group: &Group) -> Vec<u8> {
    let mut message = Vec::new();
    text(&mut message, 1, group.message);
    let mut oneofs = Vec::new();
    for (number, member) in numbered(group) {
        let mut field = Vec::new();
        text(&mut field, 1, &member.name);
        varint_field(&mut field, 3, number);
        let (wire, is_repeated) = wire_type(member);
        varint_field(&mut field, 4, if is_repeated { 3 } else { 1 });
        varint_field(&mut field, 5, wire);
        if !is_repeated {
            // The synthetic oneof by which proto3 tells presence.
            varint_field(&mut field, 9, oneofs.len() as u64);
            varint_field(&mut field, 17, 1);
            let mut oneof = Vec::new();
            text(&mut oneof, 1, &format!("_{}", member.name));
            oneofs.push(oneof);
        }
        bytes(&mut message, 2, &field);
    }
    for oneof in oneofs {
        bytes(&mut message, 8, &oneof);
    }
    let mut file = Vec::new();
    text(
        &mut file,
        1,
        &format!("{PACKAGE}/{}.proto", group.message.to_lowercase()),
    );
    text(&mut file, 2, PACKAGE);
    bytes(&mut file, 4, &message);
    text(&mut file, 12, "proto3");
    let mut set = Vec::new();
    bytes(&mut set, 1, &file);
    set
}

/// Members with their field numbers.
fn numbered(group: &Group) -> impl Iterator<Item = (u64, &Member)> {
    (1..).zip(&group.members)
}

/// The field type of `descriptor.proto`, and whether it is repeated.
fn wire_type(member: &Member) -> (u64, bool) {
    let wire = match member.value_type {
        DataType::Float64 => 1,
        DataType::Float32 | DataType::Float16 => 2,
        DataType::UInt64 => 4,
        DataType::Boolean => 8,
        DataType::Utf8 => 9,
        DataType::Binary => 12,
        DataType::UInt8 if member.is_vector => return (12, false),
        DataType::UInt8 | DataType::UInt16 | DataType::UInt32 => 13,
        DataType::Int64 => 18,
        _ => 17,
    };
    (wire, member.is_vector)
}

/// Appends the field of a member, whose place in its group is `at`.
pub(super) fn push(out: &mut Vec<u8>, at: usize, is_vector: bool, cell: &Cell<'_>) {
    let number = at as u64 + 1;
    match cell {
        Cell::Text(value) => return text(out, number, value),
        Cell::Bytes(value) | Cell::Octets(value) => return bytes(out, number, value),
        _ => {}
    }
    let mut packed = Vec::new();
    let wire = match cell {
        Cell::F64(values) => {
            packed.extend(values.iter().flat_map(|value| value.to_le_bytes()));
            1
        }
        Cell::F32(values) => {
            packed.extend(values.iter().flat_map(|value| value.to_le_bytes()));
            5
        }
        Cell::Signed(values) => {
            for value in values {
                // Zigzag.
                varint(
                    &mut packed,
                    (value << 1).cast_unsigned() ^ (value >> 63).cast_unsigned(),
                );
            }
            0
        }
        Cell::Unsigned(values) => {
            for value in values {
                varint(&mut packed, *value);
            }
            0
        }
        Cell::Flags(values) => {
            packed.extend(values.iter().map(|flag| u8::from(*flag)));
            0
        }
        Cell::Text(_) | Cell::Bytes(_) | Cell::Octets(_) => return,
    };
    if is_vector {
        bytes(out, number, &packed);
    } else {
        varint(out, number << 3 | wire);
        out.extend(packed);
    }
}

fn varint(out: &mut Vec<u8>, mut value: u64) {
    while value >= 0x80 {
        // The low seven bits, marked as not the last.
        out.push((value & 0x7f) as u8 | 0x80);
        value >>= 7;
    }
    out.push(value as u8);
}

fn varint_field(out: &mut Vec<u8>, number: u64, value: u64) {
    varint(out, number << 3);
    varint(out, value);
}

fn bytes(out: &mut Vec<u8>, number: u64, value: &[u8]) {
    varint(out, number << 3 | 2);
    varint(out, value.len() as u64);
    out.extend_from_slice(value);
}

fn text(out: &mut Vec<u8>, number: u64, value: &str) {
    bytes(out, number, value.as_bytes());
}
