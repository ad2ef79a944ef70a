//! A pass over a file of columns.

use std::collections::{BTreeMap, HashSet};
use std::sync::Arc;

use arrow::array::{
    ArrayRef, BooleanArray, Int64Array, RecordBatch, RecordBatchOptions, RecordBatchReader,
};
use arrow::datatypes::SchemaRef;
use arrow::error::ArrowError;

use super::columns::{ColumnPlan, Conversion, Role};
use super::rows::{EpisodeNames, EpisodeTracker, as_index, check_action, convert};
use super::table::Table;
use crate::error::{DatasetError, Result};
use crate::schema;
use crate::source::Scan;

/// The rows of a file, in the file's own columns.
pub(crate) trait TableReader: Send {
    /// The next rows, with the episode and step columns at least, and the row of the file they start at. Rows
    /// of episodes that are not wanted may be passed over.
    fn next_rows(&mut self) -> Option<Result<(u64, RecordBatch)>>;

    /// The rows given last, with all columns of the pass. Only asked for if one of them is wanted.
    ///
    /// # Errors
    /// The columns cannot be read.
    fn complete(&mut self, rows: RecordBatch) -> Result<RecordBatch>;
}

/// What a pass needs of the file, and how it is converted.
pub(crate) struct TableScan<'a> {
    table: &'a Table,
    schema: SchemaRef,
    columns: Vec<&'a ColumnPlan>,
    episodes: Option<HashSet<i64>>,
    tracker: EpisodeTracker,
    names: EpisodeNames,
    /// By place in the schema: the null row that ends a batch, of columns that are null in the last row of an
    /// episode only.
    nulls: BTreeMap<usize, Option<(i64, u64)>>,
}

impl<'a> TableScan<'a> {
    /// Plans a pass over some columns.
    ///
    /// # Errors
    /// A column that is not there.
    pub(crate) fn new(table: &'a Table, scan: &Scan) -> Result<Self> {
        let (schema, _) = schema::project(&table.schema, scan.columns.as_deref())?;
        // Episode and step are always read: they are what the rows are checked by.
        let is_read =
            |column: &&ColumnPlan| is_index(column) || schema.index_of(column.field.name()).is_ok();
        let steps =
            step_columns(table).filter_map(|column| schema.index_of(column.field.name()).ok());
        Ok(Self {
            nulls: steps.map(|place| (place, None)).collect(),
            columns: table.columns.iter().filter(is_read).collect(),
            table,
            schema,
            episodes: (scan.episodes.as_ref()).map(|wanted| wanted.iter().copied().collect()),
            tracker: EpisodeTracker::default(),
            names: EpisodeNames::default(),
        })
    }

    /// Places in the file of all columns of the pass.
    pub(crate) fn sources(&self) -> Vec<usize> {
        places(self.columns.iter())
    }

    /// Places of the episode and step columns.
    pub(crate) fn index_sources(&self) -> Vec<usize> {
        places(self.columns.iter().filter(|column| is_index(column)))
    }

    /// The batches of the pass.
    pub(crate) fn read<R: TableReader>(self, reader: R) -> TableBatches<'a, R> {
        TableBatches {
            scan: self,
            reader,
            failed: false,
        }
    }

    fn name(&self, column: &ColumnPlan) -> &'a str {
        self.table.file.field(column.source).name()
    }

    fn array(
        &mut self,
        batch: &RecordBatch,
        column: &ColumnPlan,
        first_row: u64,
    ) -> Result<ArrayRef> {
        let name = self.name(column);
        let array = batch
            .column_by_name(name)
            .ok_or_else(|| DatasetError::corrupt("a column vanished"))?;
        match column.conversion {
            Conversion::Name => self.names.numbers(name, array, first_row),
            _ => convert(column, name, array, first_row),
        }
    }

    /// Converts the next rows; without any if no wanted episode is among them.
    fn convert(
        &mut self,
        batch: RecordBatch,
        reader: &mut impl TableReader,
    ) -> Result<Option<RecordBatch>> {
        let first_row = self.tracker.first_row;
        let (episodes, steps) = self.index_columns(&batch, first_row)?;
        let keep = self.wanted(&episodes);
        if keep.as_ref().is_some_and(|keep| keep.true_count() == 0) {
            self.nulls.values_mut().for_each(|null| *null = None);
            return Ok(None);
        }
        let batch = reader.complete(batch)?;
        let mut arrays: Vec<ArrayRef> = Vec::with_capacity(self.schema.fields().len());
        for field in Arc::clone(&self.schema).fields() {
            arrays.push(match field.name().as_str() {
                schema::EPISODE_INDEX => Arc::new(episodes.clone()),
                schema::STEP_INDEX => Arc::new(steps.clone()),
                name => {
                    let find = |column: &&&ColumnPlan| column.field.name() == name;
                    let column: &ColumnPlan = self
                        .columns
                        .iter()
                        .find(find)
                        .ok_or_else(|| DatasetError::corrupt("a column vanished"))?;
                    self.array(&batch, column, first_row)?
                }
            });
        }
        for (&place, pending) in &mut self.nulls {
            let name = self.schema.field(place).name();
            let column = self.columns.iter().find(|c| c.field.name() == name);
            let name = column.map_or(name, |column| self.table.file.field(column.source).name());
            check_action(name, &arrays[place], &episodes, pending, first_row)?;
        }
        self.assemble(arrays, episodes.len(), keep).map(Some)
    }

    fn index_columns(
        &mut self,
        batch: &RecordBatch,
        first_row: u64,
    ) -> Result<(Int64Array, Int64Array)> {
        let mut read = |role: Role| -> Result<Option<(&str, ArrayRef)>> {
            let Some(&column) = self.columns.iter().find(|column| column.role == role) else {
                return Ok(None);
            };
            Ok(Some((
                self.name(column),
                self.array(batch, column, first_row)?,
            )))
        };
        let (episode, step) = (read(Role::Episode)?, read(Role::Step)?);
        let index = |column: &'_ Option<(&'a str, ArrayRef)>| {
            column
                .as_ref()
                .map(|(name, array)| (*name, as_index(array).clone()))
        };
        let (episode, step) = (index(&episode), index(&step));
        self.tracker.rows(
            batch.num_rows(),
            episode.as_ref().map(|(name, array)| (*name, array)),
            step.as_ref().map(|(name, array)| (*name, array)),
        )
    }

    fn wanted(&self, episodes: &Int64Array) -> Option<BooleanArray> {
        let wanted = self.episodes.as_ref()?;
        let is_wanted = |episode: &i64| Some(wanted.contains(episode));
        Some(episodes.values().iter().map(is_wanted).collect())
    }

    fn assemble(
        &self,
        arrays: Vec<ArrayRef>,
        n_rows: usize,
        keep: Option<BooleanArray>,
    ) -> Result<RecordBatch> {
        let options = RecordBatchOptions::new().with_row_count(Some(n_rows));
        let batch = RecordBatch::try_new_with_options(Arc::clone(&self.schema), arrays, &options)
            .map_err(DatasetError::arrow("build a batch"))?;
        match keep {
            None => Ok(batch),
            Some(keep) => arrow::compute::filter_record_batch(&batch, &keep)
                .map_err(DatasetError::arrow("choose episodes")),
        }
    }
}

/// The columns that have a value in every step: the first action, reward and flags.
fn step_columns(table: &Table) -> impl Iterator<Item = &ColumnPlan> {
    let scalars = [schema::REWARD, schema::TERMINATED, schema::TRUNCATED];
    let action = table.columns.iter().find(|c| c.role == Role::Action);
    let others = table.columns.iter();
    action
        .into_iter()
        .chain(others.filter(move |c| scalars.contains(&c.field.name().as_str())))
}

fn is_index(column: &ColumnPlan) -> bool {
    matches!(column.role, Role::Episode | Role::Step)
}

fn places<'c>(columns: impl Iterator<Item = &'c &'c ColumnPlan>) -> Vec<usize> {
    let mut places: Vec<usize> = columns.map(|column| column.source).collect();
    // A text of an episode is read for its number and for itself.
    places.sort_unstable();
    places.dedup();
    places
}

/// The batches of a pass.
pub(crate) struct TableBatches<'a, R> {
    scan: TableScan<'a>,
    reader: R,
    failed: bool,
}

impl<R: TableReader> Iterator for TableBatches<'_, R> {
    type Item = Result<RecordBatch, ArrowError>;

    fn next(&mut self) -> Option<Self::Item> {
        while !self.failed {
            let converted = self.reader.next_rows()?.and_then(|(first_row, rows)| {
                self.scan.tracker.first_row = first_row;
                self.scan.convert(rows, &mut self.reader)
            });
            match converted {
                Ok(Some(batch)) if batch.num_rows() > 0 => return Some(Ok(batch)),
                Ok(_) => {}
                Err(error) => {
                    self.failed = true;
                    return Some(Err(error.in_file(&self.scan.table.path).into()));
                }
            }
        }
        None
    }
}

impl<R: TableReader> RecordBatchReader for TableBatches<'_, R> {
    fn schema(&self) -> SchemaRef {
        Arc::clone(&self.scan.schema)
    }
}
