//! Rows of one episode, as numbers.

use std::ops::Range;

use arrow::array::{Array, ArrayRef, AsArray, RecordBatch};
use arrow::buffer::NullBuffer;
use arrow::datatypes::{DataType, Float64Type, Int64Type};

use super::facts::{Column, Kind};
use super::report::Place;
use crate::episode::column;
use crate::error::{DatasetError, Result};
use crate::schema;

/// One column of a batch.
pub(super) struct Values {
    /// Row-major; empty for columns that are not numbers.
    numbers: Vec<f64>,
    width: usize,
    nulls: Option<NullBuffer>,
    array: ArrayRef,
}

impl Values {
    fn new(array: &ArrayRef, about: &Column) -> Result<Self> {
        let numbers = match about.kind {
            Kind::Opaque => Vec::new(),
            Kind::Number | Kind::Float => numbers(array)?,
        };
        Ok(Self {
            numbers,
            width: about.width,
            nulls: array.nulls().cloned(),
            array: array.clone(),
        })
    }

    /// True if the row is not there.
    pub(super) fn is_null(&self, row: usize) -> bool {
        self.nulls.as_ref().is_some_and(|nulls| nulls.is_null(row))
    }

    /// The numbers of a row; `None` for a null row and in a column that holds none.
    pub(super) fn row(&self, row: usize) -> Option<&[f64]> {
        if self.is_null(row) {
            return None;
        }
        let start = row.checked_mul(self.width)?;
        self.numbers.get(start..start + self.width)
    }

    /// The number of a scalar column.
    pub(super) fn number(&self, row: usize) -> Option<f64> {
        self.row(row)?.first().copied()
    }

    /// The flag of a scalar column.
    pub(super) fn flag(&self, row: usize) -> Option<bool> {
        self.number(row).map(|value| value != 0.0)
    }

    /// The bytes of a text or an encoded picture; those of a raw picture.
    pub(super) fn bytes(&self, row: usize) -> Option<&[u8]> {
        if self.is_null(row) {
            return None;
        }
        match self.array.data_type() {
            DataType::Binary => Some(self.array.as_binary::<i32>().value(row)),
            DataType::Utf8 => Some(self.array.as_string::<i32>().value(row).as_bytes()),
            DataType::FixedSizeList(child, _) if *child.data_type() == DataType::UInt8 => {
                let list = self.array.as_fixed_size_list();
                let bytes = list
                    .values()
                    .as_primitive_opt::<arrow::datatypes::UInt8Type>()?;
                let start = usize::try_from(list.value_offset(row)).ok()?;
                let len = usize::try_from(list.value_length()).ok()?;
                bytes.values().get(start..start + len)
            }
            _ => None,
        }
    }
}

/// All values of a column as `f64`; NaN for a null among them.
fn numbers(array: &ArrayRef) -> Result<Vec<f64>> {
    let flat = match array.data_type() {
        DataType::FixedSizeList(_, size) => {
            let list = array.as_fixed_size_list();
            let size = usize::try_from(*size).unwrap_or(0);
            let start = usize::try_from(list.value_offset(0)).unwrap_or(0);
            list.values().slice(start, list.len() * size)
        }
        _ => array.clone(),
    };
    let cast = arrow::compute::cast(&flat, &DataType::Float64)
        .map_err(DatasetError::arrow("look at a column"))?;
    let cast = cast.as_primitive::<Float64Type>();
    Ok(match cast.null_count() {
        0 => cast.values().to_vec(),
        _ => cast.iter().map(|value| value.unwrap_or(f64::NAN)).collect(),
    })
}

/// The rows of a batch.
pub(super) struct Rows {
    pub(super) columns: Vec<Values>,
    episodes: Vec<i64>,
    steps: Vec<i64>,
    is_step: Vec<bool>,
}

impl Rows {
    pub(super) fn new(batch: &RecordBatch, about: &[Column]) -> Result<Self> {
        let columns = batch.columns().iter().zip(about);
        let columns: Vec<Values> = columns
            .map(|(array, about)| Values::new(array, about))
            .collect::<Result<_>>()?;
        let index = |name| -> Result<Vec<i64>> {
            Ok(column(batch, name)?
                .as_primitive::<Int64Type>()
                .values()
                .to_vec())
        };
        let marks: Vec<&Values> = columns
            .iter()
            .zip(about)
            .filter(|(_, about)| about.marks_steps)
            .map(|(values, _)| values)
            .collect();
        let is_step = |row: usize| marks.is_empty() || marks.iter().any(|mark| !mark.is_null(row));
        Ok(Self {
            episodes: index(schema::EPISODE_INDEX)?,
            steps: index(schema::STEP_INDEX)?,
            is_step: (0..batch.num_rows()).map(is_step).collect(),
            columns,
        })
    }

    /// Runs of rows of one episode, in `new` rows; the row before `new`, if any, was seen before.
    pub(super) fn segments(&self, new: Range<usize>) -> impl Iterator<Item = Segment<'_>> {
        let mut start = new.start;
        std::iter::from_fn(move || {
            let episode = *self.episodes.get(start).filter(|_| start < new.end)?;
            let same = self.episodes[start..new.end].iter();
            let len = same.take_while(|other| **other == episode).count();
            let range = start..start + len;
            let continues = start > 0 && self.episodes[start - 1] == episode;
            start = range.end;
            Some(Segment {
                rows: self,
                range,
                episode,
                continues,
            })
        })
    }
}

/// Rows that follow each other in one episode.
pub(super) struct Segment<'a> {
    rows: &'a Rows,
    range: Range<usize>,
    /// The episode.
    pub(super) episode: i64,
    /// Whether the row before the first belongs to the episode too; it was in an earlier segment.
    pub(super) continues: bool,
}

impl<'a> Segment<'a> {
    /// A column, by its place in the schema.
    pub(super) fn column(&self, place: usize) -> &'a Values {
        &self.rows.columns[place]
    }

    /// The rows, each of them once over all segments.
    pub(super) fn rows(&self) -> Range<usize> {
        self.range.clone()
    }

    /// The rows that are steps.
    pub(super) fn step_rows(&self) -> impl Iterator<Item = usize> + '_ {
        self.rows().filter(|&row| self.is_step(row))
    }

    /// Every row that has one before it in its episode, with that one.
    pub(super) fn pairs(&self) -> impl Iterator<Item = (usize, usize)> + use<> {
        let first = if self.continues {
            self.range.start
        } else {
            self.range.start + 1
        };
        (first..self.range.end).map(|row| (row - 1, row))
    }

    /// Whether the row is a step and not a final observation.
    pub(super) fn is_step(&self, row: usize) -> bool {
        self.rows.is_step[row]
    }

    /// Step number of a row.
    pub(super) fn step(&self, row: usize) -> i64 {
        self.rows.steps[row]
    }

    /// Where a row is.
    pub(super) fn place(&self, row: usize) -> Place {
        Place::step(self.episode, self.step(row))
    }
}
