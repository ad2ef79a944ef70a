//! Columns of the canonical layout as arrays of a data file.

use std::sync::Arc;

use arrow::array::{
    Array, ArrayRef, AsArray, BooleanArray, FixedSizeListArray, Float16Array, Float32Array,
    Float64Array, ListArray, Scalar, StringArray, StructArray, new_null_array,
};
use arrow::buffer::OffsetBuffer;
use arrow::compute::kernels::zip::zip;
use arrow::datatypes::{DataType, Float64Type};

use super::super::picture;
use super::plan::{Feature, Form, picture_fields};
use crate::error::{DatasetError, Result};
use crate::formats::tabular::place::{Place, first_null};
use crate::schema;

/// A converted column.
pub(super) struct Converted {
    pub(super) array: ArrayRef,
    /// Its values one after another.
    pub(super) values: ArrayRef,
    /// Rows that were null, in whole or in part.
    pub(super) n_filled: u64,
}

/// Converts a column; `first_row` is its place in the dataset.
///
/// # Errors
/// A picture that is none or has another shape, or a null picture.
pub(super) fn convert(feature: &Feature, array: &ArrayRef, first_row: u64) -> Result<Converted> {
    if feature.form == Form::Picture {
        check_pictures(feature, array, first_row)?;
        let n = array.len();
        let paths = new_null_array(&DataType::Utf8, n);
        let columns = vec![Arc::clone(array), paths];
        let pictures = StructArray::try_new(picture_fields(), columns, None);
        let pictures = pictures.map_err(DatasetError::arrow("build a column"))?;
        return Ok(Converted {
            array: Arc::new(pictures),
            values: Arc::clone(array),
            n_filled: 0,
        });
    }
    let (values, n_filled) = filled(feature, &flat(array), array)?;
    let values = arrow::compute::cast(&values, &feature.value_type)
        .map_err(DatasetError::arrow("build a column"))?;
    let array = match feature.form {
        Form::Scalar | Form::Picture => Arc::clone(&values),
        Form::Vector => Arc::new(
            FixedSizeListArray::try_new(
                schema::element(feature.value_type.clone()),
                i32::try_from(feature.width()).unwrap_or(i32::MAX),
                Arc::clone(&values),
                None,
            )
            .map_err(DatasetError::arrow("build a column"))?,
        ),
        Form::Tensor => nest(&values, &feature.shape)?,
    };
    Ok(Converted {
        array,
        values,
        n_filled,
    })
}

/// The values of a plain or list column.
fn flat(array: &ArrayRef) -> ArrayRef {
    match array.as_fixed_size_list_opt() {
        Some(list) => {
            let width = usize::try_from(list.value_length()).unwrap_or(0);
            let start = usize::try_from(list.value_offset(0)).unwrap_or(0);
            list.values().slice(start, list.len() * width)
        }
        None => Arc::clone(array),
    }
}

/// LeRobot knows no nulls: NaN, zero, false or no text stand in for them.
fn filled(feature: &Feature, values: &ArrayRef, rows: &ArrayRef) -> Result<(ArrayRef, u64)> {
    if values.null_count() == 0 && rows.null_count() == 0 {
        return Ok((Arc::clone(values), 0));
    }
    let width = feature.width().max(1);
    let is_there = |i: usize| !rows.is_null(i / width) && !values.is_null(i);
    let mask: Vec<bool> = (0..values.len()).map(is_there).collect();
    let n_filled = mask
        .chunks(width)
        .filter(|row| row.contains(&false))
        .count() as u64;
    let stand_in: ArrayRef = match values.data_type() {
        DataType::Float16 => Arc::new(Float16Array::from(vec![half::f16::NAN])),
        DataType::Float32 => Arc::new(Float32Array::from(vec![f32::NAN])),
        DataType::Float64 => Arc::new(Float64Array::from(vec![f64::NAN])),
        DataType::Utf8 => Arc::new(StringArray::from(vec![""])),
        other => arrow::compute::cast(&BooleanArray::from(vec![false]), other)
            .map_err(DatasetError::arrow("fill a column"))?,
    };
    let values = zip(&BooleanArray::from(mask), values, &Scalar::new(stand_in))
        .map_err(DatasetError::arrow("fill a column"))?;
    Ok((values, n_filled))
}

/// Values in C order as lists of lists: rows of this shape.
pub(super) fn nest(values: &ArrayRef, shape: &[usize]) -> Result<ArrayRef> {
    let mut array = Arc::clone(values);
    for &length in shape.iter().rev() {
        let n = array.len() / length.max(1);
        let offsets = OffsetBuffer::from_repeated_length(length, n);
        let element = schema::element(array.data_type().clone());
        let list = ListArray::try_new(element, offsets, array, None);
        array = Arc::new(list.map_err(DatasetError::arrow("build a column"))?);
    }
    Ok(array)
}

/// The values as floats, for statistics.
pub(super) fn numbers(values: &ArrayRef) -> Result<Vec<f64>> {
    let read = DatasetError::arrow("compute statistics");
    // There is no direct way from flags to floats of every width.
    let values = match values.data_type() {
        DataType::Boolean => arrow::compute::cast(values, &DataType::UInt8).map_err(&read)?,
        _ => Arc::clone(values),
    };
    let floats = arrow::compute::cast(&values, &DataType::Float64).map_err(read)?;
    Ok(floats.as_primitive::<Float64Type>().values().to_vec())
}

fn check_pictures(feature: &Feature, array: &ArrayRef, first_row: u64) -> Result<()> {
    let place = Place::new(&feature.name, first_row);
    if let Some(row) = first_null(array) {
        return Err(place.null(row));
    }
    for (row, bytes) in array.as_binary::<i32>().iter().enumerate() {
        let head = bytes.and_then(picture::head);
        let head = head.ok_or_else(|| {
            let row = first_row + row as u64;
            DatasetError::corrupt(format!(
                "row {row} of \"{}\" is neither a JPEG nor a PNG picture",
                feature.name
            ))
        })?;
        if head.shape() != feature.shape || head.depth != 8 {
            return Err(DatasetError::ShapeMismatch {
                key: feature.name.clone(),
                actual: head.shape(),
                expected: format!("{:?} of 8 bits", feature.shape),
            });
        }
    }
    Ok(())
}
