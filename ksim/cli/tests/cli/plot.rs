//! `ksim plot paths`, on files as other programs write them.

use std::sync::Arc;

use arrow::array::{ArrayRef, Float64Array, Int64Array, StringArray};

use crate::process::{Demo, ksim, list, write_parquet};

/// Its folder.
fn path(demo: &Demo) -> String {
    demo.at("").trim_end_matches('/').to_owned()
}

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
fn a_dataset_says_where_positions_lie_in_a_single_vector() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let (dataset, flat, out) = (at("walk.parquet"), at("flat.parquet"), at("paths.svg"));
    walk(&dataset);
    let states = [
        -4.0, 4.0, 0.0, -4.0, 0.0, 4.0, 0.0, -4.0, 4.0, 4.0, 0.0, -4.0,
    ];
    let columns: Vec<(&str, ArrayRef)> = vec![
        ("episode_index", Arc::new(Int64Array::from(vec![0; 3]))),
        ("observation", list(4, &states)),
        ("action", list(1, &[0.5; 3])),
    ];
    write_parquet(&flat, columns);
    let plot = |flags: &[&str]| {
        let start = ["plot", "paths", &flat, "-o", &out, "--env", "antmaze-umaze"];
        ksim(start.iter().chain(flags))
    };
    plot(&[]).failed(
        1,
        &["no positions: expected column", ", observation, action"],
    );
    plot(&["--dataset", "no-such-dataset"]).failed(1, &["\"no-such-dataset\" is not on this"]);
    let run = plot(&["--dataset", &dataset]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    let svg = std::fs::read_to_string(&out).unwrap();
    assert!(
        svg.contains("M134.00 124.00L194.00 124.00L254.00 124.00"),
        "{svg}"
    );
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

#[test]
fn timelines_and_distributions_are_drawn_of_what_is_scored() {
    let demo = Demo::new();
    let (good, noisy, dataset) = (
        demo.at("good.parquet"),
        demo.at("noisy.parquet"),
        demo.at("dataset.parquet"),
    );
    let plot = |what: &str, out: &str, flags: &[&str]| {
        let start = [
            "plot",
            what,
            &good,
            &noisy,
            "--dataset",
            &dataset,
            "-o",
            out,
        ];
        ksim(start.iter().chain(flags))
    };
    let drawn = |what: &str, flags: &[&str]| {
        let out = demo.at("figure.svg");
        let run = plot(what, &out, flags);
        assert_eq!(run.code, 0, "{}", run.stderr);
        std::fs::read_to_string(out).unwrap()
    };
    let timeline = drawn("timeline", &[]);
    assert_eq!(timeline, drawn("timeline", &[]));
    for part in [
        "K-Sim, mean over the episodes that reach the step",
        "Saturated steps",
        "good.parquet",
        "noisy.parquet",
    ] {
        assert!(timeline.contains(part), "{part}");
    }
    let episodes = drawn("timeline", &["--episodes", "0-2"]);
    assert!(episodes.contains("good.parquet 2") && !episodes.contains("good.parquet 3"));
    assert!(!timeline.contains(&path(&demo)) && timeline.contains("Compared with dataset.parquet"));
    let distribution = drawn("distribution", &[]);
    assert!(
        distribution.contains("Distances to dataset.parquet") && distribution.contains(">\nγ\n<")
    );
    assert!(distribution.contains("held-out data") && distribution.contains("stroke-dasharray"));

    let none = demo.at("none.svg");
    plot("timeline", &none, &["--episodes", "77"])
        .failed(1, &["none of the rollouts has such an episode"]);
    plot("timeline", &none, &["--episodes", "0-3"]).failed(1, &["8 lines are too many"]);
    for what in ["timeline", "distribution"] {
        // Not even the dataset is opened.
        let many = [&*good; 7];
        let start = ["plot", what, "--dataset", "nowhere.parquet", "-o", &none];
        ksim(start.iter().chain(&many)).failed(1, &["7 lines are too many"]);
    }
    plot("timeline", &demo.at("none.gif"), &[]).failed(1, &["ends in .svg, .png or .pdf"]);
    assert_eq!(demo.others(), [std::path::PathBuf::from("figure.svg")]);
}

#[test]
fn tables_say_what_score_says_in_three_languages() {
    let demo = Demo::new();
    let score = demo
        .score(&["good.parquet", "random.parquet"], &["--format", "json"])
        .json();
    let table = |ending: &str| {
        let out = demo.at(&format!("table.{ending}"));
        let (good, random) = (demo.at("good.parquet"), demo.at("random.parquet"));
        let run = ksim([
            "plot",
            "tables",
            &good,
            &random,
            "--dataset",
            &demo.at("dataset.parquet"),
            "-o",
            &out,
        ]);
        assert_eq!(run.code, 0, "{}", run.stderr);
        std::fs::read_to_string(out).unwrap()
    };
    let csv = table("csv");
    let rows: Vec<&str> = csv.lines().collect();
    let names: Vec<&str> = rows[0].split(',').collect();
    assert_eq!(rows.len(), 3);
    for (place, row) in rows[1..].iter().enumerate() {
        let result = &score["results"][place];
        for (name, cell) in names.iter().zip(row.split(',')).skip(3) {
            let value = match *name {
                "low_95" => &result["interval_95"][0],
                "high_95" => &result["interval_95"][1],
                name => &result[name],
            };
            assert_eq!(
                cell.parse::<f64>().unwrap(),
                value.as_f64().unwrap(),
                "{name}"
            );
        }
    }
    let k_sim = format!("{:.3}", score["results"][0]["k_sim"].as_f64().unwrap());
    let markdown = table("md");
    assert!(
        markdown.contains(&format!("| good.parquet | 4 | 1200 | {k_sim} |"))
            && markdown.starts_with("| rollouts | episodes | steps | K-Sim\\* |"),
        "{markdown}"
    );
    // The caption says what the numbers are, and not where they were computed.
    for part in [
        "\\* all state columns, mean over all steps (the paper's definition, by exact search)",
        "Against dataset.parquet; γ ",
        "K 50, exact search; fingerprint ",
    ] {
        assert!(markdown.contains(part), "no {part:?} in {markdown}");
    }
    assert!(!markdown.contains(&path(&demo)), "{markdown}");
    let latex = table("tex");
    assert!(
        latex.contains(&format!("good.parquet & 4 & 1200 & {k_sim} &")),
        "{latex}"
    );
    assert!(
        latex.contains("\\,\\%") && latex.ends_with("\\end{tabular}\n"),
        "{latex}"
    );
    assert!(
        latex.contains("% Against dataset.parquet; γ ") && latex.contains("& K-Sim* &"),
        "{latex}"
    );
    ksim(["plot", "tables", "x", "--dataset", "y", "-o", "table.txt"])
        .failed(1, &[".md, .tex or .csv"]);
}

#[cfg(unix)]
#[test]
fn a_name_is_no_markup_in_a_table() {
    let demo = Demo::new();
    let rollouts = demo.at("<b>x|y [z](w) `q`.parquet");
    std::fs::copy(demo.at("good.parquet"), &rollouts).unwrap();
    let (dataset, out) = (demo.at("dataset.parquet"), demo.at("table.md"));
    let run = ksim([
        "plot",
        "tables",
        &rollouts,
        "--dataset",
        &dataset,
        "-o",
        &out,
        "--definition",
        "released",
    ]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    let table = std::fs::read_to_string(out).unwrap();
    assert!(
        table.contains("\n| \\<b\\>x\\|y \\[z\\](w) \\`q\\`.parquet | 4 |"),
        "{table}"
    );
    // The released script's K-Sim is another column.
    assert!(table.contains("| K-Sim | mean of episodes\\* |"), "{table}");
}

/// A file of two planners with steps from 1000 on: of the second of them, four episodes.
#[test]
fn lines_are_counted_by_planner_and_lie_at_the_recorded_steps() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let (from, out) = (at("walk.parquet"), at("time.svg"));
    let episodes: Vec<i64> = (0..5).flat_map(|episode| [episode; 4]).collect();
    let planners = episodes
        .iter()
        .map(|&episode| if episode == 0 { "a" } else { "b" });
    let values: Vec<f32> = (0..40).map(|i| (i as f32 * 0.7).sin()).collect();
    let steps = (0..20).map(|row| 1000 + 100 * (row % 4));
    let columns: Vec<(&str, ArrayRef)> = vec![
        (
            "episode_index",
            Arc::new(Int64Array::from(episodes.clone())),
        ),
        ("step_index", Arc::new(Int64Array::from_iter_values(steps))),
        ("planner", Arc::new(StringArray::from_iter_values(planners))),
        ("observation", list(2, &values)),
        ("action", list(1, &values[..20])),
    ];
    write_parquet(&from, columns);
    let plot = |flags: &[&str]| {
        let start = [
            "plot",
            "timeline",
            &from,
            "--dataset",
            &from,
            "--n-neighbors",
            "3",
            "-o",
            &out,
        ];
        ksim(start.iter().chain(flags))
    };
    let run = plot(&[]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    let svg = std::fs::read_to_string(&out).unwrap();
    for part in ["walk.parquet · a", "walk.parquet · b", "1100", "1300"] {
        assert!(svg.contains(part), "{part}");
    }
    let run = plot(&["--episodes", "0-4"]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    let twice = ksim([
        "plot",
        "timeline",
        &from,
        &from,
        "--dataset",
        &from,
        "--episodes",
        "0-4",
        "-o",
        &out,
    ]);
    twice.failed(1, &["10 lines are too many"]);
}

#[test]
fn curves_of_lambda_are_drawn_from_the_report_of_their_benchmark() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let run_dir = at("");
    ksim(["plot", "lambda", &run_dir, "-o", &at("a.svg")]).failed(1, &["report.json"]);
    let entry = |value: f64| serde_json::json!({ "environment": "maze", "summary": { "total_return": { "value": value, "interval": null } } });
    let report = serde_json::json!({ "suite": "s", "episodes": 2, "lambdas": [0.0, 100.0], "results": [entry(1.0), entry(3.0)] });
    std::fs::write(at("report.json"), report.to_string()).unwrap();
    let run = ksim(["plot", "lambda", &run_dir, "-o", &at("a.svg")]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    let svg = std::fs::read_to_string(at("a.svg")).unwrap();
    assert!(svg.contains("1e2") && svg.contains("return"), "{svg}");
}
