//! LeRobot dataset folders, v2.0 to v3.x.
//!
//! `meta/info.json` declares the features, `meta/episodes` says where each episode's rows are, `data` has the
//! rows; every row is a step, so there are no final observations. Pictures inside the Parquet files are passed
//! on encoded; videos are not read. Which feature becomes which column is in `columns`.

mod attributes;
mod columns;
mod episodes;
mod files;
mod info;
mod picture;
mod read;
mod recover;
mod root;
mod rows;
mod scan;
mod tasks;
mod write;

use std::path::Path;

use crate::error::Result;
use crate::format::OpenOptions;
use crate::sink::{DatasetSink, SinkInput, WriteOptions};
use crate::source::DatasetSource;

/// Opens a dataset folder.
///
/// # Errors
/// What is wrong with it.
pub(crate) fn open(path: &Path, options: &OpenOptions) -> Result<Box<dyn DatasetSource>> {
    let source = read::LeRobotSource::open(path, options)?;
    Ok(Box::new(source))
}

/// Starts a v3.0 dataset folder.
///
/// # Errors
/// The columns do not fit, or the folder cannot be made.
pub(crate) fn create(
    path: &Path,
    input: &SinkInput<'_>,
    options: &WriteOptions,
) -> Result<Box<dyn DatasetSink>> {
    let sink = write::LeRobotSink::create(path, input, options)?;
    Ok(Box::new(sink))
}
