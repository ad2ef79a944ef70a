//! Conversions through selections, from files and back.
#![expect(clippy::unwrap_used, reason = "tests")]

use std::ops::ControlFlow;
use std::path::Path;
use std::sync::Arc;

use arrow::array::{Array, ArrayRef, AsArray, Float64Array, Int64Array, RecordBatch, StringArray};
use arrow::compute::concat_batches;
use arrow::datatypes::{DataType, Field, Float32Type, Int64Type, Schema};
use ksim_datasets::convert::{Cast, ConvertOptions, ConvertReport, convert};
use ksim_datasets::{
    DatasetError, DatasetSink, DatasetSource, Format, OpenOptions, ParquetSink, Result, Scan, open,
    schema,
};

/// Four episodes of three steps each, with a text column.
fn write_source(path: &Path) -> Box<dyn DatasetSource> {
    let episodes: Vec<i64> = (0..12).map(|row| row / 3).collect();
    let steps: Vec<i64> = (0..12).map(|row| row % 3).collect();
    let values: Vec<f64> = (0..12).map(|row| 0.1 * f64::from(row)).collect();
    let texts: Vec<String> = (0..12).map(|row| format!("row {row}")).collect();
    let columns: Vec<(&str, ArrayRef)> = vec![
        (schema::EPISODE_INDEX, Arc::new(Int64Array::from(episodes))),
        (schema::STEP_INDEX, Arc::new(Int64Array::from(steps))),
        (
            "observation.x",
            Arc::new(Float64Array::from(values.clone())),
        ),
        (
            "observation.y",
            Arc::new(Float64Array::from(values.clone())),
        ),
        ("action", Arc::new(Float64Array::from(values))),
        ("info.note", Arc::new(StringArray::from(texts))),
    ];
    let fields: Vec<Field> = columns
        .iter()
        .map(|(name, array)| Field::new(*name, array.data_type().clone(), false))
        .collect();
    let records =
        serde_json::json!([{"episode_index": 2, "seed": 7, "attributes": {"goal": "red"}}]);
    let space = r#"{"type":"Dict","subspaces":{"x":{"type":"Box","dtype":"float64","shape":[]},"y":{"type":"Box","dtype":"float64","shape":[]}}}"#;
    let metadata = [
        (schema::EPISODE_RECORDS.to_owned(), records.to_string()),
        (schema::SPACE_OBSERVATION.to_owned(), space.to_owned()),
    ];
    let schema = Arc::new(Schema::new_with_metadata(fields, metadata.into()));
    let arrays = columns.into_iter().map(|(_, array)| array).collect();
    let batch = RecordBatch::try_new(Arc::clone(&schema), arrays).unwrap();
    let mut sink = ParquetSink::create(path, schema).unwrap();
    sink.write(&batch).unwrap();
    Box::new(sink).finish().unwrap();
    open(path, &OpenOptions::default()).unwrap()
}

fn run(source: &dyn DatasetSource, to: &Path, options: &ConvertOptions) -> Result<ConvertReport> {
    convert(source, to, options, &mut |_| ControlFlow::Continue(()))
}

fn read(path: &Path) -> RecordBatch {
    let source = open(path, &OpenOptions::default()).unwrap();
    let batches: Vec<_> = source
        .scan(&Scan::default())
        .unwrap()
        .map(|batch| batch.unwrap())
        .collect();
    concat_batches(&source.schema(), &batches).unwrap()
}

fn names(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder).unwrap();
    let mut names: Vec<String> = entries
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect();
    names.sort();
    names
}

#[test]
fn a_selection_keeps_what_was_asked_for_and_names_the_rest() {
    let dir = tempfile::tempdir().unwrap();
    let source = write_source(&dir.path().join("in.parquet"));
    let to = dir.path().join("out.parquet");
    let options = ConvertOptions {
        episodes: Some(vec![2..3, 0..1]),
        columns: Some(vec!["observation.x".to_owned(), "action".to_owned()]),
        casts: vec![Cast {
            columns: None,
            to: DataType::Float32,
        }],
        ..ConvertOptions::new(Format::Parquet)
    };
    let report = run(source.as_ref(), &to, &options).unwrap();
    assert_eq!(
        (report.n_episodes, report.n_steps, report.n_rows),
        (2, 6, 6)
    );
    assert_eq!(report.left_out, ["observation.y", "info.note"]);
    let casts: Vec<_> = report
        .casts
        .iter()
        .map(|c| (c.column.as_str(), c.n_changed))
        .collect();
    assert_eq!(casts, [("observation.x", 5), ("action", 5)]);

    let table = read(&to);
    let episodes = table[schema::EPISODE_INDEX].as_primitive::<Int64Type>();
    assert_eq!(episodes.values()[..], [0, 0, 0, 2, 2, 2]);
    let x = table["observation.x"].as_primitive::<Float32Type>();
    assert_eq!(x.value(3), 0.6_f64 as f32);
    let space = table.schema().metadata()[schema::SPACE_OBSERVATION].clone();
    assert!(
        space.contains("float32") && !space.contains("\"y\""),
        "{space}"
    );
    let back = open(&to, &OpenOptions::default()).unwrap();
    let record = &back.episodes().unwrap()[1];
    assert_eq!(
        (record.seed, record.attributes["goal"].as_str()),
        (Some(7), Some("red"))
    );
}

#[test]
fn a_conversion_of_everything_is_the_same_table() {
    let dir = tempfile::tempdir().unwrap();
    let from = dir.path().join("in.parquet");
    let source = write_source(&from);
    let to = dir.path().join("out.parquet");
    let report = run(source.as_ref(), &to, &ConvertOptions::new(Format::Parquet)).unwrap();
    assert!(report.losses.is_empty() && report.left_out.is_empty());
    assert_eq!(read(&from), read(&to));
}

#[test]
fn a_failed_conversion_leaves_nothing_and_keeps_what_was_there() {
    let dir = tempfile::tempdir().unwrap();
    let source = write_source(&dir.path().join("in.parquet"));
    let to = dir.path().join("out.parquet");
    std::fs::write(&to, "precious").unwrap();
    let mut options = ConvertOptions::new(Format::Parquet);
    let error = run(source.as_ref(), &to, &options).unwrap_err();
    assert!(
        matches!(error.cause(), DatasetError::AlreadyExists),
        "{error:?}"
    );

    options.write.overwrite = true;
    let stop = convert(source.as_ref(), &to, &options, &mut |progress| {
        assert_eq!((progress.rows, progress.of), (12, 12));
        ControlFlow::Break(())
    });
    assert!(matches!(
        stop.unwrap_err().cause(),
        DatasetError::Interrupted
    ));
    options.casts = vec![Cast {
        columns: Some("observation".to_owned()),
        to: DataType::UInt8,
    }];
    run(source.as_ref(), &to, &options).unwrap(); // fractions are cut, and that is reported
    assert_eq!(names(dir.path()), ["in.parquet", "out.parquet"]);
    assert_eq!(read(&to)["observation.x"].data_type(), &DataType::UInt8);
}

#[test]
fn what_is_not_there_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let source = write_source(&dir.path().join("in.parquet"));
    let to = dir.path().join("out.parquet");
    let options = ConvertOptions {
        episodes: Some(std::iter::once(4..9).collect()),
        ..ConvertOptions::new(Format::Parquet)
    };
    let error = run(source.as_ref(), &to, &options).unwrap_err();
    let message = error.cause().to_string();
    assert!(message.contains("4 episodes, 0 to 3"), "{message}");
    let options = ConvertOptions {
        columns: Some(vec!["observation.z".to_owned()]),
        ..ConvertOptions::new(Format::Parquet)
    };
    let error = run(source.as_ref(), &to, &options).unwrap_err();
    assert!(
        error.cause().to_string().contains("columns are"),
        "{error:?}"
    );
    assert_eq!(names(dir.path()), ["in.parquet"]);
}

#[test]
fn a_folder_is_replaced_only_when_the_new_one_is_complete() {
    let dir = tempfile::tempdir().unwrap();
    let source = write_source(&dir.path().join("in.parquet"));
    let to = dir.path().join("out");
    let steps = || open(&to, &OpenOptions::default()).unwrap().info().n_steps;
    let mut options = ConvertOptions::new(Format::LeRobot);
    run(source.as_ref(), &to, &options).unwrap();
    let error = run(source.as_ref(), &to, &options).unwrap_err();
    assert!(matches!(error.cause(), DatasetError::AlreadyExists));

    options.write.overwrite = true;
    options.episodes = Some(std::iter::once(0..2).collect());
    let stop = convert(source.as_ref(), &to, &options, &mut |_| {
        ControlFlow::Break(())
    });
    assert!(stop.is_err());
    assert_eq!(steps(), Some(12));
    run(source.as_ref(), &to, &options).unwrap();
    assert_eq!(steps(), Some(6));
    assert_eq!(names(dir.path()), ["in.parquet", "out"]);

    // What is no dataset is not ours to remove.
    std::fs::remove_dir_all(to.join("meta")).unwrap();
    assert!(run(source.as_ref(), &to, &options).is_err());
    assert!(to.join("data").exists());
}

/// The metadata of a recording is a list, one entry for each file.
#[cfg(feature = "hdf5")]
#[test]
fn metadata_that_is_no_object_does_not_keep_anything_from_being_written() {
    let dir = tempfile::tempdir().unwrap();
    let source = write_source(&dir.path().join("a.parquet"));
    let rows = read(&dir.path().join("a.parquet"));
    let mut metadata = source.schema().metadata().clone();
    metadata.insert(schema::SOURCE_METADATA.to_owned(), "[{}]".to_owned());
    let with_list = rows.schema().as_ref().clone().with_metadata(metadata);
    let path = dir.path().join("b.parquet");
    let mut sink = ParquetSink::create(&path, Arc::new(with_list.clone())).unwrap();
    sink.write(&rows.with_schema(Arc::new(with_list)).unwrap())
        .unwrap();
    Box::new(sink).finish().unwrap();
    let source = open(&path, &OpenOptions::default()).unwrap();
    for (place, format) in [Format::D4rlHdf5, Format::MinariHdf5, Format::LeRobot]
        .into_iter()
        .enumerate()
    {
        let target = dir.path().join(format!("out{place}"));
        let report = run(source.as_ref(), &target, &ConvertOptions::new(format)).unwrap();
        assert_eq!(report.n_steps, 12, "{format}");
    }
}
