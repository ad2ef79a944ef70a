//! `ksim plot paths`, on files as other programs write them.

use std::sync::Arc;

use arrow::array::{ArrayRef, Float64Array, Int64Array};

use crate::process::{ksim, list, write_parquet};

/// Two episodes of three steps through the U-shaped maze, without a word on their environment.
fn walk(path: &str) {
    let positions = [
        -4.0, 4.0, 0.0, 4.0, 4.0, 4.0, 4.0, 0.0, 4.0, -4.0, 0.0, -4.0,
    ];
    let columns: Vec<(&str, ArrayRef)> = vec![
        (
            "episode_index",
            Arc::new(Int64Array::from(vec![0, 0, 0, 7, 7, 7])),
        ),
        (
            "step_index",
            Arc::new(Int64Array::from(vec![0, 1, 2, 0, 1, 2])),
        ),
        ("observation.achieved_goal", list(2, &positions)),
        ("observation.desired_goal", list(2, &[-4.0; 12])),
        ("action", list(1, &[0.5; 6])),
        (
            "reward",
            Arc::new(Float64Array::from(vec![0.0, 0.0, 1.0, 0.0, 0.0, 0.0])),
        ),
    ];
    write_parquet(path, columns);
}

#[test]
fn paths_are_drawn_in_the_maze_of_an_environment() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let (from, out) = (at("walk.parquet"), at("paths.svg"));
    walk(&from);
    let plot = |flags: &[&str]| {
        let start = ["plot", "paths", &from, "-o", &out];
        ksim(start.iter().chain(flags))
    };
    plot(&[]).failed(
        1,
        &["the maze is not known: say --env ID or --dataset NAME"],
    );
    plot(&["--env", "Hopper-v5"]).failed(1, &["`Hopper-v5` has no maze"]);
    plot(&["--env", "antmaze-umaze", "--episodes", "3-6"]).failed(1, &["no episode in 3..7"]);
    assert!(!folder.path().join("paths.svg").exists());

    let run = plot(&["--env", "antmaze-umaze"]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    let svg = std::fs::read_to_string(&out).unwrap();
    for part in ["episode 0", "episode 7", "return 1", "x (m)", "step"] {
        assert!(svg.contains(part), "{part}");
    }
    // From the upper left cell two cells to the right.
    assert!(
        svg.contains("M134.00 124.00L194.00 124.00L254.00 124.00"),
        "{svg}"
    );

    plot(&[
        "--env",
        "antmaze-umaze",
        "--episodes",
        "7",
        "--layout",
        "together",
    ]);
    let svg = std::fs::read_to_string(&out).unwrap();
    assert!(svg.contains("episode 7") && !svg.contains("episode 0"));
    ksim([
        "plot",
        "paths",
        &from,
        "-o",
        &from,
        "--env",
        "antmaze-umaze",
    ])
    .failed(1, &["would replace what is read"]);
}

#[test]
fn scores_of_steps_color_the_paths() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let (from, scores, out) = (at("walk.parquet"), at("steps.parquet"), at("paths.svg"));
    walk(&from);
    let score = |files: &[&str]| {
        let flags = [
            "score",
            "--dataset",
            &from,
            "--exclude-same-episode",
            "--per-step",
            &scores,
        ];
        let run = ksim(flags.iter().chain(files));
        assert_eq!(run.code, 0, "{}", run.stderr);
    };
    let plot = || {
        let flags = ["--env", "AntMaze_UMaze-v4", "--per-step", &scores];
        ksim(["plot", "paths", &from, "-o", &out].iter().chain(&flags))
    };
    score(&[&from]);
    let run = plot();
    assert_eq!(run.code, 0, "{}", run.stderr);
    assert!(
        std::fs::read_to_string(&out)
            .unwrap()
            .contains("K-Sim of the step")
    );
    let other = at("other.parquet");
    std::fs::copy(&from, &other).unwrap();
    score(&[&from, &other]);
    plot().failed(1, &["scores of several rollouts"]);
}
