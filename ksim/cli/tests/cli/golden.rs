//! The whole path, from Minari HDF5 and Parquet to the result, against values recorded from
//! scikit-learn and numpy: `$KSIM_GOLDEN`, or the copies in the repository.

use std::path::{Path, PathBuf};

use crate::process::{Rollouts, column, command, finished};
use safetensors::SafeTensors;
use serde_json::Value;

/// Selection of state columns, and its name in the recording.
const SELECTIONS: [(&str, &str); 3] = [("all", "full31"), ("0..29", "full29"), ("0..2", "xy2")];

fn golden() -> PathBuf {
    match std::env::var_os("KSIM_GOLDEN").filter(|folder| !folder.is_empty()) {
        Some(folder) => PathBuf::from(folder),
        None => Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/fixtures/golden"),
    }
}

fn f64s(tensors: &SafeTensors<'_>, name: &str) -> Vec<f64> {
    let bytes = tensors.tensor(name).expect(name).data().as_chunks().0;
    bytes
        .iter()
        .map(|&bytes| f64::from_le_bytes(bytes))
        .collect()
}

fn f32s(tensors: &SafeTensors<'_>, name: &str) -> Vec<f32> {
    let bytes = tensors.tensor(name).expect(name).data().as_chunks().0;
    bytes
        .iter()
        .map(|&bytes| f32::from_le_bytes(bytes))
        .collect()
}

fn rows(tensors: &SafeTensors<'_>, name: &str) -> Vec<f64> {
    let bytes = tensors.tensor(name).expect(name).data().as_chunks().0;
    bytes
        .iter()
        .map(|&bytes| f64::from(i32::from_le_bytes(bytes)))
        .collect()
}

#[test]
fn golden_minari_scores_are_reproduced() {
    let fixtures = golden().join("data_fixtures");
    let recording = fixtures.join("ksim_small.safetensors");
    let bytes = std::fs::read(&recording).unwrap();
    let tensors = SafeTensors::deserialize(&bytes).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let (query, out) = (
        folder.path().join("query.parquet"),
        folder.path().join("steps.parquet"),
    );
    let observations = f32s(&tensors, "query.states");
    let n = observations.len() / 31;
    let actions = f32s(&tensors, "query.actions");
    let episodes: Vec<i64> = (0..n as i64).map(|row| row / 100).collect();
    Rollouts {
        observations,
        actions,
        ..Rollouts::new(&episodes, [31, 8])
    }
    .write(&query);
    for (selection, name) in SELECTIONS {
        for (kind, flags) in [
            ("exact", &["--search", "auto"][..]),
            ("exact", &["--search", "linear"]),
            ("clustered", &["--centers", recording.to_str().unwrap()]),
        ] {
            let run = command()
                .env("MINARI_DATASETS_PATH", fixtures.join("minari"))
                .args([
                    "score",
                    "--dataset",
                    "antmaze-large-play",
                    "--format",
                    "json",
                ])
                .args(["--state-columns", selection, "--per-step"])
                .arg(&out)
                .arg(&query)
                .args(flags)
                .output()
                .unwrap();
            let document = finished(&run).json();
            let at = format!("{name}.{kind} {flags:?}");
            compare(
                &document,
                &tensors,
                &format!("{name}.{kind}"),
                out.to_str().unwrap(),
                &at,
            );
        }
    }
}

fn compare(document: &Value, tensors: &SafeTensors<'_>, key: &str, steps: &str, at: &str) {
    let score = f64s(tensors, &format!("{key}.score"));
    let mean = score.iter().sum::<f64>() / score.len() as f64;
    let k_sim = document["results"][0]["k_sim"].as_f64().expect("a number");
    assert!((k_sim - mean).abs() < 1e-6, "{at}: {k_sim} for {mean}");
    for (column_name, expected) in [
        ("score", score),
        ("distance", f64s(tensors, &format!("{key}.distance"))),
    ] {
        for (found, expected) in column(steps, column_name).iter().zip(&expected) {
            assert!(
                (found - expected).abs() < 1e-6,
                "{at} {column_name}: {found} for {expected}"
            );
        }
    }
    let expected = rows(tensors, &format!("{key}.neighbour"));
    assert_eq!(column(steps, "reference_row"), expected, "{at}");
    if key.ends_with("clustered") {
        assert_eq!(
            column(steps, "cluster"),
            rows(tensors, &format!("{key}.cluster")),
            "{at}"
        );
    }
}

#[test]
fn golden_data_without_recorded_ends_is_done_with_warnings() {
    let file = golden().join("formats/hdf5/d4rl/kitchen_like.hdf5");
    let run = command()
        .args(["dataset", "info", "--format", "json"])
        .arg(file)
        .output()
        .unwrap();
    let run = finished(&run);
    assert_eq!(run.code, 3, "{}", run.stderr);
    assert!(run.stderr.starts_with("warning: "), "{}", run.stderr);
    let json: Value = serde_json::from_str(&run.stdout).unwrap();
    assert_eq!(json["format"], "d4rl-hdf5");
    assert!(!json["warnings"].as_array().unwrap().is_empty());
}

#[test]
fn golden_damaged_hdf5_is_refused() {
    let whole =
        std::fs::read(golden().join("data_fixtures/d4rl/hopper_medium-v0_layout.hdf5")).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let half = folder.path().join("half.hdf5");
    std::fs::write(&half, &whole[..whole.len() / 2]).unwrap();
    let run = command()
        .args(["dataset", "info"])
        .arg(&half)
        .output()
        .unwrap();
    finished(&run).failed(1, &["half.hdf5"]);
}
