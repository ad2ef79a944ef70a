//! A column of a batch: checks that name the row.

use arrow::array::{Array, ArrayRef, AsArray, BooleanArray, Int64Array, OffsetSizeTrait};
use arrow::datatypes::{DataType, Float64Type};

use super::columns::Role;
use crate::error::{DatasetError, Result};

/// A column and the file row its batch starts at.
#[derive(Clone, Copy)]
pub(crate) struct Place<'a> {
    name: &'a str,
    first_row: u64,
    /// Entries of the array at hand that belong to one row: more than one inside nested lists.
    per_row: usize,
}

impl<'a> Place<'a> {
    pub(crate) fn new(name: &'a str, first_row: u64) -> Self {
        Self {
            name,
            first_row,
            per_row: 1,
        }
    }

    fn row(&self, entry: usize) -> u64 {
        self.first_row + (entry / self.per_row) as u64
    }

    pub(crate) fn null(&self, row: usize) -> DatasetError {
        DatasetError::NullValue {
            column: self.name.to_owned(),
            row: self.row(row),
        }
    }

    pub(crate) fn wrong_type(&self, array: &ArrayRef) -> DatasetError {
        DatasetError::WrongType {
            key: self.name.to_owned(),
            actual: array.data_type().to_string(),
            expected: "the type of the file's schema",
        }
    }

    /// Integers as `Int64`, without nulls.
    ///
    /// # Errors
    /// [`DatasetError::NullValue`] for a null, or a number that does not fit.
    pub(crate) fn index(&self, array: &ArrayRef) -> Result<ArrayRef> {
        // A cast turns what does not fit into a null.
        let cast = arrow::compute::cast(array, &DataType::Int64)
            .map_err(DatasetError::arrow("read an integer column"))?;
        match first_null(&cast) {
            Some(row) => Err(self.null(row)),
            None => Ok(cast),
        }
    }

    /// Numbers or booleans as flags: `value != 0`.
    ///
    /// # Errors
    /// [`DatasetError::NanFlag`].
    pub(crate) fn flag(&self, array: &ArrayRef) -> Result<ArrayRef> {
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

    /// The values of nested lists whose rows all have `shape`, in C order; a null row has room for its values.
    ///
    /// # Errors
    /// [`DatasetError::RaggedList`] for a list of another length, or the column has no such lists.
    pub(crate) fn nested_values(&self, array: &ArrayRef, shape: &[usize]) -> Result<ArrayRef> {
        let mut place = *self;
        let mut values = array.clone();
        for &width in shape {
            values = place.list_values(&values, width)?;
            place.per_row = place.per_row.saturating_mul(width).max(1);
        }
        Ok(values)
    }

    pub(super) fn list_values(&self, array: &ArrayRef, width: usize) -> Result<ArrayRef> {
        match array.data_type() {
            DataType::List(_) => self.values(array.as_list::<i32>(), width),
            DataType::LargeList(_) => self.values(array.as_list::<i64>(), width),
            DataType::FixedSizeList(_, size) => {
                let list = array.as_fixed_size_list();
                let actual = usize::try_from(*size).unwrap_or(0);
                if actual != width {
                    return Err(self.ragged(0, actual, width));
                }
                let start = usize::try_from(list.value_offset(0)).unwrap_or(0);
                Ok(list.values().slice(start, list.len() * width))
            }
            _ => Err(self.wrong_type(array)),
        }
    }

    fn ragged(&self, entry: usize, actual: usize, expected: usize) -> DatasetError {
        DatasetError::RaggedList {
            column: self.name.to_owned(),
            row: self.row(entry),
            actual,
            expected,
        }
    }

    fn values<O: OffsetSizeTrait>(
        &self,
        list: &arrow::array::GenericListArray<O>,
        width: usize,
    ) -> Result<ArrayRef> {
        for row in (0..list.len()).filter(|&row| !list.is_null(row)) {
            let actual = list.value_length(row).as_usize();
            if actual != width {
                return Err(self.ragged(row, actual, width));
            }
        }
        match list.null_count() {
            0 => {
                let start = list.value_offsets()[0].as_usize();
                Ok(list.values().slice(start, list.len() * width))
            }
            _ => self.spread(list, width),
        }
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
    ///
    /// # Errors
    /// [`DatasetError::NullValue`].
    pub(crate) fn check_nulls(&self, array: &ArrayRef, role: Role) -> Result<()> {
        if role == Role::Observation
            && let Some(row) = first_null(array)
        {
            return Err(self.null(row));
        }
        if role == Role::Other {
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

/// The first row that is null.
pub(crate) fn first_null(array: &ArrayRef) -> Option<usize> {
    let nulls = array.nulls().filter(|nulls| nulls.null_count() > 0)?;
    (0..array.len()).find(|&row| nulls.is_null(row))
}
