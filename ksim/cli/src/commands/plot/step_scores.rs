//! Scores of steps, as `ksim score --per-step` writes them.

use std::collections::BTreeMap;
use std::fs::File;
use std::path::Path;

use anyhow::{Context as _, Result, bail};
use arrow::array::{Array, AsArray, RecordBatch};
use arrow::datatypes::{Float64Type, Int64Type};
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;

/// The scores of all episodes of one file, in the order of their steps.
pub(super) struct StepScores(BTreeMap<i64, Vec<f64>>);

impl StepScores {
    /// Reads the file.
    pub(super) fn read(path: &Path) -> Result<Self> {
        Self::try_read(path).with_context(|| path.display().to_string())
    }

    fn try_read(path: &Path) -> Result<Self> {
        let file = File::open(path).context("cannot open")?;
        let reader = ParquetRecordBatchReaderBuilder::try_new(file)?.build()?;
        let mut scores = BTreeMap::<i64, Vec<f64>>::new();
        let mut label = None;
        for batch in reader {
            let batch = batch?;
            check_single(&batch, &mut label)?;
            let episodes = column(&batch, "episode_index")?;
            let episodes = episodes
                .as_primitive_opt::<Int64Type>()
                .context("episode_index is no int64")?;
            let values = column(&batch, "score")?;
            let values = values
                .as_primitive_opt::<Float64Type>()
                .context("score is no float64")?;
            for (episode, score) in episodes.values().iter().zip(values.values()) {
                scores.entry(*episode).or_default().push(*score);
            }
        }
        Ok(Self(scores))
    }

    /// The scores of an episode.
    pub(super) fn of(&self, episode_index: i64, file: &Path) -> Result<Vec<f64>> {
        let scores = self.0.get(&episode_index).cloned();
        scores.with_context(|| {
            format!(
                "{} has no scores of episode {episode_index}",
                file.display()
            )
        })
    }
}

fn column<'a>(batch: &'a RecordBatch, name: &str) -> Result<&'a dyn Array> {
    let column = batch.column_by_name(name);
    let column = column.with_context(|| {
        format!("no column \"{name}\": expected what `ksim score --per-step` writes")
    })?;
    Ok(column.as_ref())
}

/// Refuses scores of several files or planners: their episodes have the same numbers.
fn check_single(batch: &RecordBatch, seen: &mut Option<Vec<String>>) -> Result<()> {
    for row in 0..batch.num_rows() {
        let label = |name: &str| -> Option<String> {
            let texts = batch.column_by_name(name)?.as_string_opt::<i32>()?;
            texts.is_valid(row).then(|| texts.value(row).to_owned())
        };
        let label: Vec<String> = ["file", "planner"].into_iter().filter_map(label).collect();
        match seen {
            Some(first) if *first != label => bail!(
                "it holds the scores of several rollouts ({} and {}): score one alone",
                first.join(", "),
                label.join(", ")
            ),
            Some(_) => {}
            None => *seen = Some(label),
        }
    }
    Ok(())
}
