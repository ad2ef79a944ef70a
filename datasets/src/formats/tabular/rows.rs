//! Checks and conversions of one batch of a file.

use std::collections::{HashMap, HashSet};

use arrow::array::{Array, ArrayRef, AsArray, FixedSizeListArray, Int64Array};
use arrow::datatypes::{ArrowNativeType, DataType, Int64Type};

use super::columns::{ColumnPlan, Conversion};
use super::place::{Place, first_null};
use crate::error::{DatasetError, Result};
use crate::schema;

/// What has been seen of the episodes so far.
#[derive(Debug, Default)]
pub(crate) struct EpisodeTracker {
    finished: HashSet<i64>,
    current: Option<(i64, i64)>,
    /// Rows before the batch at hand.
    pub(crate) first_row: u64,
}

impl EpisodeTracker {
    /// Episode and step columns of the next `n_rows`, checked.
    ///
    /// # Errors
    /// An episode that comes back, or steps that do not ascend.
    pub(crate) fn rows(
        &mut self,
        n_rows: usize,
        episode: Option<(&str, &Int64Array)>,
        step: Option<(&str, &Int64Array)>,
    ) -> Result<(Int64Array, Int64Array)> {
        let mut steps = Vec::with_capacity(n_rows);
        let mut episodes = Vec::with_capacity(n_rows);
        for row in 0..n_rows {
            let number = episode.map_or(0, |(_, values)| values.value(row));
            let recorded = step.map(|(_, values)| values.value(row));
            let previous = self
                .current
                .filter(|(current, _)| *current == number)
                .map(|(_, step)| step);
            if previous.is_none() {
                self.start(number, episode.map_or("", |(name, _)| name), row)?;
            }
            let actual =
                recorded.unwrap_or_else(|| previous.map_or(0, |step| step.saturating_add(1)));
            if let (Some(previous), Some((name, _))) = (previous, step)
                && actual <= previous
            {
                let row = self.first_row + row as u64;
                return Err(DatasetError::StepOrder {
                    column: name.to_owned(),
                    row,
                    previous,
                    actual,
                });
            }
            self.current = Some((number, actual));
            steps.push(actual);
            episodes.push(number);
        }
        self.first_row += n_rows as u64;
        Ok((episodes.into(), steps.into()))
    }

    fn start(&mut self, number: i64, column: &str, row: usize) -> Result<()> {
        if let Some((current, _)) = self.current.take() {
            self.finished.insert(current);
        }
        if self.finished.contains(&number) {
            return Err(DatasetError::NonContiguousEpisode {
                column: column.to_owned(),
                row: self.first_row + row as u64,
                episode: number,
            });
        }
        Ok(())
    }
}

/// Numbers of the episodes that have text for an id, in order of appearance. Grows with the episodes, not with
/// the rows.
#[derive(Debug, Default)]
pub(crate) struct EpisodeNames(HashMap<String, i64>);

impl EpisodeNames {
    /// The number of every row's episode; `first_row` is the batch's place in the file.
    ///
    /// # Errors
    /// [`DatasetError::NullValue`] for a row without a text.
    pub(crate) fn numbers(
        &mut self,
        name: &str,
        array: &ArrayRef,
        first_row: u64,
    ) -> Result<ArrayRef> {
        let place = Place::new(name, first_row);
        let text = arrow::compute::cast(array, &DataType::Utf8)
            .map_err(DatasetError::arrow("read a text column"))?;
        if let Some(row) = first_null(&text) {
            return Err(place.null(row));
        }
        let mut numbers = Vec::with_capacity(text.len());
        for text in text.as_string::<i32>().iter().flatten() {
            let number = match self.0.get(text) {
                Some(&number) => number,
                None => {
                    let next = i64::try_from(self.0.len()).unwrap_or(i64::MAX);
                    self.0.insert(text.to_owned(), next);
                    next
                }
            };
            numbers.push(number);
        }
        Ok(std::sync::Arc::new(Int64Array::from(numbers)))
    }
}

/// Converts one column of a batch whose first row is `first_row` of the file.
///
/// # Errors
/// Nulls where there may be none, ragged lists, NaN flags.
pub(crate) fn convert(
    plan: &ColumnPlan,
    name: &str,
    array: &ArrayRef,
    first_row: u64,
) -> Result<ArrayRef> {
    let place = Place::new(name, first_row);
    match plan.conversion {
        Conversion::Index => place.index(array),
        // Numbered over all batches by `EpisodeNames`.
        Conversion::Name => Err(place.wrong_type(array)),
        Conversion::Flag => place.flag(array),
        Conversion::List => {
            let DataType::FixedSizeList(_, width) = plan.field.data_type() else {
                return Err(place.wrong_type(array));
            };
            let width = usize::try_from(*width).unwrap_or(0);
            let list = fixed(place, array, width, plan)?;
            place.check_nulls(&list, plan.role)?;
            Ok(list)
        }
        Conversion::None => {
            place.check_nulls(array, plan.role)?;
            relabel(array, plan)
        }
    }
}

/// A list column with the canonical field's width.
fn fixed(place: Place<'_>, array: &ArrayRef, width: usize, plan: &ColumnPlan) -> Result<ArrayRef> {
    let DataType::FixedSizeList(child, size) = plan.field.data_type() else {
        return Err(DatasetError::corrupt("a list column changed its type"));
    };
    let list = FixedSizeListArray::try_new_with_length(
        child.clone(),
        *size,
        place.list_values(array, width)?,
        array.nulls().cloned(),
        array.len(),
    );
    Ok(std::sync::Arc::new(
        list.map_err(DatasetError::arrow("read a list column"))?,
    ))
}

/// Gives the array the canonical field's type where only labels differ (the name of the list element).
fn relabel(array: &ArrayRef, plan: &ColumnPlan) -> Result<ArrayRef> {
    if array.data_type() == plan.field.data_type() {
        return Ok(array.clone());
    }
    arrow::compute::cast(array, plan.field.data_type())
        .map_err(DatasetError::arrow("read a column"))
}

/// Checks that a null (of an action, reward or flag) stands only in the last row of its episode.
///
/// `pending` carries the null row that ends a batch over to the next one.
///
/// # Errors
/// [`DatasetError::NullValue`] for a null inside an episode.
pub(crate) fn check_action(
    name: &str,
    action: &ArrayRef,
    episodes: &Int64Array,
    pending: &mut Option<(i64, u64)>,
    first_row: u64,
) -> Result<()> {
    let null = |row| {
        Err(DatasetError::NullValue {
            column: name.to_owned(),
            row,
        })
    };
    if let Some((episode, row)) = pending.take()
        && !episodes.is_empty()
        && episodes.value(0) == episode
    {
        return null(row);
    }
    let Some(nulls) = action.nulls().filter(|nulls| nulls.null_count() > 0) else {
        return Ok(());
    };
    for row in (0..action.len()).filter(|&row| nulls.is_null(row)) {
        if row + 1 == action.len() {
            *pending = Some((episodes.value(row), first_row + row as u64));
        } else if episodes.value(row) == episodes.value(row + 1) {
            return null(first_row + row as u64);
        }
    }
    Ok(())
}

/// The canonical index column of a converted array.
pub(crate) fn as_index(array: &ArrayRef) -> &Int64Array {
    array.as_primitive::<Int64Type>()
}

/// Width of a list column as its first row has it.
pub(crate) fn first_width(array: &ArrayRef) -> Option<usize> {
    match array.data_type() {
        DataType::List(_) => {
            let list = array.as_list::<i32>();
            (0..list.len())
                .find(|&row| !list.is_null(row))
                .map(|row| list.value_length(row).as_usize())
        }
        DataType::LargeList(_) => {
            let list = array.as_list::<i64>();
            (0..list.len())
                .find(|&row| !list.is_null(row))
                .map(|row| list.value_length(row).as_usize())
        }
        _ => None,
    }
}

/// The field of a list column, once its width is known.
pub(crate) fn with_width(plan: &ColumnPlan, width: usize) -> Result<ColumnPlan> {
    let DataType::FixedSizeList(child, _) = plan.field.data_type() else {
        return Ok(plan.clone());
    };
    let nullable = plan.field.is_nullable();
    let field = schema::leaf_field(
        plan.field.name(),
        child.data_type().clone(),
        &[width],
        nullable,
    );
    if width == 0 || i32::try_from(width).is_err() {
        return Err(DatasetError::ShapeMismatch {
            key: plan.field.name().clone(),
            actual: vec![width],
            expected: "at least one value and at most 2^31".to_owned(),
        });
    }
    Ok(ColumnPlan {
        field: std::sync::Arc::new(field),
        ..plan.clone()
    })
}
