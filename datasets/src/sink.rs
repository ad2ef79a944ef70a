//! Writing datasets.

use arrow::array::RecordBatch;

use crate::error::Result;
use crate::source::{DatasetInfo, DatasetSource, Scan};

/// Write side. Nothing is visible at the destination until `finish` succeeds.
pub trait DatasetSink: Send {
    /// Adds the rows of a batch in the canonical layout; all batches have the same schema.
    ///
    /// # Errors
    /// A batch of another schema, or a failed write.
    fn write(&mut self, batch: &RecordBatch) -> Result<()>;

    /// Puts the dataset in its place and describes it.
    ///
    /// # Errors
    /// A failed write; the destination is then untouched.
    fn finish(self: Box<Self>) -> Result<DatasetInfo>;
}

/// Writes all rows of a dataset; the caller finishes the sink. Gives the number of rows.
///
/// # Errors
/// Those of the scan and of the sink.
pub fn copy(source: &dyn DatasetSource, sink: &mut dyn DatasetSink) -> Result<u64> {
    let mut n_rows = 0;
    for batch in source.scan(&Scan::default())? {
        let batch = batch?;
        n_rows += batch.num_rows() as u64;
        sink.write(&batch)?;
    }
    Ok(n_rows)
}
