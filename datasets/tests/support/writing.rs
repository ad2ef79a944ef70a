//! Sending datasets through sinks and comparing what comes back.

use std::path::{Path, PathBuf};
use std::process::Command;

use arrow::array::RecordBatch;
use ksim_datasets::{
    DatasetSource, Format, LeafSpec, Loss, LossEffect, OpenOptions, Scan, SinkInput, WriteOptions,
    copy, create, open,
};
use serde_json::Value;

/// A dataset that was written and opened again.
pub(crate) struct RoundTrip {
    pub(crate) back: Box<dyn DatasetSource>,
    pub(crate) losses: Vec<Loss>,
}

/// Writes a source by batches that cut through episodes, and opens the result.
pub(crate) fn round_trip(
    source: &dyn DatasetSource,
    target: &Path,
    format: Format,
    options: &WriteOptions,
) -> RoundTrip {
    let schema = source.schema();
    let episodes = source.episodes().unwrap();
    let input = SinkInput {
        schema: &schema,
        info: source.info(),
        episodes: &episodes,
    };
    let mut sink = create(target, format, &input, options).unwrap();
    let is_small = source.info().n_steps.is_some_and(|n| n < 500);
    let scan = Scan {
        batch_rows: if is_small { 7 } else { 701 },
        ..Scan::default()
    };
    for batch in source.scan(&scan).unwrap() {
        sink.write(&batch.unwrap()).unwrap();
    }
    assert!(
        !target.exists(),
        "nothing is visible before the sink finishes"
    );
    let written = sink.finish().unwrap();
    let back = open(target, &OpenOptions::default()).unwrap();
    assert_eq!(back.info().format, format);
    assert_eq!(back.info().observation, written.info.observation);
    RoundTrip {
        back,
        losses: written.losses,
    }
}

/// A sink that is dropped leaves nothing behind, not even after a row was written.
pub(crate) fn check_atomic(source: &dyn DatasetSource, folder: &Path, format: Format) {
    let schema = source.schema();
    let episodes = source.episodes().unwrap();
    let input = SinkInput {
        schema: &schema,
        info: source.info(),
        episodes: &episodes,
    };
    let before = std::fs::read_dir(folder).unwrap().count();
    let target = folder.join("dropped");
    let mut sink = create(&target, format, &input, &WriteOptions::default()).unwrap();
    copy(source, sink.as_mut()).unwrap();
    drop(sink);
    assert_eq!(std::fs::read_dir(folder).unwrap().count(), before);
    // Fewer rows than promised are an error, and leave nothing either.
    if source.info().n_steps != Some(0) {
        let sink = create(&target, format, &input, &WriteOptions::default()).unwrap();
        assert!(sink.finish().is_err(), "rows are missing");
        assert_eq!(std::fs::read_dir(folder).unwrap().count(), before);
    }
}

/// All rows as one batch.
pub(crate) fn rows(source: &dyn DatasetSource) -> RecordBatch {
    let reader = source.scan(&Scan::default()).unwrap();
    let schema = reader.schema();
    let batches: Vec<_> = reader.collect::<Result<_, _>>().unwrap();
    arrow::compute::concat_batches(&schema, &batches).unwrap()
}

/// The same columns with the same values, bit by bit, and the same episodes.
pub(crate) fn assert_same(a: &dyn DatasetSource, b: &dyn DatasetSource, place: &str) {
    let (rows_a, rows_b) = (rows(a), rows(b));
    assert_eq!(
        rows_a.schema().fields(),
        rows_b.schema().fields(),
        "{place}"
    );
    for (place_of, field) in rows_a.schema().fields().iter().enumerate() {
        let (column_a, column_b) = (rows_a.column(place_of), rows_b.column(place_of));
        assert_eq!(column_a, column_b, "{place}: {}", field.name());
    }
    assert_eq!(a.episodes().unwrap(), b.episodes().unwrap(), "{place}");
    let leaves = |source: &dyn DatasetSource| {
        let info = source.info();
        let leaves = info.observation.iter().chain(&info.action);
        let plain = |leaf: &LeafSpec| {
            (
                leaf.column.clone(),
                leaf.shape.clone(),
                leaf.data_type.clone(),
            )
        };
        leaves.map(plain).collect::<Vec<_>>()
    };
    assert_eq!(leaves(a), leaves(b), "{place}");
}

/// The count of a loss; `None` if it is not among them.
pub(crate) fn loss(losses: &[Loss], item: &str, effect: LossEffect) -> Option<u64> {
    let found = losses
        .iter()
        .find(|loss| loss.item == item && loss.effect == effect);
    found.map(|loss| loss.count.unwrap_or(0))
}

/// Runs a script of the repository with the Python of `KSIM_PYTHON`, by default `python3`, and gives the JSON it
/// prints. `None` if a module it needs is not installed, which is said on the standard error output.
#[expect(clippy::print_stderr, reason = "a test that is skipped says so")]
pub(crate) fn python(script: &str, modules: &str, arguments: &[&Path]) -> Option<Value> {
    let python = std::env::var_os("KSIM_PYTHON").unwrap_or_else(|| "python3".into());
    let import = Command::new(&python)
        .args(["-c", &format!("import {modules}")])
        .output();
    if !import.is_ok_and(|output| output.status.success()) {
        eprintln!("skipped: {} cannot import {modules}", python.display());
        return None;
    }
    let script: PathBuf = Path::new(env!("CARGO_MANIFEST_DIR"))
        .join("../scripts")
        .join(script);
    let output = Command::new(&python)
        .arg(&script)
        .args(arguments)
        .output()
        .unwrap();
    assert!(
        output.status.success(),
        "{}: {}",
        script.display(),
        String::from_utf8_lossy(&output.stderr)
    );
    Some(serde_json::from_slice(&output.stdout).unwrap())
}
