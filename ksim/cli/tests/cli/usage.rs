//! Help, wrong usage, the demo, and what is told about datasets.

use serde_json::Value;

use crate::process::{Demo, command, finished, ksim};

#[test]
fn help_names_every_command_and_flag() {
    let root = ksim(["--help"]);
    assert_eq!(root.code, 0);
    for part in [
        "score",
        "report",
        "watch",
        "export",
        "dataset",
        "demo",
        "--threads",
        "--quiet",
        "Exit status",
    ] {
        assert!(root.stdout.contains(part), "{part}");
    }
    let score = ksim(["score", "--help"]);
    for flag in [
        "--dataset",
        "--format",
        "--per-step",
        "--sparkline",
        "--definition",
        "--state-columns",
        "--n-clusters",
        "--n-neighbors",
        "--gamma",
        "--search",
        "--centers",
        "--k-means",
        "--seed",
        "--threads",
        "--exclude-same-episode",
        "--approximation-error",
        "--n-resamples",
        "--episode-policy",
        "--max-episode-steps",
        "--force",
        "--observation-columns",
        "--action-columns",
        "--episode-column",
    ] {
        assert!(score.stdout.contains(flag), "{flag}");
    }
    assert_eq!(
        ksim(["--version"]).stdout,
        format!("ksim {}\n", env!("CARGO_PKG_VERSION"))
    );
}

#[test]
fn wrong_usage_is_exit_2() {
    let demo = Demo::new();
    ksim::<&str>([]).failed(2, &["Usage"]);
    ksim(["score", "x.parquet"]).failed(2, &["--dataset"]);
    let score = |flags: &[&str]| demo.score(&["good.parquet"], flags);
    score(&["--gamma", "0"]).failed(2, &["expected a finite number above 0"]);
    score(&["--gamma", "-1"]).failed(2, &["expected a finite number above 0"]);
    score(&["--n-neighbors", "0"]).failed(2, &["whole number"]);
    score(&["--threads", "0"]).failed(2, &["--threads"]);
    score(&["--search", "fast"]).failed(2, &["kd-tree"]);
    score(&["--approximation-error"]).failed(2, &["--search clusters"]);
    score(&["--centers", "c.safetensors", "--search", "linear"]).failed(2, &["--search linear"]);
}

#[test]
fn the_demo_tells_good_from_noisy() {
    let demo = ksim(["demo"]);
    assert_eq!((demo.code, demo.stderr.as_str()), (0, ""));
    for part in [
        "good.parquet",
        "95 % interval",
        "exact (blocked)",
        "What they do not say",
    ] {
        assert!(demo.stdout.contains(part), "{part}");
    }
    let document = ksim(["demo", "--format", "json"]).json();
    let k_sim = |at: usize| document["results"][at]["k_sim"].as_f64().expect("a number");
    assert!(k_sim(0) > k_sim(1) + 0.15, "{} {}", k_sim(0), k_sim(1));
    assert!(k_sim(0) > k_sim(2) + 0.15, "{} {}", k_sim(0), k_sim(2));
}

#[test]
fn dataset_list_says_where_it_looked() {
    let roots = tempfile::tempdir().unwrap();
    let run = |format: &str| {
        let mut command = command();
        command.env("MINARI_DATASETS_PATH", roots.path());
        finished(
            &command
                .args(["dataset", "list", "--format", format])
                .output()
                .unwrap(),
        )
    };
    let text = run("text").stdout;
    for part in [
        "no datasets found",
        roots.path().to_str().unwrap(),
        "D4RL_DATASET_DIR",
        "ksim dataset download",
    ] {
        assert!(text.contains(part), "no {part} in {text}");
    }
    let json = run("json").json();
    assert_eq!(json["schema"], "ksim.dataset-list/1");
    assert_eq!(json["datasets"], Value::Array(Vec::new()));
}

#[test]
fn dataset_info_counts() {
    let demo = Demo::new();
    let run = ksim([
        "dataset",
        "info",
        &demo.at("dataset.parquet"),
        "--format",
        "json",
    ]);
    let json = run.json();
    assert_eq!(json["schema"], "ksim.dataset-info/1");
    assert_eq!(
        (&json["n_episodes"], &json["n_steps"]),
        (&12.into(), &12_000.into())
    );
    assert_eq!(
        (&json["observation_width"], &json["action_width"]),
        (&31.into(), &8.into())
    );
    let text = ksim(["dataset", "info", &demo.at("dataset.parquet")]).stdout;
    assert!(
        text.contains("12000") && text.contains("observation"),
        "{text}"
    );
}

#[test]
fn a_reader_that_had_enough_is_no_failure() {
    let mut child = command()
        .args(["demo", "--format", "json"])
        .stdout(std::process::Stdio::piped())
        .spawn()
        .unwrap();
    drop(child.stdout.take());
    assert_eq!(child.wait().unwrap().code(), Some(0));
}
