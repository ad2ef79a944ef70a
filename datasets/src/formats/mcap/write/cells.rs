//! The value of a column in a row, whatever its Arrow type.

use std::borrow::Cow;

use arrow::array::{Array, ArrayRef, AsArray};
use arrow::datatypes::{
    ArrowPrimitiveType, DataType, Float16Type, Float32Type, Float64Type, Int8Type, Int16Type,
    Int32Type, Int64Type, UInt8Type, UInt16Type, UInt32Type, UInt64Type,
};

use crate::error::{DatasetError, Result};

/// The values of a row: one, or those of a vector in C order.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Cell<'a> {
    F64(&'a [f64]),
    F32(Cow<'a, [f32]>),
    Signed(Vec<i64>),
    Unsigned(Vec<u64>),
    /// A vector or tensor of `UInt8`.
    Octets(&'a [u8]),
    Flags(Vec<bool>),
    Text(&'a str),
    Bytes(&'a [u8]),
}

/// The row of a column; `None` if it is null.
///
/// # Errors
/// A null inside a vector, or a type that no column has.
pub(super) fn cell<'a>(array: &'a ArrayRef, row: usize, column: &str) -> Result<Option<Cell<'a>>> {
    if array.is_null(row) {
        return Ok(None);
    }
    let (values, start, len, is_vector) = match array.data_type() {
        DataType::FixedSizeList(..) => {
            let list = array.as_fixed_size_list();
            let width = usize::try_from(list.value_length()).unwrap_or(0);
            let start = usize::try_from(list.value_offset(row)).unwrap_or(0);
            (list.values(), start, width, true)
        }
        _ => (array, row, 1, false),
    };
    if is_vector && values.slice(start, len).null_count() > 0 {
        return Err(DatasetError::NullValue {
            column: column.to_owned(),
            row: row as u64,
        });
    }
    let run = Run { values, start, len };
    let cell = match values.data_type() {
        DataType::Float64 => Cell::F64(run.of::<Float64Type>()),
        DataType::Float32 => Cell::F32(run.of::<Float32Type>().into()),
        DataType::Float16 => {
            Cell::F32(run.of::<Float16Type>().iter().map(|v| v.to_f32()).collect())
        }
        DataType::Int8 => Cell::Signed(run.signed::<Int8Type>()),
        DataType::Int16 => Cell::Signed(run.signed::<Int16Type>()),
        DataType::Int32 => Cell::Signed(run.signed::<Int32Type>()),
        DataType::Int64 => Cell::Signed(run.signed::<Int64Type>()),
        DataType::UInt8 if is_vector => Cell::Octets(run.of::<UInt8Type>()),
        DataType::UInt8 => Cell::Unsigned(run.unsigned::<UInt8Type>()),
        DataType::UInt16 => Cell::Unsigned(run.unsigned::<UInt16Type>()),
        DataType::UInt32 => Cell::Unsigned(run.unsigned::<UInt32Type>()),
        DataType::UInt64 => Cell::Unsigned(run.unsigned::<UInt64Type>()),
        DataType::Boolean => {
            let flags = values.as_boolean();
            Cell::Flags((start..start + len).map(|i| flags.value(i)).collect())
        }
        DataType::Utf8 => Cell::Text(values.as_string::<i32>().value(start)),
        DataType::Binary => Cell::Bytes(values.as_binary::<i32>().value(start)),
        other => {
            return Err(DatasetError::WrongType {
                key: column.to_owned(),
                actual: other.to_string(),
                expected: "numbers, flags, text or a picture",
            });
        }
    };
    Ok(Some(cell))
}

struct Run<'a> {
    values: &'a ArrayRef,
    start: usize,
    len: usize,
}

impl<'a> Run<'a> {
    fn of<T: ArrowPrimitiveType>(&self) -> &'a [T::Native] {
        let values = self.values.as_primitive::<T>().values();
        values
            .get(self.start..self.start + self.len)
            .unwrap_or_default()
    }

    fn signed<T: ArrowPrimitiveType<Native: Into<i64>>>(&self) -> Vec<i64> {
        self.of::<T>().iter().map(|value| (*value).into()).collect()
    }

    fn unsigned<T: ArrowPrimitiveType<Native: Into<u64>>>(&self) -> Vec<u64> {
        self.of::<T>().iter().map(|value| (*value).into()).collect()
    }
}
