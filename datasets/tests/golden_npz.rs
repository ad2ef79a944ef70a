//! The npz reader against archives that NumPy wrote in the layouts of OGBench and D4RL.
//!
//! The folder is `$KSIM_GOLDEN`, by default a small part of it in the repository. Whatever is found there is
//! checked: other recordings with other values must pass as well.
#![expect(clippy::unwrap_used, reason = "tests")]

#[path = "support/mod.rs"]
#[expect(dead_code, reason = "shared with the other golden tests")]
mod support;

use ksim_datasets::{DatasetSource, Format, OpenOptions, conformance, detect, open, schema};
use serde_json::Value;
use support::{Table, files, golden, read_json};

#[test]
fn golden_npz_archives_are_bit_equal() {
    let recordings = files(&golden("formats/hdf5/npz"), ".expected.json");
    assert!(!recordings.is_empty());
    for expected_path in recordings {
        let expected = read_json(&expected_path);
        let name = expected["file"].as_str().unwrap();
        let path = expected_path.with_file_name(name);
        assert_eq!(detect(&path).unwrap(), Format::Npz);
        let source = open(&path, &OpenOptions::default());
        if let Some(fault) = expected["fault"].as_str() {
            let error = source.err().unwrap();
            let message = error.cause().to_string();
            assert!(
                !fault.contains("pickle") || message.contains("never unpickled"),
                "{message}"
            );
            continue;
        }
        let source = source.unwrap();
        conformance::check_source(source.as_ref()).unwrap();
        let folder = tempfile::tempdir().unwrap();
        conformance::check_parquet_round_trip(source.as_ref(), folder.path()).unwrap();
        let table = Table::read_all(source.as_ref());
        for (key, array) in expected["keys"].as_object().unwrap() {
            let place = format!("{name}: {key}");
            match column(key, expected["episodes"].is_array()) {
                Some(column) => table.leaf(&column).assert_is(array, &place),
                None => assert!(
                    expected["episodes"].is_array(),
                    "{place} is only left to OGBench"
                ),
            }
        }
        check_episodes(source.as_ref(), &expected, name);
    }
}

/// The column that has every row of a key. OGBench's actions lack the last row of a trajectory, and its
/// `terminals` are the ends of the episodes.
fn column(key: &str, is_ogbench: bool) -> Option<String> {
    Some(match key {
        "observations" => schema::OBSERVATION.to_owned(),
        "actions" | "terminals" | "valids" if is_ogbench => return None,
        "actions" => schema::ACTION.to_owned(),
        "rewards" => schema::REWARD.to_owned(),
        "terminals" => schema::TERMINATED.to_owned(),
        "timeouts" => schema::TRUNCATED.to_owned(),
        key => format!(
            "info.{}",
            key.trim_start_matches("infos/").replace('/', ".")
        ),
    })
}

fn check_episodes(source: &dyn DatasetSource, expected: &Value, name: &str) {
    let is_ogbench = expected["episodes"].is_array();
    let key = if is_ogbench {
        "episodes"
    } else {
        "sequence_dataset_episodes"
    };
    let ranges: Vec<[u64; 2]> = serde_json::from_value(expected[key].clone()).unwrap();
    let episodes = source.episodes().unwrap();
    let found: Vec<_> = episodes
        .iter()
        .map(|e| [e.first_row, e.first_row + e.n_rows])
        .collect();
    assert_eq!(found, ranges, "{name}");
    let n_steps: u64 = ranges
        .iter()
        .map(|[start, end]| end - start - u64::from(is_ogbench))
        .sum();
    assert_eq!(source.info().n_steps, Some(n_steps), "{name}");
    if let Some(transitions) = expected["transitions"].as_u64() {
        assert_eq!(n_steps, transitions, "{name}");
    }
    assert!(
        episodes.iter().all(|e| e.has_final_obs == is_ogbench),
        "{name}"
    );
}
