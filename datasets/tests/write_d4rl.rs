//! The D4RL writer: round trips, also by way of Minari, and D4RL's own rules as the judge.
#![cfg(feature = "hdf5")]
#![expect(clippy::unwrap_used, reason = "tests")]

#[path = "support/mod.rs"]
#[expect(dead_code, reason = "shared with the golden tests")]
mod support;
#[path = "support/tables.rs"]
#[expect(dead_code, reason = "shared with the tests of other writers")]
mod tables;
#[path = "support/writing.rs"]
#[expect(dead_code, reason = "shared with the tests of Minari's writers")]
mod writing;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use arrow::array::{ArrayRef, AsArray};
use arrow::datatypes::{DataType, Float64Type};
use hdf5_metno as hdf5;
use ksim_datasets::{
    DatasetError, DatasetSource, EpisodePolicy, FinalObservation, Format, LossEffect, OpenOptions,
    SinkInput, WriteOptions, conformance, create, open, schema,
};
use proptest::prelude::*;
use support::{files, golden};
use tables::{Allowed, MemorySource, tables};
use writing::{check_atomic, loss, python, round_trip, rows};

/// The D4RL files that open, with the options that open them.
fn samples() -> Vec<(PathBuf, OpenOptions)> {
    let roots = [golden("formats/hdf5/d4rl"), golden("data_fixtures/d4rl")];
    let paths = roots.iter().flat_map(|root| files(root, ".hdf5"));
    let mut samples = Vec::new();
    for path in paths {
        for episode_policy in [None, Some(EpisodePolicy::Clean)] {
            let options = OpenOptions {
                episode_policy,
                max_episode_steps: Some(50),
                ..OpenOptions::default()
            };
            if open(&path, &options).is_ok() {
                samples.push((path.clone(), options));
            }
        }
    }
    assert!(!samples.is_empty(), "no sample opens");
    samples
}

/// Type, shape and values of an array of a file.
#[derive(Debug, PartialEq)]
struct Raw {
    descriptor: String,
    shape: Vec<usize>,
    /// Bits of the values as `f64`, which holds those of all samples.
    bits: Vec<u64>,
}

/// All arrays with a row per step, and the single numbers of the metadata.
fn raw(path: &Path) -> BTreeMap<String, Raw> {
    fn collect(group: &hdf5::Group, parent: &str, found: &mut BTreeMap<String, Raw>) {
        for name in group.member_names().unwrap() {
            let key = if parent.is_empty() {
                name.clone()
            } else {
                format!("{parent}/{name}")
            };
            if key == "virtual" {
                continue;
            }
            if let Ok(inner) = group.group(&name) {
                collect(&inner, &key, found);
                continue;
            }
            let array = group.dataset(&name).unwrap();
            let descriptor = array.dtype().unwrap().to_descriptor().unwrap();
            let (Ok(values), false) = (values(&array, &descriptor), key.starts_with("metadata/"))
            else {
                continue;
            };
            let raw = Raw {
                descriptor: descriptor.to_string(),
                shape: array.shape(),
                bits: values.into_iter().map(f64::to_bits).collect(),
            };
            found.insert(key, raw);
        }
    }
    let mut found = BTreeMap::new();
    collect(&hdf5::File::open(path).unwrap(), "", &mut found);
    found
}

fn values(
    array: &hdf5::Dataset,
    descriptor: &hdf5::types::TypeDescriptor,
) -> hdf5::Result<Vec<f64>> {
    match descriptor {
        hdf5::types::TypeDescriptor::Boolean => {
            let flags = array.read_raw::<bool>()?.into_iter();
            Ok(flags.map(|flag| f64::from(u8::from(flag))).collect())
        }
        _ => array.read_raw::<f64>(),
    }
}

#[test]
fn golden_d4rl_files_come_back_array_by_array() {
    for (sample, options) in samples() {
        let place = format!("{} by {:?}", sample.display(), options.episode_policy);
        let source = open(&sample, &options).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let target = folder.path().join(sample.file_name().unwrap());
        let trip = round_trip(
            source.as_ref(),
            &target,
            Format::D4rlHdf5,
            &WriteOptions::default(),
        );
        let (mut before, mut after) = (raw(&sample), raw(&target));
        let n_invented = loss(&trip.losses, "timeouts", LossEffect::Invented).unwrap_or(0);
        if n_invented > 0 {
            // Borders that no flag records get one, and nothing else changes.
            let ends = after.remove("timeouts").unwrap().bits;
            let n_flags = |bits: &[u64]| bits.iter().filter(|bits| **bits != 0).count() as u64;
            let recorded = before.remove("timeouts");
            let n_before = recorded.map_or(0, |recorded| n_flags(&recorded.bits));
            assert_eq!(n_flags(&ends), n_before + n_invented, "{place}");
            assert!(
                source.info().boundaries_inferred,
                "{place}: {:?}",
                trip.losses
            );
        }
        assert_eq!(
            before.keys().collect::<Vec<_>>(),
            after.keys().collect::<Vec<_>>(),
            "{place}"
        );
        for (key, array) in &before {
            assert!(*array == after[key], "{place}: {key}");
        }
        check_metadata(source.as_ref(), trip.back.as_ref(), &place);
    }
}

/// Single values of the metadata are kept.
fn check_metadata(source: &dyn DatasetSource, back: &dyn DatasetSource, place: &str) {
    for (key, value) in &source.info().metadata {
        if !value.is_array() && !value.is_object() {
            assert_eq!(back.info().metadata.get(key), Some(value), "{place}: {key}");
        }
    }
}

#[test]
fn golden_d4rl_survives_minari() {
    for (sample, options) in samples() {
        // The policy makes no difference to the rows.
        if options.episode_policy.is_some() {
            continue;
        }
        let source = open(&sample, &options).unwrap();
        if source.info().n_steps == Some(0) {
            continue;
        }
        for format in [
            Format::MinariHdf5,
            Format::MinariArrow,
            Format::MinariParquet,
        ] {
            let place = format!("{} by way of {format}", sample.display());
            let folder = tempfile::tempdir().unwrap();
            // Without recorded next observations every step is kept only if the last one is repeated.
            let options = WriteOptions {
                final_observation: FinalObservation::Duplicate,
                ..WriteOptions::default()
            };
            let there = round_trip(
                source.as_ref(),
                &folder.path().join("there"),
                format,
                &options,
            );
            let target = folder.path().join("back.hdf5");
            let back = round_trip(there.back.as_ref(), &target, Format::D4rlHdf5, &options);
            assert_eq!(back.back.info().n_steps, source.info().n_steps, "{place}");
            let (before, after) = (raw(&sample), raw(&target));
            for key in ["observations", "actions"] {
                assert_eq!(before[key], after[key], "{place}: {key}");
            }
            // Types become Minari's, values stay.
            let keys = before.keys().filter(|key| key.starts_with("infos/"));
            for key in keys.chain([&"rewards".to_owned(), &"terminals".to_owned()]) {
                assert_eq!(before[key].bits, after[key].bits, "{place}: {key}");
            }
        }
    }
}

#[test]
fn golden_d4rl_recorded_next_observations_are_minaris_final_ones() {
    for (sample, options) in samples() {
        let source = open(&sample, &options).unwrap();
        let schema = source.schema();
        if schema.index_of(schema::NEXT_OBSERVATION).is_err() {
            continue;
        }
        let folder = tempfile::tempdir().unwrap();
        let options = WriteOptions::default();
        let trip = round_trip(
            source.as_ref(),
            &folder.path().join("m"),
            Format::MinariArrow,
            &options,
        );
        assert_eq!(trip.back.info().n_steps, source.info().n_steps);
        let n_final = loss(&trip.losses, "final observations", LossEffect::Changed);
        assert_eq!(n_final, source.info().n_episodes);
        let (before, after) = (rows(source.as_ref()), rows(trip.back.as_ref()));
        let next = before.column_by_name(schema::NEXT_OBSERVATION).unwrap();
        let observed = after.column_by_name(schema::OBSERVATION).unwrap();
        let episodes = source
            .episodes()
            .unwrap()
            .into_iter()
            .zip(trip.back.episodes().unwrap());
        for (old, new) in episodes {
            let last = |end: u64| usize::try_from(end).unwrap() - 1;
            let (from, to) = (
                last(old.first_row + old.length),
                last(new.first_row + new.n_rows),
            );
            assert_eq!(
                &next.slice(from, 1),
                &observed.slice(to, 1),
                "{}",
                sample.display()
            );
        }
    }
}

#[test]
fn golden_d4rl_by_its_own_rules() {
    for (sample, options) in samples() {
        if options.episode_policy.is_some() {
            continue;
        }
        let source = open(&sample, &options).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let target = folder.path().join(sample.file_name().unwrap());
        let trip = round_trip(
            source.as_ref(),
            &target,
            Format::D4rlHdf5,
            &WriteOptions::default(),
        );
        let Some(found) = python("check_d4rl.py", "h5py", &[&sample, &target]) else {
            return;
        };
        let invented = loss(&trip.losses, "timeouts", LossEffect::Invented).is_some();
        for key in ["sequence", "qlearning"] {
            if !invented {
                assert_eq!(found[0][key], found[1][key], "{}: {key}", sample.display());
            }
        }
        let arrays = found[1]["arrays"].as_object().unwrap();
        for (key, array) in arrays
            .iter()
            .filter(|(key, _)| !key.starts_with("metadata/"))
        {
            assert_eq!(
                array["compression"],
                serde_json::json!(["gzip", 4]),
                "{key}"
            );
            if !(invented && key == "timeouts") {
                for about in ["shape", "dtype", "sha256"] {
                    let place = format!("{}: {about} of {key}", sample.display());
                    assert_eq!(found[0]["arrays"][key][about], array[about], "{place}");
                }
            }
        }
    }
}

#[test]
fn a_sink_that_is_dropped_leaves_nothing() {
    let (sample, options) = &samples()[0];
    let folder = tempfile::tempdir().unwrap();
    check_atomic(
        open(sample, options).unwrap().as_ref(),
        folder.path(),
        Format::D4rlHdf5,
    );
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 32, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn made_up_tables_are_joined_and_kept(table in tables(Allowed { special_floats: false, ..Allowed::default() })) {
        let folder = tempfile::tempdir().unwrap();
        let target = folder.path().join("made_up.hdf5");
        let Some(trip) = written(&table, &target) else {
            return Ok(());
        };
        conformance::check_source(trip.back.as_ref()).unwrap();
        let (before, after) = (rows(&table), rows(trip.back.as_ref()));
        let steps = steps(&table);
        for root in [schema::OBSERVATION, schema::ACTION] {
            let joined = floats(after.column_by_name(root).unwrap());
            let mut offset = 0;
            let width = joined.len() / steps.len();
            for leaf in table.info.observation.iter().chain(&table.info.action) {
                if schema::belongs_to(&leaf.column, root) && leaf.is_numeric() {
                    let values = floats(before.column_by_name(&leaf.column).unwrap());
                    for (row, &step) in steps.iter().enumerate() {
                        let start = row * width + offset;
                        let expected = &values[step * leaf.width()..(step + 1) * leaf.width()];
                        prop_assert_eq!(&joined[start..start + leaf.width()], expected);
                    }
                    offset += leaf.width();
                }
            }
            prop_assert_eq!(offset, width);
        }
        let lengths = |episodes: &[ksim_datasets::EpisodeRecord]| episodes.iter().map(|e| e.length).collect::<Vec<_>>();
        let found = trip.back.episodes().unwrap();
        prop_assert_eq!(lengths(&found), lengths(&table.episodes));
        check_next(&table, &target);
    }
}

proptest! {
    // Each case starts Python.
    #![proptest_config(ProptestConfig { cases: 4, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn d4rl_finds_the_episodes_of_made_up_tables(table in tables(Allowed::default())) {
        let folder = tempfile::tempdir().unwrap();
        let target = folder.path().join("made_up.hdf5");
        if let Some(_trip) = written(&table, &target)
            && let Some(found) = python("check_d4rl.py", "h5py", &[&target])
        {
            let sequence: Vec<u64> = serde_json::from_value(found[0]["sequence"].clone()).unwrap();
            let lengths: Vec<u64> = table.episodes.iter().map(|episode| episode.length).collect();
            prop_assert_eq!(sequence, lengths);
        }
    }
}

/// The result, unless nothing numeric is observed or done, or an integer has no float: both are errors.
fn written(table: &MemorySource, target: &Path) -> Option<writing::RoundTrip> {
    let schema = table.schema();
    let numeric =
        |leaves: &[ksim_datasets::LeafSpec]| leaves.iter().any(ksim_datasets::LeafSpec::is_numeric);
    if !numeric(&table.info.observation) || !numeric(&table.info.action) {
        let error = create(
            target,
            Format::D4rlHdf5,
            &table.input(&schema),
            &WriteOptions::default(),
        );
        let error = error.err().unwrap();
        assert!(
            matches!(error.cause(), DatasetError::MissingColumn { .. }),
            "{error:?}"
        );
        return None;
    }
    let mixed = |leaves: &[ksim_datasets::LeafSpec]| {
        let is_64 = |t: &DataType| matches!(t, DataType::Int64 | DataType::UInt64);
        leaves.iter().filter(|leaf| leaf.is_numeric()).count() > 1
            && leaves.iter().any(|leaf| is_64(&leaf.data_type))
    };
    if mixed(&table.info.observation) || mixed(&table.info.action) {
        return None;
    }
    Some(round_trip(
        table,
        target,
        Format::D4rlHdf5,
        &WriteOptions::default(),
    ))
}

/// Rows of the table that are steps.
fn steps(table: &MemorySource) -> Vec<usize> {
    let of = |episode: &ksim_datasets::EpisodeRecord| {
        let first = usize::try_from(episode.first_row).unwrap();
        first..first + usize::try_from(episode.length).unwrap()
    };
    table.episodes.iter().flat_map(of).collect()
}

fn floats(array: &ArrayRef) -> Vec<f64> {
    let values = match array.as_fixed_size_list_opt() {
        Some(list) => list.values().clone(),
        None => array.clone(),
    };
    let values = arrow::compute::cast(&values, &DataType::Float64).unwrap();
    values.as_primitive::<Float64Type>().values().to_vec()
}

/// Next observations are the rows that follow, inside their episode.
fn check_next(table: &MemorySource, target: &Path) {
    let arrays = raw(target);
    let has_final = table.episodes.iter().any(|episode| episode.has_final_obs);
    assert_eq!(arrays.contains_key("next_observations"), has_final);
    let Some(next) = arrays.get("next_observations") else {
        return;
    };
    let observed = &arrays["observations"];
    assert_eq!(next.shape, observed.shape);
    let width = observed.bits.len() / observed.shape[0];
    let mut row = 0;
    for episode in &table.episodes {
        let n = usize::try_from(episode.length).unwrap();
        let inside = &next.bits[row * width..(row + n - 1) * width];
        assert_eq!(inside, &observed.bits[(row + 1) * width..(row + n) * width]);
        row += n;
    }
}

#[test]
fn a_large_integer_beside_a_float_is_refused() {
    use arrow::array::{Float32Array, Int64Array, RecordBatch};
    use arrow::datatypes::{Field, Schema};
    use std::sync::Arc;
    let schema = Arc::new(Schema::new(vec![
        Field::new(schema::EPISODE_INDEX, DataType::Int64, false),
        Field::new(schema::STEP_INDEX, DataType::Int64, false),
        Field::new("observation.a", DataType::Float32, false),
        Field::new("observation.b", DataType::Int64, false),
        Field::new("action", DataType::Float32, true),
    ]));
    let column = |values: [i64; 2]| Arc::new(Int64Array::from(values.to_vec())) as ArrayRef;
    let floats = || Arc::new(Float32Array::from(vec![0.0, 1.0])) as ArrayRef;
    let columns = vec![
        column([0, 0]),
        column([0, 1]),
        floats(),
        column([1, (1 << 53) + 1]),
        floats(),
    ];
    let batch = RecordBatch::try_new(schema.clone(), columns).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let parquet = folder.path().join("a.parquet");
    let mut sink = ksim_datasets::ParquetSink::create(&parquet, schema).unwrap();
    ksim_datasets::DatasetSink::write(&mut sink, &batch).unwrap();
    ksim_datasets::DatasetSink::finish(Box::new(sink)).unwrap();
    let source = open(&parquet, &OpenOptions::default()).unwrap();
    let (schema, episodes) = (source.schema(), source.episodes().unwrap());
    let input = SinkInput {
        schema: &schema,
        info: source.info(),
        episodes: &episodes,
    };
    let target = folder.path().join("a.hdf5");
    let mut sink = create(&target, Format::D4rlHdf5, &input, &WriteOptions::default()).unwrap();
    let error = ksim_datasets::copy(source.as_ref(), sink.as_mut()).unwrap_err();
    assert!(
        matches!(error.cause(), DatasetError::InexactInteger { row: 1, .. }),
        "{error:?}"
    );
}
