//! Comparing next observations with observations.

use arrow::array::{Array as _, ArrayData};
use arrow::datatypes::{DataType, Field};

use super::demos::{NEXT_OBS, OBS};
use crate::error::{DatasetError, Result};
use crate::formats::hdf5::{Array, Element, H5File, LeafBuilder, join};

/// Bytes compared at a time.
const BYTES_AT_ONCE: usize = 8 << 20;

/// Whether row i of a next observation is row i + 1 of the observation, for all rows but the last.
///
/// # Errors
/// They cannot be read, or have other types.
pub(super) fn is_shifted(file: &H5File, group: &str, path: &str) -> Result<bool> {
    let observation = format!("{OBS}{}", path.strip_prefix(NEXT_OBS).unwrap_or(path));
    if !file.root().link_exists(&join(group, &observation)) {
        return Ok(false);
    }
    let (before, after) = (
        file.array(&join(group, &observation))?,
        file.array(&join(group, path))?,
    );
    if before.element() != after.element() || before.row_shape() != after.row_shape() {
        return Err(DatasetError::ShapeMismatch {
            key: after.key().to_owned(),
            actual: after.row_shape().to_vec(),
            expected: format!("type and shape of \"{}\"", before.key()),
        });
    }
    let row_bytes = before.width().saturating_mul(8).max(1);
    let at_once = (BYTES_AT_ONCE / row_bytes).max(1) as u64;
    let n_pairs = after.n_rows().min(before.n_rows()).saturating_sub(1);
    let mut start = 0;
    while start < n_pairs {
        let n = usize::try_from(at_once.min(n_pairs - start)).unwrap_or(1);
        if flat(&before, start + 1, n)? != flat(&after, start, n)? {
            return Ok(false);
        }
        start += n as u64;
    }
    Ok(true)
}

fn flat(array: &Array, start: u64, n: usize) -> Result<ArrayData> {
    let mut builder = LeafBuilder::new(array.element(), array.width(), n);
    builder.append(array, start, n)?;
    let data_type = match array.element() {
        Element::Bool => DataType::Int8,
        element => element.data_type(),
    };
    Ok(builder
        .finish(&Field::new(array.key(), data_type, true))?
        .to_data())
}
