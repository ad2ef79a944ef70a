//! LeRobot dataset folders, v2.0 to v3.x.

use std::path::Path;

use crate::error::{DatasetError, Result};
use crate::format::OpenOptions;
use crate::sink::{DatasetSink, SinkInput, WriteOptions};
use crate::source::DatasetSource;

/// Opens a dataset folder.
///
/// # Errors
/// What is wrong with it.
pub(crate) fn open(_path: &Path, _options: &OpenOptions) -> Result<Box<dyn DatasetSource>> {
    Err(DatasetError::Unsupported {
        what: "LeRobot".to_owned(),
    })
}

/// Starts a v3.0 dataset folder.
///
/// # Errors
/// The columns do not fit, or the folder cannot be made.
pub(crate) fn create(
    _path: &Path,
    _input: &SinkInput<'_>,
    _options: &WriteOptions,
) -> Result<Box<dyn DatasetSink>> {
    Err(DatasetError::Unsupported {
        what: "writing LeRobot".to_owned(),
    })
}
