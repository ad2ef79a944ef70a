//! `ksim dataset collect`: Minari datasets, in our reader and in Minari.

use std::path::{Path, PathBuf};

use serde_json::Value;

use crate::process::{Run, ksim};

/// Where a dataset of this name lies, in a folder of Minari's.
fn place(root: &Path, name: &str) -> PathBuf {
    root.join("mine").join(name)
}

/// Collects two episodes.
fn collect(root: &Path, name: &str, flags: &[&str]) -> Run {
    let (folder, id) = (place(root, name), format!("mine/{name}"));
    let folder = folder.to_str().expect("a path in UTF-8");
    let start = [
        "dataset",
        "collect",
        "--policy",
        "random",
        "--episodes",
        "2",
        "--seed",
        "5",
    ];
    let more = ["--id", &id, "-o", folder, "--author", "somebody"];
    ksim(start.iter().chain(&more).chain(flags))
}

fn metadata(root: &Path, name: &str) -> Value {
    let text = std::fs::read_to_string(place(root, name).join("data/metadata.json"));
    let text = text.expect("the dataset is there");
    serde_json::from_str(&text.replace("Infinity", "1e9")).expect("it is JSON")
}

#[test]
fn every_storage_holds_the_same_dataset() {
    let root = tempfile::tempdir().unwrap();
    let storages: &[&str] = if cfg!(feature = "hdf5") {
        &["arrow", "parquet", "hdf5"]
    } else {
        &["arrow", "parquet"]
    };
    for storage in storages {
        let name = format!("{storage}-v0");
        let flags = ["--env", "PointMass-v0", "--storage", storage];
        let scores = ["--ref-min-score", "-1", "--ref-max-score", "1"];
        let run = collect(root.path(), &name, &[&flags[..], &scores].concat());
        assert_eq!(run.code, 0, "{}", run.stderr);
        let about = metadata(root.path(), &name);
        assert_eq!(about["total_episodes"], 2);
        assert_eq!(about["algorithm_name"], "random");
        assert_eq!(about["author"], serde_json::json!(["somebody"]));
        assert_eq!(
            (&about["ref_min_score"], &about["ref_max_score"]),
            (&(-1.0).into(), &1.0.into())
        );
        assert!(about["action_space"].as_str().unwrap().contains("float32"));
        let [first, other] = [storages[0], *storage].map(|storage| {
            place(root.path(), &format!("{storage}-v0"))
                .display()
                .to_string()
        });
        let score = ksim(["score", &other, "--dataset", &first, "--format", "json"]).json();
        assert_eq!(score["results"][0]["k_sim"], 1.0, "{storage}");
    }
    let again = collect(root.path(), "arrow-v0", &["--env", "PointMass-v0"]);
    again.failed(1, &["there is something already"]);
    let run = collect(
        root.path(),
        "v0",
        &["--env", "PointMass-v0", "--storage", "arrow"],
    );
    run.failed(1, &["dataset id \"mine/v0\" is refused"]);
}

/// What Minari makes of the datasets. Runs where Python (`$KSIM_PYTHON`, else `python3`) has the libraries.
#[cfg(feature = "mujoco")]
#[test]
fn minari_reads_the_datasets_and_makes_their_environments() {
    let root = tempfile::tempdir().unwrap();
    let hopper = collect(root.path(), "hopper-v0", &["--env", "Hopper-v5"]);
    assert_eq!(hopper.code, 0, "{}", hopper.stderr);
    let flags = ["--env", "AntMaze_UMaze-v4", "--max-steps", "30"];
    let maze = collect(root.path(), "maze-v0", &flags);
    assert_eq!(maze.code, 0, "{}", maze.stderr);
    let Some(found) = check_collected(root.path(), &["mine/hopper-v0", "mine/maze-v0"]) else {
        return;
    };
    for (found, id) in found
        .as_array()
        .unwrap()
        .iter()
        .zip(["Hopper-v5", "AntMaze_UMaze-v4"])
    {
        assert_eq!(found["environments"], serde_json::json!([id, id]));
        assert_eq!(found["seeds"], serde_json::json!([5, 6]));
        assert_eq!(found["actions_fit"], true);
        // Gymnasium's environment, reset with the recorded seed, starts where ours did.
        assert_eq!(found["first_observation_error"], 0.0);
    }
    assert_eq!(
        found[1]["infos"],
        serde_json::json!(["goal", "qpos", "qvel", "success"])
    );
    assert_eq!(found[1]["n_steps"], 60);
}

/// Runs `scripts/check_collected.py`; `None` if the libraries are not there.
#[cfg(feature = "mujoco")]
#[expect(clippy::print_stderr, reason = "a test that is skipped says so")]
fn check_collected(root: &Path, ids: &[&str]) -> Option<Value> {
    use std::process::Command;
    let python = std::env::var_os("KSIM_PYTHON").unwrap_or_else(|| "python3".into());
    let import = ["-c", "import minari, h5py, gymnasium_robotics, mujoco"];
    let import = Command::new(&python).args(import).output();
    if !import.is_ok_and(|output| output.status.success()) {
        eprintln!(
            "skipped: {} lacks Minari or its environments",
            python.display()
        );
        return None;
    }
    let script = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../../scripts/check_collected.py"
    );
    let output = Command::new(&python)
        .arg(script)
        .args(ids)
        .env("MINARI_DATASETS_PATH", root)
        .output();
    let output = output.expect("Python runs");
    assert!(
        output.status.success(),
        "{}",
        String::from_utf8_lossy(&output.stderr)
    );
    Some(serde_json::from_slice(&output.stdout).expect("it prints JSON"))
}
