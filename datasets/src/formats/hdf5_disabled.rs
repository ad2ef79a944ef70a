//! Stands in for the HDF5 readers in a build without the feature `hdf5`.

use std::path::Path;

use crate::error::{DatasetError, Result};
use crate::format::OpenOptions;
use crate::source::DatasetSource;

/// # Errors
/// Always: this build cannot read HDF5.
pub(crate) fn open_d4rl(_path: &Path, _options: &OpenOptions) -> Result<Box<dyn DatasetSource>> {
    Err(DatasetError::MissingFeature {
        what: "D4RL HDF5",
        feature: "hdf5",
    })
}

/// # Errors
/// Always: this build cannot read HDF5.
pub(crate) fn open_minari(_path: &Path, _options: &OpenOptions) -> Result<Box<dyn DatasetSource>> {
    Err(DatasetError::MissingFeature {
        what: "Minari HDF5",
        feature: "hdf5",
    })
}

/// # Errors
/// Always: this build cannot read HDF5.
pub(crate) fn open_robomimic(
    _path: &Path,
    _options: &OpenOptions,
) -> Result<Box<dyn DatasetSource>> {
    Err(DatasetError::MissingFeature {
        what: "robomimic HDF5",
        feature: "hdf5",
    })
}

/// False: this build cannot look into HDF5.
pub(crate) fn is_robomimic(_path: &Path) -> bool {
    false
}
