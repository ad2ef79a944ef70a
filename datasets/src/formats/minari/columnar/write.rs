//! Writing the Arrow and Parquet storages.

use std::path::Path;

use crate::error::{DatasetError, Result};
use crate::format::Format;
use crate::sink::{DatasetSink, SinkInput, WriteOptions};

/// Starts a dataset folder.
///
/// # Errors
/// The columns do not fit, or the folder cannot be made.
pub(crate) fn create(
    _path: &Path,
    format: Format,
    _input: &SinkInput<'_>,
    _options: &WriteOptions,
) -> Result<Box<dyn DatasetSink>> {
    Err(DatasetError::Unsupported {
        what: format!("writing {format}"),
    })
}
