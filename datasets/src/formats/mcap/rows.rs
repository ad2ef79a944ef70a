//! Rows of a column, from samples to an Arrow array.

use std::sync::Arc;

use arrow::array::{ArrayData, ArrayRef, make_array};
use arrow::buffer::{BooleanBuffer, Buffer, NullBuffer};
use arrow::datatypes::{DataType, Field};

use super::align::{between, between_angles, between_quaternions};
use super::bind::Layout;
use super::mapping::Kind;
use super::values;
use crate::error::{DatasetError, Result};

/// Collects the rows of one column.
pub(crate) struct Rows {
    field: Arc<Field>,
    value_type: DataType,
    /// Bytes of a row; `None` for text and binary.
    row_bytes: Option<usize>,
    bytes: Vec<u8>,
    /// Ends of rows in `bytes`, for text and binary.
    ends: Vec<i32>,
    valid: Vec<bool>,
}

impl Rows {
    pub(crate) fn new(field: &Arc<Field>, layout: &Layout) -> Self {
        let width = values::width(&layout.value_type);
        Self {
            field: Arc::clone(field),
            value_type: layout.value_type.clone(),
            row_bytes: width.map(|width| width * layout.width()),
            bytes: Vec::new(),
            ends: vec![0],
            valid: Vec::new(),
        }
    }

    /// Appends a row; `None` is null.
    pub(crate) fn push(&mut self, row: Option<&[u8]>) -> Result<()> {
        self.valid.push(row.is_some());
        match (row, self.row_bytes) {
            (Some(row), Some(expected)) if row.len() != expected => {
                return Err(DatasetError::corrupt(format!(
                    "a row of \"{}\" has {} bytes, expected {expected}",
                    self.field.name(),
                    row.len()
                )));
            }
            (Some(row), _) => self.bytes.extend_from_slice(row),
            (None, Some(expected)) => self.bytes.resize(self.bytes.len() + expected, 0),
            (None, None) => {}
        }
        if self.row_bytes.is_none() {
            let end = i32::try_from(self.bytes.len());
            self.ends.push(end.map_err(|_| {
                DatasetError::corrupt(format!("a batch of \"{}\" over 2 GB", self.field.name()))
            })?);
        }
        Ok(())
    }

    /// Bytes so far.
    pub(crate) fn size(&self) -> usize {
        self.bytes.len()
    }

    /// The array, of the field's type.
    pub(crate) fn finish(self) -> Result<ArrayRef> {
        let n_rows = self.valid.len();
        let nulls = Some(NullBuffer::from(self.valid)).filter(|nulls| nulls.null_count() > 0);
        let build = DatasetError::arrow("build a column");
        if self.row_bytes.is_none() {
            let data = ArrayData::builder(self.field.data_type().clone())
                .len(n_rows)
                .nulls(nulls)
                .add_buffer(Buffer::from_vec(self.ends))
                .add_buffer(Buffer::from_vec(self.bytes));
            return data.build().map(make_array).map_err(build);
        }
        let values = match self.value_type {
            DataType::Boolean => {
                let bits: BooleanBuffer = self.bytes.iter().map(|byte| *byte != 0).collect();
                bits.into_inner()
            }
            // Copied, so that it is aligned for its type.
            _ => Buffer::from_slice_ref(&self.bytes),
        };
        let DataType::FixedSizeList(child, width) = self.field.data_type() else {
            let data = ArrayData::builder(self.field.data_type().clone())
                .len(n_rows)
                .nulls(nulls)
                .add_buffer(values);
            return data.build().map(make_array).map_err(build);
        };
        let n_values = n_rows * usize::try_from(*width).unwrap_or(0);
        let child = ArrayData::builder(child.data_type().clone())
            .len(n_values)
            .add_buffer(values);
        let data = ArrayData::builder(self.field.data_type().clone())
            .len(n_rows)
            .nulls(nulls)
            .add_child_data(child.build().map_err(&build)?);
        data.build().map(make_array).map_err(build)
    }
}

/// The row between two, for float columns.
pub(crate) fn mix(
    (before, after): (&[u8], &[u8]),
    weight: f64,
    layout: &Layout,
    kind: Option<Kind>,
) -> Result<Vec<u8>> {
    let floats = |bytes| values::floats(&layout.value_type, bytes);
    let (Some(a), Some(b)) = (floats(before), floats(after)) else {
        return Err(not_linear(&layout.value_type));
    };
    let pairs = a.iter().zip(&b);
    let mixed: Vec<f64> = match kind {
        Some(Kind::Angle) => pairs.map(|(a, b)| between_angles(*a, *b, weight)).collect(),
        Some(Kind::QuaternionXyzw) => {
            let (a, b) = (a.as_chunks::<4>().0, b.as_chunks::<4>().0);
            let mixed = a
                .iter()
                .zip(b)
                .map(|(a, b)| between_quaternions(*a, *b, weight));
            mixed.flatten().collect()
        }
        _ => pairs.map(|(a, b)| between(*a, *b, weight)).collect(),
    };
    let mut bytes = Vec::with_capacity(before.len());
    for value in mixed {
        match layout.value_type {
            DataType::Float32 => bytes.extend((value as f32).to_ne_bytes()),
            _ => bytes.extend(value.to_ne_bytes()),
        }
    }
    Ok(bytes)
}

/// Why a column cannot be interpolated.
pub(crate) fn not_linear(value_type: &DataType) -> DatasetError {
    DatasetError::Unsupported {
        what: format!(
            "`align = \"linear\"` with values of type {value_type}: only float32 and float64 have values between"
        ),
    }
}
