//! The HDF5 readers of a build with the feature `hdf5`.

use std::path::Path;

use crate::error::Result;
use crate::format::OpenOptions;
use crate::formats::{d4rl, minari, robomimic};
use crate::source::DatasetSource;

/// Opens a D4RL file.
///
/// # Errors
/// Whatever is wrong with the file.
pub(crate) fn open_d4rl(path: &Path, options: &OpenOptions) -> Result<Box<dyn DatasetSource>> {
    Ok(Box::new(d4rl::D4rlSource::open(path, options)?))
}

/// Opens a Minari dataset folder.
///
/// # Errors
/// Whatever is wrong with the dataset.
pub(crate) fn open_minari(path: &Path, options: &OpenOptions) -> Result<Box<dyn DatasetSource>> {
    Ok(Box::new(minari::MinariSource::open(path, options)?))
}

/// Opens a robomimic file.
///
/// # Errors
/// Whatever is wrong with the file.
pub(crate) fn open_robomimic(path: &Path, options: &OpenOptions) -> Result<Box<dyn DatasetSource>> {
    robomimic::open(path, options)
}

/// Whether an HDF5 file is robomimic's: it has a group `data` of demonstrations. False if it cannot be opened:
/// then the reader that is tried says what is wrong.
pub(crate) fn is_robomimic(path: &Path) -> bool {
    robomimic::is_robomimic(path)
}
