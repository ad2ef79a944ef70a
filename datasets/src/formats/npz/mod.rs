//! NumPy archives as OGBench and D4RL-like projects publish them.

use std::path::Path;

use crate::error::{DatasetError, Result};
use crate::format::OpenOptions;
use crate::source::DatasetSource;

/// Opens an archive.
///
/// # Errors
/// What is wrong with it.
pub(crate) fn open(_path: &Path, _options: &OpenOptions) -> Result<Box<dyn DatasetSource>> {
    Err(DatasetError::Unsupported {
        what: "npz".to_owned(),
    })
}
