//! Files that robomimic's own tools would not write, or not all at once.

use std::path::Path;

use arrow::array::{Array, AsArray, RecordBatch};
use arrow::datatypes::Float64Type;
use hdf5_metno as hdf5;

use crate::error::Result;
use crate::format::{Format, OpenOptions, detect, open};
use crate::source::{DatasetSource, Scan, Warning};

/// Demonstrations 0 and 2 of three steps; observation i is i, and the next observation i + 1.
fn file(path: &Path, change: impl Fn(&hdf5::Group)) {
    let file = hdf5::File::create(path).unwrap();
    let data = file.create_group("data").unwrap();
    for name in ["demo_0", "demo_2"] {
        let demo = data.create_group(name).unwrap();
        add(&demo, "obs/x", &[0.0, 1.0, 2.0]);
        add(&demo, "next_obs/x", &[1.0, 2.0, 3.0]);
        add(&demo, "actions", &[0.5, 0.5, 0.5]);
        add(&demo, "dones", &[0.0, 0.0, 1.0]);
    }
    change(&data.group("demo_2").unwrap());
    file.close().unwrap();
}

fn add(group: &hdf5::Group, key: &str, values: &[f64]) {
    let (group, key) = match key.split_once('/') {
        Some((inner, key)) if group.link_exists(inner) => (group.group(inner).unwrap(), key),
        Some((inner, key)) => (group.create_group(inner).unwrap(), key),
        None => (group.clone(), key),
    };
    group
        .new_dataset_builder()
        .with_data(values)
        .create(key)
        .unwrap();
}

fn replace(group: &hdf5::Group, key: &str, values: &[f64]) {
    group.unlink(key).unwrap();
    add(group, key, values);
}

fn opened(path: &Path, recover: bool) -> Result<Box<dyn DatasetSource>> {
    let options = OpenOptions {
        recover,
        ..OpenOptions::default()
    };
    open(path, &options)
}

fn rows(source: &dyn DatasetSource) -> RecordBatch {
    let reader = source.scan(&Scan::default()).unwrap();
    let schema = reader.schema();
    let batches: Vec<_> = reader.collect::<Result<_, _>>().unwrap();
    arrow::compute::concat_batches(&schema, &batches).unwrap()
}

fn column(rows: &RecordBatch, name: &str) -> Vec<Option<f64>> {
    rows[name].as_primitive::<Float64Type>().iter().collect()
}

#[test]
fn the_last_next_observation_is_the_final_one() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.hdf5");
    file(&path, |_| {});
    assert_eq!(detect(&path).unwrap(), Format::Robomimic);
    let source = opened(&path, false).unwrap();
    assert_eq!(source.info().warnings, []);
    crate::conformance::check_source(source.as_ref()).unwrap();
    let rows = rows(source.as_ref());
    let expected: Vec<Option<f64>> = [0.0, 1.0, 2.0, 3.0]
        .repeat(2)
        .into_iter()
        .map(Some)
        .collect();
    assert_eq!(column(&rows, "observation.x"), expected);
    assert_eq!(column(&rows, "info.done")[3], None);
    assert!(rows.column_by_name("next_observation.x").is_none());
    assert!(rows.column_by_name("terminated").is_none());
    let numbers: Vec<_> = source
        .episodes()
        .unwrap()
        .iter()
        .map(|e| e.episode_index)
        .collect();
    assert_eq!(numbers, [0, 2]);
}

#[test]
fn next_observations_that_are_no_shift_are_kept() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.hdf5");
    file(&path, |demo| replace(demo, "next_obs/x", &[1.0, 7.0, 3.0]));
    let source = opened(&path, false).unwrap();
    crate::conformance::check_source(source.as_ref()).unwrap();
    let expected = Warning::NextObservationDiffers {
        column: "next_observation.x".to_owned(),
        n_episodes: 1,
    };
    assert_eq!(source.info().warnings, [expected]);
    let next = column(&rows(source.as_ref()), "next_observation.x");
    let expected = [
        Some(1.0),
        Some(2.0),
        Some(3.0),
        None,
        Some(1.0),
        Some(7.0),
        Some(3.0),
        None,
    ];
    assert_eq!(next, expected);
}

#[test]
fn a_demonstration_without_next_observations_has_no_final_row() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.hdf5");
    file(&path, |demo| demo.unlink("next_obs").unwrap());
    let source = opened(&path, false).unwrap();
    crate::conformance::check_source(source.as_ref()).unwrap();
    assert_eq!(
        source.info().warnings,
        [Warning::NoFinalObservation { n_episodes: 1 }]
    );
    let rows = rows(source.as_ref());
    assert_eq!(rows.num_rows(), 7);
    let next = &rows["next_observation.x"];
    assert_eq!((next.null_count(), next.is_valid(2)), (4, true));
}

#[test]
fn arrays_of_different_lengths_are_refused_or_left_out() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.hdf5");
    file(&path, |demo| replace(demo, "dones", &[0.0, 1.0]));
    let error = opened(&path, false).err().unwrap();
    let expected = "\"data/demo_2/dones\" has 2 rows, expected 3";
    assert_eq!(error.cause().to_string(), expected);
    let source = opened(&path, true).unwrap();
    crate::conformance::check_source(source.as_ref()).unwrap();
    assert_eq!(rows(source.as_ref()).num_rows(), 4);
    let lost = Warning::Lost {
        what: format!("demo_2 ({expected})"),
    };
    assert_eq!(source.info().warnings, [lost]);
}

#[test]
fn what_is_not_per_step_or_too_large_is_told() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.hdf5");
    file(&path, |demo| {
        add(demo, "extra", &[1.0, 2.0, 3.0]);
        let attribute = demo
            .new_attr::<hdf5::types::VarLenUnicode>()
            .create("model_file")
            .unwrap();
        let model: hdf5::types::VarLenUnicode = "<x/>".repeat(2000).parse().unwrap();
        attribute.write_scalar(&model).unwrap();
    });
    let source = opened(&path, false).unwrap();
    let left_out: Vec<String> = source
        .info()
        .warnings
        .iter()
        .map(ToString::to_string)
        .collect();
    assert_eq!(left_out.len(), 2, "{left_out:?}");
    assert!(left_out[0].starts_with("\"extra\"") && left_out[1].starts_with("\"model_file\""));
    assert!(
        !source.episodes().unwrap()[1]
            .attributes
            .contains_key("model_file")
    );
}
