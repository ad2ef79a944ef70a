//! How many lines a figure is to have, before anything is scored.

use std::collections::BTreeSet;
use std::ops::Range;

use anyhow::{Context as _, Result, bail};
use ksim_bench_harness::figure::lines::MAX_LINES;
use ksim_datasets::{TransitionOptions, TransitionReader};

use crate::load::{self, PLANNER};
use crate::scoring::RolloutFile;

/// Refuses more lines than can be told apart.
pub(super) fn check(n_lines: usize) -> Result<()> {
    if n_lines > MAX_LINES {
        bail!(
            "{n_lines} lines are too many to be told apart, expected at most {MAX_LINES}: \
             draw fewer files, planners or episodes"
        );
    }
    Ok(())
}

/// A line per file or planner; with `episodes`, per episode of these that a file or planner has.
pub(super) fn count(files: &[RolloutFile], episodes: &[Range<i64>]) -> Result<usize> {
    let counts = files.iter().map(|file| {
        of_file(file, episodes).with_context(|| file.source.info().path.display().to_string())
    });
    counts.sum()
}

fn of_file(file: &RolloutFile, episodes: &[Range<i64>]) -> Result<usize> {
    let names_planners = load::names_planners(&*file.source);
    if !names_planners && episodes.is_empty() {
        return Ok(1);
    }
    let options = TransitionOptions {
        // One column is enough to tell which rows are steps.
        state_columns: Some(file.columns.indices.iter().copied().take(1).collect()),
        text_column: names_planners.then(|| PLANNER.to_owned()),
        ..TransitionOptions::default()
    };
    let mut lines = BTreeSet::new();
    for batch in TransitionReader::new(&*file.source, &options)? {
        let batch = batch?;
        for (row, number) in batch.episode_index.iter().enumerate() {
            let planner = batch.text.as_ref().and_then(|text| text[row].clone());
            if episodes.is_empty() {
                lines.insert((planner, None));
            } else if episodes.iter().any(|range| range.contains(number)) {
                lines.insert((planner, Some(*number)));
            }
        }
    }
    Ok(lines.len())
}
