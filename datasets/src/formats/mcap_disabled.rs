//! Stands in for MCAP in a build without the feature `mcap`.

use std::path::Path;

use crate::error::{DatasetError, Result};
use crate::format::OpenOptions;
use crate::sink::{DatasetSink, SinkInput, WriteOptions};
use crate::source::DatasetSource;

/// Opens a recording, or a folder of recordings.
///
/// # Errors
/// Always: this build cannot read MCAP.
pub(crate) fn open(_path: &Path, _options: &OpenOptions) -> Result<Box<dyn DatasetSource>> {
    Err(DatasetError::MissingFeature {
        what: "MCAP",
        feature: "mcap",
    })
}

/// Starts a recording.
///
/// # Errors
/// Always: this build cannot write MCAP.
pub(crate) fn create(
    _path: &Path,
    _input: &SinkInput<'_>,
    _options: &WriteOptions,
) -> Result<Box<dyn DatasetSink>> {
    Err(DatasetError::MissingFeature {
        what: "MCAP",
        feature: "mcap",
    })
}
