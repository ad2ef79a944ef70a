//! The numbers of every episode, as Parquet and as JSON.

use std::path::Path;
use std::sync::Arc;

use anyhow::{Context as _, Result};
use arrow::array::{ArrayRef, BooleanArray, Float64Array, RecordBatch, UInt64Array};
use ksim_bench_harness::record::EpisodeRecord;
use parquet::arrow::ArrowWriter;
use serde_json::{Value, json};

use crate::atomic::AtomicFile;

/// Writes a row per episode; the file appears when it is complete.
pub(crate) fn write(path: &Path, records: &[EpisodeRecord]) -> Result<()> {
    let batch = batch(records).context("cannot make a table of the episodes")?;
    let write = || format!("cannot write {}", path.display());
    let file = AtomicFile::create(path)?;
    let mut writer = ArrowWriter::try_new(file, batch.schema(), None).with_context(write)?;
    writer.write(&batch).with_context(write)?;
    writer.into_inner().with_context(write)?.publish()
}

fn batch(records: &[EpisodeRecord]) -> Result<RecordBatch> {
    let count = |value: fn(&EpisodeRecord) -> Option<u64>| -> ArrayRef {
        Arc::new(records.iter().map(value).collect::<UInt64Array>())
    };
    let number = |value: fn(&EpisodeRecord) -> Option<f64>| -> ArrayRef {
        Arc::new(records.iter().map(value).collect::<Float64Array>())
    };
    let flag = |value: fn(&EpisodeRecord) -> Option<bool>| -> ArrayRef {
        Arc::new(records.iter().map(value).collect::<BooleanArray>())
    };
    Ok(RecordBatch::try_from_iter_with_nullable([
        ("episode_index", count(|r| Some(r.episode as u64)), false),
        ("run", count(|r| Some(r.run as u64)), false),
        ("seed", count(|r| Some(r.seed)), false),
        ("length", count(|r| Some(r.length as u64)), false),
        ("return", number(|r| Some(r.total_return)), false),
        (
            "discounted_return",
            number(|r| Some(r.discounted_return)),
            false,
        ),
        ("normalized_score", number(|r| r.normalized_score), true),
        ("terminated", flag(|r| Some(r.terminated)), false),
        ("truncated", flag(|r| Some(r.truncated)), false),
        ("success", flag(|r| r.success), true),
        ("success_at_end", flag(|r| r.success_at_end), true),
        (
            "first_success_step",
            count(|r| r.first_success_step.map(|step| step as u64)),
            true,
        ),
    ])?)
}

/// The same as JSON.
pub(crate) fn json(record: &EpisodeRecord) -> Value {
    json!({
        "episode_index": record.episode,
        "run": record.run,
        "seed": record.seed,
        "length": record.length,
        "return": record.total_return,
        "discounted_return": record.discounted_return,
        "normalized_score": record.normalized_score,
        "terminated": record.terminated,
        "truncated": record.truncated,
        "success": record.success,
        "success_at_end": record.success_at_end,
        "first_success_step": record.first_success_step,
    })
}
