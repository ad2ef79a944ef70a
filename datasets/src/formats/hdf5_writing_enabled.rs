//! The HDF5 writers of a build with the feature `hdf5`.

use std::path::Path;

use crate::error::{DatasetError, Result};
use crate::sink::{DatasetSink, SinkInput, WriteOptions};

/// Starts a D4RL file.
///
/// # Errors
/// The columns do not fit, or the file cannot be made.
pub(crate) fn create_d4rl(
    _path: &Path,
    _input: &SinkInput<'_>,
    _options: &WriteOptions,
) -> Result<Box<dyn DatasetSink>> {
    Err(DatasetError::Unsupported {
        what: "writing D4RL HDF5".to_owned(),
    })
}

/// Starts a Minari dataset folder.
///
/// # Errors
/// The columns do not fit, or the folder cannot be made.
pub(crate) fn create_minari(
    _path: &Path,
    _input: &SinkInput<'_>,
    _options: &WriteOptions,
) -> Result<Box<dyn DatasetSink>> {
    Err(DatasetError::Unsupported {
        what: "writing Minari HDF5".to_owned(),
    })
}
