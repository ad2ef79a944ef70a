//! Rows that stand for nothing.

use std::sync::Arc;

use arrow::array::{
    Array, ArrayRef, BinaryArray, BooleanArray, FixedSizeListArray, Float64Array, Int8Array,
    StringArray, UInt64Array,
};
use arrow::datatypes::DataType;

use crate::error::{DatasetError, Result};

/// One row of zeros (floats: `float`), of empty text or bytes.
///
/// # Errors
/// A type that is no column of an episode.
pub(crate) fn blank_row(data_type: &DataType, float: f64) -> Result<ArrayRef> {
    blank(data_type, float, 1)
}

fn blank(data_type: &DataType, float: f64, n: usize) -> Result<ArrayRef> {
    let cast = |array: ArrayRef| {
        arrow::compute::cast(&array, data_type).map_err(DatasetError::arrow("fill a row"))
    };
    Ok(match data_type {
        DataType::FixedSizeList(child, size) => {
            let width = usize::try_from(*size).unwrap_or(0);
            let values = blank(child.data_type(), float, n * width)?;
            let list = FixedSizeListArray::try_new(child.clone(), *size, values, None);
            Arc::new(list.map_err(DatasetError::arrow("fill a row"))?)
        }
        DataType::Boolean => Arc::new(BooleanArray::from(vec![false; n])),
        DataType::Utf8 => Arc::new(StringArray::from(vec![""; n])),
        DataType::Binary => Arc::new(BinaryArray::from(vec![&b""[..]; n])),
        other if other.is_floating() => cast(Arc::new(Float64Array::from(vec![float; n])))?,
        _ => cast(Arc::new(Int8Array::from(vec![0; n])))?,
    })
}

/// The array with blank rows (floats: NaN) in place of null ones, and how many those were.
///
/// # Errors
/// A type that is no column of an episode.
pub(crate) fn without_nulls(array: &ArrayRef) -> Result<(ArrayRef, u64)> {
    let n_nulls = array.null_count();
    if n_nulls == 0 {
        return Ok((array.clone(), 0));
    }
    let blank = blank_row(array.data_type(), f64::NAN)?;
    let both = concat(&[array, &blank])?;
    let last = array.len() as u64;
    let rows: UInt64Array = (0..last)
        .zip(0..array.len())
        .map(|(row, place)| Some(if array.is_null(place) { last } else { row }))
        .collect();
    let filled =
        arrow::compute::take(&both, &rows, None).map_err(DatasetError::arrow("fill rows"))?;
    Ok((filled, n_nulls as u64))
}

/// Arrays of one type, one after another.
///
/// # Errors
/// They have different types.
pub(crate) fn concat(arrays: &[&ArrayRef]) -> Result<ArrayRef> {
    let arrays: Vec<&dyn Array> = arrays.iter().map(|array| array.as_ref()).collect();
    arrow::compute::concat(&arrays).map_err(DatasetError::arrow("put rows together"))
}

#[cfg(test)]
mod tests {
    use arrow::array::{AsArray, Float32Array};
    use arrow::datatypes::Float32Type;

    use super::*;

    #[test]
    fn nulls_become_nan_and_nothing_else_changes() {
        let array: ArrayRef = Arc::new(Float32Array::from(vec![Some(1.0), None, Some(-0.0)]));
        let (filled, n) = without_nulls(&array).unwrap();
        let values = filled.as_primitive::<Float32Type>().values();
        assert_eq!((n, filled.null_count()), (1, 0));
        assert!(values[0] == 1.0 && values[1].is_nan() && values[2].is_sign_negative());
    }
}
