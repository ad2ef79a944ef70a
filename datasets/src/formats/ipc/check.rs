//! What must hold of an IPC file before its bytes are taken for arrays.

use std::ops::Range;

use arrow::datatypes::{DataType, Field};
use arrow::ipc;

use crate::error::{DatasetError, Result};

/// Nesting of a column, at most.
const MAX_DEPTH: usize = 32;
/// Bytes that the packed buffers of a batch may always unpack to.
const ALWAYS_ALLOWED: u64 = 64 << 20;
/// How many times its size in the file a packed batch may unpack to, beyond [`ALWAYS_ALLOWED`].
const MAX_RATIO: u64 = 1100;
/// In place of the length, in front of a buffer that packing would not shrink.
const NOT_PACKED: i64 = -1;
/// The length in front of a packed buffer.
const PREFIX: usize = 8;

/// Bytes that a batch of `body_length` bytes in the file may take in memory.
pub(super) fn allowed(body_length: u64) -> u64 {
    body_length
        .saturating_mul(MAX_RATIO)
        .saturating_add(ALWAYS_ALLOWED)
}

/// Refuses a schema with types that no dataset here has.
///
/// # Errors
/// [`DatasetError::WrongType`] naming the column.
pub(super) fn check_schema(schema: ipc::Schema<'_>) -> Result<()> {
    if schema.endianness() != ipc::Endianness::Little {
        return Err(DatasetError::Unsupported {
            what: "an Arrow file in big-endian byte order".to_owned(),
        });
    }
    let fields = schema
        .fields()
        .ok_or_else(|| DatasetError::corrupt("the Arrow schema has no columns"))?;
    fields.iter().try_for_each(|field| check_field(field, 0))
}

fn check_field(field: ipc::Field<'_>, depth: usize) -> Result<()> {
    let children = || field.children().into_iter().flatten();
    let is_known = match field.type_type() {
        ipc::Type::Bool
        | ipc::Type::Utf8
        | ipc::Type::LargeUtf8
        | ipc::Type::Binary
        | ipc::Type::LargeBinary
        | ipc::Type::Date
        | ipc::Type::Time
        | ipc::Type::Timestamp
        | ipc::Type::Duration => children().count() == 0,
        ipc::Type::Int => field
            .type_as_int()
            .is_some_and(|int| matches!(int.bitWidth(), 8 | 16 | 32 | 64)),
        ipc::Type::FloatingPoint => field.type_as_floating_point().is_some_and(|float| {
            let precision = float.precision();
            precision == ipc::Precision::HALF
                || precision == ipc::Precision::SINGLE
                || precision == ipc::Precision::DOUBLE
        }),
        ipc::Type::Struct_ => true,
        ipc::Type::List | ipc::Type::LargeList => children().count() == 1,
        ipc::Type::FixedSizeList => {
            let size = field.type_as_fixed_size_list().map(|list| list.listSize());
            size.is_some_and(|size| size >= 0) && children().count() == 1
        }
        _ => false,
    };
    // Dictionaries keep their values' type and are marked beside it.
    let is_fit = field
        .dictionary()
        .is_none_or(|_| depth == 0 && children().count() == 0);
    if !is_known || !is_fit || field.name().is_none() || depth > MAX_DEPTH {
        return Err(DatasetError::WrongType {
            key: field.name().unwrap_or_default().to_owned(),
            actual: format!("{:?}", field.type_type()),
            expected: "numbers, flags, text, bytes, times, lists, or a struct of these",
        });
    }
    children().try_for_each(|child| check_field(child, depth + 1))
}

/// The bytes of a batch, as far as they are known.
#[derive(Clone, Copy)]
pub(super) enum Body<'a> {
    /// Only their number.
    Length(u64),
    /// The buffers of the columns to be read.
    Read {
        bytes: &'a [u8],
        columns: &'a [usize],
    },
}

impl Body<'_> {
    fn length(self) -> u64 {
        match self {
            Self::Length(length) => length,
            Self::Read { bytes, .. } => bytes.len() as u64,
        }
    }
}

/// Checks that every buffer of a batch lies in its body, that lengths of nested columns fit together, and, for
/// columns that were read, that packed buffers do not unpack to more than [`allowed`]. Gives the place of each
/// column's buffers in the body.
///
/// # Errors
/// [`DatasetError::Corrupt`] naming the column.
pub(super) fn check_batch<'f>(
    batch: ipc::RecordBatch<'_>,
    fields: impl Iterator<Item = &'f Field>,
    body: Body<'_>,
) -> Result<Vec<Vec<Range<u64>>>> {
    if batch
        .variadicBufferCounts()
        .is_some_and(|counts| !counts.is_empty())
    {
        return Err(DatasetError::corrupt(
            "a batch counts buffers no column has",
        ));
    }
    let (nodes, buffers) = (batch.nodes(), batch.buffers());
    let mut walk = Walk {
        nodes: nodes
            .iter()
            .flatten()
            .copied()
            .collect::<Vec<_>>()
            .into_iter(),
        buffers: buffers
            .iter()
            .flatten()
            .copied()
            .collect::<Vec<_>>()
            .into_iter(),
        body,
        is_packed: batch.compression().is_some(),
        is_read: false,
        unpacked: 0,
        ranges: Vec::new(),
    };
    let mut places = Vec::new();
    for (place, field) in fields.enumerate() {
        walk.is_read = matches!(body, Body::Read { columns, .. } if columns.contains(&place));
        walk.field(field, Some(batch.length()))?;
        places.push(std::mem::take(&mut walk.ranges));
    }
    if walk.unpacked > allowed(body.length()) {
        return Err(DatasetError::corrupt(format!(
            "a record batch of {} bytes claims to unpack to {}",
            body.length(),
            walk.unpacked
        )));
    }
    Ok(places)
}

struct Walk<'a> {
    nodes: std::vec::IntoIter<ipc::FieldNode>,
    buffers: std::vec::IntoIter<ipc::Buffer>,
    body: Body<'a>,
    is_packed: bool,
    /// Whether the column at hand was read.
    is_read: bool,
    /// Bytes that the packed buffers claim.
    unpacked: u64,
    ranges: Vec<Range<u64>>,
}

impl Walk<'_> {
    /// A column; `n_rows` is the number of values it must have, where its parent says so.
    fn field(&mut self, field: &Field, n_rows: Option<i64>) -> Result<()> {
        let damaged = || {
            DatasetError::corrupt(format!(
                "column \"{}\" does not fit its record batch",
                field.name()
            ))
        };
        let node = self.nodes.next().ok_or_else(damaged)?;
        let length = node.length();
        // Nothing has more values than bits, so that no empty list has rows without end.
        let most = i64::try_from(allowed(self.body.length())).unwrap_or(i64::MAX);
        let sane = n_rows.is_none_or(|n_rows| length == n_rows)
            && (0..=most.saturating_mul(8)).contains(&length)
            && (0..=length).contains(&node.null_count());
        let n_values = length.unsigned_abs();
        let validity = self.buffer().filter(|_| sane).ok_or_else(damaged)?;
        if node.null_count() > 0 && validity < n_values.div_ceil(8) {
            return Err(damaged());
        }
        match field.data_type() {
            DataType::Struct(children) => {
                for child in children {
                    self.field(child, Some(length))?;
                }
                Ok(())
            }
            DataType::FixedSizeList(child, size) => {
                let inner = length.checked_mul(i64::from(*size)).ok_or_else(damaged)?;
                self.field(child, Some(inner))
            }
            DataType::List(child) | DataType::LargeList(child) => {
                self.buffer().ok_or_else(damaged)?;
                self.field(child, None)
            }
            DataType::Utf8 | DataType::LargeUtf8 | DataType::Binary | DataType::LargeBinary => {
                self.buffer().ok_or_else(damaged)?;
                self.buffer().map(drop).ok_or_else(damaged)
            }
            data_type => {
                let bits = value_bits(data_type);
                let needed = n_values.checked_mul(bits).ok_or_else(damaged)?;
                let values = self.buffer().ok_or_else(damaged)?;
                if values < needed.div_ceil(8) {
                    return Err(damaged());
                }
                Ok(())
            }
        }
    }

    /// Length of the next buffer in memory, if it lies in the body.
    fn buffer(&mut self) -> Option<u64> {
        let buffer = self.buffers.next()?;
        let offset = u64::try_from(buffer.offset()).ok()?;
        let length = u64::try_from(buffer.length()).ok()?;
        let end = offset.checked_add(length)?;
        if end > self.body.length() {
            return None;
        }
        self.ranges.push(offset..end);
        match self.body {
            _ if !self.is_packed => Some(length),
            Body::Read { bytes, .. } if self.is_read => {
                let range = usize::try_from(offset).ok()?..usize::try_from(end).ok()?;
                let unpacked = unpacked_length(bytes.get(range)?)?;
                self.unpacked = self.unpacked.saturating_add(unpacked);
                Some(unpacked)
            }
            // Not known yet: nothing speaks against it.
            _ => Some(u64::MAX),
        }
    }
}

fn value_bits(data_type: &DataType) -> u64 {
    let stored = match data_type {
        DataType::Dictionary(key, _) => key.as_ref(),
        other => other,
    };
    stored.primitive_width().map_or(1, |bytes| 8 * bytes as u64)
}

/// Length of a packed buffer in memory, as it claims.
fn unpacked_length(packed: &[u8]) -> Option<u64> {
    if packed.is_empty() {
        return Some(0);
    }
    let prefix: [u8; PREFIX] = packed.get(..PREFIX)?.try_into().ok()?;
    match i64::from_le_bytes(prefix) {
        NOT_PACKED => Some((packed.len() - PREFIX) as u64),
        length => u64::try_from(length).ok(),
    }
}
