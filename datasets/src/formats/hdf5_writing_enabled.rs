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

pub(crate) use crate::formats::minari::create_hdf5 as create_minari;
