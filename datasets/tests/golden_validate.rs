//! What `validate` says about recorded datasets, good and bad.
//!
//! The folder is `$KSIM_GOLDEN`, by default a small part of it in the repository. Whatever is found there is
//! checked: other recordings with other values must pass as well.
#![cfg(feature = "hdf5")]
#![expect(clippy::unwrap_used, reason = "tests")]

#[path = "support/mod.rs"]
#[expect(dead_code, reason = "shared with the tests of the readers")]
mod support;

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use ksim_datasets::validate::{Report, Severity, validate_path};
use ksim_datasets::{EpisodePolicy, OpenOptions};
use serde_json::Value;
use support::{files, golden, read_json};

fn report(path: &Path) -> Report {
    validate_path(path, &OpenOptions::default())
}

fn codes(report: &Report, worst: Severity) -> BTreeSet<&'static str> {
    let bad = report
        .findings
        .iter()
        .filter(|finding| finding.severity <= worst);
    bad.map(|finding| finding.code).collect()
}

/// A recording's dataset, and what is expected of it.
fn recordings(folder: &str) -> Vec<(PathBuf, Value)> {
    let of = |expected: PathBuf| {
        let value = read_json(&expected);
        let name = value["file"].as_str().map(ToOwned::to_owned).or_else(|| {
            let name = expected.file_name()?.to_str()?;
            Some(name.strip_suffix(".expected.json")?.to_owned())
        });
        (expected.with_file_name(name.unwrap()), value)
    };
    let found = files(&golden(folder), ".expected.json").into_iter().map(of);
    found.filter(|(path, _)| path.exists()).collect()
}

#[test]
fn golden_validate_finds_every_recorded_fault() {
    let mut n_faults = 0;
    for (path, expected) in recordings("formats/hdf5") {
        let (Some(fault), Some(must)) = (expected["fault"].as_str(), expected["must"].as_str())
        else {
            continue;
        };
        let report = report(&path);
        let place = format!("{}: {fault}: {report:?}", path.display());
        let codes = codes(&report, Severity::Error);
        n_faults += 1;
        if must.starts_with("report") {
            assert!(codes.contains("not-finite"), "{place}");
            assert!(report.coverage.complete, "{place}");
        } else if must.starts_with("zero episodes") {
            assert!(codes.contains("no-steps"), "{place}");
        } else {
            assert_eq!(codes, BTreeSet::from(["unreadable"]), "{place}");
            let has_file = report.findings[0].places[0].file.is_some();
            assert!(has_file && !report.coverage.complete, "{place}");
        }
    }
    assert!(n_faults >= 5, "only {n_faults} faults found");
}

#[test]
fn golden_validate_has_no_error_for_good_files() {
    let mut n_good = 0;
    for (path, expected) in recordings("formats/hdf5") {
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        let report = report(&path);
        // Whether the other readers open their files is for their own tests to say.
        let is_read = report.format.is_some() || path.parent().unwrap().ends_with("d4rl");
        if !expected["fault"].is_null() || name.contains("bad") || !is_read {
            continue;
        }
        n_good += 1;
        let codes = codes(&report, Severity::Error);
        assert_eq!(codes, BTreeSet::new(), "{name}: {report:?}");
        assert!(report.coverage.complete, "{name}");
    }
    assert!(n_good >= 5, "only {n_good} good files found");
}

#[test]
fn golden_validate_names_the_known_faults_of_d4rl() {
    for (path, expected) in recordings("formats/hdf5/d4rl") {
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        let report = report(&path);
        let all = codes(&report, Severity::Warning);
        let mentions = |code: &str, text: &str| {
            let found = report.findings.iter().find(|finding| finding.code == code);
            found.is_some_and(|finding| finding.message.contains(text))
        };
        if let Some(starts) = expected["true_starts"].as_array() {
            assert!(mentions("position-jump", "D4RL#77"), "{name}: {report:?}");
            let jumps = report
                .findings
                .iter()
                .find(|f| f.code == "position-jump")
                .unwrap();
            assert!(jumps.count < starts.len() as u64, "{name}: {report:?}");
            let fixed = OpenOptions {
                episode_policy: Some(EpisodePolicy::PositionJump),
                ..OpenOptions::default()
            };
            let codes = codes(&validate_path(&path, &fixed), Severity::Error);
            assert!(!codes.contains("position-jump"), "{name}");
        }
        if let Some(rows) = expected["goal_change_rows"].as_array() {
            let found = report
                .findings
                .iter()
                .find(|f| f.code == "goal-change")
                .unwrap();
            assert_eq!(found.count, rows.len() as u64, "{name}");
            assert!(all.contains("goal-change"), "{name}: {report:?}");
        }
        if name.starts_with("antmaze_v2") {
            assert!(
                mentions("one-step-episodes", "D4RL#199"),
                "{name}: {report:?}"
            );
        }
        if expected["max_episode_steps"].is_number() {
            assert!(all.contains("no-episode-ends"), "{name}: {report:?}");
        }
    }
}

#[test]
fn golden_validate_never_fails_on_minari() {
    let mut n_read = 0;
    for metadata in files(&golden("formats/minari"), "metadata.json") {
        let folder = metadata.parent().and_then(Path::parent).unwrap();
        if !metadata.ends_with("data/metadata.json") || folder.ends_with("data") {
            continue;
        }
        let (report, name) = (report(folder), folder.to_string_lossy().into_owned());
        let codes = codes(&report, Severity::Error);
        match name {
            name if name.contains("truncated") || name.contains("future") => {
                assert_eq!(codes, BTreeSet::from(["unreadable"]), "{name}: {report:?}");
            }
            name if name.contains("buffers") => {
                assert_eq!(codes, BTreeSet::from(["not-finite"]), "{name}: {report:?}");
            }
            name => {
                assert_eq!(codes, BTreeSet::new(), "{name}: {report:?}");
                assert!(report.coverage.complete, "{name}");
            }
        }
        n_read += 1;
    }
    assert!(n_read >= 3, "only {n_read} datasets found");
}

#[test]
fn golden_validate_says_little_about_real_motion() {
    let mut n_read = 0;
    let folder = golden("data_fixtures");
    let hdf5 = files(&folder.join("d4rl"), ".hdf5");
    for path in hdf5
        .into_iter()
        .chain(files(&folder.join("minari"), "main_data.hdf5"))
    {
        let report = report(&path);
        assert_eq!(
            codes(&report, Severity::Error),
            BTreeSet::new(),
            "{report:?}"
        );
        n_read += 1;
    }
    assert!(n_read >= 2, "only {n_read} datasets found");
}

/// Recordings of every other format: whatever is said, nothing panics.
#[test]
fn golden_validate_survives_every_sample() {
    for folder in [
        "formats/mcap",
        "formats/lerobot",
        "formats/hdf5/npz",
        "formats/hdf5/robomimic",
    ] {
        for (path, _) in recordings(folder) {
            let report = report(&path);
            assert!(
                report.coverage.complete || codes(&report, Severity::Error).contains("unreadable"),
                "{}: {report:?}",
                path.display()
            );
        }
    }
}
