//! MCAP in a build with the feature `mcap`.

use std::path::Path;

use crate::error::Result;
use crate::format::OpenOptions;
use crate::formats::mcap::{McapSink, McapSource};
use crate::sink::{DatasetSink, SinkInput, WriteOptions};
use crate::source::DatasetSource;

/// Opens a recording, or a folder of recordings.
///
/// # Errors
/// What is wrong with it.
pub(crate) fn open(path: &Path, options: &OpenOptions) -> Result<Box<dyn DatasetSource>> {
    Ok(Box::new(McapSource::open(path, options)?))
}

/// Starts a recording.
///
/// # Errors
/// The columns do not fit, or the file cannot be made.
pub(crate) fn create(
    path: &Path,
    input: &SinkInput<'_>,
    options: &WriteOptions,
) -> Result<Box<dyn DatasetSink>> {
    Ok(Box::new(McapSink::create(path, input, options)?))
}
