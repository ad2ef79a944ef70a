//! Arrow IPC files, read a record batch at a time.
//!
//! The `arrow` crate's own decoder trusts what a file says about itself and panics on some of what it does not
//! expect. So a file is checked first: types, the place of every block and buffer, and the lengths of nested
//! columns. Memory is O(one record batch), which is never more than the file has bytes.

mod check;
mod file;

pub(crate) use file::IpcFile;

use std::path::Path;

use crate::error::{DatasetError, Result};
use crate::format::OpenOptions;
use crate::sink::{DatasetSink, SinkInput, WriteOptions};
use crate::source::DatasetSource;

/// Opens a file in the canonical layout.
///
/// # Errors
/// What is wrong with it.
pub(crate) fn open(_path: &Path, _options: &OpenOptions) -> Result<Box<dyn DatasetSource>> {
    Err(DatasetError::Unsupported {
        what: "Arrow IPC".to_owned(),
    })
}

/// Starts a file.
///
/// # Errors
/// The file cannot be made.
pub(crate) fn create(
    _path: &Path,
    _input: &SinkInput<'_>,
    _options: &WriteOptions,
) -> Result<Box<dyn DatasetSink>> {
    Err(DatasetError::Unsupported {
        what: "writing Arrow IPC".to_owned(),
    })
}
