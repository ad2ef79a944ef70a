//! Checks and conversions of one batch of a data file.

use std::sync::Arc;

use arrow::array::{
    Array, ArrayRef, AsArray, BinaryArray, FixedSizeListArray, Int64Array, RecordBatch,
    StringBuilder,
};
use arrow::datatypes::{DataType, Float64Type, Int64Type};

use super::columns::{Column, Conversion, FRAME_INDEX, INDEX, TASK_INDEX, TIMESTAMP, value_type};
use super::episodes;
use super::picture;
use super::tasks::Tasks;
use crate::error::{DatasetError, Result};
use crate::formats::tabular::Role;
use crate::formats::tabular::place::{Place, first_null};
use crate::schema;

/// A run of rows of one episode inside a batch.
#[derive(Debug, Clone, Copy)]
pub(super) struct Run {
    pub(super) episode: episodes::Place,
    /// Step of the first row.
    pub(super) first_step: u64,
    pub(super) n_rows: usize,
}

/// A batch as the file has it, and what its rows must be.
pub(super) struct Rows<'a> {
    pub(super) batch: &'a RecordBatch,
    pub(super) runs: Vec<Run>,
    pub(super) fps: f64,
    pub(super) tasks: &'a Tasks,
}

impl Rows<'_> {
    /// Episode and step of every row, checked against the file's index columns.
    ///
    /// # Errors
    /// [`DatasetError::Corrupt`] naming the first row whose episode, step or index is another than expected.
    pub(super) fn indices(&self) -> Result<(ArrayRef, ArrayRef)> {
        let n_rows = self.batch.num_rows();
        let mut episodes = Vec::with_capacity(n_rows);
        let mut steps = Vec::with_capacity(n_rows);
        let mut indices = Vec::with_capacity(n_rows);
        for run in &self.runs {
            let first = i64::try_from(run.first_step).unwrap_or(i64::MAX);
            episodes.resize(episodes.len() + run.n_rows, run.episode.number);
            steps.extend(
                (0i64..)
                    .take(run.n_rows)
                    .map(|row| first.saturating_add(row)),
            );
            let from = run.episode.first_index.saturating_add(first);
            indices.extend(
                (0i64..)
                    .take(run.n_rows)
                    .map(|row| from.saturating_add(row)),
            );
        }
        self.check(schema::EPISODE_INDEX, &episodes)?;
        self.check(FRAME_INDEX, &steps)?;
        if self.batch.column_by_name(INDEX).is_some() {
            self.check(INDEX, &indices)?;
        }
        Ok((
            Arc::new(Int64Array::from(episodes)),
            Arc::new(Int64Array::from(steps)),
        ))
    }

    fn check(&self, name: &str, expected: &[i64]) -> Result<()> {
        let array = self.column(name)?;
        let place = Place::new(name, 0);
        if !array.data_type().is_integer() {
            return Err(place.wrong_type(array));
        }
        let actual = place.index(array).map_err(|error| self.in_row(error))?;
        let actual = actual.as_primitive::<Int64Type>().values();
        let differs = actual.iter().zip(expected).position(|(a, e)| a != e);
        match differs {
            None => Ok(()),
            Some(row) => {
                let (actual, expected) = (actual[row], expected[row]);
                let row = self.file_row(row);
                Err(DatasetError::corrupt(format!(
                    "row {row} of \"{name}\" is {actual}, expected {expected}"
                )))
            }
        }
    }

    /// Puts the row of the file in the place of the row of the batch: there may be gaps between the runs.
    fn in_row(&self, mut error: DatasetError) -> DatasetError {
        if let DatasetError::NullValue { row, .. }
        | DatasetError::RaggedList { row, .. }
        | DatasetError::NanFlag { row, .. } = &mut error
        {
            *row = self.file_row(usize::try_from(*row).unwrap_or(usize::MAX));
        }
        error
    }

    /// Row in the file of a row of the batch.
    fn file_row(&self, row: usize) -> u64 {
        let mut before = 0;
        for run in &self.runs {
            if row < before + run.n_rows {
                return run.episode.first_row + run.first_step + (row - before) as u64;
            }
            before += run.n_rows;
        }
        row as u64
    }

    fn column(&self, name: &str) -> Result<&ArrayRef> {
        crate::episode::column(self.batch, name)
    }

    /// The canonical column; `steps` are those of [`Self::indices`].
    ///
    /// # Errors
    /// A null where a value must be, lists of another length, another type than in the first file, a task or
    /// picture that cannot be.
    pub(super) fn convert(&self, column: &Column, steps: &ArrayRef) -> Result<ArrayRef> {
        self.converted(column, steps)
            .map_err(|error| self.in_row(error))
    }

    fn converted(&self, column: &Column, steps: &ArrayRef) -> Result<ArrayRef> {
        let array = self.column(&column.feature)?;
        let place = Place::new(&column.feature, 0);
        if value_type(array.data_type()) != column.stored {
            return Err(DatasetError::WrongType {
                key: column.feature.clone(),
                actual: array.data_type().to_string(),
                expected: "the type it has in the first file",
            });
        }
        let converted = match column.conversion {
            Conversion::Picture => self.pictures(column, array)?,
            Conversion::Values => values(column, array, place)?,
            Conversion::Flag => place.flag(&scalars(array, place)?)?,
            Conversion::Time => self.times(&scalars(array, place)?, steps)?,
            Conversion::Task => self.task_texts(&scalars(array, place)?)?,
        };
        let role = role(column.field.name());
        // In LeRobot every row is a step, and a step has no nulls but in what is recorded beside it.
        if role != Role::Other
            && let Some(row) = first_null(&converted)
        {
            return Err(DatasetError::NullValue {
                column: column.feature.clone(),
                row: row as u64,
            });
        }
        place.check_nulls(&converted, role)?;
        Ok(converted)
    }

    /// `frame_index / fps` to the nanosecond where the timestamp is that number at its precision, else the
    /// timestamp itself.
    fn times(&self, seconds: &ArrayRef, steps: &ArrayRef) -> Result<ArrayRef> {
        let seconds = arrow::compute::cast(seconds, &DataType::Float64)
            .map_err(DatasetError::arrow("read a column"))?;
        let seconds = seconds.as_primitive::<Float64Type>();
        let steps = steps.as_primitive::<Int64Type>().values();
        let mut times = Vec::with_capacity(seconds.len());
        for (row, (second, &step)) in seconds.iter().zip(steps).enumerate() {
            let Some(second) = second else {
                times.push(None);
                continue;
            };
            if !second.is_finite() || second.abs() > 9e9 {
                let row = self.file_row(row);
                return Err(DatasetError::corrupt(format!(
                    "row {row} of \"{TIMESTAMP}\" is {second}, expected seconds"
                )));
            }
            times.push(Some(time_ns(second, step, self.fps)));
        }
        Ok(Arc::new(Int64Array::from(times)))
    }

    fn task_texts(&self, numbers: &ArrayRef) -> Result<ArrayRef> {
        let numbers = Place::new(TASK_INDEX, 0).index(numbers)?;
        let numbers = numbers.as_primitive::<Int64Type>().values();
        let mut texts = StringBuilder::new();
        for (row, &number) in numbers.iter().enumerate() {
            let text = self.tasks.text(number).ok_or_else(|| {
                let (row, n_tasks) = (self.file_row(row), self.tasks.len());
                DatasetError::corrupt(format!(
                    "row {row} of \"{TASK_INDEX}\" is {number}, expected one of the {n_tasks} recorded tasks"
                ))
            })?;
            texts.append_value(text);
        }
        Ok(Arc::new(texts.finish()))
    }

    fn pictures(&self, column: &Column, array: &ArrayRef) -> Result<ArrayRef> {
        let bytes = picture_bytes(array).ok_or_else(|| DatasetError::WrongType {
            key: column.feature.clone(),
            actual: array.data_type().to_string(),
            expected: "encoded pictures",
        })?;
        let codec = column.field.metadata().get(schema::IMAGE_CODEC);
        for (row, picture) in bytes.iter().enumerate() {
            let found = picture.and_then(picture::codec);
            if picture.is_some() && found != codec.map(String::as_str) {
                let row = self.file_row(row);
                let (name, found) = (&column.feature, found.unwrap_or("no picture"));
                let codec = codec.map_or("", String::as_str);
                return Err(DatasetError::corrupt(format!(
                    "row {row} of \"{name}\" is {found}, expected {codec} as in the first"
                )));
            }
        }
        Ok(Arc::new(bytes))
    }
}

/// The bytes of encoded pictures.
pub(super) fn picture_bytes(array: &ArrayRef) -> Option<BinaryArray> {
    let bytes = match array.as_struct_opt() {
        Some(pictures) => {
            let bytes = Arc::clone(pictures.column_by_name("bytes")?);
            match pictures.nulls().filter(|nulls| nulls.null_count() > 0) {
                None => bytes,
                Some(nulls) => {
                    let absent = nulls.iter().map(|valid| Some(!valid)).collect();
                    arrow::compute::nullif(&bytes, &absent).ok()?
                }
            }
        }
        None => Arc::clone(array),
    };
    let bytes = arrow::compute::cast(&bytes, &DataType::Binary).ok()?;
    Some(bytes.as_binary::<i32>().clone())
}

/// Which rule of nulls a column follows: flags and rewards are as strict as actions.
fn role(column: &str) -> Role {
    let strict = [schema::REWARD, schema::TERMINATED, schema::TRUNCATED];
    match column {
        name if schema::belongs_to(name, schema::OBSERVATION) => Role::Observation,
        name if schema::belongs_to(name, schema::ACTION) || strict.contains(&name) => Role::Action,
        _ => Role::Other,
    }
}

/// One value a row; lists of one value are taken for it.
fn scalars(array: &ArrayRef, place: Place<'_>) -> Result<ArrayRef> {
    match array.data_type() {
        DataType::List(_) | DataType::LargeList(_) | DataType::FixedSizeList(_, _) => {
            place.nested_values(array, &[1])
        }
        _ => Ok(array.clone()),
    }
}

fn values(column: &Column, array: &ArrayRef, place: Place<'_>) -> Result<ArrayRef> {
    let values = match column.shape.as_slice() {
        [] => scalars(array, place)?,
        shape => place.nested_values(array, shape)?,
    };
    let read = DatasetError::arrow("read a column");
    match column.field.data_type() {
        DataType::FixedSizeList(child, size) => {
            let values = arrow::compute::cast(&values, child.data_type()).map_err(&read)?;
            let nulls = array.nulls().cloned();
            let list = FixedSizeListArray::try_new_with_length(
                Arc::clone(child),
                *size,
                values,
                nulls,
                array.len(),
            );
            Ok(Arc::new(list.map_err(read)?))
        }
        data_type => arrow::compute::cast(&values, data_type).map_err(read),
    }
}

/// Nanoseconds of step `step`.
pub(super) fn grid_ns(step: i64, fps: f64) -> i64 {
    const SECOND: i128 = 1_000_000_000;
    // Whole rates are exact; with others the product is rounded once.
    if fps.fract() == 0.0 && fps <= 1e9 {
        let fps = fps as i128;
        let ns = (i128::from(step) * SECOND * 2 + fps).div_euclid(2 * fps);
        return i64::try_from(ns).unwrap_or(i64::MAX);
    }
    (step as f64 * 1e9 / fps).round() as i64
}

fn time_ns(second: f64, step: i64, fps: f64) -> i64 {
    let on_grid = step as f64 / fps;
    // Timestamps are f32 as a rule, some summed up in it.
    let precision = 1e-6 + on_grid.abs() * 2f64.powi(-22);
    match (second - on_grid).abs() <= precision {
        true => grid_ns(step, fps),
        false => (second * 1e9).round() as i64,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_exact_on_the_grid_and_as_recorded_off_it() {
        assert_eq!(time_ns(f64::from(2.0f32 / 3.0), 20, 30.0), 666_666_667);
        assert_eq!(time_ns(0.5, 20, 30.0), 500_000_000);
        assert_eq!(time_ns(0.6667, 20, 30.0), 666_700_000);
        assert_eq!(grid_ns(1 << 33, 1.0), (1 << 33) * 1_000_000_000);
        assert_eq!(grid_ns(1, 29.97), 33_366_700);
        assert_eq!(grid_ns(3, 1000.0), 3_000_000);
    }
}
