//! The Minari writers: round trips through every storage, and the Minari library as the judge.
#![cfg(feature = "hdf5")]
#![expect(clippy::unwrap_used, reason = "tests")]

#[path = "support/mod.rs"]
#[expect(dead_code, reason = "shared with the golden tests")]
mod support;
#[path = "support/tables.rs"]
#[expect(dead_code, reason = "shared with the tests of other writers")]
mod tables;
#[path = "support/writing.rs"]
mod writing;

use std::path::{Path, PathBuf};

use ksim_datasets::{
    FinalObservation, Format, LossEffect, OpenOptions, WriteOptions, conformance, open, schema,
};
use proptest::prelude::*;
use serde_json::Value;
use support::{files, golden};
use tables::{Allowed, FinalRows, MemorySource, tables};
use writing::{assert_same, check_atomic, loss, python, round_trip};

const STORAGES: [Format; 3] = [
    Format::MinariHdf5,
    Format::MinariArrow,
    Format::MinariParquet,
];

/// The Minari datasets that open without force.
fn samples() -> Vec<PathBuf> {
    let roots = [golden("formats/minari"), golden("data_fixtures/minari")];
    let metadata = roots.iter().flat_map(|root| files(root, "metadata.json"));
    let folders = metadata
        .filter(|path| path.ends_with("data/metadata.json"))
        .map(|path| path.parent().and_then(Path::parent).unwrap().to_owned());
    let readable = folders.filter(|path| open(path, &OpenOptions::default()).is_ok());
    readable.collect()
}

#[test]
fn golden_minari_survives_every_storage() {
    let samples = samples();
    assert!(samples.len() >= 3, "only {} samples", samples.len());
    for sample in samples {
        let source = open(&sample, &OpenOptions::default()).unwrap();
        for format in STORAGES {
            let folder = tempfile::tempdir().unwrap();
            let target = folder.path().join("out");
            let trip = round_trip(source.as_ref(), &target, format, &WriteOptions::default());
            let place = format!("{} as {format}", sample.display());
            assert_same(source.as_ref(), trip.back.as_ref(), &place);
            assert_eq!(
                source.info().observation,
                trip.back.info().observation,
                "{place}"
            );
            let unexpected = trip.losses.iter().filter(|loss| loss.item != schema::INFO);
            assert_eq!(unexpected.count(), 0, "{place}: {:?}", trip.losses);
        }
    }
}

/// What the library finds, without what differs by the storage.
fn by_minari(datasets: &[&Path]) -> Option<Vec<Value>> {
    let found = python("check_minari.py", "minari, h5py, pyarrow, PIL", datasets)?;
    let mut found: Vec<Value> = serde_json::from_value(found).unwrap();
    for dataset in &mut found {
        dataset
            .as_object_mut()
            .unwrap()
            .remove("data_format")
            .unwrap();
    }
    Some(found)
}

#[test]
fn golden_minari_is_the_same_to_minari_itself() {
    for sample in files(&golden("formats/minari"), "metadata.json") {
        let Some(sample) = sample.parent().filter(|data| data.ends_with("data")) else {
            continue;
        };
        let sample = sample.parent().unwrap();
        let Ok(source) = open(sample, &OpenOptions::default()) else {
            continue;
        };
        let folder = tempfile::tempdir().unwrap();
        let targets = STORAGES.map(|format| folder.path().join(format!("{format}-v0")));
        for (target, format) in targets.iter().zip(STORAGES) {
            round_trip(source.as_ref(), target, format, &WriteOptions::default());
        }
        let mut datasets = vec![sample];
        datasets.extend(targets.iter().map(PathBuf::as_path));
        let Some(mut found) = by_minari(&datasets) else {
            return;
        };
        // The library does not restore nested infos of the columnar storages, not even its own.
        let is_nested = |name: &str| name.starts_with("info.") && name.matches('.').count() > 1;
        let schema = source.schema();
        if schema.fields().iter().any(|field| is_nested(field.name())) {
            let episodes = found
                .iter_mut()
                .flat_map(|dataset| dataset["episodes"].as_array_mut());
            for episode in episodes.flatten() {
                episode["infos"].as_object_mut().unwrap().remove("nested");
            }
        }
        for (other, target) in found.iter().zip(&datasets).skip(1) {
            assert_eq!(
                *other,
                found[0],
                "{} as {}",
                sample.display(),
                target.display()
            );
        }
    }
}

fn allowed_without_losses() -> Allowed {
    Allowed {
        final_rows: FinalRows::Always,
        missing_columns: false,
        // Only D4RL-like rows leave infos without a value after the last step.
        infos: false,
        ..Allowed::default()
    }
}

/// The table with the attributes that Minari adds.
fn with_minari_attributes(mut table: MemorySource) -> MemorySource {
    for episode in &mut table.episodes {
        let attributes = &mut episode.attributes;
        attributes.insert("id".to_owned(), episode.episode_index.into());
        attributes.insert("total_steps".to_owned(), episode.length.into());
    }
    table
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn made_up_tables_survive_every_storage(table in tables(allowed_without_losses())) {
        let table = with_minari_attributes(table);
        let folder = tempfile::tempdir().unwrap();
        for format in STORAGES {
            let target = folder.path().join(format.name());
            let trip = round_trip(&table, &target, format, &WriteOptions::default());
            assert_same(&table, trip.back.as_ref(), format.name());
            prop_assert_eq!(trip.losses, []);
            conformance::check_source(trip.back.as_ref()).unwrap();
        }
    }

    #[test]
    fn whatever_comes_is_written_and_the_storages_agree(table in tables(Allowed::default())) {
        let folder = tempfile::tempdir().unwrap();
        for wish in [FinalObservation::Recorded, FinalObservation::Duplicate, FinalObservation::DropStep] {
            let options = WriteOptions { final_observation: wish, ..WriteOptions::default() };
            let trips = STORAGES.map(|format| {
                let target = folder.path().join(format!("{format}-{wish:?}"));
                round_trip(&table, &target, format, &options)
            });
            for trip in &trips {
                conformance::check_source(trip.back.as_ref()).unwrap();
                check_counts(&table, wish, trip);
            }
            assert_same(trips[1].back.as_ref(), trips[2].back.as_ref(), "arrow and parquet");
        }
    }
}

proptest! {
    // Each case starts Python.
    #![proptest_config(ProptestConfig { cases: 4, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn minari_reads_made_up_tables_alike(table in tables(Allowed { pictures: false, infos: false, ..Allowed::default() })) {
        let folder = tempfile::tempdir().unwrap();
        let targets = STORAGES.map(|format| folder.path().join(format!("{format}-v0")));
        for (target, format) in targets.iter().zip(STORAGES) {
            round_trip(&table, target, format, &WriteOptions::default());
        }
        if let Some(found) = by_minari(&targets.each_ref().map(PathBuf::as_path)) {
            prop_assert_eq!(&found[0], &found[1]);
            prop_assert_eq!(&found[0], &found[2]);
        }
    }
}

/// Every episode and step is there or is a counted loss.
fn check_counts(table: &MemorySource, wish: FinalObservation, trip: &writing::RoundTrip) {
    let lost = |item, effect| loss(&trip.losses, item, effect).unwrap_or(0);
    let without_final = table
        .episodes
        .iter()
        .filter(|episode| !episode.has_final_obs);
    let (n_without, n_short) = (
        without_final.clone().count() as u64,
        without_final.filter(|episode| episode.length == 1).count() as u64,
    );
    let back = trip.back.info();
    let (n_steps, n_episodes) = (back.n_steps.unwrap(), back.n_episodes.unwrap());
    if wish == FinalObservation::Duplicate {
        assert_eq!(lost("final observations", LossEffect::Invented), n_without);
        assert_eq!(Some(n_steps), table.info.n_steps);
        assert_eq!(Some(n_episodes), table.info.n_episodes);
    } else {
        assert_eq!(lost("steps", LossEffect::Dropped), n_without - n_short);
        assert_eq!(lost("episodes", LossEffect::Dropped), n_short);
        assert_eq!(Some(n_steps + n_without), table.info.n_steps);
        assert_eq!(Some(n_episodes + n_short), table.info.n_episodes);
    }
}

#[test]
fn a_sink_that_is_dropped_leaves_nothing() {
    let sample = &samples()[0];
    let source = open(sample, &OpenOptions::default()).unwrap();
    for format in STORAGES {
        let folder = tempfile::tempdir().unwrap();
        check_atomic(source.as_ref(), folder.path(), format);
    }
}
