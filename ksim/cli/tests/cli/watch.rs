//! `ksim watch` and `ksim score --sparkline`.

use std::io::{BufRead as _, BufReader};
use std::process::Stdio;
use std::time::{Duration, Instant};

use crate::process::{Demo, Rollouts, command, finished, ksim};

#[test]
fn a_sparkline_is_drawn_when_asked_for_and_not_into_a_pipe() {
    let demo = Demo::new();
    let score = |flags: &[&str]| {
        let run = demo.score(&["good.parquet", "noisy.parquet"], flags);
        assert_eq!(run.code, 0, "{}", run.stderr);
        run.stdout
    };
    let blocks = |text: &str| {
        text.lines()
            .filter(|line| line.contains(['▁', '▂', '▃', '▄', '▅', '▆', '▇', '█']))
            .count()
    };
    for none in [
        &[][..],
        &["--sparkline"],
        &["--sparkline=auto"],
        &["--sparkline=never"],
    ] {
        assert_eq!(blocks(&score(none)), 0, "{none:?}");
    }
    let drawn = score(&["--sparkline=always"]);
    assert_eq!(blocks(&drawn), 8, "{drawn}");
    assert!(drawn.contains("\ngood.parquet\n       0  0."), "{drawn}");
    assert_eq!(
        blocks(&score(&["--sparkline=always", "--format", "json"])),
        0
    );
}

fn rollouts(n_steps: &[usize]) -> Rollouts {
    let episodes = n_steps
        .iter()
        .enumerate()
        .flat_map(|(episode, n)| vec![episode as i64; *n]);
    Rollouts::new(&episodes.collect::<Vec<_>>(), [2, 1])
}

#[test]
fn what_is_there_is_scored_once() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    rollouts(&[40, 40]).write(at("data.parquet"));
    rollouts(&[5, 7]).write(at("roll.parquet"));
    let (data, roll) = (at("data.parquet"), at("roll.parquet"));
    let run = ksim(["watch", &roll, "--dataset", &data, "--once"]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    let score = ksim(["score", &roll, "--dataset", &data, "--format", "json"]).json();
    let result = &score["results"][0];
    let lines: Vec<&str> = run.stdout.lines().collect();
    assert_eq!(lines.len(), 3, "{}", run.stdout);
    let number = |value: &serde_json::Value| format!("{:.4}", value.as_f64().unwrap());
    assert!(
        lines[1].starts_with(&format!(
            "episode 1: 7 steps, K-Sim {} ",
            number(&result["episodes"][1]["k_sim"])
        )),
        "{}",
        lines[1]
    );
    let (pooled, mean) = (
        number(&result["k_sim"]),
        number(&result["k_sim_episode_mean"]),
    );
    assert_eq!(
        lines[2],
        format!("2 episodes, 12 steps: K-Sim {pooled}, episode mean {mean}, 100.0 % saturated")
    );
    ksim(["watch", &at("none.parquet"), "--dataset", &data, "--once"]).failed(1, &["none.parquet"]);
    ksim(["watch", &roll, "--dataset", &data, "--interval", "0"]).failed(2, &["a number from 0.1"]);
}

/// A file that comes late, is broken for a while, and grows.
#[cfg(unix)]
#[test]
fn a_growing_file_is_followed_until_ctrl_c() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    rollouts(&[40, 40]).write(at("data.parquet"));
    let roll = at("roll.parquet");
    std::fs::write(&roll, "PAR1 not yet").unwrap();
    let mut child = command()
        .args([
            "watch",
            &roll,
            "--dataset",
            &at("data.parquet"),
            "--interval",
            "0.1",
        ])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let said = BufReader::new(child.stderr.take().unwrap())
        .lines()
        .next()
        .unwrap()
        .unwrap();
    assert!(said.starts_with("waiting: "), "{said}");
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
    let mut next = || lines.next().unwrap().unwrap();
    let replace = |n_steps: &[usize]| {
        rollouts(n_steps).write(at("next.parquet"));
        std::fs::rename(at("next.parquet"), &roll).unwrap();
    };
    replace(&[5]);
    assert!(next().starts_with("episode 0: 5 steps, K-Sim"));
    assert!(next().starts_with("1 episode, 5 steps: "));
    // Steps are the same as before as far as they were there; the second episode's differ in their actions.
    replace(&[9]);
    assert!(next().starts_with("episode 0: 9 steps"));
    assert!(next().starts_with("1 episode, 9 steps: "));
    replace(&[9, 4]);
    next();
    let total = loop {
        let line = next();
        if line.contains("episodes") {
            break line;
        }
    };
    assert!(total.starts_with("2 episodes, 13 steps: "), "{total}");
    let interrupt = std::process::Command::new("kill")
        .args(["-INT", &child.id().to_string()])
        .status()
        .unwrap();
    assert!(interrupt.success());
    assert_eq!(next(), total);
    assert_eq!(child.wait().unwrap().code(), Some(130));
}

#[cfg(unix)]
#[test]
fn a_lasting_fault_and_a_reader_that_is_gone_end_it() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let (data, roll) = (at("data.parquet"), at("roll.parquet"));
    rollouts(&[40, 40]).write(&data);
    let watch = || {
        let mut command = command();
        command.args(["watch", &roll, "--dataset", &data, "--interval", "0.1"]);
        command
    };
    Rollouts::new(&[0; 5], [3, 1]).write(&roll);
    finished(&watch().output().unwrap()).failed(1, &["observations have 3 columns, expected 2"]);
    let mut nameless = rollouts(&[5]);
    nameless.names[2] = "acts";
    nameless.write(&roll);
    finished(&watch().output().unwrap()).failed(1, &["no action column"]);

    rollouts(&[5]).write(&roll);
    let mut child = watch().stdout(Stdio::piped()).spawn().unwrap();
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
    assert!(
        lines
            .next()
            .unwrap()
            .unwrap()
            .starts_with("episode 0: 5 steps")
    );
    drop(lines);
    rollouts(&[9]).write(at("next.parquet"));
    std::fs::rename(at("next.parquet"), &roll).unwrap();
    let deadline = Instant::now() + Duration::from_secs(60);
    let code = loop {
        match child.try_wait().unwrap() {
            Some(status) => break status.code(),
            None if Instant::now() > deadline => break None,
            None => std::thread::sleep(Duration::from_millis(20)),
        }
    };
    let _ = child.kill();
    assert_eq!(code, Some(0));
}
