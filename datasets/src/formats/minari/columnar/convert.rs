//! Leaves of a file's batch as canonical columns.

use std::sync::Arc;

use arrow::array::{
    Array, ArrayRef, AsArray, BooleanArray, FixedSizeListArray, RecordBatch, new_null_array,
};
use arrow::buffer::NullBuffer;
use arrow::datatypes::DataType;

use super::leaves::{Leaf, Rule, wrong_type};
use crate::error::{DatasetError, Result};

/// The column of `leaf` in a batch whose first row is `first_row` of the episode. Rows from `n_steps` on are
/// the padding after the last step.
///
/// # Errors
/// A null where a value must be, or another type than in the first episode.
pub(super) fn column(
    leaf: &Leaf,
    batch: &RecordBatch,
    first_row: u64,
    n_steps: u64,
) -> Result<ArrayRef> {
    let Some((array, parents)) = find(leaf, batch) else {
        if leaf.rule == Rule::Info {
            return Ok(new_null_array(leaf.field.data_type(), batch.num_rows()));
        }
        return Err(DatasetError::MissingKey {
            key: leaf.path.join("/"),
            found: crate::schema::column_names(&batch.schema()),
        });
    };
    if !same_type(array.data_type(), &leaf.stored) {
        let expected = "the type it has in the first episode";
        return Err(wrong_type(&leaf.path, array.data_type(), expected));
    }
    let nulls = NullBuffer::union(parents.as_ref(), array.nulls());
    let array = relabelled(leaf, &array, nulls)?;
    let n_valid = n_steps.saturating_sub(first_row);
    let n_valid = usize::try_from(n_valid)
        .unwrap_or(usize::MAX)
        .min(array.len());
    check_nulls(leaf, &array, n_valid, first_row)?;
    if leaf.rule != Rule::Step || n_valid == array.len() {
        return Ok(array);
    }
    let padding: BooleanArray = (0..array.len()).map(|row| Some(row >= n_valid)).collect();
    arrow::compute::nullif(&array, &padding).map_err(DatasetError::arrow("mark the padding"))
}

/// The leaf's array, and the nulls of the structs around it.
fn find(leaf: &Leaf, batch: &RecordBatch) -> Option<(ArrayRef, Option<NullBuffer>)> {
    let (root, inner) = leaf.path.split_first()?;
    let mut array = Arc::clone(batch.column_by_name(root)?);
    let mut nulls = None;
    for name in inner {
        let parent = array.as_struct_opt()?;
        nulls = NullBuffer::union(nulls.as_ref(), parent.nulls());
        let child = Arc::clone(parent.column_by_name(name)?);
        array = child;
    }
    Some((array, nulls))
}

/// Equal but for the name of list elements.
fn same_type(a: &DataType, b: &DataType) -> bool {
    match (a, b) {
        (DataType::FixedSizeList(a, n), DataType::FixedSizeList(b, m)) => {
            n == m && a.data_type() == b.data_type()
        }
        _ => a == b,
    }
}

/// The array in the canonical field's type, null where `nulls` has it.
fn relabelled(leaf: &Leaf, array: &ArrayRef, nulls: Option<NullBuffer>) -> Result<ArrayRef> {
    if let (DataType::FixedSizeList(child, size), Some(list)) =
        (leaf.field.data_type(), array.as_fixed_size_list_opt())
    {
        let list = FixedSizeListArray::try_new_with_length(
            Arc::clone(child),
            *size,
            Arc::clone(list.values()),
            nulls,
            list.len(),
        );
        return Ok(Arc::new(
            list.map_err(DatasetError::arrow("read a list column"))?,
        ));
    }
    let array = arrow::compute::cast(array, leaf.field.data_type())
        .map_err(DatasetError::arrow("read a column"))?;
    let Some(nulls) = nulls.filter(|nulls| nulls.null_count() > array.null_count()) else {
        return Ok(array);
    };
    let absent: BooleanArray = nulls.iter().map(|valid| Some(!valid)).collect();
    arrow::compute::nullif(&array, &absent).map_err(DatasetError::arrow("read a column"))
}

/// Observations have no nulls; actions, rewards and flags only in the padding.
fn check_nulls(leaf: &Leaf, array: &ArrayRef, n_valid: usize, first_row: u64) -> Result<()> {
    let checked = match leaf.rule {
        Rule::Observation => array.len(),
        Rule::Step => n_valid,
        Rule::Info => return Ok(()),
    };
    let list = array.as_fixed_size_list_opt();
    let inner = list.and_then(|list| {
        let nulls = list.values().nulls()?;
        let width = usize::try_from(list.value_length()).ok()?;
        (nulls.null_count() > 0).then_some((nulls, width))
    });
    let is_null = |row: &usize| {
        array.is_null(*row)
            || inner.is_some_and(|(nulls, width)| {
                (row * width..(row + 1) * width).any(|i| nulls.is_null(i))
            })
    };
    if array.null_count() == 0 && inner.is_none() {
        return Ok(());
    }
    match (0..checked).find(is_null) {
        Some(row) => Err(DatasetError::NullValue {
            column: leaf.path.join("/"),
            row: first_row + row as u64,
        }),
        None => Ok(()),
    }
}
