//! Parquet files as LeRobot writes them: snappy, with what pandas and `datasets` note in the schema.

use std::collections::BTreeMap;
use std::fs::File;
use std::path::Path;

use arrow::array::RecordBatch;
use arrow::datatypes::SchemaRef;
use parquet::arrow::ArrowWriter;
use parquet::basic::Compression;
use parquet::file::metadata::KeyValue;
use parquet::file::properties::{EnabledStatistics, WriterProperties};
use parquet::schema::types::ColumnPath;

use super::super::columns::{FRAME_INDEX, INDEX, TASK_INDEX};
use crate::error::{DatasetError, Result};
use crate::schema;

/// Memory of a row group that is not written yet, at most (and one batch more).
const GROUP_BYTES: usize = 32 << 20;

/// Starts a file; the folder is made if it is not there. What the schema's metadata say is noted in the footer
/// and in the Arrow schema inside it, where pyarrow looks first.
///
/// # Errors
/// The system refuses.
pub(super) fn start(path: &Path, schema: &SchemaRef) -> Result<ArrowWriter<File>> {
    if let Some(folder) = path.parent() {
        std::fs::create_dir_all(folder).map_err(|e| DatasetError::io("create", e))?;
    }
    let file = File::create(path).map_err(|e| DatasetError::io("create", e))?;
    let metadata: BTreeMap<_, _> = schema.metadata().iter().collect();
    let notes = metadata.into_iter();
    let notes = notes.map(|(key, value)| KeyValue::new(key.clone(), value.clone()));
    let mut properties = WriterProperties::builder()
        .set_compression(Compression::SNAPPY)
        .set_dictionary_enabled(false)
        .set_statistics_enabled(EnabledStatistics::Chunk)
        .set_key_value_metadata(Some(notes.collect()));
    // Runs of equal or ascending numbers.
    for name in [schema::EPISODE_INDEX, FRAME_INDEX, INDEX, TASK_INDEX] {
        let path = ColumnPath::new(vec![name.to_owned()]);
        properties = properties.set_column_dictionary_enabled(path, true);
    }
    ArrowWriter::try_new(file, SchemaRef::clone(schema), Some(properties.build()))
        .map_err(DatasetError::parquet("start a Parquet file"))
}

/// Writes rows; closes the row group when it gets too large to be held.
///
/// # Errors
/// A failed write.
pub(super) fn write(writer: &mut ArrowWriter<File>, batch: &RecordBatch) -> Result<()> {
    let written = DatasetError::parquet("write rows");
    writer.write(batch).map_err(&written)?;
    match writer.memory_size() > GROUP_BYTES {
        true => writer.flush().map_err(written),
        false => Ok(()),
    }
}

/// Writes the footer and waits until the file is on disk.
///
/// # Errors
/// A failed write.
pub(super) fn finish(writer: ArrowWriter<File>) -> Result<()> {
    let file = writer
        .into_inner()
        .map_err(DatasetError::parquet("finish a Parquet file"))?;
    file.sync_all().map_err(|e| DatasetError::io("write", e))
}

/// Writes a text file and waits until it is on disk.
///
/// # Errors
/// A failed write.
pub(super) fn write_text(path: &Path, text: &str) -> Result<()> {
    use std::io::Write;
    let write = || {
        let mut file = File::create(path)?;
        file.write_all(text.as_bytes())?;
        file.sync_all()
    };
    write().map_err(|e| DatasetError::io("write", e))
}
