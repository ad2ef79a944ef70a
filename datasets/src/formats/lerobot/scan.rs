//! A pass over the data files.

use std::collections::VecDeque;
use std::sync::Arc;

use arrow::array::{ArrayRef, RecordBatch, RecordBatchOptions, RecordBatchReader};
use arrow::datatypes::SchemaRef;
use arrow::error::ArrowError;

use super::columns::{Column, Conversion, FRAME_INDEX, INDEX};
use super::episodes::Place;
use super::files::{Batches, ParquetFile};
use super::read::LeRobotSource;
use super::rows::{Rows, Run};
use crate::error::{DatasetError, Result};
use crate::schema;

/// Bytes of a batch, about: fewer rows are read at a time where they are large.
const BATCH_BYTES: u64 = 64 << 20;

/// A pass over the data files.
pub(super) struct LeRobotScan<'a> {
    source: &'a LeRobotSource,
    schema: SchemaRef,
    columns: Vec<&'a Column>,
    /// Wanted episodes of the files that are not open yet, none empty.
    jobs: VecDeque<Vec<Place>>,
    open: Option<OpenFile>,
    batch_rows: usize,
}

struct OpenFile {
    /// Place among the files.
    file: usize,
    batches: Batches,
    /// Episodes not yet read to the end, and how many steps of the first were.
    episodes: VecDeque<Place>,
    next_step: u64,
}

impl<'a> LeRobotScan<'a> {
    pub(super) fn new(
        source: &'a LeRobotSource,
        schema: SchemaRef,
        columns: Vec<&'a Column>,
        jobs: VecDeque<Vec<Place>>,
        batch_rows: usize,
    ) -> Self {
        Self {
            source,
            schema,
            columns,
            jobs,
            open: None,
            batch_rows: batch_rows.max(1),
        }
    }

    fn next_batch(&mut self) -> Result<Option<RecordBatch>> {
        loop {
            if self.open.is_none() {
                let Some(job) = self.jobs.pop_front() else {
                    return Ok(None);
                };
                let file = job[0].file;
                let opened = self.open_file(file, job);
                self.open = Some(opened.map_err(|error| self.in_data_file(file, error))?);
            }
            if let Some(mut open) = self.open.take() {
                let file = open.file;
                let batch = self.read(&mut open);
                let batch = batch.map_err(|error| self.in_data_file(file, error))?;
                if batch.is_some() {
                    self.open = Some(open);
                    return Ok(batch);
                }
            }
        }
    }

    fn in_data_file(&self, file: usize, error: DatasetError) -> DatasetError {
        let file = self.source.episodes.files.get(file);
        let path = file.map_or("", |file| file.path.as_str());
        error.in_file(&self.source.root.join(path))
    }

    /// The index columns are always read: they are what the rows are checked by.
    fn open_file(&self, place: usize, episodes: Vec<Place>) -> Result<OpenFile> {
        let source = self.source;
        let Some(data_file) = source.episodes.files.get(place) else {
            return Err(DatasetError::corrupt("a file vanished"));
        };
        let file = ParquetFile::open(&source.root, &data_file.path)?;
        if file.n_rows() != data_file.n_rows {
            return Err(DatasetError::LengthMismatch {
                key: "data".to_owned(),
                actual: file.n_rows(),
                expected: data_file.n_rows,
            });
        }
        let ranges: Vec<(u64, u64)> = episodes
            .iter()
            .map(|place| (place.first_row, place.first_row + place.length))
            .collect();
        let wanted = |name: &str| {
            [schema::EPISODE_INDEX, FRAME_INDEX, INDEX].contains(&name)
                || self.columns.iter().any(|column| column.feature == name)
        };
        let batch_rows = self.batch_rows.min(self.affordable_rows(&file, &wanted));
        Ok(OpenFile {
            file: place,
            batches: file.read_rows(wanted, batch_rows, &ranges)?,
            episodes: episodes.into(),
            next_step: 0,
        })
    }

    /// How many rows may be read at a time.
    fn affordable_rows(&self, file: &ParquetFile, wanted: &dyn Fn(&str) -> bool) -> usize {
        let stored = file.row_bytes(wanted);
        let declared = self.columns.iter().map(|column| {
            let width = column.shape.iter().product::<usize>() as u64;
            width.saturating_mul(column.stored.primitive_width().unwrap_or(1) as u64)
        });
        let has_task = |column: &&Column| column.conversion == Conversion::Task;
        let task = match self.columns.iter().any(has_task) {
            true => self.source.tasks.longest() as u64,
            false => 0,
        };
        let row = declared.fold(stored.saturating_add(task), u64::saturating_add);
        usize::try_from(BATCH_BYTES / row.max(1))
            .unwrap_or(1)
            .max(1)
    }

    fn read(&self, open: &mut OpenFile) -> Result<Option<RecordBatch>> {
        let Some(batch) = open.batches.next().transpose()? else {
            let Some(place) = open.episodes.front() else {
                return Ok(None);
            };
            return Err(DatasetError::LengthMismatch {
                key: format!("episode {}", place.number),
                actual: open.next_step,
                expected: place.length,
            });
        };
        let rows = Rows {
            runs: open.runs(batch.num_rows())?,
            batch: &batch,
            fps: self.source.declared.fps,
            tasks: &self.source.tasks,
        };
        let (episodes, steps) = rows.indices()?;
        let mut arrays: Vec<ArrayRef> = Vec::with_capacity(self.schema.fields().len());
        let mut columns = self.columns.iter();
        for field in self.schema.fields() {
            arrays.push(match field.name().as_str() {
                schema::EPISODE_INDEX => Arc::clone(&episodes),
                schema::STEP_INDEX => Arc::clone(&steps),
                _ => match columns.next() {
                    Some(column) => rows.convert(column, &steps)?,
                    None => return Err(DatasetError::corrupt("a column vanished")),
                },
            });
        }
        let options = RecordBatchOptions::new().with_row_count(Some(batch.num_rows()));
        RecordBatch::try_new_with_options(Arc::clone(&self.schema), arrays, &options)
            .map(Some)
            .map_err(DatasetError::arrow("build a batch"))
    }
}

impl OpenFile {
    /// Takes the next rows off the episodes.
    fn runs(&mut self, n_rows: usize) -> Result<Vec<Run>> {
        let mut runs = Vec::new();
        let mut left = n_rows;
        while left > 0 {
            let Some(&episode) = self.episodes.front() else {
                return Err(DatasetError::corrupt("more rows than its footer counts"));
            };
            let rest = episode.length - self.next_step;
            let n_rows = usize::try_from(rest).unwrap_or(usize::MAX).min(left);
            runs.push(Run {
                episode,
                first_step: self.next_step,
                n_rows,
            });
            left -= n_rows;
            self.next_step += n_rows as u64;
            if self.next_step == episode.length {
                self.episodes.pop_front();
                self.next_step = 0;
            }
        }
        Ok(runs)
    }
}

impl Iterator for LeRobotScan<'_> {
    type Item = Result<RecordBatch, ArrowError>;

    fn next(&mut self) -> Option<Self::Item> {
        let batch = self.next_batch();
        if batch.is_err() {
            // A reader that failed ends its pass.
            self.jobs.clear();
            self.open = None;
        }
        batch.map_err(ArrowError::from).transpose()
    }
}

impl RecordBatchReader for LeRobotScan<'_> {
    fn schema(&self) -> SchemaRef {
        Arc::clone(&self.schema)
    }
}
