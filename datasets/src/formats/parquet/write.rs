//! Writing the canonical layout to Parquet.

use std::fs::File;
use std::path::{Path, PathBuf};

use arrow::array::{AsArray, RecordBatch};
use arrow::datatypes::{DataType, Int64Type, Schema, SchemaRef};
use parquet::arrow::ArrowWriter;
use parquet::basic::{Compression, Encoding, ZstdLevel};
use parquet::file::properties::{WriterProperties, WriterPropertiesBuilder};
use parquet::schema::types::ColumnPath;

use crate::error::{DatasetError, Result};
use crate::schema;
use crate::sink::{DatasetSink, Written, publish};
use crate::staging::Staged;

/// A row group is closed at the first episode border after this many rows, so that no episode straddles two
/// groups unless it is longer than [`MAX_GROUP_ROWS`].
const GROUP_ROWS: usize = 32_768;
const MAX_GROUP_ROWS: usize = 131_072;

/// Writes a Parquet file: zstd, floats byte-stream-split and without dictionary (half the size of plain
/// zstd for robot data), row groups aligned to episode borders.
pub struct ParquetSink {
    path: PathBuf,
    staged: Staged,
    writer: ArrowWriter<File>,
    last_episode: Option<i64>,
}

impl ParquetSink {
    /// Starts a file in the folder of `path`; an existing file is replaced when the sink finishes.
    ///
    /// # Errors
    /// The file cannot be created, or `schema` lacks the index columns.
    pub fn create(path: &Path, schema: SchemaRef) -> Result<Self> {
        Self::try_create(path, schema).map_err(|error| error.in_file(path))
    }

    fn try_create(path: &Path, schema: SchemaRef) -> Result<Self> {
        schema::project(
            &schema,
            Some(&[
                schema::EPISODE_INDEX.to_owned(),
                schema::STEP_INDEX.to_owned(),
            ]),
        )?;
        let staged = Staged::file(path)?;
        let file = File::create(staged.path()).map_err(|e| DatasetError::io("create", e))?;
        let properties = properties(&schema);
        let writer = ArrowWriter::try_new(file, schema, Some(properties))
            .map_err(DatasetError::parquet("start a Parquet file"))?;
        Ok(Self {
            path: path.to_owned(),
            staged,
            writer,
            last_episode: None,
        })
    }

    fn write_rows(&mut self, batch: &RecordBatch) -> Result<()> {
        let border = (self.writer.in_progress_rows() + batch.num_rows() >= GROUP_ROWS)
            .then(|| self.last_border(batch))
            .flatten();
        let write = DatasetError::parquet("write rows");
        match border {
            None => self.writer.write(batch).map_err(write)?,
            Some(border) => {
                self.writer.write(&batch.slice(0, border)).map_err(&write)?;
                self.writer.flush().map_err(&write)?;
                self.writer
                    .write(&batch.slice(border, batch.num_rows() - border))
                    .map_err(&write)?;
            }
        }
        let episodes =
            crate::episode::column(batch, schema::EPISODE_INDEX)?.as_primitive::<Int64Type>();
        self.last_episode = episodes.values().last().copied().or(self.last_episode);
        Ok(())
    }

    /// The last row of the batch that starts an episode; row 0 counts if the episode before ended.
    fn last_border(&self, batch: &RecordBatch) -> Option<usize> {
        let episodes = batch
            .column_by_name(schema::EPISODE_INDEX)?
            .as_primitive::<Int64Type>()
            .values();
        let inside = (1..episodes.len())
            .rev()
            .find(|&row| episodes[row] != episodes[row - 1]);
        let starts = || {
            episodes
                .first()
                .is_some_and(|first| self.last_episode.is_some_and(|last| last != *first))
        };
        inside.or_else(|| starts().then_some(0))
    }
}

impl DatasetSink for ParquetSink {
    fn write(&mut self, batch: &RecordBatch) -> Result<()> {
        self.write_rows(batch)
            .map_err(|error| error.in_file(&self.path))
    }

    fn finish(self: Box<Self>) -> Result<Written> {
        let Self {
            path,
            staged,
            writer,
            ..
        } = *self;
        let place = || -> Result<Written> {
            let file = writer
                .into_inner()
                .map_err(DatasetError::parquet("finish a Parquet file"))?;
            file.sync_all().map_err(|e| DatasetError::io("write", e))?;
            publish(staged, Vec::new())
        };
        place().map_err(|error| error.in_file(&path))
    }
}

fn properties(schema: &Schema) -> WriterProperties {
    let mut builder: WriterPropertiesBuilder = WriterProperties::builder()
        .set_compression(Compression::ZSTD(ZstdLevel::default()))
        .set_max_row_group_row_count(Some(MAX_GROUP_ROWS));
    for field in schema.fields() {
        let (value_type, path) = match field.data_type() {
            DataType::FixedSizeList(child, _) => (
                child.data_type(),
                // Parquet's three-level lists.
                vec![
                    field.name().clone(),
                    "list".to_owned(),
                    child.name().clone(),
                ],
            ),
            other => (other, vec![field.name().clone()]),
        };
        if matches!(
            value_type,
            DataType::Float32 | DataType::Float64 | DataType::Float16
        ) {
            let path = ColumnPath::new(path);
            builder = builder
                .set_column_dictionary_enabled(path.clone(), false)
                .set_column_encoding(path, Encoding::BYTE_STREAM_SPLIT);
        }
    }
    builder.build()
}
