//! What must hold of an IPC file before its bytes are taken for arrays.

use arrow::datatypes::{DataType, Field, Fields};
use arrow::ipc;

use crate::error::{DatasetError, Result};

/// Nesting of a column, at most.
const MAX_DEPTH: usize = 32;

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
        | ipc::Type::LargeBinary => children().count() == 0,
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
        ipc::Type::FixedSizeList => {
            let size = field.type_as_fixed_size_list().map(|list| list.listSize());
            size.is_some_and(|size| size >= 0) && children().count() == 1
        }
        _ => false,
    };
    // Dictionaries keep their type's name and are marked beside it.
    if !is_known || field.name().is_none() || field.dictionary().is_some() || depth > MAX_DEPTH {
        return Err(DatasetError::WrongType {
            key: field.name().unwrap_or_default().to_owned(),
            actual: format!("{:?}", field.type_type()),
            expected: "numbers, flags, text, bytes, lists of one length, or a struct of these",
        });
    }
    children().try_for_each(|child| check_field(child, depth + 1))
}

/// Checks that every buffer of a batch lies in its body and that lengths of nested columns fit together.
///
/// # Errors
/// [`DatasetError::Corrupt`] naming the column.
pub(super) fn check_batch(
    batch: ipc::RecordBatch<'_>,
    fields: &Fields,
    body_length: u64,
) -> Result<()> {
    if batch.compression().is_some() {
        return Err(DatasetError::Unsupported {
            what: "an Arrow file with packed buffers".to_owned(),
        });
    }
    if batch
        .variadicBufferCounts()
        .is_some_and(|counts| !counts.is_empty())
    {
        return Err(DatasetError::corrupt(
            "a batch counts buffers no column has",
        ));
    }
    let mut walk = Walk {
        nodes: batch
            .nodes()
            .iter()
            .flatten()
            .copied()
            .collect::<Vec<_>>()
            .into_iter(),
        buffers: batch
            .buffers()
            .iter()
            .flatten()
            .copied()
            .collect::<Vec<_>>()
            .into_iter(),
        body_length,
    };
    for field in fields {
        walk.field(field, batch.length())?;
    }
    Ok(())
}

struct Walk {
    nodes: std::vec::IntoIter<ipc::FieldNode>,
    buffers: std::vec::IntoIter<ipc::Buffer>,
    body_length: u64,
}

impl Walk {
    /// A column that must have `n_rows` values.
    fn field(&mut self, field: &Field, n_rows: i64) -> Result<()> {
        let damaged = || {
            DatasetError::corrupt(format!(
                "column \"{}\" does not fit its record batch",
                field.name()
            ))
        };
        let node = self.nodes.next().ok_or_else(damaged)?;
        let sane = node.length() == n_rows && (0..=n_rows).contains(&node.null_count());
        let validity = self.buffer().filter(|_| sane).ok_or_else(damaged)?;
        if node.null_count() > 0 && validity < n_rows.unsigned_abs().div_ceil(8) {
            return Err(damaged());
        }
        match field.data_type() {
            DataType::Struct(children) => {
                for child in children {
                    self.field(child, n_rows)?;
                }
                Ok(())
            }
            DataType::FixedSizeList(child, size) => {
                let inner = n_rows.checked_mul(i64::from(*size)).ok_or_else(damaged)?;
                self.field(child, inner)
            }
            DataType::Utf8 | DataType::LargeUtf8 | DataType::Binary | DataType::LargeBinary => {
                self.buffer().ok_or_else(damaged)?;
                self.buffer().map(drop).ok_or_else(damaged)
            }
            data_type => {
                let bits = data_type
                    .primitive_width()
                    .map_or(1, |bytes| 8 * bytes as u64);
                let needed = n_rows
                    .unsigned_abs()
                    .checked_mul(bits)
                    .ok_or_else(damaged)?;
                let values = self.buffer().ok_or_else(damaged)?;
                if values < needed.div_ceil(8) {
                    return Err(damaged());
                }
                Ok(())
            }
        }
    }

    /// Length of the next buffer, if it lies in the body.
    fn buffer(&mut self) -> Option<u64> {
        let buffer = self.buffers.next()?;
        let offset = u64::try_from(buffer.offset()).ok()?;
        let length = u64::try_from(buffer.length()).ok()?;
        (offset.checked_add(length)? <= self.body_length).then_some(length)
    }
}
