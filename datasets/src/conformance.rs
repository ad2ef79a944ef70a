//! What every [`DatasetSource`] and [`crate::DatasetSink`] must hold to. For tests: the checks panic.

use std::path::Path;

use arrow::array::{Array, AsArray, RecordBatch};
use arrow::datatypes::Int64Type;

use crate::error::Result;
use crate::format::{Format, OpenOptions, open};
use crate::schema;
use crate::sink::{SinkInput, WriteOptions, copy, create};
use crate::source::{DatasetSource, Scan};

/// Checks the contract of [`DatasetSource`]: schemas, order of rows, the N+1 rule, batch sizes, projection,
/// choice of episodes, and that `info` and `episodes` agree with the rows.
///
/// # Errors
/// Those of the source.
///
/// # Panics
/// If the source breaks the contract.
pub fn check_source(source: &dyn DatasetSource) -> Result<()> {
    let whole = read(source, &Scan::default())?;
    check_rows(&whole);
    for batch_rows in [1, 7] {
        let scan = Scan {
            batch_rows,
            ..Scan::default()
        };
        for batch in source.scan(&scan)? {
            assert!(
                (1..=batch_rows).contains(&batch?.num_rows()),
                "batches keep to their size"
            );
        }
        assert_eq!(
            read(source, &scan)?,
            whole,
            "the size of batches changes nothing"
        );
    }
    for (place, field) in source.schema().fields().iter().enumerate() {
        let scan = Scan {
            columns: Some(vec![field.name().clone()]),
            ..Scan::default()
        };
        let one = read(source, &scan)?;
        assert_eq!(one.num_columns(), 1);
        assert_eq!(
            one.column(0),
            whole.column(place),
            "a projection changes nothing"
        );
    }
    let unknown = Scan {
        columns: Some(vec!["no such column".to_owned()]),
        ..Scan::default()
    };
    assert!(
        source.scan(&unknown).is_err(),
        "an unknown column is an error"
    );
    check_episodes(source, &whole)
}

/// Writes `source` to Parquet in `folder`, reads it back, and compares every value and all metadata.
///
/// # Errors
/// Those of source and sink.
///
/// # Panics
/// If something was lost.
pub fn check_parquet_round_trip(source: &dyn DatasetSource, folder: &Path) -> Result<()> {
    check_round_trip(source, folder, Format::Parquet)
}

/// As [`check_parquet_round_trip`], for any format that holds the canonical layout as it is.
///
/// # Errors
/// Those of source and sink.
///
/// # Panics
/// If something was lost.
pub fn check_round_trip(source: &dyn DatasetSource, folder: &Path, format: Format) -> Result<()> {
    let path = folder.join(format!("round_trip.{format}"));
    let schema = source.schema();
    let episodes = source.episodes()?;
    let input = SinkInput {
        schema: &schema,
        info: source.info(),
        episodes: &episodes,
    };
    let mut sink = create(&path, format, &input, &WriteOptions::default())?;
    let n_rows = copy(source, sink.as_mut())?;
    assert!(
        !path.exists(),
        "nothing is visible before the sink finishes"
    );
    let info = sink.finish()?.info;
    assert_eq!(info.id, source.info().id);
    let back = open(&path, &OpenOptions::default())?;
    let (before, after) = (
        read(source, &Scan::default())?,
        read(back.as_ref(), &Scan::default())?,
    );
    assert_eq!(after.num_rows() as u64, n_rows);
    let mut metadata = after.schema().metadata().clone();
    if !schema.metadata().contains_key(schema::EPISODE_RECORDS) {
        // Where the file keeps what the source has elsewhere.
        metadata.remove(schema::EPISODE_RECORDS);
    }
    assert_eq!(before.schema().fields(), after.schema().fields());
    assert_eq!(*schema.metadata(), metadata, "the metadata survives");
    assert_eq!(before.columns(), after.columns(), "the rows survive");
    assert_eq!(info.observation_width(), source.info().observation_width());
    Ok(())
}

fn read(source: &dyn DatasetSource, scan: &Scan) -> Result<RecordBatch> {
    let reader = source.scan(scan)?;
    let (promised, _) = schema::project(&source.schema(), scan.columns.as_deref())?;
    assert_eq!(
        reader.schema(),
        promised,
        "a reader has the promised schema"
    );
    let mut batches = Vec::new();
    for batch in reader {
        let batch = batch?;
        assert_eq!(
            batch.schema(),
            promised,
            "every batch has the promised schema"
        );
        batches.push(batch);
    }
    Ok(arrow::compute::concat_batches(&promised, &batches)?)
}

fn indices(batch: &RecordBatch, name: &str) -> Vec<i64> {
    let column = batch
        .column_by_name(name)
        .unwrap_or_else(|| panic!("no column {name}"));
    assert_eq!(column.null_count(), 0, "{name} has no nulls");
    column.as_primitive::<Int64Type>().values().to_vec()
}

fn check_rows(whole: &RecordBatch) {
    let (episodes, steps) = (
        indices(whole, schema::EPISODE_INDEX),
        indices(whole, schema::STEP_INDEX),
    );
    for row in 1..episodes.len() {
        if episodes[row] == episodes[row - 1] {
            assert!(steps[row] > steps[row - 1], "row {row}: steps ascend");
        } else {
            assert!(
                !episodes[..row].contains(&episodes[row]),
                "row {row}: episodes are contiguous"
            );
        }
    }
    let fields = whole.schema();
    let step_columns: Vec<_> = fields
        .fields()
        .iter()
        .zip(whole.columns())
        .filter(|(field, _)| {
            schema::belongs_to(field.name(), schema::ACTION)
                || [schema::REWARD, schema::TERMINATED].contains(&field.name().as_str())
        })
        .map(|(_, column)| column)
        .collect();
    for row in 0..episodes.len() {
        let n_null = step_columns
            .iter()
            .filter(|column| column.is_null(row))
            .count();
        assert!(
            n_null == 0 || n_null == step_columns.len(),
            "row {row} is a step or it is not"
        );
        let is_last = row + 1 == episodes.len() || episodes[row + 1] != episodes[row];
        assert!(
            n_null == 0 || is_last,
            "row {row}: only the last row of an episode is no step"
        );
    }
}

fn check_episodes(source: &dyn DatasetSource, whole: &RecordBatch) -> Result<()> {
    let episodes = source.episodes()?;
    let info = source.info();
    assert!(
        info.n_episodes.is_none_or(|n| n == episodes.len() as u64),
        "info counts the episodes"
    );
    let n_steps: u64 = episodes.iter().map(|episode| episode.length).sum();
    assert!(
        info.n_steps.is_none_or(|n| n == n_steps),
        "info counts the steps"
    );
    let mut row = 0;
    for episode in &episodes {
        assert_eq!(episode.first_row, row);
        assert_eq!(
            episode.n_rows,
            episode.length + u64::from(episode.has_final_obs)
        );
        row += episode.n_rows;
    }
    assert_eq!(
        row,
        whole.num_rows() as u64,
        "every row belongs to an episode"
    );
    if let Some(last) = episodes.last() {
        let chosen = Some(vec![last.episode_index]);
        let one = read(
            source,
            &Scan {
                episodes: chosen,
                batch_rows: 3,
                ..Scan::default()
            },
        )?;
        let start = usize::try_from(last.first_row).unwrap_or(usize::MAX);
        assert_eq!(
            one,
            whole.slice(start, one.num_rows()),
            "an episode can be read alone"
        );
        assert_eq!(one.num_rows() as u64, last.n_rows);
    }
    Ok(())
}
