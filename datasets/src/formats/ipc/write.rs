//! Writing the canonical layout to Arrow IPC.

use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use arrow::array::{Array, AsArray, RecordBatch};
use arrow::datatypes::{Int64Type, SchemaRef};
use arrow::ipc::writer::FileWriter;

use crate::error::{DatasetError, Result};
use crate::schema;
use crate::sink::{DatasetSink, SinkInput, WriteOptions, Written, publish, with_records};
use crate::staging::Staged;

/// A record batch is closed at the first episode border after this many rows or bytes.
const BATCH_ROWS: usize = 16_384;
const BATCH_BYTES: usize = 32 << 20;
/// Rows and bytes after which a record batch is closed inside an episode.
const MAX_BATCH_ROWS: usize = 65_536;
const MAX_BATCH_BYTES: usize = 128 << 20;

/// Starts a file; an existing one is replaced when the sink finishes.
///
/// # Errors
/// The columns lack the indices, or the file cannot be made.
pub(crate) fn create(
    path: &Path,
    input: &SinkInput<'_>,
    options: &WriteOptions,
) -> Result<Box<dyn DatasetSink>> {
    let indices = [schema::EPISODE_INDEX, schema::STEP_INDEX].map(str::to_owned);
    schema::project(input.schema, Some(&indices))?;
    let schema = with_records(input, options);
    let staged = Staged::file(path)?;
    let file = File::create(staged.path()).map_err(|e| DatasetError::io("create", e))?;
    let writer = FileWriter::try_new(BufWriter::new(file), &schema)
        .map_err(DatasetError::arrow("start an Arrow file"))?;
    Ok(Box::new(IpcSink {
        path: path.to_owned(),
        staged,
        schema,
        writer,
        pending: Vec::new(),
        n_rows: 0,
        n_bytes: 0,
    }))
}

/// Writes an Arrow IPC file: not packed, so that it can be mapped, its record batches cut at episode borders.
/// Memory is one record batch: [`MAX_BATCH_BYTES`] and the batch at hand.
struct IpcSink {
    path: PathBuf,
    staged: Staged,
    schema: SchemaRef,
    writer: FileWriter<BufWriter<File>>,
    /// Rows of the record batch that is being filled.
    pending: Vec<RecordBatch>,
    n_rows: usize,
    n_bytes: usize,
}

impl IpcSink {
    fn add(&mut self, batch: &RecordBatch) -> Result<()> {
        let episodes = crate::episode::column(batch, schema::EPISODE_INDEX)?;
        let episodes = episodes.as_primitive::<Int64Type>().values();
        let mut start = 0;
        for run in episodes.chunk_by(|a, b| a == b) {
            if self.is_border(run.first().copied()) && self.is_full(BATCH_ROWS, BATCH_BYTES) {
                self.flush()?;
            }
            self.add_run(&batch.slice(start, run.len()))?;
            start += run.len();
        }
        Ok(())
    }

    /// Adds rows of one episode.
    fn add_run(&mut self, rows: &RecordBatch) -> Result<()> {
        let row_bytes = n_bytes(rows).div_ceil(rows.num_rows().max(1)).max(1);
        let mut start = 0;
        while start < rows.num_rows() {
            if self.is_full(MAX_BATCH_ROWS, MAX_BATCH_BYTES) {
                self.flush()?;
            }
            let room = (MAX_BATCH_BYTES - self.n_bytes).div_ceil(row_bytes);
            let n = (rows.num_rows() - start)
                .min(MAX_BATCH_ROWS - self.n_rows)
                .min(room);
            self.pending.push(rows.slice(start, n));
            self.n_rows += n;
            self.n_bytes += n * row_bytes;
            start += n;
        }
        Ok(())
    }

    fn is_full(&self, n_rows: usize, n_bytes: usize) -> bool {
        self.n_rows >= n_rows || self.n_bytes >= n_bytes
    }

    fn is_border(&self, next: Option<i64>) -> bool {
        let last = self.pending.last().and_then(|rows| {
            let episodes = rows.column_by_name(schema::EPISODE_INDEX)?;
            episodes
                .as_primitive::<Int64Type>()
                .values()
                .last()
                .copied()
        });
        last != next
    }

    fn flush(&mut self) -> Result<()> {
        let write = DatasetError::arrow("write rows");
        if !self.pending.is_empty() {
            let batch =
                arrow::compute::concat_batches(&self.schema, &self.pending).map_err(&write)?;
            self.writer.write(&batch).map_err(&write)?;
        }
        (self.n_rows, self.n_bytes) = (0, 0);
        self.pending.clear();
        Ok(())
    }

    fn close(mut self) -> Result<Written> {
        self.flush()?;
        let file = self.writer.into_inner();
        let file = file.map_err(DatasetError::arrow("finish an Arrow file"))?;
        let file = file
            .into_inner()
            .map_err(|e| DatasetError::io("write", e.into_error()))?;
        file.sync_all().map_err(|e| DatasetError::io("write", e))?;
        publish(self.staged, Vec::new())
    }
}

/// Bytes of the rows of a slice.
fn n_bytes(rows: &RecordBatch) -> usize {
    let size = |array: &dyn Array| array.to_data().get_slice_memory_size().unwrap_or(0);
    rows.columns()
        .iter()
        .map(|array| size(array.as_ref()))
        .sum()
}

impl DatasetSink for IpcSink {
    fn write(&mut self, batch: &RecordBatch) -> Result<()> {
        // The metadata may differ: the file's holds the records of the episodes.
        if batch.schema().fields() != self.schema.fields() {
            let found = schema::column_names(&batch.schema());
            let what = format!("a batch of another schema, with columns {found}");
            return Err(DatasetError::corrupt(what).in_file(&self.path));
        }
        let columns = batch.columns().to_vec();
        RecordBatch::try_new(Arc::clone(&self.schema), columns)
            .map_err(DatasetError::arrow("write rows"))
            .and_then(|batch| self.add(&batch))
            .map_err(|error| error.in_file(&self.path))
    }

    fn finish(self: Box<Self>) -> Result<Written> {
        let path = self.path.clone();
        (*self).close().map_err(|error| error.in_file(&path))
    }
}
