//! `ksim train`, `ksim planner`, `ksim rollout --planner` and `ksim bench` of planners, on the point mass.

use std::path::Path;

use serde_json::Value;

use crate::process::{Run, batches, column, ksim};
#[cfg(all(feature = "torch", unix))]
use crate::process::{command, finished};

/// A folder with a dataset: full pushes, which reach the goal.
struct Toy(tempfile::TempDir);

impl Toy {
    fn new() -> Self {
        let toy = Self(tempfile::tempdir().expect("a folder"));
        // The process planner in Rust is not built with this crate's tests; random pushes are data enough.
        let data = toy.at("data.parquet");
        let flags = ["--episodes", "12", "--seed", "5", "-o", &data];
        let run = ksim(
            [
                &["rollout", "--env", "PointMass-v0", "--policy", "random"][..],
                &flags,
            ]
            .concat(),
        );
        assert_eq!(run.code, 0, "{}", run.stderr);
        toy
    }

    fn at(&self, name: &str) -> String {
        let path = self.0.path().join(name);
        path.to_str().expect("a path in UTF-8").to_owned()
    }

    fn rollout(&self, planner: &str, flags: &[&str]) -> Run {
        let start = ["rollout", "--env", "PointMass-v0", "--planner", planner];
        ksim([&start[..], &["--episodes", "4"], flags].concat())
    }

    fn write(&self, name: &str, text: &str) -> String {
        std::fs::write(self.at(name), text).expect("it is written");
        self.at(name)
    }

    /// A suite of baselines.
    fn suite(&self, more: &str) -> String {
        let data = self.at("data.parquet");
        let text = format!(
            "name = \"toy\"\nepisodes = 3\nruns = 2\n\n\
             [[environment]]\nname = \"mass\"\nenv = \"PointMass-v0\"\ndataset = {data:?}\nmax_steps = 20\n\n\
             [[planner]]\nname = \"nearest\"\nsource = \"nearest:{{dataset}}\"\nreplan_interval = 3\n\n\
             [[planner]]\nname = \"random\"\npolicy = \"random\"\n{more}"
        );
        self.write("suite.toml", &text)
    }
}

#[test]
fn a_planner_is_played_scored_and_recorded_in_one_command() {
    let toy = Toy::new();
    let (data, out) = (toy.at("data.parquet"), toy.at("out.parquet"));
    let planner = format!("nearest:{data}");
    let flags = ["--dataset", &data, "--format", "json", "-o", &out];
    let run = toy.rollout(&planner, &flags);
    let document = run.json();
    assert_eq!(document["policy"], "nearest:data");
    // Steps of the dataset again: the number alone says nothing, and the command says so.
    assert!(
        document["k_sim"]["saturated_share"]
            .as_f64()
            .expect("a number")
            > 0.9
    );
    assert!(run.stderr.contains("are saturated"), "{}", run.stderr);
    assert_eq!(document["planner"]["replan_interval"], 1);
    let k_sim = &document["k_sim"];
    let score = ksim(["score", &out, "--dataset", &data, "--format", "json"]).json();
    let expected = score["results"][0]["k_sim"].as_f64().expect("a number");
    assert!((k_sim["k_sim"].as_f64().expect("a number") - expected).abs() < 1e-12);
    assert!(document["summary"]["success"]["ever"]["value"].is_number());
    // The novelty of every step is in the file; the state after the last has none.
    let novelties = column(&out, "info.novelty");
    let lengths: f64 = document["episodes"]
        .as_array()
        .expect("a list")
        .iter()
        .map(|one| one["length"].as_f64().expect("a number"))
        .sum();
    let known = novelties.iter().filter(|value| !value.is_nan()).count();
    assert_eq!(known as f64, lengths);
    assert_eq!(novelties.len() as f64, lengths + 4.0);
    let without = toy.rollout(
        &planner,
        &["--dataset", &data, "--no-k-sim", "--format", "json"],
    );
    assert!(without.json()["k_sim"].is_null());
}

#[test]
fn neither_threads_nor_environments_show_in_the_plans() {
    let toy = Toy::new();
    let data = toy.at("data.parquet");
    for planner in [
        "random".to_owned(),
        format!("nearest:{data}"),
        format!("replay:{data}"),
    ] {
        let play = |name: &str, flags: &[&str]| {
            let out = toy.at(name);
            let run = toy.rollout(
                &planner,
                &[flags, &["--replan-interval", "2", "-o", &out]].concat(),
            );
            assert_eq!(run.code, 0, "{}", run.stderr);
            let bytes = std::fs::read(&out).expect("it was written");
            std::fs::remove_file(&out).expect("it is there");
            bytes
        };
        let one = play("same.parquet", &["--parallel", "1", "--threads", "1"]);
        let many = play("same.parquet", &["--parallel", "3", "--threads", "4"]);
        assert!(one == many, "{planner}");
    }
}

#[test]
fn a_trained_baseline_plays_as_its_dataset_does() {
    let toy = Toy::new();
    let (data, run) = (toy.at("data.parquet"), toy.at("run"));
    let train = ["train", "nearest", "--dataset", &data, "-o", &run];
    let trained = ksim([&train[..], &["--set", "n_candidates=2", "--seed", "3"]].concat());
    assert_eq!(trained.code, 0, "{}", trained.stderr);
    assert!(
        trained
            .stdout
            .contains(&format!("ksim rollout --planner {run}")),
        "{}",
        trained.stdout
    );
    let info = ksim(["planner", "info", &run, "--format", "json"]).json();
    assert_eq!(info["manifest"]["family"], "nearest");
    assert_eq!(info["manifest"]["config"]["n_candidates"], 2);
    let episodes = |planner: &str, flags: &[&str]| {
        toy.rollout(planner, &[flags, &["--format", "json"]].concat())
            .json()["episodes"]
            .clone()
    };
    let direct = format!("nearest:{data}");
    assert_eq!(
        episodes(&run, &[]),
        episodes(&direct, &["--candidates", "2"])
    );
    ksim(train).failed(1, &["manifest.json", "a run of nearest, expected no run"]);
    toy.rollout(&run, &["--curiosity", "3"])
        .failed(1, &["weight of curiosity"]);
}

#[test]
fn a_planner_that_is_served_plans_as_one_that_is_not() {
    let toy = Toy::new();
    let direct = format!("nearest:{}", toy.at("data.parquet"));
    let served = format!(
        "process:'{}' planner serve '{direct}'",
        env!("CARGO_BIN_EXE_ksim")
    );
    let episodes = |planner: &str| {
        let flags = ["--replan-interval", "4", "--format", "json"];
        toy.rollout(planner, &flags).json()["episodes"].clone()
    };
    assert_eq!(episodes(&served), episodes(&direct));
    let broken = format!(
        "process:'{}' planner serve nearest:none",
        env!("CARGO_BIN_EXE_ksim")
    );
    toy.rollout(&broken, &[])
        .failed(1, &["ended (exit status: 1)", "not on this machine"]);
    toy.rollout("process:sleep 60", &["--planner-timeout", "1"])
        .failed(1, &["`sleep 60`", "did not answer within 1 s"]);
}

/// OpenMP reads the variable when libtorch is loaded, so it must be set before the program starts.
#[cfg(all(feature = "torch", unix))]
#[test]
fn threads_of_libtorch_wait_passively_unless_told_otherwise() {
    let told = |policy: Option<&str>| {
        let mut ksim = command();
        match policy {
            Some(policy) => ksim.env("OMP_WAIT_POLICY", policy),
            None => ksim.env_remove("OMP_WAIT_POLICY"),
        };
        let planner = "process:sh -c 'echo waits $OMP_WAIT_POLICY >&2; exit 3'";
        ksim.args(["rollout", "--env", "PointMass-v0", "--episodes", "1"]);
        ksim.args(["--planner", planner]);
        finished(&ksim.output().expect("the binary runs"))
    };
    told(None).failed(1, &["waits PASSIVE"]);
    told(Some("ACTIVE")).failed(1, &["waits ACTIVE"]);
}

#[test]
fn faults_name_what_is_wrong() {
    let toy = Toy::new();
    let data = toy.at("data.parquet");
    toy.rollout("nearest:", &[])
        .failed(1, &["no planner `nearest:`", "nearest:DATASET"]);
    toy.rollout("no/such/run", &[])
        .failed(1, &["no/such/run: cannot read the planner"]);
    std::fs::create_dir(toy.at("empty")).unwrap();
    toy.rollout(&toy.at("empty"), &[])
        .failed(1, &["empty/manifest.json: cannot read the planner"]);
    toy.rollout("random", &["--curiosity", "1"])
        .failed(1, &["no weight of curiosity"]);
    toy.rollout("random", &["--precision", "bf16"])
        .failed(1, &["no precision"]);
    toy.rollout("random", &["--candidates", "4294967295"])
        .failed(1, &["n_candidates is 4294967295, expected 1 to 65536"]);
    for flag in ["--curiosity", "--warm-start", "--planner-timeout"] {
        let policy = [
            "rollout",
            "--env",
            "PointMass-v0",
            "--policy",
            "random",
            "--episodes",
            "1",
        ];
        let message = format!("{flag} is for --planner");
        ksim([&policy[..], &[flag, "1"]].concat()).failed(2, &[&message]);
    }
    toy.rollout("random", &["--policy", "zero"])
        .failed(2, &["--policy"]);
    toy.rollout("random", &["--guidance", "-1"])
        .failed(2, &["0 or more"]);
    toy.rollout("random", &["--candidates", "0"])
        .failed(2, &["--candidates"]);
    let train = |planner: &str, flags: &[&str]| {
        let start = ["train", planner, "--dataset", &data, "-o"];
        let out = toy.at("new");
        ksim([&start[..], &[&out], flags].concat())
    };
    train("nobody", &[]).failed(1, &["no planner \"nobody\"", "nearest"]);
    train("nearest", &["--preset", "paper"]).failed(1, &["no preset \"paper\"", "default"]);
    train("nearest", &["--set", "horizn=3"]).failed(1, &["no setting \"horizn\"", "horizon"]);
    train("nearest", &["--base", &data]).failed(1, &["the base is", "no network"]);
    train("nearest", &["--resume"]).failed(1, &["the run to go on with is missing"]);
    train("nearest", &["--set", "horizon"]).failed(2, &["KEY=VALUE"]);
    assert!(!Path::new(&toy.at("new")).exists());
}

#[test]
fn planners_are_listed() {
    let list = ksim(["planner", "list", "--format", "json"]).json();
    let ids: Vec<&str> = list["planners"]
        .as_array()
        .expect("a list")
        .iter()
        .filter_map(|one| one["id"].as_str())
        .collect();
    for id in [
        "nearest",
        "random",
        "replay",
        "diffuser",
        "curiosity-diffuser",
    ] {
        assert!(ids.contains(&id), "{id} in {ids:?}");
    }
    let text = ksim(["planner", "list"]).stdout;
    assert!(text.contains("process:COMMAND"), "{text}");
}

#[test]
fn a_benchmark_is_played_once_and_reported() {
    let toy = Toy::new();
    let (suite, out) = (toy.suite(""), toy.at("results"));
    let bench = |flags: &[&str]| {
        let start = ["bench", "planners", &suite, "-o", &out];
        ksim([&start[..], flags].concat())
    };
    let first = bench(&["--parallel", "2"]);
    assert_eq!(first.code, 0, "{}", first.stderr);
    for part in [
        "## Success, %",
        "at the last step",
        "## K-Sim",
        "| mass | nearest |",
    ] {
        assert!(first.stdout.contains(part), "{part} in {}", first.stdout);
    }
    let episodes = toy.at("results/episodes.parquet");
    let rows: usize = batches(&episodes)
        .iter()
        .map(|batch| batch.num_rows())
        .sum();
    assert_eq!(rows, 2 * 2 * 3);
    let seeds = column(&episodes, "seed");
    assert_eq!(seeds[..6], [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]);
    assert!(
        column(&episodes, "k_sim")
            .iter()
            .all(|value| (0.0..=1.0).contains(value))
    );
    let written = std::fs::read(&episodes).expect("it is there");
    let again = bench(&["--parallel", "1"]);
    assert!(
        again.stderr.contains("4 of 4 cells were done before"),
        "{}",
        again.stderr
    );
    assert_eq!(again.stdout, first.stdout);
    assert!(std::fs::read(&episodes).expect("it is there") == written);
    // One cell is lost, and comes back as it was.
    std::fs::remove_file(toy.at("results/cells/nearest--mass--1.parquet")).expect("it is there");
    let mended = bench(&[]);
    assert!(mended.stderr.contains("3 of 4 cells"), "{}", mended.stderr);
    assert!(std::fs::read(&episodes).expect("it is there") == written);
    let report: Value =
        serde_json::from_slice(&std::fs::read(toy.at("results/report.json")).unwrap())
            .expect("it is JSON");
    assert_eq!(report["schema"], "ksim.bench-report/1");
    assert_eq!(report["results"][0]["summary"]["n_episodes"], 6);
}

#[test]
fn a_benchmark_does_not_mix_settings() {
    let toy = Toy::new();
    let out = toy.at("results");
    let bench = |suite: &str| ksim(["bench", "planners", suite, "-o", &out]);
    let suite = toy.suite("");
    assert_eq!(bench(&suite).code, 0);
    let text = std::fs::read_to_string(&suite).expect("it is there");
    let other = toy.write(
        "other.toml",
        &text.replace("replan_interval = 3", "replan_interval = 2"),
    );
    bench(&other).failed(
        1,
        &[
            "nearest in mass, run 0",
            "was played with planner",
            "write to another folder",
        ],
    );
    let wrong = toy.suite("candidats = 3\n");
    bench(&wrong).failed(1, &["suite.toml", "unknown field `candidats`"]);
    bench(&toy.at("none.toml")).failed(1, &["none.toml"]);
}

#[test]
fn a_planner_that_is_not_finished_plays_and_says_so() {
    let toy = Toy::new();
    let (data, run, out) = (toy.at("data.parquet"), toy.at("run"), toy.at("results"));
    let train = ["train", "diffuser", "--dataset", &data, "-o", &run];
    let trained = ksim([&train[..], &["--preset", "smoke"]].concat());
    assert_eq!(trained.code, 0, "{}", trained.stderr);
    let file = toy.at("run/planner.safetensors");
    let played = toy.rollout(&file, &["--format", "json"]);
    assert!(!played.stderr.contains("not finished"), "{}", played.stderr);
    assert_eq!(played.json()["planner"]["finished"], true);
    let bytes = std::fs::read(&file).expect("it is there");
    let (header, tensors) = bytes[8..].split_at(header_len(&bytes));
    let header = std::str::from_utf8(header).expect("JSON");
    let mut header = header.replace(r#"finished\":true"#, r#"finished\":false"#);
    header += &" ".repeat(header.len().next_multiple_of(8) - header.len());
    let length = (header.len() as u64).to_le_bytes();
    let edited = [&length[..], header.as_bytes(), tensors].concat();
    std::fs::write(&file, edited).expect("it is written");
    let played = toy.rollout(&run, &["--format", "json"]);
    assert!(
        played.stderr.contains("is not finished"),
        "{}",
        played.stderr
    );
    assert_eq!(played.json()["planner"]["finished"], false);
    let suite = toy.suite(&format!(
        "\n[[planner]]\nname = \"early\"\nsource = {run:?}\n"
    ));
    let bench = ksim(["bench", "planners", &suite, "-o", &out]);
    assert!(bench.stderr.contains("is not finished"), "{}", bench.stderr);
    let note = "**The training of early in mass is not finished.**";
    assert!(bench.stdout.contains(note), "{}", bench.stdout);
    // A Diffuser has no curiosity: nothing is played.
    let lambda = ["bench", "lambda", &run, "--env", "PointMass-v0", "-o"];
    let empty = toy.at("lambda");
    ksim([&lambda[..], &[&empty, "--lambdas", "0,1"]].concat())
        .failed(1, &["λ=1", "which has no curiosity"]);
    assert!(!Path::new(&toy.at("lambda/manifest.json")).exists());
}

/// Length of the header of a safetensors file.
fn header_len(bytes: &[u8]) -> usize {
    u64::from_le_bytes(bytes[..8].try_into().expect("8 bytes")) as usize
}
