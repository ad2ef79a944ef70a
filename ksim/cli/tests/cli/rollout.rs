//! `ksim rollout`, `ksim env` and `ksim plot`.

use serde_json::Value;

use crate::process::{Run, batches, column, command, finished, ksim, wait_until_at_work};

/// A folder for what is written.
struct Folder(tempfile::TempDir);

impl Folder {
    fn new() -> Self {
        Self(tempfile::tempdir().expect("a folder"))
    }

    fn at(&self, name: &str) -> String {
        self.0
            .path()
            .join(name)
            .to_str()
            .expect("a path in UTF-8")
            .to_owned()
    }

    fn names(&self) -> Vec<String> {
        let entries = std::fs::read_dir(self.0.path()).expect("the folder is there");
        let mut names: Vec<String> = entries
            .map(|entry| {
                entry
                    .expect("an entry")
                    .file_name()
                    .to_string_lossy()
                    .into_owned()
            })
            .collect();
        names.sort();
        names
    }
}

/// Random pushes of the point mass.
fn point_mass(flags: &[&str]) -> Run {
    let rollout = ["rollout", "--env", "PointMass-v0", "--policy", "random"];
    ksim(rollout.iter().chain(flags))
}

#[test]
fn a_rollout_is_scored_as_it_is_written() {
    let folder = Folder::new();
    for name in ["a.parquet", "b.arrow"] {
        let out = folder.at(name);
        let run = point_mass(&["--episodes", "5", "--seed", "3", "-o", &out]);
        assert_eq!(run.code, 0, "{}", run.stderr);
        assert!(run.stdout.contains("success at any step"), "{}", run.stdout);
        assert!(run.stderr.contains("steps/s"), "{}", run.stderr);
    }
    let (a, b) = (folder.at("a.parquet"), folder.at("b.arrow"));
    let score = ksim(["score", &a, "--dataset", &b, "--format", "json"]).json();
    assert_eq!(score["results"][0]["n_episodes"], 5);
    assert_eq!(score["results"][0]["k_sim"], 1.0);
    assert_eq!(folder.names(), ["a.parquet", "b.arrow"]);
}

#[test]
fn neither_threads_nor_environments_nor_the_clock_show_in_the_result() {
    let folder = Folder::new();
    let mut seen = Vec::new();
    for (name, flags) in [
        ("a.parquet", ["--parallel", "1", "--threads", "1"]),
        ("b.parquet", ["--parallel", "7", "--threads", "3"]),
    ] {
        let out = folder.at(name);
        let more = [
            "--episodes",
            "9",
            "--runs",
            "2",
            "--format",
            "json",
            "-o",
            &out,
        ];
        let mut document = point_mass(&[&flags[..], &more].concat()).json();
        document["output"] = Value::Null;
        seen.push((document, std::fs::read(&out).unwrap()));
    }
    assert!(seen[0] == seen[1]);
}

#[test]
fn the_document_and_the_table_of_episodes_say_the_same() {
    let folder = Folder::new();
    let table = folder.at("episodes.parquet");
    let flags = [
        "--episodes",
        "3",
        "--runs",
        "2",
        "--seed",
        "40",
        "--format",
        "json",
    ];
    let document = point_mass(&[&flags[..], &["--episodes-output", &table]].concat()).json();
    assert_eq!(document["schema"], "ksim.rollout/1");
    assert_eq!(document["interrupted"], false);
    assert_eq!(document["n_episodes"], 6);
    let episodes = document["episodes"].as_array().unwrap();
    let seeds: Vec<u64> = episodes
        .iter()
        .map(|one| one["seed"].as_u64().unwrap())
        .collect();
    assert_eq!(seeds, [40, 41, 42, 43, 44, 45]);
    assert_eq!(episodes[3]["run"], 1);
    let returns: Vec<f64> = episodes
        .iter()
        .map(|one| one["return"].as_f64().unwrap())
        .collect();
    assert_eq!(column(&table, "return"), returns);
    let mean = returns.iter().sum::<f64>() / 6.0;
    let summary = document["summary"]["total_return"]["value"]
        .as_f64()
        .unwrap();
    assert!((summary - mean).abs() < 1e-12);
}

#[test]
fn the_return_of_a_recorded_episode_is_the_way_it_went() {
    // As the point mass is defined: the rewards of an episode add up to its last position less its first.
    let folder = Folder::new();
    let (out, table) = (folder.at("a.parquet"), folder.at("episodes.parquet"));
    let flags = ["--episodes", "4", "-o", &out, "--episodes-output", &table];
    assert_eq!(point_mass(&flags).code, 0);
    let rows = batches(&out);
    let n_rows: usize = rows.iter().map(|batch| batch.num_rows()).sum();
    let lengths = column(&table, "length");
    assert_eq!(n_rows as f64, lengths.iter().sum::<f64>() + 4.0);
    let info = ksim(["dataset", "info", &out, "--format", "json"]).json();
    let mean = info["returns"]["mean"].as_f64().unwrap();
    let returns = column(&table, "return");
    assert!((mean - returns.iter().sum::<f64>() / 4.0).abs() < 1e-12);
    assert_eq!(ksim(["dataset", "validate", &out]).code, 0);
}

#[test]
fn what_is_there_stays_and_is_told_before_anything_is_played() {
    let folder = Folder::new();
    let out = folder.at("a.parquet");
    std::fs::write(&out, "mine").unwrap();
    let huge = "4000000000";
    point_mass(&["--episodes", huge, "-o", &out]).failed(1, &["there is something already"]);
    let nowhere = folder.at("none/a.parquet");
    point_mass(&["--episodes", huge, "-o", &nowhere]).failed(1, &["there is no folder"]);
    point_mass(&["--episodes", huge, "-o", &folder.at("a")]).failed(1, &["--to"]);
    assert_eq!(std::fs::read(&out).unwrap(), b"mine");
    let run = point_mass(&["--episodes", "1", "-o", &out, "--overwrite"]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    assert_eq!(ksim(["dataset", "info", &out]).code, 0);
    assert_eq!(folder.names(), ["a.parquet"]);
}

#[test]
fn faults_name_what_is_wrong() {
    let rollout = |env: &str, policy: &str, flags: &[&str]| {
        let start = [
            "rollout",
            "--env",
            env,
            "--policy",
            policy,
            "--episodes",
            "1",
        ];
        ksim(start.iter().chain(flags))
    };
    rollout("PointMas-v0", "zero", &[]).failed(1, &["unknown environment", "PointMass-v0"]);
    rollout("PointMass-v0", "nobody", &[]).failed(1, &["unknown policy `nobody`", "random"]);
    rollout("PointMass-v0", "mlp:none.safetensors", &[]).failed(1, &["none.safetensors"]);
    let flags = ["--env-arg", "wind=3"];
    rollout("PointMass-v0", "zero", &flags).failed(1, &["argument `wind`"]);
    rollout("PointMass-v0", "zero", &["--goal-cell", "1,1"]).failed(1, &["goal_cell", "no maze"]);
    for discount in ["2", "nan"] {
        rollout("PointMass-v0", "zero", &["--discount", discount]).failed(1, &["discount"]);
    }
    ksim(["rollout", "--policy", "zero", "--episodes", "1"]).failed(2, &["--env"]);
    let of = |name: &str| {
        ksim([
            "rollout",
            "--dataset",
            name,
            "--policy",
            "zero",
            "--episodes",
            "1",
        ])
    };
    of("antmaze-large-play-v2").failed(1, &["D4RL's AntMaze is an environment of its own"]);
    of("no-such-thing").failed(1, &["not on this machine"]);
}

#[test]
fn an_interval_says_what_it_is_over() {
    let run = point_mass(&["--episodes", "3", "--runs", "2"]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    for (what, over) in [("return ", "over episodes"), ("IQM of runs ", "over runs")] {
        let line = run.stdout.lines().find(|line| line.starts_with(what));
        assert!(
            line.is_some_and(|line| line.ends_with(over)),
            "{}",
            run.stdout
        );
    }
}

#[cfg(feature = "mujoco")]
#[test]
fn a_map_that_is_no_maze_is_named_once() {
    let rollout = ["rollout", "--env", "AntMaze_UMaze-v4", "--policy", "zero"];
    let flags = ["--episodes", "1", "--env-arg", "maze_map=[[1]]"];
    let run = ksim(rollout.iter().chain(&flags));
    run.failed(
        1,
        &["`AntMaze_UMaze-v4`: argument `maze_map`: no cell for a goal"],
    );
    assert_eq!(run.stderr.matches("no cell for a goal").count(), 1);
}

#[cfg(not(feature = "mujoco"))]
#[test]
fn without_mujoco_the_command_says_what_to_install() {
    let rollout = [
        "rollout",
        "--env",
        "Hopper-v5",
        "--policy",
        "zero",
        "--episodes",
        "1",
    ];
    ksim(rollout).failed(1, &["needs MuJoCo", "--features mujoco"]);
    let of = [
        "rollout",
        "--dataset",
        "hopper-medium-v2",
        "--policy",
        "zero",
        "--episodes",
        "1",
    ];
    ksim(of).failed(1, &["`Hopper-v4` needs MuJoCo"]);
}

#[test]
fn environments_are_listed_and_described() {
    let list = ksim(["env", "list", "--format", "json"]).json();
    let find = |id: &str| {
        let all = list["environments"].as_array().unwrap();
        all.iter().find(|one| one["id"] == id).cloned().expect(id)
    };
    assert_eq!(find("PointMass-v0")["runs_here"], true);
    assert_eq!(
        find("AntMaze_Large-v5")["runs_here"],
        cfg!(feature = "mujoco")
    );
    let large = ksim(["env", "info", "antmaze-large"]);
    assert_eq!(large.code, 0, "{}", large.stderr);
    for part in ["AntMaze_Large-v4", "1000 steps", "████  ██  ██  ██  ██████"]
    {
        assert!(large.stdout.contains(part), "{part} in {}", large.stdout);
    }
    let mass = ksim(["env", "info", "PointMass-v0", "--format", "json"]).json();
    assert_eq!(mass["action_high"], serde_json::json!([1.0]));
    ksim(["env", "info", "Humanoid-v5"]).failed(1, &["ksim env list"]);
}

/// Sends a signal to a rollout without end, once some episodes must be complete.
#[cfg(unix)]
fn interrupted(signal: &str, folder: &Folder) -> Run {
    use std::io::{BufRead as _, BufReader};
    let out = folder.at("a.parquet");
    let mut child = command()
        .args([
            "rollout",
            "--env",
            "PointMass-v0",
            "--policy",
            "random",
            "--episodes",
            "4000000",
        ])
        .args(["--format", "json", "-o", &out])
        .stdout(std::process::Stdio::piped())
        .stderr(std::process::Stdio::piped())
        .spawn()
        .expect("the binary runs");
    wait_until_at_work(&child);
    let kill = std::process::Command::new("kill")
        .args([signal, &child.id().to_string()])
        .status();
    assert!(kill.expect("kill runs").success());
    // A pipe that is full would hold the command up.
    let stderr = child.stderr.take().expect("piped");
    let read = std::thread::spawn(move || {
        BufReader::new(stderr)
            .lines()
            .map_while(Result::ok)
            .collect::<Vec<_>>()
            .join("\n")
    });
    let mut run = finished(&child.wait_with_output().expect("it ends"));
    run.stderr = read.join().expect("stderr is text");
    run
}

#[cfg(unix)]
#[test]
fn an_interrupted_rollout_leaves_a_readable_prefix_and_says_which() {
    let folder = Folder::new();
    let whole = folder.at("whole.parquet");
    for signal in ["-INT", "-TERM"] {
        let run = interrupted(signal, &folder);
        assert_eq!(run.code, 130, "{}", run.stderr);
        let out = folder.at("a.parquet");
        let info = ksim(["dataset", "info", &out, "--format", "json"]).json();
        let n = info["n_episodes"].as_u64().unwrap();
        assert!((1..4_000_000).contains(&n));
        let told = format!("interrupted after {n} of 4000000 episodes; {out} holds these {n}");
        assert!(run.stderr.contains(&told), "{}", run.stderr);
        let document: Value = serde_json::from_str(&run.stdout).expect("stdout is JSON");
        assert_eq!(
            (&document["interrupted"], &document["n_episodes"]),
            (&true.into(), &n.into())
        );
        // The prefix is what a shorter rollout would have been.
        let episodes = n.to_string();
        assert_eq!(
            point_mass(&["--episodes", &episodes, "-o", &whole, "--overwrite"]).code,
            0
        );
        assert!(batches(&out)[0].columns() == batches(&whole)[0].columns());
        assert_eq!(folder.names(), ["a.parquet", "whole.parquet"]);
        std::fs::remove_file(&out).unwrap();
    }
}

#[cfg(unix)]
#[test]
fn a_killed_rollout_leaves_nothing() {
    let folder = Folder::new();
    interrupted("-KILL", &folder);
    assert!(folder.names().is_empty(), "{:?}", folder.names());
}
