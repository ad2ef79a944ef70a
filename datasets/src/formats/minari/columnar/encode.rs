//! The rows of an episode as Minari's columns.

use std::collections::HashMap;
use std::sync::Arc;

use arrow::array::{
    Array, ArrayRef, AsArray, FixedSizeListArray, RecordBatch, StructArray, new_null_array,
};
use arrow::datatypes::{DataType, Field, Fields, Schema};

use super::super::write::Rows;
use super::super::write::columns::{Group, Leaf};
use super::super::write::tree::Node;
use crate::error::{DatasetError, Result};
use crate::formats::fill::{blank_row, concat, without_nulls};
use crate::sink::{LossEffect, LossTally};

/// Name of list elements, as pyarrow has it.
const ITEM: &str = "item";

/// Makes batches of a file from rows.
pub(super) struct Encoder {
    pub(super) observation: Group,
    pub(super) action: Group,
    pub(super) infos: Group,
}

type Column = (Field, ArrayRef);

impl Encoder {
    /// One batch of these rows, with the infos that `infos` says.
    ///
    /// # Errors
    /// Columns that do not go together.
    pub(super) fn batch(
        &self,
        rows: &Rows,
        infos: &[bool],
        losses: &mut LossTally,
    ) -> Result<RecordBatch> {
        let n_rows = rows.n_rows();
        let padded = |array: &ArrayRef| padded(array, n_rows);
        let actions = rows.actions.iter().map(padded);
        let mut columns = vec![
            group("observations", &self.observation, &rows.observations)?,
            group(
                "actions",
                &self.action,
                &actions.collect::<Result<Vec<_>>>()?,
            )?,
        ];
        for (name, array) in [
            ("rewards", &rows.rewards),
            ("terminations", &rows.terminations),
            ("truncations", &rows.truncations),
        ] {
            columns.push(stored(name, &padded(array)?)?);
        }
        columns.extend(self.infos(rows, infos, losses)?);
        let (fields, arrays): (Vec<Field>, Vec<ArrayRef>) = columns.into_iter().unzip();
        RecordBatch::try_new(Arc::new(Schema::new(fields)), arrays)
            .map_err(DatasetError::arrow("build an episode"))
    }

    /// The column of infos, if the episode has any.
    fn infos(
        &self,
        rows: &Rows,
        present: &[bool],
        losses: &mut LossTally,
    ) -> Result<Option<Column>> {
        let mut arrays = Vec::with_capacity(rows.infos.len());
        let leaves = self.infos.leaves.iter().zip(&rows.infos).zip(present);
        for ((leaf, array), is_present) in leaves {
            if !is_present {
                arrays.push(None);
                continue;
            }
            let (filled, n_filled) = without_nulls(array)?;
            let detail = "rows without a value got NaN, 0 or empty text";
            losses.add(&leaf.column, LossEffect::Invented, detail, n_filled);
            arrays.push(Some((leaf, filled)));
        }
        let leaf = |place: usize, name: &str| -> Result<Option<Column>> {
            let Some(Some((leaf, array))) = arrays.get(place) else {
                return Ok(None);
            };
            let (field, array) = stored(name, array)?;
            Ok(Some((with_shape(field, leaf), array)))
        };
        match &self.infos.tree {
            Some(tree) => nested(tree, "infos", &leaf),
            None => Ok(None),
        }
    }
}

/// A column of nested leaves, all of which are there.
fn group(name: &str, group: &Group, arrays: &[ArrayRef]) -> Result<Column> {
    let leaf = |place: usize, name: &str| match arrays.get(place) {
        Some(array) => stored(name, array).map(Some),
        None => Ok(None),
    };
    let column = match &group.tree {
        Some(tree) => nested(tree, name, &leaf)?,
        None => None,
    };
    column.ok_or(DatasetError::Empty)
}

/// Structs of leaves; `None` where there is none.
fn nested(
    node: &Node,
    name: &str,
    leaf: &dyn Fn(usize, &str) -> Result<Option<Column>>,
) -> Result<Option<Column>> {
    let parts: Vec<Column> = match node {
        Node::Leaf(place) => return leaf(*place, name),
        Node::Dict(parts) => {
            let parts = parts.iter().map(|(key, part)| nested(part, key, leaf));
            parts.filter_map(Result::transpose).collect::<Result<_>>()?
        }
        Node::Tuple(parts) => {
            let parts = parts.iter().enumerate();
            let parts = parts.map(|(index, part)| nested(part, &index.to_string(), leaf));
            parts.filter_map(Result::transpose).collect::<Result<_>>()?
        }
    };
    if parts.is_empty() {
        return Ok(None);
    }
    let (fields, arrays): (Vec<Field>, Vec<ArrayRef>) = parts.into_iter().unzip();
    let array = StructArray::try_new(Fields::from(fields), arrays, None)
        .map_err(DatasetError::arrow("build a nested column"))?;
    let field = Field::new(name, array.data_type().clone(), true);
    Ok(Some((field, Arc::new(array))))
}

/// A leaf, with list elements named as pyarrow names them.
fn stored(name: &str, array: &ArrayRef) -> Result<Column> {
    let array: ArrayRef = match array.as_fixed_size_list_opt() {
        None => array.clone(),
        Some(list) => {
            let child = Field::new(ITEM, list.value_type(), true);
            let (width, n_rows) = (list.value_length(), list.len());
            let list = FixedSizeListArray::try_new_with_length(
                Arc::new(child),
                width,
                Arc::clone(list.values()),
                list.nulls().cloned(),
                n_rows,
            );
            Arc::new(list.map_err(DatasetError::arrow("build a list column"))?)
        }
    };
    Ok((Field::new(name, array.data_type().clone(), true), array))
}

/// The shape of an info's rows stands beside its list, since no space has it.
fn with_shape(field: Field, leaf: &Leaf) -> Field {
    if leaf.shape.is_empty() {
        return field;
    }
    let shape: Vec<String> = leaf.shape.iter().map(ToString::to_string).collect();
    field.with_metadata(HashMap::from([("shape".to_owned(), shape.join(","))]))
}

/// Zeros after the last step, as Minari pads; text and pictures are null there.
fn padded(array: &ArrayRef, n_rows: usize) -> Result<ArrayRef> {
    let n_missing = n_rows.saturating_sub(array.len());
    if n_missing == 0 {
        return Ok(array.clone());
    }
    let row = match array.data_type() {
        DataType::Utf8 | DataType::Binary => new_null_array(array.data_type(), 1),
        other => blank_row(other, 0.0)?,
    };
    let mut parts = vec![array];
    parts.extend(std::iter::repeat_n(&row, n_missing));
    concat(&parts)
}
