//! MCAP in a build with the feature `mcap`.

use std::path::Path;

use crate::error::{DatasetError, Result};
use crate::format::OpenOptions;
use crate::sink::{DatasetSink, SinkInput, WriteOptions};
use crate::source::DatasetSource;

/// Opens a recording, or a folder of recordings.
///
/// # Errors
/// What is wrong with it.
pub(crate) fn open(_path: &Path, _options: &OpenOptions) -> Result<Box<dyn DatasetSource>> {
    Err(DatasetError::Unsupported {
        what: "MCAP".to_owned(),
    })
}

/// Starts a recording.
///
/// # Errors
/// The columns do not fit, or the file cannot be made.
pub(crate) fn create(
    _path: &Path,
    _input: &SinkInput<'_>,
    _options: &WriteOptions,
) -> Result<Box<dyn DatasetSink>> {
    Err(DatasetError::Unsupported {
        what: "writing MCAP".to_owned(),
    })
}
