//! Stands in for the HDF5 writers in a build without the feature `hdf5`.

use std::path::Path;

use crate::error::{DatasetError, Result};
use crate::sink::{DatasetSink, SinkInput, WriteOptions};

/// Starts a D4RL file.
///
/// # Errors
/// Always: this build cannot write HDF5.
pub(crate) fn create_d4rl(
    _path: &Path,
    _input: &SinkInput<'_>,
    _options: &WriteOptions,
) -> Result<Box<dyn DatasetSink>> {
    Err(DatasetError::MissingFeature {
        what: "D4RL HDF5",
        feature: "hdf5",
    })
}

/// Starts a Minari dataset folder.
///
/// # Errors
/// Always: this build cannot write HDF5.
pub(crate) fn create_minari(
    _path: &Path,
    _input: &SinkInput<'_>,
    _options: &WriteOptions,
) -> Result<Box<dyn DatasetSink>> {
    Err(DatasetError::MissingFeature {
        what: "Minari HDF5",
        feature: "hdf5",
    })
}
