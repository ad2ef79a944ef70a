//! Cutting the batches a sink is given into the episodes it was promised.

use arrow::array::{Array, ArrayRef, AsArray, RecordBatch};
use arrow::datatypes::{Int64Type, SchemaRef};
use arrow::error::ArrowError;

use crate::episode::{EpisodeRecord, column};
use crate::error::{DatasetError, Result};
use crate::schema;
use crate::sink::SinkInput;

/// Rows of one episode that came in one batch.
pub(crate) struct EpisodePiece {
    /// Place of the episode among those promised.
    pub(crate) place: usize,
    /// Place of the first of the rows inside the episode.
    pub(crate) first_row: u64,
    pub(crate) rows: RecordBatch,
}

/// Where a sink stands in the episodes it was promised.
pub(crate) struct EpisodeCursor {
    schema: SchemaRef,
    episodes: Vec<EpisodeRecord>,
    place: usize,
    /// Rows of the current episode so far.
    n_rows: u64,
}

impl EpisodeCursor {
    /// Before the first row.
    pub(crate) fn new(input: &SinkInput<'_>) -> Self {
        Self {
            schema: input.schema.clone(),
            episodes: input.episodes.to_vec(),
            place: 0,
            n_rows: 0,
        }
    }

    /// The episodes promised.
    pub(crate) fn episodes(&self) -> &[EpisodeRecord] {
        &self.episodes
    }

    /// The batch, cut at the borders of episodes.
    ///
    /// # Errors
    /// Another schema, or other episodes than promised.
    pub(crate) fn cut(&mut self, batch: &RecordBatch) -> Result<Vec<EpisodePiece>> {
        if batch.schema_ref().fields() != self.schema.fields() {
            let error = ArrowError::SchemaError("a batch has other columns".to_owned());
            return Err(DatasetError::arrow("write rows")(error));
        }
        let numbers = column(batch, schema::EPISODE_INDEX)?.as_primitive::<Int64Type>();
        let numbers = numbers.values();
        let mut pieces = Vec::new();
        let mut start = 0;
        while let Some(&number) = numbers.get(start) {
            let expected = self.episodes.get(self.place);
            let Some(episode) = expected.filter(|episode| episode.episode_index == number) else {
                return Err(not_promised(number, expected, self.n_rows));
            };
            let missing = usize::try_from(episode.n_rows - self.n_rows).unwrap_or(usize::MAX);
            let same = numbers.iter().skip(start).take(missing);
            let n = same.take_while(|&&other| other == number).count();
            pieces.push(EpisodePiece {
                place: self.place,
                first_row: self.n_rows,
                rows: batch.slice(start, n),
            });
            start += n;
            self.n_rows += n as u64;
            if self.n_rows >= episode.n_rows {
                self.place += 1;
                self.n_rows = 0;
            }
        }
        Ok(pieces)
    }

    /// Makes sure that all rows came.
    ///
    /// # Errors
    /// Some did not.
    pub(crate) fn finish(&self) -> Result<()> {
        match self.episodes.get(self.place) {
            None => Ok(()),
            Some(episode) => Err(DatasetError::LengthMismatch {
                key: format!("episode {}", episode.episode_index),
                actual: self.n_rows,
                expected: episode.n_rows,
            }),
        }
    }
}

fn not_promised(number: i64, expected: Option<&EpisodeRecord>, n_rows: u64) -> DatasetError {
    let expected = match expected {
        Some(episode) => format!(
            "row {n_rows} of episode {} was to come",
            episode.episode_index
        ),
        None => "no more rows were to come".to_owned(),
    };
    DatasetError::corrupt(format!("a row of episode {number} came where {expected}"))
}

/// The values of a list column one after another, or the column itself.
pub(crate) fn flat_values(rows: &ArrayRef) -> ArrayRef {
    match rows.as_fixed_size_list_opt() {
        None => rows.clone(),
        Some(list) => {
            let width = usize::try_from(list.value_length()).unwrap_or(0);
            let start = usize::try_from(list.value_offset(0)).unwrap_or(0);
            list.values().slice(start, list.len() * width)
        }
    }
}

/// Makes sure that no row is null or holds a null. `first_row` is the first row's number, for the message.
///
/// # Errors
/// [`DatasetError::NullValue`].
pub(crate) fn refuse_nulls(rows: &ArrayRef, column: &str, first_row: u64) -> Result<()> {
    let values = flat_values(rows);
    if rows.null_count() == 0 && values.null_count() == 0 {
        return Ok(());
    }
    let width = values.len() / rows.len().max(1);
    let is_null = |row: &usize| {
        rows.is_null(*row) || (row * width..(row + 1) * width).any(|i| values.is_null(i))
    };
    let row = (0..rows.len()).find(is_null).unwrap_or(0);
    Err(DatasetError::NullValue {
        column: column.to_owned(),
        row: first_row + row as u64,
    })
}
