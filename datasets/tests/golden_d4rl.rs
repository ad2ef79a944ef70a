//! The D4RL reader against recordings of h5py and of D4RL's own functions.
//!
//! The folder is `$KSIM_GOLDEN`, by default a small part of it in the repository. Whatever is found there is
//! checked: other recordings with other values must pass as well.
#![cfg(feature = "hdf5")]
#![expect(clippy::unwrap_used, reason = "tests")]

#[path = "support/mod.rs"]
#[expect(dead_code, reason = "shared with the Minari tests")]
mod support;

use ksim_datasets::{
    DatasetError, DatasetSource, EpisodePolicy, OpenOptions, TransitionOptions, TransitionReader,
    open, summarize,
};
use serde_json::Value;
use std::path::Path;
use support::{Table, files, golden, read_json, sha256_i64};

fn with_policy(policy: EpisodePolicy, expected: &Value) -> OpenOptions {
    OpenOptions {
        episode_policy: Some(policy),
        max_episode_steps: expected["max_episode_steps"].as_u64(),
        ..OpenOptions::default()
    }
}

/// `[start, end]` of every episode, in rows of the file.
fn cuts(path: &Path, options: &OpenOptions) -> Vec<(u64, u64)> {
    let source = open(path, options).unwrap();
    let episodes = source.episodes().unwrap();
    let starts: Vec<u64> = file_rows(path, source.as_ref());
    episodes
        .iter()
        .scan(0usize, |row, episode| {
            let start = starts[*row];
            *row += usize::try_from(episode.n_rows).unwrap();
            Some((start, start + episode.length))
        })
        .collect()
}

/// File row of every row of a scan, found by comparing observations with a reading of every row.
fn file_rows(path: &Path, source: &dyn DatasetSource) -> Vec<u64> {
    let all = all_rows(path);
    let all = Table::read(all.as_ref(), &["observation", "action"]);
    let some = Table::read(source, &["observation", "action", "step_index"]);
    let (all, some) = (all.row_bytes("observation"), some.row_bytes("observation"));
    let mut rows = Vec::new();
    let mut at = 0;
    for bytes in &some {
        // A final observation may be the next episode's first row: step back by one at most.
        at = (at..all.len())
            .find(|&row| same_values(&all[row], bytes))
            .unwrap();
        rows.push(at as u64);
        at = (at + 1).min(all.len());
        if rows.len() < some.len()
            && at > 0
            && !all[at..]
                .iter()
                .any(|row| same_values(row, &some[rows.len()]))
        {
            at -= 1;
        }
    }
    rows
}

fn same_values(all: &[f64], some: &[f64]) -> bool {
    #[expect(
        clippy::cast_possible_truncation,
        reason = "qlearning_dataset casts to float32"
    )]
    let narrow = |value: &f64| (*value as f32).to_bits();
    all.iter().map(narrow).eq(some.iter().map(narrow))
}

fn all_rows(path: &Path) -> Box<dyn DatasetSource> {
    // A limit no file reaches: terminals alone cut, and the tail is kept.
    let options = OpenOptions {
        episode_policy: Some(EpisodePolicy::Clean),
        ..OpenOptions::default()
    };
    open(path, &options).unwrap()
}

fn pairs(value: &Value) -> Vec<(u64, u64)> {
    let number = |value: &Value| value.as_u64().unwrap();
    value
        .as_array()
        .unwrap()
        .iter()
        .map(|pair| (number(&pair[0]), number(&pair[1])))
        .collect()
}

#[test]
fn golden_d4rl_arrays_are_bit_equal() {
    let mut n_files = 0;
    for expected_path in files(&golden("formats/hdf5/d4rl"), ".expected.json") {
        let expected = read_json(&expected_path);
        let Some(keys) = expected["keys"].as_object() else {
            continue;
        };
        let path = expected_path.with_file_name(expected["file"].as_str().unwrap());
        let source = all_rows(&path);
        let table = Table::read_all(source.as_ref());
        for (key, array) in keys {
            if key.starts_with("virtual/") {
                continue;
            }
            let place = format!("{}: {key}", path.display());
            if let Some(inner) = key.strip_prefix("metadata/") {
                check_metadata(source.as_ref(), inner, array, &place);
                continue;
            }
            let column = match key.as_str() {
                "observations" => "observation".to_owned(),
                "actions" => "action".to_owned(),
                "rewards" => "reward".to_owned(),
                "terminals" => "terminated".to_owned(),
                "timeouts" => "truncated".to_owned(),
                "next_observations" => "next_observation".to_owned(),
                "infos" => "info".to_owned(),
                other => other.replace("infos/", "info.").replace('/', "."),
            };
            table.leaf(&column).assert_is(array, &place);
        }
        n_files += 1;
    }
    assert!(n_files >= 5, "only {n_files} files found");
}

fn check_metadata(source: &dyn DatasetSource, inner: &str, array: &Value, place: &str) {
    let metadata = Value::Object(source.info().metadata.clone());
    let found = metadata.pointer(&format!("/{inner}"));
    let found = found.unwrap_or_else(|| panic!("{place} is lost"));
    if let (Some(list), Some(last)) = (found.as_array(), array["last"].as_f64()) {
        assert_eq!(list.last().and_then(Value::as_f64), Some(last), "{place}");
    }
}

#[test]
fn golden_d4rl_episodes_of_every_policy() {
    for expected_path in files(&golden("formats/hdf5/d4rl"), ".expected.json") {
        let expected = read_json(&expected_path);
        if expected["keys"].is_null() {
            continue;
        }
        let path = expected_path.with_file_name(expected["file"].as_str().unwrap());
        let place = path.display();
        let of = |policy| cuts(&path, &with_policy(policy, &expected));
        let lists = [
            ("sequence_dataset_episodes", EpisodePolicy::D4rlSequence),
            ("true_episodes", EpisodePolicy::Clean),
            ("trajectory_episodes_by_timeout", EpisodePolicy::Timeouts),
        ];
        for (key, policy) in lists {
            if !expected[key].is_null() {
                assert_eq!(of(policy), pairs(&expected[key]), "{place}: {key}");
            }
        }
        if let Some(episodes) = expected["reader_episodes_start_end_terminal_timeout"].as_array() {
            check_clean(&path, episodes);
        }
        let starts = |policy| {
            of(policy)
                .iter()
                .map(|(start, _)| *start)
                .collect::<Vec<_>>()
        };
        let numbers = |value: &Value| {
            value
                .as_array()
                .unwrap()
                .iter()
                .map(|n| n.as_u64().unwrap())
                .collect::<Vec<_>>()
        };
        if !expected["true_starts"].is_null() {
            assert_eq!(
                starts(EpisodePolicy::PositionJump),
                numbers(&expected["true_starts"]),
                "{place}"
            );
        }
        if !expected["goal_change_rows"].is_null() {
            assert_eq!(
                starts(EpisodePolicy::GoalChange)[1..],
                numbers(&expected["goal_change_rows"]),
                "{place}"
            );
        }
        check_qlearning(&path, &expected);
    }
}

fn check_clean(path: &Path, episodes: &[Value]) {
    let options = with_policy(EpisodePolicy::Clean, &Value::Null);
    let spans: Vec<(u64, u64)> = episodes
        .iter()
        .map(|e| (e[0].as_u64().unwrap(), e[1].as_u64().unwrap()))
        .collect();
    assert_eq!(cuts(path, &options), spans, "{}", path.display());
    let found = open(path, &options).unwrap().episodes().unwrap();
    let ends: Vec<String> = found
        .iter()
        .map(|episode| episode.end.to_string())
        .collect();
    let expected: Vec<&str> = episodes
        .iter()
        .map(|e| match (e[2].as_bool(), e[3].as_bool()) {
            (Some(true), _) => "terminated",
            (_, Some(true)) => "truncated",
            _ => "cut",
        })
        .collect();
    assert_eq!(ends, expected, "{}", path.display());
}

fn check_qlearning(path: &Path, expected: &Value) {
    let place = path.display();
    if let Some(count) = expected["qlearning_count"].as_u64() {
        let options = with_policy(EpisodePolicy::D4rlQlearning, expected);
        let rows: Vec<i64> = cuts(path, &options)
            .iter()
            .flat_map(|&(start, end)| (start..end).map(|row| i64::try_from(row).unwrap()))
            .collect();
        assert_eq!(rows.len() as u64, count, "{place}");
        if let Some(sha) = expected["qlearning_rows_sha"].as_str() {
            assert_eq!(sha256_i64(&rows), sha, "{place}");
        }
        if let Some(terminals) = expected["qlearning_terminals_true"].as_u64() {
            let flags = TransitionOptions {
                flags: true,
                ..TransitionOptions::default()
            };
            let source = open(path, &options).unwrap();
            let batches = TransitionReader::new(source.as_ref(), &flags).unwrap();
            let found: usize = batches
                .map(|batch| {
                    batch
                        .unwrap()
                        .terminated
                        .unwrap()
                        .iter()
                        .filter(|flag| **flag)
                        .count()
                })
                .sum();
            assert_eq!(found as u64, terminals, "{place}");
        }
    }
    if let Some(count) = expected["qlearning_terminate_on_end_count"].as_u64() {
        let options = OpenOptions {
            terminate_on_end: true,
            ..with_policy(EpisodePolicy::D4rlQlearning, expected)
        };
        assert_eq!(
            open(path, &options).unwrap().info().n_steps,
            Some(count),
            "{place}"
        );
    }
}

#[test]
fn golden_d4rl_faults_fail_as_they_must() {
    let mut n_faults = 0;
    for expected_path in files(&golden("formats/hdf5/d4rl"), ".expected.json") {
        let expected = read_json(&expected_path);
        if expected["fault"].is_null() {
            continue;
        }
        n_faults += 1;
        let name = expected["file"].as_str().unwrap();
        let path = expected_path.with_file_name(name);
        let error = || {
            open(&path, &OpenOptions::default())
                .err()
                .unwrap_or_else(|| panic!("{name} opens"))
        };
        let cause_is = |fits: fn(&DatasetError) -> bool| {
            let error = error();
            assert!(
                error.to_string().contains(name),
                "{error} does not name the file"
            );
            assert!(fits(error.cause()), "{name}: {:?}", error.cause());
        };
        match name {
            "fault_nan_inf.hdf5" => {
                let summary =
                    summarize(open(&path, &OpenOptions::default()).unwrap().as_ref()).unwrap();
                let count = |column: &str| {
                    let column = summary.columns.iter().find(|c| c.name == column).unwrap();
                    (column.n_nan, column.n_infinite)
                };
                assert_eq!(count("observation"), (1, 0));
                assert_eq!(count("action"), (0, 1));
                assert_eq!(count("reward"), (0, 1));
            }
            "fault_zero_rows.hdf5" => {
                let source = open(&path, &OpenOptions::default()).unwrap();
                assert_eq!(source.episodes().unwrap(), []);
                assert_eq!(summarize(source.as_ref()).unwrap().n_steps, 0);
            }
            "fault_length_mismatch.hdf5" => {
                cause_is(
                    |e| matches!(e, DatasetError::LengthMismatch { key, .. } if key == "actions"),
                );
            }
            "fault_missing_terminals.hdf5" => {
                cause_is(
                    |e| matches!(e, DatasetError::MissingKey { key, .. } if key == "terminals"),
                );
            }
            "fault_bomb_declared_shape.hdf5" => {
                cause_is(|e| matches!(e, DatasetError::DeclaredSize { .. }));
            }
            "fault_unknown_filter.hdf5" => {
                cause_is(|e| matches!(e, DatasetError::UnknownFilter { filter: 32999, .. }));
            }
            _ => cause_is(|e| matches!(e, DatasetError::Corrupt { .. })),
        }
    }
    assert!(n_faults >= 5, "only {n_faults} faults found");
}

/// Files without expected values: they must open under every policy that fits, and agree with themselves.
#[test]
fn golden_d4rl_fixtures_agree_with_each_other() {
    for path in files(&golden("data_fixtures/d4rl"), ".hdf5") {
        let source = all_rows(&path);
        let summary = summarize(source.as_ref()).unwrap();
        assert_eq!(
            Some(summary.n_steps),
            source.info().n_steps,
            "{}",
            path.display()
        );
        assert_eq!(summary.n_rows, summary.n_steps, "{}", path.display());
        assert!(
            summary.columns.iter().all(|column| column.n_nan == 0),
            "{}",
            path.display()
        );
        for policy in [
            EpisodePolicy::Timeouts,
            EpisodePolicy::D4rlSequence,
            EpisodePolicy::D4rlQlearning,
        ] {
            let source = open(&path, &with_policy(policy, &Value::Null)).unwrap();
            let n_steps: u64 = source
                .episodes()
                .unwrap()
                .iter()
                .map(|episode| episode.length)
                .sum();
            assert_eq!(
                Some(n_steps),
                source.info().n_steps,
                "{}: {policy}",
                path.display()
            );
        }
    }
    // The same rows with rewards of shape (N, 1).
    let folder = golden("data_fixtures/d4rl");
    let pair = [
        "hopper_medium_replay-v2.hdf5",
        "hopper_medium_replay_column_rewards.hdf5",
    ];
    if pair.iter().all(|name| folder.join(name).exists()) {
        let tables = pair.map(|name| Table::read_all(all_rows(&folder.join(name)).as_ref()));
        for column in ["reward", "terminated", "observation"] {
            assert_eq!(
                tables[0].row_bytes(column),
                tables[1].row_bytes(column),
                "{column}"
            );
        }
    }
}

/// Every sample that opens keeps the trait's contract and survives a trip through Parquet.
#[test]
fn golden_d4rl_sources_conform() {
    let mut n_checked = 0;
    for path in files(&golden("formats/hdf5/d4rl"), ".hdf5") {
        let Ok(source) = open(&path, &OpenOptions::default()) else {
            continue;
        };
        // NaN is not equal to itself; these are compared by hash above.
        let summary = summarize(source.as_ref()).unwrap();
        if summary.n_rows == 0 || summary.columns.iter().any(|column| column.n_nan > 0) {
            continue;
        }
        let dir = tempfile::tempdir().unwrap();
        ksim_datasets::conformance::check_source(source.as_ref()).unwrap();
        ksim_datasets::conformance::check_parquet_round_trip(source.as_ref(), dir.path()).unwrap();
        n_checked += 1;
    }
    assert!(n_checked >= 5, "only {n_checked} sources");
}
