//! Flat arrays with a row per step, as D4RL lays them out: keys, checks and columns, whatever file they lie in.

use std::sync::Arc;

use arrow::datatypes::DataType;

use super::policy::EpisodePolicy;
use crate::error::{DatasetError, Result};
use crate::formats::steps::{ArrayInfo, ColumnSource, LeafBuilder, RowRule, StepColumn};
use crate::schema;

pub(crate) const OBSERVATIONS: &str = "observations";
pub(crate) const ACTIONS: &str = "actions";
pub(crate) const REWARDS: &str = "rewards";
pub(crate) const TERMINALS: &str = "terminals";
pub(crate) const TIMEOUTS: &str = "timeouts";
pub(crate) const NEXT_OBSERVATIONS: &str = "next_observations";
pub(crate) const INFOS: &str = "infos";
pub(crate) const GOAL: &str = "infos/goal";
/// What every file has.
pub(crate) const REQUIRED: [&str; 4] = [OBSERVATIONS, ACTIONS, REWARDS, TERMINALS];

/// A file of arrays of the same length.
pub(crate) trait FlatArrays {
    /// Its arrays.
    fn infos(&self) -> Vec<ArrayInfo>;

    /// Their length.
    fn n_rows(&self) -> u64;

    /// The rows of an array that is there.
    ///
    /// # Errors
    /// It cannot be read.
    fn rows<'a>(&'a self, key: &str) -> Result<Box<dyn FlatRows + 'a>>;
}

/// The rows of one array, read in order.
pub(crate) trait FlatRows {
    /// Appends rows `start..start + n`.
    ///
    /// # Errors
    /// They cannot be read.
    fn append(&mut self, start: u64, n: usize, to: &mut LeafBuilder) -> Result<()>;
}

/// The error for a key that must be there.
pub(crate) fn missing<'k>(key: &str, found: impl Iterator<Item = &'k str>) -> DatasetError {
    DatasetError::MissingKey {
        key: key.to_owned(),
        found: found.collect::<Vec<_>>().join(", "),
    }
}

/// Whether an array of this key has a row per step in every file.
pub(crate) fn is_known(key: &str) -> bool {
    REQUIRED.contains(&key)
        || [TIMEOUTS, NEXT_OBSERVATIONS, INFOS].contains(&key)
        || key
            .strip_prefix(INFOS)
            .is_some_and(|rest| rest.starts_with('/'))
}

/// Checks the length of an array, and that rewards and flags are one value a row.
///
/// # Errors
/// [`DatasetError::LengthMismatch`] or [`DatasetError::ShapeMismatch`], naming the key.
pub(crate) fn check(array: &ArrayInfo, n_rows: u64) -> Result<()> {
    if array.n_rows != n_rows {
        return Err(DatasetError::LengthMismatch {
            key: array.key.clone(),
            actual: array.n_rows,
            expected: n_rows,
        });
    }
    if [REWARDS, TERMINALS, TIMEOUTS].contains(&array.key.as_str()) && !array.is_column() {
        return Err(DatasetError::ShapeMismatch {
            key: array.key.clone(),
            actual: array.row_shape.clone(),
            expected: "one value a row".to_owned(),
        });
    }
    Ok(())
}

/// The columns of the step table, canonical order.
pub(crate) fn columns(arrays: &[ArrayInfo], policy: EpisodePolicy) -> Vec<StepColumn> {
    let mut columns = Vec::new();
    let mut add = |key: &str, name: &str, rule: RowRule, role: Role| {
        if let Some(array) = arrays.iter().find(|array| array.key == key) {
            columns.push(column(array, name, rule, role, policy));
        }
    };
    add(
        OBSERVATIONS,
        schema::OBSERVATION,
        RowRule::Observation,
        Role::Values,
    );
    add(ACTIONS, schema::ACTION, RowRule::Step, Role::Values);
    add(REWARDS, schema::REWARD, RowRule::Step, Role::Values);
    add(TERMINALS, schema::TERMINATED, RowRule::Step, Role::Flag);
    add(TIMEOUTS, schema::TRUNCATED, RowRule::Step, Role::Flag);
    add(
        NEXT_OBSERVATIONS,
        schema::NEXT_OBSERVATION,
        RowRule::Step,
        Role::Other,
    );
    let known = [
        OBSERVATIONS,
        ACTIONS,
        REWARDS,
        TERMINALS,
        TIMEOUTS,
        NEXT_OBSERVATIONS,
    ];
    for array in arrays
        .iter()
        .filter(|array| !known.contains(&array.key.as_str()))
    {
        add(
            &array.key,
            &info_name(&array.key),
            RowRule::Step,
            Role::Other,
        );
    }
    columns
}

/// `info` for the dataset `infos`, `info.a.b` for `infos/a/b` and for any other key.
pub(crate) fn info_name(key: &str) -> String {
    let inside = match key.strip_prefix(INFOS) {
        Some("") => return schema::INFO.to_owned(),
        Some(rest) if rest.starts_with('/') => &rest[1..],
        _ => key,
    };
    inside
        .split('/')
        .fold(schema::INFO.to_owned(), |parent, part| {
            schema::join_key(&parent, part)
        })
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Role {
    /// Observation, action, reward: what `qlearning_dataset` casts to `float32`.
    Values,
    Flag,
    Other,
}

fn column(
    array: &ArrayInfo,
    name: &str,
    rule: RowRule,
    role: Role,
    policy: EpisodePolicy,
) -> StepColumn {
    let element = array.element;
    let nullable = rule != RowRule::Observation;
    // D4RL's loader squeezes (N, 1) rewards and flags.
    let squeezed = matches!(
        name,
        schema::REWARD | schema::TERMINATED | schema::TRUNCATED
    );
    let shape: &[usize] = if squeezed { &[] } else { &array.row_shape };
    let data_type = match role {
        Role::Flag => DataType::Boolean,
        Role::Values if policy == EpisodePolicy::D4rlQlearning => DataType::Float32,
        _ => element.data_type(),
    };
    let mut field = schema::leaf_field(name, data_type, shape, nullable);
    let converted = *field.data_type() != element.data_type() && shape.is_empty();
    let mut note = |key: &str, value: &str| {
        field
            .metadata_mut()
            .insert(key.to_owned(), value.to_owned());
    };
    if converted {
        note(schema::SOURCE_DTYPE, element.numpy_name());
    }
    if squeezed && array.row_shape == [1] {
        note(schema::SOURCE_SHAPE, "[1]");
    }
    // An array outside of the infos, which its column does not tell.
    if schema::belongs_to(name, schema::INFO) && !array.key.starts_with(INFOS) {
        note(schema::SOURCE_KEY, &array.key);
    }
    let source = ColumnSource {
        key: array.key.clone(),
        element,
        width: array.width(),
        rule,
    };
    StepColumn {
        field: Arc::new(field),
        source,
    }
}
