//! ROS 1 and ROS 2 messages: types from the text in the file, values from the bytes of the message.
//!
//! ROS 2 messages are CDR version 1: four bytes that name the byte order, then the members, each aligned to its
//! size counted from byte 4; texts are a length with the NUL counted, arrays a length (if it is not fixed) and
//! the elements; a struct without members takes one byte. ROS 1 messages are packed, little-endian, and texts
//! have no NUL.

mod cursor;
mod parse;
mod plan;
#[cfg(test)]
mod tests;
mod tree;
mod types;

pub(super) use parse::parse;
pub(super) use plan::RosPlan;
pub(super) use tree::decode;
pub(super) use types::{Flavor, Types};
