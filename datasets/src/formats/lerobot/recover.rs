//! Leaving out what is damaged.
//!
//! What is in `meta` must be whole: without it nothing can be found. A damaged data file costs the episodes
//! whose rows cannot be read, so in this mode every file is read once while the dataset is opened.

use super::episodes::{Episodes, Place};
use super::files::ParquetFile;
use super::read::LeRobotSource;
use super::root::Root;
use crate::error::{DatasetError, Result};
use crate::source::Warning;

/// Leaves out the episodes of files that are missing or have no whole footer.
///
/// # Errors
/// No file is left.
pub(super) fn drop_unopenable(
    root: &Root,
    episodes: &mut Episodes,
    warnings: &mut Vec<Warning>,
) -> Result<()> {
    let mut first_error = None;
    for file in 0..episodes.files.len() {
        let path = episodes.files[file].path.clone();
        if let Err(error) = ParquetFile::open(root, &path) {
            lose(episodes, file, |_| true, &error, warnings);
            first_error.get_or_insert(error);
        }
    }
    match first_error {
        Some(error) if episodes.places.is_empty() => Err(error),
        _ => Ok(()),
    }
}

/// Leaves out the episodes whose rows cannot be read.
pub(super) fn drop_damaged(source: &mut LeRobotSource, warnings: &mut Vec<Warning>) {
    let places = source.all_episodes().places.clone();
    for of_file in places.chunk_by(|a, b| a.file == b.file) {
        if read(source, of_file).is_ok() {
            continue;
        }
        let mut damaged = Vec::new();
        let mut first_error = None;
        for place in of_file {
            if let Err(error) = read(source, std::slice::from_ref(place)) {
                damaged.push(place.number);
                first_error.get_or_insert(error);
            }
        }
        if let Some(error) = first_error {
            let file = of_file[0].file;
            let is_damaged = |place: &Place| damaged.contains(&place.number);
            lose(source.all_episodes(), file, is_damaged, &error, warnings);
        }
    }
}

fn read(source: &LeRobotSource, places: &[Place]) -> Result<()> {
    for batch in source.pass(places.iter().copied(), None, 4096)? {
        batch?;
    }
    Ok(())
}

fn lose(
    episodes: &mut Episodes,
    file: usize,
    is_lost: impl Fn(&Place) -> bool,
    error: &DatasetError,
    warnings: &mut Vec<Warning>,
) {
    let all = episodes.places.iter().filter(|place| place.file == file);
    let lost: Vec<i64> = all
        .filter(|place| is_lost(place))
        .map(|place| place.number)
        .collect();
    episodes
        .places
        .retain(|place| place.file != file || !is_lost(place));
    let (Some(first), Some(last)) = (lost.first(), lost.last()) else {
        return;
    };
    let which = match lost.len() {
        1 => format!("episode {first}"),
        n => format!("{n} episodes, {first} to {last}"),
    };
    let path = &episodes.files[file].path;
    let what = format!("{which} of {path}: {}", chain(error.cause()));
    warnings.push(Warning::Lost { what });
}

/// An error and its causes in one line.
fn chain(error: &DatasetError) -> String {
    let mut text = error.to_string();
    let mut source = std::error::Error::source(error);
    while let Some(error) = source {
        text = format!("{text}: {error}");
        source = error.source();
    }
    text
}
