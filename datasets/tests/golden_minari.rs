//! The Minari readers against recordings of Minari itself.
//!
//! The folder is `$KSIM_GOLDEN`, by default a small part of it in the repository. Whatever is found there is
//! checked: other recordings with other values must pass as well. Without the feature `hdf5` the datasets in
//! that storage are passed over.
#![expect(clippy::unwrap_used, reason = "tests")]

#[path = "support/mod.rs"]
#[expect(dead_code, reason = "shared with the D4RL tests")]
mod support;

use std::path::{Path, PathBuf};

use ksim_datasets::{
    DatasetError, Format, OpenOptions, Scan, conformance, detect, open, schema, summarize,
};
use serde_json::Value;
use support::{Leaf, Table, files, golden, read_json};

/// The dataset folders under a root that this build reads.
fn datasets(root: &Path) -> Vec<PathBuf> {
    let metadata = files(root, "metadata.json").into_iter();
    let folders = metadata
        .filter(|path| path.ends_with("data/metadata.json"))
        .map(|path| path.parent().and_then(Path::parent).unwrap().to_owned());
    folders.filter(|path| is_readable(path)).collect()
}

fn is_readable(dataset: &Path) -> bool {
    cfg!(feature = "hdf5") || detect(dataset).unwrap() != Format::MinariHdf5
}

fn minari_root() -> std::path::PathBuf {
    golden("formats/minari")
}

#[test]
fn golden_minari_episodes_are_bit_equal() {
    let mut n_datasets = 0;
    for expected_path in files(&minari_root().join("expected"), ".json") {
        let expected = read_json(&expected_path);
        let id = expected["dataset_id"].as_str().unwrap();
        let path = minari_root().join(id);
        if !is_readable(&path) {
            continue;
        }
        n_datasets += 1;
        let source = open(&path, &OpenOptions::default()).unwrap();
        assert_eq!(source.info().id, id);
        assert_eq!(
            source.info().n_episodes,
            expected["total_episodes"].as_u64(),
            "{id}"
        );
        assert_eq!(
            source.info().n_steps,
            expected["total_steps"].as_u64(),
            "{id}"
        );
        let records = source.episodes().unwrap();
        for (record, episode) in records.iter().zip(expected["episodes"].as_array().unwrap()) {
            let place = format!("{id} episode {}", record.episode_index);
            assert_eq!(
                Some(record.episode_index),
                episode["id"].as_i64(),
                "{place}"
            );
            assert_eq!(Some(record.length), episode["length"].as_u64(), "{place}");
            assert_eq!(record.seed, episode["metadata"]["seed"].as_u64(), "{place}");
            assert_eq!(
                Value::Object(record.attributes.clone()),
                sorted(&episode["metadata"]),
                "{place}"
            );
            let table = Table::read_episode(source.as_ref(), record.episode_index);
            check_leaves(
                &table,
                "observation",
                &episode["observations"],
                false,
                &place,
            );
            check_leaves(&table, "action", &episode["actions"], true, &place);
            table
                .leaf("reward")
                .steps()
                .assert_is(&episode["rewards"], &place);
            table
                .leaf("terminated")
                .steps()
                .assert_is(&episode["terminations"], &place);
            table
                .leaf("truncated")
                .steps()
                .assert_is(&episode["truncations"], &place);
            if episode["infos"].is_object() {
                check_leaves(&table, "info", &episode["infos"], false, &place);
            }
        }
    }
    assert!(n_datasets >= 1, "only {n_datasets} datasets found");
}

/// Key order is no part of the value.
fn sorted(value: &Value) -> Value {
    match value {
        Value::Object(map) => {
            let mut keys: Vec<_> = map.iter().collect();
            keys.sort_by(|a, b| a.0.cmp(b.0));
            Value::Object(
                keys.into_iter()
                    .map(|(k, v)| (k.clone(), sorted(v)))
                    .collect(),
            )
        }
        other => other.clone(),
    }
}

fn check_leaves(table: &Table, column: &str, expected: &Value, steps: bool, place: &str) {
    if let Some(list) = expected.as_array() {
        for (index, part) in list.iter().enumerate() {
            check_leaves(table, &format!("{column}[{index}]"), part, steps, place);
        }
        return;
    }
    let is_leaf = expected.get("sha256_c_order").is_some() || expected["len"].is_number();
    if !is_leaf {
        for (key, part) in expected.as_object().unwrap() {
            check_leaves(table, &format!("{column}.{key}"), part, steps, place);
        }
        return;
    }
    let leaf: &Leaf = table.leaf(column);
    let place = format!("{place} {column}");
    if steps {
        leaf.steps().assert_is(expected, &place)
    } else {
        leaf.assert_is(expected, &place)
    }
}

#[test]
fn golden_minari_versions_and_damage() {
    for dataset in datasets(&minari_root()) {
        let dataset = dataset.as_path();
        let id = dataset.to_string_lossy();
        if id.contains("future") {
            let error = open(dataset, &OpenOptions::default()).err().unwrap();
            assert!(
                matches!(error.cause(), DatasetError::UnknownVersion { .. }),
                "{error:?}"
            );
            let forced = OpenOptions {
                force: true,
                ..OpenOptions::default()
            };
            let source = open(dataset, &forced).unwrap();
            assert!(!source.info().warnings.is_empty());
        } else if id.contains("truncated") {
            let error = open(dataset, &OpenOptions::default()).err().unwrap();
            assert!(error.to_string().contains("main_data.hdf5"), "{error}");
            assert!(
                matches!(error.cause(), DatasetError::Corrupt { .. }),
                "{error:?}"
            );
        }
    }
}

#[test]
fn golden_minari_fixtures_open() {
    let mut n_datasets = 0;
    for dataset in datasets(&golden("data_fixtures/minari")) {
        let dataset = dataset.as_path();
        let source = open(dataset, &OpenOptions::default()).unwrap();
        assert_eq!(source.info().warnings, [], "{}", dataset.display());
        let summary = summarize(source.as_ref()).unwrap();
        assert_eq!(
            Some(summary.n_steps),
            source.info().n_steps,
            "{}",
            dataset.display()
        );
        assert_eq!(
            summary.n_rows,
            summary.n_steps + summary.n_episodes,
            "{}",
            dataset.display()
        );
        if dataset.to_string_lossy().contains("antmaze") {
            assert_eq!(source.info().observation_width(), 31);
            let names: Vec<&str> = source
                .info()
                .observation
                .iter()
                .map(|leaf| leaf.column.as_str())
                .collect();
            let goals_frame = [
                "observation.achieved_goal",
                "observation.observation",
                "observation.desired_goal",
            ];
            assert_eq!(names, goals_frame);
            assert_eq!(summary.n_success_known, summary.n_episodes);
        }
        n_datasets += 1;
    }
    assert!(
        n_datasets >= 1 || !cfg!(feature = "hdf5"),
        "no datasets found"
    );
}

/// Every sample that opens keeps the trait's contract and survives a trip through Parquet.
#[test]
fn golden_minari_sources_conform() {
    let mut n_checked = 0;
    for path in datasets(&golden("formats/minari")) {
        let Ok(source) = open(&path, &OpenOptions::default()) else {
            continue;
        };
        // NaN is not equal to itself; these are compared by hash above.
        let summary = summarize(source.as_ref()).unwrap();
        if summary.columns.iter().any(|column| column.n_nan > 0) {
            continue;
        }
        let dir = tempfile::tempdir().unwrap();
        conformance::check_source(source.as_ref()).unwrap();
        conformance::check_parquet_round_trip(source.as_ref(), dir.path()).unwrap();
        n_checked += 1;
    }
    assert!(n_checked >= 1, "only {n_checked} sources");
}

/// The same episodes in different storages give the same rows in the same columns.
#[test]
fn golden_minari_storages_agree() {
    let root = golden("formats/minari/sample");
    for other in ["arrow", "parquet"] {
        for dataset in datasets(&root.join(other)) {
            let twin = root.join("hdf5").join(dataset.file_name().unwrap());
            if !twin.exists() || !is_readable(&twin) {
                continue;
            }
            let place = dataset.display();
            let read = |path: &Path| {
                let source = open(path, &OpenOptions::default()).unwrap();
                let schema = source.schema();
                let batches = source.scan(&Scan::default()).unwrap();
                let batches: Vec<_> = batches.collect::<Result<_, _>>().unwrap();
                arrow::compute::concat_batches(&schema, &batches).unwrap()
            };
            let (rows, twin) = (read(&dataset), read(&twin));
            for column in [schema::EPISODE_INDEX, schema::STEP_INDEX, schema::REWARD] {
                let of = |batch: &arrow::array::RecordBatch| batch.column_by_name(column).cloned();
                assert_eq!(of(&rows), of(&twin), "{place}: {column}");
            }
            for (field, array) in rows.schema().fields().iter().zip(rows.columns()) {
                let (_, same) = twin.schema_ref().column_with_name(field.name()).unwrap();
                // Pictures are encoded anew for each storage, and infos have N rows or N+1.
                let is_info = schema::belongs_to(field.name(), schema::INFO);
                if *field.data_type() != arrow::datatypes::DataType::Binary && !is_info {
                    assert_eq!(field.as_ref(), same, "{place}");
                    let same = twin.column_by_name(field.name()).unwrap();
                    assert_eq!(array, same, "{place}: {}", field.name());
                }
            }
        }
    }
}

/// Copies a dataset, so that it can be spoilt.
fn copy_of(dataset: &Path, to: &Path) {
    for file in files(dataset, "") {
        let copy = to.join(file.strip_prefix(dataset).unwrap());
        std::fs::create_dir_all(copy.parent().unwrap()).unwrap();
        std::fs::write(copy, std::fs::read(file).unwrap()).unwrap();
    }
}

#[test]
fn golden_minari_damaged_parts_are_named() {
    let mut n_datasets = 0;
    for dataset in datasets(&golden("formats/minari/sample")) {
        let mut parts = files(&dataset, ".arrow");
        parts.append(&mut files(&dataset, ".parquet"));
        let Some(part) = parts.last() else { continue };
        let dir = tempfile::tempdir().unwrap();
        copy_of(&dataset, dir.path());
        let copy = dir.path().join(part.strip_prefix(&dataset).unwrap());
        let bytes = std::fs::read(part).unwrap();
        let refused = || {
            let error = open(dir.path(), &OpenOptions::default()).err().unwrap();
            assert_eq!(error.to_string(), copy.display().to_string());
        };
        for n_kept in [0, 4, bytes.len() / 2, bytes.len() - 1] {
            std::fs::write(&copy, &bytes[..n_kept]).unwrap();
            refused();
        }
        std::fs::remove_file(&copy).unwrap();
        refused();
        // An episode's own metadata say how many of its rows are steps.
        std::fs::write(&copy, &bytes).unwrap();
        let metadata = copy.with_file_name("metadata.json");
        std::fs::write(&metadata, r#"{"total_steps": 1000}"#).unwrap();
        refused();
        std::fs::remove_file(&metadata).unwrap();
        assert!(open(dir.path(), &OpenOptions::default()).is_ok());
        n_datasets += 1;
    }
    assert!(n_datasets >= 1, "no datasets found");
}

#[test]
fn golden_minari_without_episodes_are_empty() {
    for dataset in datasets(&golden("formats/minari/sample")) {
        let whole = detect(&dataset).unwrap();
        if whole == Format::MinariHdf5 {
            continue;
        }
        let dir = tempfile::tempdir().unwrap();
        std::fs::create_dir(dir.path().join("data")).unwrap();
        let metadata = std::fs::read(dataset.join("data/metadata.json")).unwrap();
        std::fs::write(dir.path().join("data/metadata.json"), metadata).unwrap();
        let empty = open(dir.path(), &OpenOptions::default()).unwrap();
        assert_eq!(empty.info().n_episodes, Some(0));
        assert_eq!(empty.episodes().unwrap(), []);
        assert_eq!(summarize(empty.as_ref()).unwrap().n_rows, 0);
        let whole = open(&dataset, &OpenOptions::default()).unwrap();
        let (leaves, same) = (&whole.info().observation, &empty.info().observation);
        assert_eq!(leaves, same, "the spaces tell the same columns");
        assert_eq!(whole.info().action, empty.info().action);
    }
}
