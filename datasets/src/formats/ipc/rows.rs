//! The rows of a file in batches of the size asked for.

use arrow::array::RecordBatch;

use super::IpcFile;
use crate::error::Result;
use crate::formats::tabular::TableReader;

/// A pass over some columns of a file. A record batch longer than the batch size is handed out in slices.
pub(crate) struct IpcRows {
    file: IpcFile,
    columns: Vec<usize>,
    /// The columns that are read at first; the others when they are wanted.
    first: Vec<usize>,
    batch_rows: usize,
    /// Place of the record batch after `current`.
    next: usize,
    current: Option<Current>,
    /// Rows given so far.
    first_row: u64,
}

/// The record batch at hand.
struct Current {
    rows: RecordBatch,
    is_complete: bool,
    /// Where the slice that was given last starts.
    start: usize,
    /// Where it ends.
    end: usize,
}

impl IpcRows {
    /// A pass over the columns at these places.
    pub(crate) fn new(file: IpcFile, columns: Vec<usize>, batch_rows: usize) -> Self {
        Self {
            file,
            first: columns.clone(),
            columns,
            batch_rows: batch_rows.max(1),
            next: 0,
            current: None,
            first_row: 0,
        }
    }

    /// Reads only the columns at `first` of record batches of which nothing is wanted.
    pub(crate) fn with_first(mut self, first: Vec<usize>) -> Self {
        // Without a column the number of rows would not be checked against any bytes.
        if !first.is_empty() {
            self.first = first;
        }
        self
    }

    fn advance(&mut self) -> Result<Option<RecordBatch>> {
        loop {
            if let Some(current) = &mut self.current {
                let n = (current.rows.num_rows() - current.end).min(self.batch_rows);
                if n > 0 {
                    current.start = current.end;
                    current.end += n;
                    return Ok(Some(current.rows.slice(current.start, n)));
                }
                self.current = None;
            }
            if self.next >= self.file.n_batches() {
                return Ok(None);
            }
            let rows = self.file.read(self.next, &self.first)?;
            self.next += 1;
            self.current = Some(Current {
                rows,
                is_complete: self.first == self.columns,
                start: 0,
                end: 0,
            });
        }
    }
}

impl Iterator for IpcRows {
    type Item = Result<RecordBatch>;

    fn next(&mut self) -> Option<Self::Item> {
        let rows = self.advance();
        if rows.is_err() {
            // A reader that failed ends its pass.
            (self.next, self.current) = (usize::MAX, None);
        }
        rows.transpose()
    }
}

impl TableReader for IpcRows {
    fn next_rows(&mut self) -> Option<Result<(u64, RecordBatch)>> {
        let rows = self.next()?;
        Some(rows.map(|rows| {
            let first_row = self.first_row;
            self.first_row += rows.num_rows() as u64;
            (first_row, rows)
        }))
    }

    fn complete(&mut self, rows: RecordBatch) -> Result<RecordBatch> {
        let Some(current) = &mut self.current else {
            return Ok(rows);
        };
        if !current.is_complete {
            current.rows = self.file.read(self.next - 1, &self.columns)?;
            current.is_complete = true;
        }
        Ok(current
            .rows
            .slice(current.start, current.end - current.start))
    }
}
