//! Collecting rows of one leaf into an Arrow array.

use std::sync::Arc;

use arrow::array::{
    ArrayRef, BinaryBuilder, BooleanArray, BooleanBufferBuilder, FixedSizeListArray,
    PrimitiveArray, StringBuilder,
};
use arrow::buffer::{NullBuffer, ScalarBuffer};
use arrow::datatypes::{
    ArrowPrimitiveType, DataType, Field, Float16Type, Float32Type, Float64Type, Int8Type,
    Int16Type, Int32Type, Int64Type, UInt8Type, UInt16Type, UInt32Type, UInt64Type,
};

use super::element::Element;
use crate::error::{DatasetError, Result};

/// The values of a column, by type.
pub(in crate::formats) enum Values {
    I8(Vec<i8>),
    I16(Vec<i16>),
    I32(Vec<i32>),
    I64(Vec<i64>),
    U8(Vec<u8>),
    U16(Vec<u16>),
    U32(Vec<u32>),
    U64(Vec<u64>),
    F16(Vec<half::f16>),
    F32(Vec<f32>),
    F64(Vec<f64>),
    Text(StringBuilder),
    Bytes(BinaryBuilder),
}

/// Rows of one column, growing.
pub(crate) struct LeafBuilder {
    pub(in crate::formats) values: Values,
    pub(in crate::formats) element: Element,
    pub(in crate::formats) width: usize,
    pub(in crate::formats) nulls: BooleanBufferBuilder,
}

impl LeafBuilder {
    /// A builder with room for `n_rows` rows of `width` values.
    pub(crate) fn new(element: Element, width: usize, n_rows: usize) -> Self {
        let n = n_rows * width;
        let values = match element {
            Element::I8 | Element::Bool => Values::I8(Vec::with_capacity(n)),
            Element::I16 => Values::I16(Vec::with_capacity(n)),
            Element::I32 => Values::I32(Vec::with_capacity(n)),
            Element::I64 => Values::I64(Vec::with_capacity(n)),
            Element::U8 => Values::U8(Vec::with_capacity(n)),
            Element::U16 => Values::U16(Vec::with_capacity(n)),
            Element::U32 => Values::U32(Vec::with_capacity(n)),
            Element::U64 => Values::U64(Vec::with_capacity(n)),
            Element::F16 => Values::F16(Vec::with_capacity(n)),
            Element::F32 => Values::F32(Vec::with_capacity(n)),
            Element::F64 => Values::F64(Vec::with_capacity(n)),
            Element::Text => Values::Text(StringBuilder::new()),
            Element::Bytes => Values::Bytes(BinaryBuilder::new()),
        };
        Self {
            values,
            element,
            width,
            nulls: BooleanBufferBuilder::new(n_rows),
        }
    }

    /// Appends `n` rows as their bytes lie in a file.
    ///
    /// # Errors
    /// There are not as many bytes as such rows have.
    pub(crate) fn append_bytes(
        &mut self,
        bytes: &[u8],
        n: usize,
        is_big_endian: bool,
    ) -> Result<()> {
        if bytes.len() != n * self.width * self.element.n_bytes() {
            return Err(DatasetError::corrupt(
                "rows of another length than declared",
            ));
        }
        macro_rules! extend {
            ($values:expr, $type:ty) => {{
                let (chunks, _) = bytes.as_chunks::<{ size_of::<$type>() }>();
                let value = |chunk: &[u8; size_of::<$type>()]| match is_big_endian {
                    true => <$type>::from_be_bytes(*chunk),
                    false => <$type>::from_le_bytes(*chunk),
                };
                $values.extend(chunks.iter().map(value));
            }};
        }
        match &mut self.values {
            Values::I8(values) => extend!(values, i8),
            Values::I16(values) => extend!(values, i16),
            Values::I32(values) => extend!(values, i32),
            Values::I64(values) => extend!(values, i64),
            Values::U8(values) => values.extend_from_slice(bytes),
            Values::U16(values) => extend!(values, u16),
            Values::U32(values) => extend!(values, u32),
            Values::U64(values) => extend!(values, u64),
            Values::F16(values) => extend!(values, half::f16),
            Values::F32(values) => extend!(values, f32),
            Values::F64(values) => extend!(values, f64),
            Values::Text(_) | Values::Bytes(_) => {
                return Err(DatasetError::corrupt("text where numbers were declared"));
            }
        }
        self.nulls.append_n(n, true);
        Ok(())
    }

    /// Appends flags that are not stored anywhere, to a column of [`Element::Bool`].
    pub(crate) fn append_flags(&mut self, flags: impl Iterator<Item = bool>) {
        if let Values::I8(values) = &mut self.values {
            let before = values.len();
            values.extend(flags.map(i8::from));
            self.nulls.append_n(values.len() - before, true);
        }
    }

    /// Appends `n` null rows.
    pub(crate) fn append_nulls(&mut self, n: usize) {
        let empty = n * self.width;
        match &mut self.values {
            Values::I8(values) => values.resize(values.len() + empty, 0),
            Values::I16(values) => values.resize(values.len() + empty, 0),
            Values::I32(values) => values.resize(values.len() + empty, 0),
            Values::I64(values) => values.resize(values.len() + empty, 0),
            Values::U8(values) => values.resize(values.len() + empty, 0),
            Values::U16(values) => values.resize(values.len() + empty, 0),
            Values::U32(values) => values.resize(values.len() + empty, 0),
            Values::U64(values) => values.resize(values.len() + empty, 0),
            Values::F16(values) => values.resize(values.len() + empty, half::f16::ZERO),
            Values::F32(values) => values.resize(values.len() + empty, 0.0),
            Values::F64(values) => values.resize(values.len() + empty, 0.0),
            Values::Text(values) => values.append_nulls(n),
            Values::Bytes(values) => values.append_nulls(n),
        }
        self.nulls.append_n(n, false);
    }

    /// The array for a column of this field.
    ///
    /// # Errors
    /// A flag that is NaN, or a type the field cannot take.
    pub(crate) fn finish(mut self, field: &Field) -> Result<ArrayRef> {
        let nulls = NullBuffer::new(self.nulls.finish());
        let nulls = (nulls.null_count() > 0).then_some(nulls);
        if *field.data_type() == DataType::Boolean {
            return self.finish_flags(field.name(), nulls);
        }
        let is_list = matches!(field.data_type(), DataType::FixedSizeList(..));
        let own = if is_list { None } else { nulls.clone() };
        let values: ArrayRef = match self.values {
            Values::I8(values) => primitive::<Int8Type>(values, own),
            Values::I16(values) => primitive::<Int16Type>(values, own),
            Values::I32(values) => primitive::<Int32Type>(values, own),
            Values::I64(values) => primitive::<Int64Type>(values, own),
            Values::U8(values) => primitive::<UInt8Type>(values, own),
            Values::U16(values) => primitive::<UInt16Type>(values, own),
            Values::U32(values) => primitive::<UInt32Type>(values, own),
            Values::U64(values) => primitive::<UInt64Type>(values, own),
            Values::F16(values) => primitive::<Float16Type>(values, own),
            Values::F32(values) => primitive::<Float32Type>(values, own),
            Values::F64(values) => primitive::<Float64Type>(values, own),
            Values::Text(mut values) => Arc::new(values.finish()),
            Values::Bytes(mut values) => Arc::new(values.finish()),
        };
        let DataType::FixedSizeList(child, size) = field.data_type() else {
            return converted(values, field);
        };
        let n_rows = values.len() / self.width.max(1);
        let values = converted(values, child)?;
        let list =
            FixedSizeListArray::try_new_with_length(child.clone(), *size, values, nulls, n_rows);
        Ok(Arc::new(
            list.map_err(DatasetError::arrow("build a list column"))?,
        ))
    }

    fn finish_flags(self, name: &str, nulls: Option<NullBuffer>) -> Result<ArrayRef> {
        fn not_zero<T: Default + PartialEq>(values: Vec<T>) -> Vec<bool> {
            values
                .into_iter()
                .map(|value| value != T::default())
                .collect()
        }
        let nan = |row: Option<usize>| match row {
            Some(row) => Err(DatasetError::NanFlag {
                column: name.to_owned(),
                row: row as u64,
            }),
            None => Ok(()),
        };
        let flags = match self.values {
            Values::I8(values) => not_zero(values),
            Values::I16(values) => not_zero(values),
            Values::I32(values) => not_zero(values),
            Values::I64(values) => not_zero(values),
            Values::U8(values) => not_zero(values),
            Values::U16(values) => not_zero(values),
            Values::U32(values) => not_zero(values),
            Values::U64(values) => not_zero(values),
            Values::F16(values) => {
                nan(values.iter().position(|value| value.is_nan()))?;
                not_zero(values)
            }
            Values::F32(values) => {
                nan(values.iter().position(|value| value.is_nan()))?;
                not_zero(values)
            }
            Values::F64(values) => {
                nan(values.iter().position(|value| value.is_nan()))?;
                not_zero(values)
            }
            Values::Text(_) | Values::Bytes(_) => {
                let actual = self.element.numpy_name().to_owned();
                return Err(DatasetError::WrongType {
                    key: name.to_owned(),
                    actual,
                    expected: "flags",
                });
            }
        };
        Ok(Arc::new(BooleanArray::new(flags.into(), nulls)))
    }
}

fn primitive<T: ArrowPrimitiveType>(values: Vec<T::Native>, nulls: Option<NullBuffer>) -> ArrayRef {
    Arc::new(PrimitiveArray::<T>::new(ScalarBuffer::from(values), nulls))
}

/// The array in the field's type: equal but for the policy that promises `float32`, and for flags in lists.
fn converted(values: ArrayRef, field: &Field) -> Result<ArrayRef> {
    if values.data_type() == field.data_type() {
        return Ok(values);
    }
    arrow::compute::cast(&values, field.data_type())
        .map_err(DatasetError::arrow("convert a column"))
}
