//! robomimic HDF5 files.

use std::path::Path;

use crate::error::{DatasetError, Result};
use crate::format::OpenOptions;
use crate::source::DatasetSource;

/// Opens a file.
///
/// # Errors
/// What is wrong with it.
pub(crate) fn open(_path: &Path, _options: &OpenOptions) -> Result<Box<dyn DatasetSource>> {
    Err(DatasetError::Unsupported {
        what: "robomimic".to_owned(),
    })
}
