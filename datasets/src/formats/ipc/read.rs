//! IPC files as datasets.

use std::path::Path;
use std::sync::Arc;

use arrow::array::{RecordBatch, RecordBatchReader};
use arrow::datatypes::SchemaRef;

use super::{IpcFile, IpcRows};
use crate::episode::EpisodeRecord;
use crate::error::{DatasetError, Result};
use crate::format::{Format, OpenOptions};
use crate::formats::tabular::{FIRST_ROWS, Table, TableScan};
use crate::source::{DatasetInfo, DatasetSource, Scan};

/// Opens a file in the canonical layout, or any with columns that can be recognized.
///
/// # Errors
/// The file is damaged, or has no columns that can serve.
pub(crate) fn open(path: &Path, options: &OpenOptions) -> Result<Box<dyn DatasetSource>> {
    let (file, mut warnings) = open_file(path, options.recover)?;
    let schema = Arc::clone(file.schema());
    let mut table = Table::new(
        path,
        Format::ArrowIpc,
        &schema,
        &options.columns,
        |places| first_rows(file, places),
    )?;
    warnings.append(&mut table.info.warnings);
    table.info.warnings = warnings;
    Ok(Box::new(IpcSource {
        table,
        recover: options.recover,
    }))
}

fn open_file(path: &Path, recover: bool) -> Result<(IpcFile, Vec<crate::Warning>)> {
    match recover {
        true => IpcFile::recover(path),
        false => Ok((IpcFile::open(path)?, Vec::new())),
    }
}

fn first_rows(file: IpcFile, places: &[usize]) -> Result<RecordBatch> {
    let mut rows = IpcRows::new(file, places.to_vec(), FIRST_ROWS);
    rows.next().ok_or(DatasetError::Empty)?
}

struct IpcSource {
    table: Table,
    recover: bool,
}

impl DatasetSource for IpcSource {
    fn info(&self) -> &DatasetInfo {
        &self.table.info
    }

    fn schema(&self) -> SchemaRef {
        Arc::clone(&self.table.schema)
    }

    fn scan(&self, scan: &Scan) -> Result<Box<dyn RecordBatchReader + Send + '_>> {
        let reader = || -> Result<Box<dyn RecordBatchReader + Send + '_>> {
            let pass = TableScan::new(&self.table, scan)?;
            let (file, _) = open_file(self.table.path(), self.recover)?;
            let mut rows = IpcRows::new(file, pass.sources(), scan.batch_rows);
            if scan.episodes.is_some() {
                rows = rows.with_first(pass.index_sources());
            }
            Ok(Box::new(pass.read(rows)))
        };
        reader().map_err(|error| error.in_file(self.table.path()))
    }

    fn episodes(&self) -> Result<Vec<EpisodeRecord>> {
        (self as &dyn DatasetSource).derived_episodes()
    }
}
