//! Finding faults in datasets.
//!
//! [`validate`] reads a dataset once, in batches, and says what is wrong or odd about it as a [`Report`] of
//! [`Finding`]s. Each kind of fault has a stable code; `docs/validate.md` lists all of them.
//!
//! Memory is one batch (at most about four million values) twice, as read and as `f64`, and for the whole pass:
//! one number per value of a row, some 50 bytes per episode (its number and a digest), and a histogram of a few
//! megabytes at most per observation column.
//! The result depends on nothing but the data: not on batch sizes, threads or hash order.

mod actions;
mod drive;
mod duplicates;
mod facts;
mod flags;
mod goals;
mod jumps;
mod lengths;
mod magnitudes;
mod next;
mod numbers;
mod opening;
mod report;
mod rows;
mod times;
mod values;

#[cfg(test)]
mod synthetic;

use std::path::Path;

use crate::error::DatasetError;
use crate::format::OpenOptions;
use crate::source::DatasetSource;

pub use report::{Coverage, Finding, Place, Report, Severity};

/// Looks for faults in an open dataset. A read error ends the pass and is a finding itself; what was found
/// before it is kept, and [`Coverage::complete`] is false.
pub fn validate(source: &dyn DatasetSource) -> Report {
    drive::run(source)
}

/// Opens a dataset and looks for faults; failure to open is the only finding then.
pub fn validate_path(path: &Path, options: &OpenOptions) -> Report {
    match crate::open(path, options) {
        Ok(source) => validate(source.as_ref()),
        Err(error) => unreadable(path, &error),
    }
}

/// The report on a dataset that cannot be opened.
pub fn unreadable(path: &Path, error: &DatasetError) -> Report {
    Report {
        id: path
            .file_stem()
            .map(|stem| stem.to_string_lossy().into_owned())
            .unwrap_or_default(),
        format: None,
        path: path.to_owned(),
        coverage: Coverage::default(),
        findings: vec![opening::unreadable(path, error)],
    }
}
