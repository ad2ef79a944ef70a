//! One episode's file.

use std::fs::File;
use std::path::{Path, PathBuf};

use arrow::array::RecordBatch;
use arrow::datatypes::SchemaRef;
use parquet::arrow::ProjectionMask;
use parquet::arrow::arrow_reader::{
    ArrowReaderMetadata, ArrowReaderOptions, ParquetRecordBatchReader,
    ParquetRecordBatchReaderBuilder,
};

use crate::error::{DatasetError, Result};
use crate::format::Format;
use crate::formats::ipc::{IpcFile, IpcRows};
use crate::guard;

/// A file whose footer was read.
pub(super) enum Part {
    Arrow(IpcFile),
    Parquet(File, ArrowReaderMetadata),
}

impl Part {
    /// The path of an episode's file.
    pub(super) fn path(format: Format, episode: &Path) -> PathBuf {
        episode.join(match format {
            Format::MinariParquet => "part-0.parquet",
            _ => "part-0.arrow",
        })
    }

    /// Opens a file by its path.
    ///
    /// # Errors
    /// The file is not there or damaged.
    pub(super) fn open(format: Format, path: &Path) -> Result<Self> {
        if format != Format::MinariParquet {
            return Ok(Self::Arrow(IpcFile::open(path)?));
        }
        let file = File::open(path).map_err(|e| DatasetError::io("open", e))?;
        let metadata = guard::decode(|| {
            ArrowReaderMetadata::load(&file, ArrowReaderOptions::new())
                .map_err(DatasetError::parquet("read the Parquet footer"))
        })?;
        Ok(Self::Parquet(file, metadata))
    }

    pub(super) fn schema(&self) -> &SchemaRef {
        match self {
            Self::Arrow(file) => file.schema(),
            Self::Parquet(_, metadata) => metadata.schema(),
        }
    }

    /// Rows, as the footer counts them.
    pub(super) fn n_rows(&self) -> u64 {
        match self {
            Self::Arrow(file) => file.n_rows(),
            Self::Parquet(_, metadata) => {
                let n_rows = metadata.metadata().file_metadata().num_rows();
                u64::try_from(n_rows).unwrap_or(0)
            }
        }
    }

    /// Reads the columns at these places in batches of `batch_rows` rows, at most.
    ///
    /// # Errors
    /// Parquet's reader cannot be set up.
    pub(super) fn read(self, columns: Vec<usize>, batch_rows: usize) -> Result<PartReader> {
        Ok(match self {
            Self::Arrow(file) => PartReader::Arrow(IpcRows::new(file, columns, batch_rows)),
            Self::Parquet(file, metadata) => {
                let mask = ProjectionMask::roots(metadata.parquet_schema(), columns);
                let reader = guard::decode(|| {
                    ParquetRecordBatchReaderBuilder::new_with_metadata(file, metadata)
                        .with_projection(mask)
                        .with_batch_size(batch_rows)
                        .build()
                        .map_err(DatasetError::parquet("read rows"))
                });
                PartReader::Parquet(reader?)
            }
        })
    }
}

/// The batches of a file.
pub(super) enum PartReader {
    Arrow(IpcRows),
    Parquet(ParquetRecordBatchReader),
}

impl Iterator for PartReader {
    type Item = Result<RecordBatch>;

    fn next(&mut self) -> Option<Self::Item> {
        match self {
            Self::Arrow(rows) => rows.next(),
            Self::Parquet(reader) => guard::decode(|| {
                reader
                    .next()
                    .transpose()
                    .map_err(DatasetError::arrow("read rows"))
            })
            .transpose(),
        }
    }
}
