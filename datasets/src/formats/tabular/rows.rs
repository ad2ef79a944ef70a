//! Checks and conversions of one batch of a file.

use std::collections::{HashMap, HashSet};

use arrow::array::{
    Array, ArrayRef, AsArray, BooleanArray, FixedSizeListArray, Int64Array, OffsetSizeTrait,
};
use arrow::datatypes::{ArrowNativeType, DataType, Float64Type, Int64Type};

use super::columns::{ColumnPlan, Conversion, Role};
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
        let place = Place { name, first_row };
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
    let place = Place { name, first_row };
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
            let list = match array.data_type() {
                DataType::List(_) => place.fixed(array.as_list::<i32>(), width, plan)?,
                DataType::LargeList(_) => place.fixed(array.as_list::<i64>(), width, plan)?,
                _ => return Err(place.wrong_type(array)),
            };
            place.check_nulls(&list, plan)?;
            Ok(list)
        }
        Conversion::None => {
            place.check_nulls(array, plan)?;
            relabel(array, plan)
        }
    }
}

/// A column and the file row its batch starts at.
struct Place<'a> {
    name: &'a str,
    first_row: u64,
}

impl Place<'_> {
    fn row(&self, row: usize) -> u64 {
        self.first_row + row as u64
    }

    fn null(&self, row: usize) -> DatasetError {
        DatasetError::NullValue {
            column: self.name.to_owned(),
            row: self.row(row),
        }
    }

    fn wrong_type(&self, array: &ArrayRef) -> DatasetError {
        DatasetError::WrongType {
            key: self.name.to_owned(),
            actual: array.data_type().to_string(),
            expected: "the type of the file's schema",
        }
    }

    fn index(&self, array: &ArrayRef) -> Result<ArrayRef> {
        // A cast turns what does not fit into a null.
        let cast = arrow::compute::cast(array, &DataType::Int64)
            .map_err(DatasetError::arrow("read an integer column"))?;
        match first_null(&cast) {
            Some(row) => Err(self.null(row)),
            None => Ok(cast),
        }
    }

    fn flag(&self, array: &ArrayRef) -> Result<ArrayRef> {
        if *array.data_type() == DataType::Boolean {
            return Ok(array.clone());
        }
        let numbers = arrow::compute::cast(array, &DataType::Float64)
            .map_err(DatasetError::arrow("read a flag column"))?;
        let numbers = numbers.as_primitive::<Float64Type>();
        let mut flags = Vec::with_capacity(numbers.len());
        for (row, value) in numbers.iter().enumerate() {
            if value.is_some_and(f64::is_nan) {
                return Err(DatasetError::NanFlag {
                    column: self.name.to_owned(),
                    row: self.row(row),
                });
            }
            flags.push(value.map(|value| value != 0.0));
        }
        Ok(std::sync::Arc::new(BooleanArray::from(flags)))
    }

    fn fixed<O: OffsetSizeTrait>(
        &self,
        list: &arrow::array::GenericListArray<O>,
        width: usize,
        plan: &ColumnPlan,
    ) -> Result<ArrayRef> {
        for row in (0..list.len()).filter(|&row| !list.is_null(row)) {
            let actual = list.value_length(row).as_usize();
            if actual != width {
                let (column, row) = (self.name.to_owned(), self.row(row));
                return Err(DatasetError::RaggedList {
                    column,
                    row,
                    actual,
                    expected: width,
                });
            }
        }
        let DataType::FixedSizeList(child, size) = plan.field.data_type() else {
            return Err(DatasetError::corrupt("a list column changed its type"));
        };
        let values = if list.null_count() == 0 {
            let start = list.value_offsets()[0].as_usize();
            list.values().slice(start, list.len() * width)
        } else {
            self.spread(list, width)?
        };
        let array = FixedSizeListArray::try_new_with_length(
            child.clone(),
            *size,
            values,
            list.nulls().cloned(),
            list.len(),
        );
        Ok(std::sync::Arc::new(
            array.map_err(DatasetError::arrow("read a list column"))?,
        ))
    }

    /// The values with room for the null rows.
    fn spread<O: OffsetSizeTrait>(
        &self,
        list: &arrow::array::GenericListArray<O>,
        width: usize,
    ) -> Result<ArrayRef> {
        let mut take: Vec<Option<i64>> = Vec::with_capacity(list.len() * width);
        for row in 0..list.len() {
            let start = list.value_offsets()[row].as_usize();
            let null = list.is_null(row);
            take.extend((start..start + width).map(|i| i64::try_from(i).ok().filter(|_| !null)));
        }
        arrow::compute::take(list.values(), &Int64Array::from(take), None)
            .map_err(DatasetError::arrow("read a list column"))
    }

    /// Observations have no nulls; lists have none inside a row that is there.
    fn check_nulls(&self, array: &ArrayRef, plan: &ColumnPlan) -> Result<()> {
        if plan.role == Role::Observation
            && let Some(row) = first_null(array)
        {
            return Err(self.null(row));
        }
        if plan.role == Role::Other {
            return Ok(());
        }
        let Some(list) = array.as_fixed_size_list_opt() else {
            return Ok(());
        };
        let width = usize::try_from(list.value_length()).unwrap_or(0);
        let Some(nulls) = list.values().nulls().filter(|nulls| nulls.null_count() > 0) else {
            return Ok(());
        };
        let start = usize::try_from(list.value_offset(0)).unwrap_or(0);
        let inside = |row: usize| (0..width).any(|i| nulls.is_null(start + row * width + i));
        match (0..list.len()).find(|&row| !list.is_null(row) && inside(row)) {
            Some(row) => Err(self.null(row)),
            None => Ok(()),
        }
    }
}

/// Gives the array the canonical field's type where only labels differ (the name of the list element).
fn relabel(array: &ArrayRef, plan: &ColumnPlan) -> Result<ArrayRef> {
    if array.data_type() == plan.field.data_type() {
        return Ok(array.clone());
    }
    arrow::compute::cast(array, plan.field.data_type())
        .map_err(DatasetError::arrow("read a column"))
}

fn first_null(array: &ArrayRef) -> Option<usize> {
    let nulls = array.nulls().filter(|nulls| nulls.null_count() > 0)?;
    (0..array.len()).find(|&row| nulls.is_null(row))
}

/// Checks that a null action stands only in the last row of its episode.
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
