//! Reading Parquet files in batches.

use std::fs::File;
use std::path::Path;
use std::sync::Arc;

use arrow::array::{RecordBatch, RecordBatchReader};
use arrow::datatypes::SchemaRef;
use parquet::arrow::ProjectionMask;
use parquet::arrow::arrow_reader::{
    ArrowReaderMetadata, ArrowReaderOptions, ParquetRecordBatchReaderBuilder,
};
use parquet::file::metadata::RowGroupMetaData;
use parquet::file::statistics::Statistics;

use super::ahead::{Ahead, Selection};

use crate::episode::EpisodeRecord;
use crate::error::{DatasetError, Result};
use crate::format::Format;
use crate::formats::tabular::{ColumnNames, FIRST_ROWS, Table, TableReader, TableScan};
use crate::guard;
use crate::source::{DatasetInfo, DatasetSource, Scan};

/// Opens a Parquet file.
///
/// # Errors
/// Not a Parquet file, missing columns, or columns of types that cannot serve.
pub(crate) fn open(path: &Path, names: &ColumnNames) -> Result<Box<dyn DatasetSource>> {
    let file = File::open(path).map_err(|e| DatasetError::io("open", e))?;
    let metadata = guard::decode(|| {
        ArrowReaderMetadata::load(&file, ArrowReaderOptions::new())
            .map_err(DatasetError::parquet("read the Parquet footer"))
    })?;
    let mut table = Table::new(path, Format::Parquet, metadata.schema(), names, |places| {
        first_rows(file, &metadata, places)
    })?;
    table.info.n_steps = steps_without_final_rows(&metadata, &table);
    Ok(Box::new(ParquetSource { metadata, table }))
}

/// The first few rows of some columns.
fn first_rows(file: File, metadata: &ArrowReaderMetadata, places: &[usize]) -> Result<RecordBatch> {
    let mask = ProjectionMask::roots(metadata.parquet_schema(), places.iter().copied());
    let mut reader = ParquetRecordBatchReaderBuilder::new_with_metadata(file, metadata.clone())
        .with_projection(mask)
        .with_batch_size(FIRST_ROWS)
        .with_limit(FIRST_ROWS)
        .build()
        .map_err(DatasetError::parquet("read the first rows"))?;
    guard::decode(|| {
        reader
            .next()
            .ok_or(DatasetError::Empty)?
            .map_err(DatasetError::arrow("read the first rows"))
    })
}

/// The rows of the file, if its statistics say that no action is null.
fn steps_without_final_rows(metadata: &ArrowReaderMetadata, table: &Table) -> Option<u64> {
    let action = table.action_source()?;
    let leaf = (0..metadata.parquet_schema().num_columns())
        .find(|&leaf| metadata.parquet_schema().get_column_root_idx(leaf) == action)?;
    let mut n_rows = 0;
    for group in metadata.metadata().row_groups() {
        if group.column(leaf).statistics()?.null_count_opt()? != 0 {
            return None;
        }
        n_rows += u64::try_from(group.num_rows()).ok()?;
    }
    Some(n_rows)
}

struct ParquetSource {
    metadata: ArrowReaderMetadata,
    table: Table,
}

impl DatasetSource for ParquetSource {
    fn info(&self) -> &DatasetInfo {
        &self.table.info
    }

    fn schema(&self) -> SchemaRef {
        Arc::clone(&self.table.schema)
    }

    fn scan(&self, scan: &Scan) -> Result<Box<dyn RecordBatchReader + Send + '_>> {
        self.reader(scan)
            .map_err(|error| error.in_file(self.table.path()))
    }

    fn episodes(&self) -> Result<Vec<EpisodeRecord>> {
        (self as &dyn DatasetSource).derived_episodes()
    }
}

impl ParquetSource {
    fn reader(&self, scan: &Scan) -> Result<Box<dyn RecordBatchReader + Send + '_>> {
        let pass = TableScan::new(&self.table, scan)?;
        let selection = Selection {
            path: self.table.path().to_owned(),
            metadata: self.metadata.clone(),
            mask: ProjectionMask::roots(self.metadata.parquet_schema(), pass.sources()),
            batch_rows: scan.batch_rows.max(1),
        };
        let groups = self.groups_of(scan.episodes.as_deref());
        Ok(Box::new(pass.read(Ahead::start(&selection, &groups))))
    }

    /// The row groups that may hold rows of some episodes, by the statistics of the episode column.
    fn groups_of(&self, episodes: Option<&[i64]>) -> Vec<usize> {
        let groups = self.metadata.metadata().row_groups();
        let leaf = self.table.episode_source().and_then(|source| {
            let descriptor = self.metadata.parquet_schema();
            (0..descriptor.num_columns())
                .find(|&leaf| descriptor.get_column_root_idx(leaf) == source)
        });
        let may_hold = |group: &RowGroupMetaData| {
            let (Some(wanted), Some(leaf)) = (episodes, leaf) else {
                return true;
            };
            let Some(Statistics::Int64(statistics)) = group.column(leaf).statistics() else {
                return true;
            };
            match (statistics.min_opt(), statistics.max_opt()) {
                (Some(min), Some(max)) => wanted.iter().any(|e| (min..=max).contains(&e)),
                _ => true,
            }
        };
        (0..groups.len())
            .filter(|&group| may_hold(&groups[group]))
            .collect()
    }
}

impl TableReader for Ahead {
    fn next_rows(&mut self) -> Option<Result<(u64, RecordBatch)>> {
        self.next()
    }

    fn complete(&mut self, rows: RecordBatch) -> Result<RecordBatch> {
        Ok(rows)
    }
}
