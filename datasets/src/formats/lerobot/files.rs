//! Parquet files inside the folder.

use std::fs::File;
use std::io::{BufRead, BufReader};

use arrow::array::{ArrayRef, RecordBatch};
use arrow::datatypes::{DataType, SchemaRef};
use parquet::arrow::ProjectionMask;
use parquet::arrow::arrow_reader::{
    ArrowReaderMetadata, ArrowReaderOptions, ParquetRecordBatchReader,
    ParquetRecordBatchReaderBuilder, RowSelection, RowSelector,
};

use serde_json::{Map, Value};

use super::root::Root;
use crate::error::{DatasetError, Result};
use crate::formats::minari::json;
use crate::{episode, guard};

/// A file whose footer was read.
pub(super) struct ParquetFile {
    file: File,
    metadata: ArrowReaderMetadata,
}

impl ParquetFile {
    /// # Errors
    /// The file is not there, not inside the folder, or has no whole footer; it is named.
    pub(super) fn open(root: &Root, relative: &str) -> Result<Self> {
        let file = root.open(relative)?;
        let metadata = guard::decode(|| {
            ArrowReaderMetadata::load(&file, ArrowReaderOptions::new())
                .map_err(DatasetError::parquet("read the Parquet footer"))
        })
        .map_err(|error| error.in_file(&root.join(relative)))?;
        Ok(Self { file, metadata })
    }

    pub(super) fn schema(&self) -> &SchemaRef {
        self.metadata.schema()
    }

    /// Rows, as the footer counts them.
    pub(super) fn n_rows(&self) -> u64 {
        let n_rows = self.metadata.metadata().file_metadata().num_rows();
        u64::try_from(n_rows).unwrap_or(0)
    }

    /// Bytes of a row in those columns before they were packed, by the fullest row group.
    pub(super) fn row_bytes(&self, wanted: impl Fn(&str) -> bool) -> u64 {
        let groups = self.metadata.metadata().row_groups().iter();
        let per_row = groups.map(|group| {
            let columns = group.columns().iter();
            let roots = columns.filter(|column| {
                let root = column.column_path().parts().first();
                root.is_some_and(|root| wanted(root))
            });
            let bytes: u64 = roots
                .map(|column| u64::try_from(column.uncompressed_size()).unwrap_or(0))
                .fold(0, u64::saturating_add);
            bytes / u64::try_from(group.num_rows()).unwrap_or(0).max(1)
        });
        per_row.max().unwrap_or(0)
    }

    /// All rows of the wanted columns.
    ///
    /// # Errors
    /// The reader cannot be set up.
    pub(super) fn read(self, wanted: impl Fn(&str) -> bool, batch_rows: usize) -> Result<Batches> {
        let n_rows = self.n_rows();
        self.read_rows(wanted, batch_rows, &[(0, n_rows)])
    }

    /// Those rows, given as ascending ranges; row groups outside them are not touched.
    ///
    /// # Errors
    /// The reader cannot be set up.
    pub(super) fn read_rows(
        self,
        wanted: impl Fn(&str) -> bool,
        batch_rows: usize,
        ranges: &[(u64, u64)],
    ) -> Result<Batches> {
        let fields = self.metadata.schema().fields().iter().enumerate();
        let roots = fields.filter(|(_, field)| wanted(field.name()));
        let mask = ProjectionMask::roots(
            self.metadata.parquet_schema(),
            roots.map(|(place, _)| place),
        );
        let (groups, selection) = self.select(ranges);
        let reader = guard::decode(|| {
            ParquetRecordBatchReaderBuilder::new_with_metadata(self.file, self.metadata)
                .with_projection(mask)
                .with_row_groups(groups)
                .with_row_selection(selection)
                .with_batch_size(batch_rows)
                .build()
                .map_err(DatasetError::parquet("read rows"))
        });
        Ok(Batches(reader?))
    }

    /// The row groups that hold rows of the ranges, and which of their rows.
    fn select(&self, ranges: &[(u64, u64)]) -> (Vec<usize>, RowSelection) {
        let mut groups = Vec::new();
        let mut selectors = Vec::new();
        let mut start = 0u64;
        for (place, group) in self.metadata.metadata().row_groups().iter().enumerate() {
            let end = start.saturating_add(u64::try_from(group.num_rows()).unwrap_or(0));
            let mut at = start;
            let mut chosen = Vec::new();
            for (from, to) in ranges {
                let (from, to) = ((*from).max(at), (*to).min(end));
                if from < to {
                    chosen.push(RowSelector::skip(to_usize(from - at)));
                    chosen.push(RowSelector::select(to_usize(to - from)));
                    at = to;
                }
            }
            if !chosen.is_empty() {
                chosen.push(RowSelector::skip(to_usize(end - at)));
                selectors.append(&mut chosen);
                groups.push(place);
            }
            start = end;
        }
        (groups, RowSelection::from(selectors))
    }
}

fn to_usize(n: u64) -> usize {
    usize::try_from(n).unwrap_or(usize::MAX)
}

/// Rows of a file.
pub(super) struct Batches(ParquetRecordBatchReader);

impl Iterator for Batches {
    type Item = Result<RecordBatch>;

    fn next(&mut self) -> Option<Self::Item> {
        guard::decode(|| {
            self.0
                .next()
                .transpose()
                .map_err(DatasetError::arrow("read rows"))
        })
        .transpose()
    }
}

/// A column of a batch in another type; what does not fit becomes null.
///
/// # Errors
/// It is not there, or cannot be converted.
pub(super) fn cast(batch: &RecordBatch, name: &str, to: &DataType) -> Result<ArrayRef> {
    let column = episode::column(batch, name)?;
    arrow::compute::cast(column, to).map_err(DatasetError::arrow("convert a column"))
}

/// Hands the object of every line to `each`.
///
/// # Errors
/// The file is not there, a line is no object, or what `each` says; the file is named.
pub(super) fn json_lines(
    root: &Root,
    relative: &str,
    mut each: impl FnMut(Map<String, Value>) -> Result<()>,
) -> Result<()> {
    let mut read = || {
        for (number, line) in BufReader::new(root.open(relative)?).lines().enumerate() {
            let line = line.map_err(|e| DatasetError::io("read", e))?;
            if line.trim().is_empty() {
                continue;
            }
            match json::parse(&line, &format!("line {}", number + 1))? {
                Value::Object(object) => each(object)?,
                _ => {
                    let what = format!("line {} is no JSON object", number + 1);
                    return Err(DatasetError::corrupt(what));
                }
            }
        }
        Ok(())
    };
    read().map_err(|error| error.in_file(&root.join(relative)))
}
