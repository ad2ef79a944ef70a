//! The batch loop of the readers of arrays.

use std::collections::HashMap;
use std::path::Path;
use std::sync::Arc;

use arrow::array::{ArrayRef, Int64Array, RecordBatch, RecordBatchOptions, RecordBatchReader};
use arrow::datatypes::{DataType, Field, FieldRef, Schema, SchemaRef};
use arrow::error::ArrowError;
use serde_json::Value;

use super::builder::LeafBuilder;
use super::element::Element;
use super::pager::{Pager, Piece};
use crate::error::{DatasetError, Result};
use crate::schema;
use crate::source::{DatasetInfo, Scan};

/// Which rows of an episode a column has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum RowRule {
    /// Every row, the final observation included.
    Observation,
    /// Steps only: null in the final-observation row.
    Step,
    /// As many as the source has, steps at most plus one; null in the rest.
    Info,
}

/// A column that is read from the file.
#[derive(Debug, Clone)]
pub(crate) struct StepColumn {
    pub(crate) field: FieldRef,
    pub(crate) source: ColumnSource,
}

/// How a column is stored.
#[derive(Debug, Clone)]
pub(crate) struct ColumnSource {
    /// Path in the file, or inside an episode's group.
    pub(crate) key: String,
    pub(crate) element: Element,
    /// Values in a row.
    pub(crate) width: usize,
    pub(crate) rule: RowRule,
}

/// The schema of a table with these columns, after the index columns.
pub(crate) fn table_schema(columns: &[StepColumn], info: &DatasetInfo) -> SchemaRef {
    let mut fields: Vec<FieldRef> = vec![
        Arc::new(Field::new(schema::EPISODE_INDEX, DataType::Int64, false)),
        Arc::new(Field::new(schema::STEP_INDEX, DataType::Int64, false)),
    ];
    fields.extend(columns.iter().map(|column| Arc::clone(&column.field)));
    let text = |key: &str, value: String| (key.to_owned(), value);
    let mut metadata = HashMap::from([
        text(schema::VERSION_KEY, schema::VERSION.to_owned()),
        text(schema::SOURCE_FORMAT, info.format.name().to_owned()),
        text(schema::SOURCE_ID, info.id.clone()),
        text(
            schema::SOURCE_METADATA,
            Value::Object(info.metadata.clone()).to_string(),
        ),
    ]);
    metadata.extend(
        info.env_spec
            .iter()
            .map(|spec| text(schema::ENV_SPEC, spec.to_string())),
    );
    Arc::new(Schema::new_with_metadata(fields, metadata))
}

/// The rows of one episode.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct EpisodeRows {
    pub(crate) episode_index: i64,
    pub(crate) n_steps: u64,
    pub(crate) has_final_obs: bool,
}

impl EpisodeRows {
    pub(crate) fn n_rows(self) -> u64 {
        self.n_steps + u64::from(self.has_final_obs)
    }
}

/// A file as a table of steps.
pub(crate) trait StepTable: Send + Sync {
    fn path(&self) -> &Path;

    /// Rows of the episode at that place of the list, or `None` past the end. May read shapes, not data.
    fn episode(&self, place: usize) -> Option<Result<EpisodeRows>>;

    /// Appends the rows of all pieces to the builder, null where `column`'s rule has none.
    fn append(&self, pieces: &[Piece], column: &ColumnSource, to: &mut LeafBuilder) -> Result<()>;
}

impl<T: StepTable> StepTable for &T {
    fn path(&self) -> &Path {
        (**self).path()
    }

    fn episode(&self, place: usize) -> Option<Result<EpisodeRows>> {
        (**self).episode(place)
    }

    fn append(&self, pieces: &[Piece], column: &ColumnSource, to: &mut LeafBuilder) -> Result<()> {
        (**self).append(pieces, column, to)
    }
}

impl Piece {
    /// How many rows of the piece lie before `end`, and how many do not.
    pub(crate) fn split_at(&self, end: u64) -> (usize, usize) {
        let n = end.clamp(self.from, self.to) - self.from;
        // A piece is part of a batch, so its rows fit memory.
        let size = |n: u64| usize::try_from(n).unwrap_or(0);
        (size(n), size(self.to - self.from - n))
    }
}

/// A pass over a table.
pub(crate) struct StepScan<T> {
    table: T,
    schema: SchemaRef,
    columns: Vec<Option<StepColumn>>,
    episodes: Option<Vec<i64>>,
    pager: Pager,
    failed: bool,
}

impl<T: StepTable> StepScan<T> {
    /// Starts a pass over the columns of `columns` that `scan` asks for.
    ///
    /// # Errors
    /// A column that is not in `schema`.
    pub(crate) fn new(
        table: T,
        schema: &SchemaRef,
        columns: &[StepColumn],
        scan: &Scan,
    ) -> Result<Self> {
        let (schema, _) = schema::project(schema, scan.columns.as_deref())?;
        let find = |name: &str| {
            columns
                .iter()
                .find(|column| column.field.name() == name)
                .cloned()
        };
        let columns = schema
            .fields()
            .iter()
            .map(|field| find(field.name()))
            .collect();
        let mut episodes = scan.episodes.clone();
        if let Some(episodes) = &mut episodes {
            episodes.sort_unstable();
        }
        Ok(Self {
            table,
            schema,
            columns,
            episodes,
            pager: Pager::new(scan.batch_rows),
            failed: false,
        })
    }

    fn next_batch(&mut self) -> Result<Option<RecordBatch>> {
        let Self {
            table,
            episodes,
            pager,
            ..
        } = self;
        let episodes = episodes.as_deref();
        let wanted = |rows: EpisodeRows| match episodes {
            Some(episodes) if episodes.binary_search(&rows.episode_index).is_err() => 0,
            _ => rows.n_rows(),
        };
        let pieces =
            pager.next_batch(|place| table.episode(place).map(|rows| rows.map(&wanted)))?;
        if pieces.is_empty() {
            return Ok(None);
        }
        let n_rows = pieces
            .iter()
            .map(|piece| piece.to - piece.from)
            .sum::<u64>();
        let n_rows =
            usize::try_from(n_rows).map_err(|_| DatasetError::corrupt("more rows than memory"))?;
        let mut arrays = Vec::with_capacity(self.columns.len());
        for (field, column) in self.schema.fields().iter().zip(&self.columns) {
            arrays.push(match column {
                Some(column) => self.column(column, &pieces, n_rows)?,
                None => self.index(field.name(), &pieces, n_rows)?,
            });
        }
        let options = RecordBatchOptions::new().with_row_count(Some(n_rows));
        RecordBatch::try_new_with_options(Arc::clone(&self.schema), arrays, &options)
            .map(Some)
            .map_err(DatasetError::arrow("build a batch"))
    }

    fn column(&self, column: &StepColumn, pieces: &[Piece], n_rows: usize) -> Result<ArrayRef> {
        let mut builder = LeafBuilder::new(column.source.element, column.source.width, n_rows);
        self.table.append(pieces, &column.source, &mut builder)?;
        builder.finish(&column.field)
    }

    fn index(&self, name: &str, pieces: &[Piece], n_rows: usize) -> Result<ArrayRef> {
        let mut values = Vec::with_capacity(n_rows);
        for piece in pieces {
            let episode = self.episode(piece.episode)?;
            for row in piece.from..piece.to {
                let step = i64::try_from(row).unwrap_or(i64::MAX);
                values.push(if name == schema::EPISODE_INDEX {
                    episode.episode_index
                } else {
                    step
                });
            }
        }
        Ok(Arc::new(Int64Array::from(values)))
    }

    fn episode(&self, place: usize) -> Result<EpisodeRows> {
        self.table
            .episode(place)
            .unwrap_or_else(|| Err(DatasetError::corrupt("an episode vanished")))
    }
}

impl<T: StepTable> Iterator for StepScan<T> {
    type Item = Result<RecordBatch, ArrowError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.failed {
            return None;
        }
        let batch = self
            .next_batch()
            .map_err(|error| error.in_file(self.table.path()));
        self.failed = batch.is_err();
        batch.map_err(ArrowError::from).transpose()
    }
}

impl<T: StepTable> RecordBatchReader for StepScan<T> {
    fn schema(&self) -> SchemaRef {
        Arc::clone(&self.schema)
    }
}
