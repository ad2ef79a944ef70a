//! `ksim bench search`.

use serde_json::Value;

use crate::process::{Demo, ksim};

/// Small enough for an unoptimised build.
const SMALL: [&str; 10] = [
    "--n-queries",
    "60",
    "--n-checked",
    "20",
    "--n-single",
    "2",
    "--repeats",
    "1",
    "--n-resamples",
    "100",
];

fn bench(arguments: &[&str]) -> crate::process::Run {
    ksim([&["bench", "search"], arguments, &SMALL].concat())
}

#[test]
fn generated_data_are_measured_at_every_size_and_width() {
    let flags = [
        "--rows",
        "1e3,2000",
        "--widths",
        "2,31",
        "--engines",
        "linear,auto,clusters",
    ];
    let more = [
        "--n-clusters",
        "5,20",
        "--thread-counts",
        "1,2",
        "--format",
        "json",
    ];
    let report = bench(&[flags.as_slice(), &more].concat()).json();
    assert_eq!(report["schema"], "ksim.bench.search/1");
    assert_eq!(report["source"]["dataset"], Value::Null);
    let all = report["measurements"].as_array().unwrap();
    // linear, auto, clusters twice; 2 sizes, 2 widths, 2 numbers of threads, 3 kinds.
    assert_eq!(all.len(), 4 * 2 * 2 * 2 * 3);
    for one in all {
        assert!(one["query_s"].as_f64().unwrap() > 0.0);
        assert!(one["single_query_s"].as_f64().unwrap() > 0.0);
        assert_eq!(one["n_checked"], 20);
        let exact = one["exact"].as_bool().unwrap();
        assert_eq!(exact, one["engine"] != "clusters");
        assert_eq!(one["approximation"].is_null(), exact);
        if !exact {
            let found = &one["approximation"];
            let recall = found["recall_at_k"].as_f64().unwrap();
            assert!(0.0 < recall && recall <= 1.0, "{recall}");
            let difference = &found["score_difference"];
            let [low, high] = [0, 1].map(|end| difference["interval"][end].as_f64().unwrap());
            let value = difference["value"].as_f64().unwrap();
            assert!(low <= value && value <= high);
        }
    }
}

#[test]
fn a_dataset_is_asked_with_rollouts_and_scores_are_those_of_ksim_score() {
    let demo = Demo::new();
    let (dataset, good, noisy) = (
        demo.at("dataset.parquet"),
        demo.at("good.parquet"),
        demo.at("noisy.parquet"),
    );
    let arguments = [
        &dataset,
        "--engines",
        "blocked,clusters",
        "--n-clusters",
        "10",
        "--format",
        "json",
        "--n-queries",
        "100000",
        "--n-checked",
        "5",
        "--n-single",
        "1",
        "--repeats",
        "1",
        "--rollouts",
        &good,
        &noisy,
    ];
    let report = ksim([&["bench", "search"], arguments.as_slice()].concat()).json();
    assert_eq!(
        report["source"]["rollouts"],
        serde_json::json!(["good", "noisy"])
    );
    let of = |engine: &str, queries: &str| {
        let all = report["measurements"].as_array().unwrap();
        let found = all
            .iter()
            .find(|one| one["engine"] == engine && one["queries"] == queries);
        found.unwrap()["k_sim"].as_f64().unwrap()
    };
    for (flags, engine) in [
        (&["--format", "json"][..], "blocked"),
        (
            &[
                "--format",
                "json",
                "--search",
                "clusters",
                "--n-clusters",
                "10",
            ],
            "clusters",
        ),
    ] {
        let scored = demo.score(&["good.parquet", "noisy.parquet"], flags).json();
        for (at, queries) in ["good", "noisy"].into_iter().enumerate() {
            let k_sim = scored["results"][at]["k_sim"].as_f64().unwrap();
            assert!(
                (k_sim - of(engine, queries)).abs() < 1e-12,
                "{engine} {queries}"
            );
        }
    }
}

#[test]
fn episodes_are_held_out_where_there_are_no_rollouts() {
    let demo = Demo::new();
    let dataset = demo.at("dataset.parquet");
    let run = bench(&[&dataset, "--engines", "auto", "--widths", "4"]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    // Of twelve episodes of 1000 steps one is held out. For 60 questions no tree is worth planting.
    for part in [
        "held-out episodes",
        "in-distribution",
        "noisy",
        "random",
        "blocked",
        "11000",
        "oracle",
    ] {
        assert!(run.stdout.contains(part), "no {part:?} in\n{}", run.stdout);
    }
}

#[test]
fn nothing_checked_is_nothing_claimed() {
    let arguments = ["--rows", "500", "--widths", "2", "--engines", "blocked"];
    let small = ["--n-queries", "20", "--n-single", "0", "--repeats", "1"];
    let run = |n_checked: &str| {
        let checked = ["--n-checked", n_checked];
        ksim([&["bench", "search"], &arguments[..], &small, &checked].concat()).stdout
    };
    assert!(run("0").contains("exact        not checked"));
    assert!(run("3").contains("exact        3 queries of every kind"));
}

#[test]
fn the_figure_shows_what_is_compared() {
    let folder = tempfile::tempdir().unwrap();
    let figure = folder.path().join("bench.svg");
    let figure = figure.to_str().unwrap();
    let clusters = [
        "--rows",
        "1000",
        "--widths",
        "3",
        "--n-clusters",
        "5,20",
        "--figure",
        figure,
    ];
    let run = bench(&clusters);
    assert_eq!(run.code, 0, "{}", run.stderr);
    let svg = std::fs::read_to_string(figure).unwrap();
    assert!(svg.contains("difference in K-Sim") && svg.contains("random, exact"));
    let run = bench(&["--rows", "1000,2000", "--widths", "3", "--figure", figure]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    assert!(
        std::fs::read_to_string(figure)
            .unwrap()
            .contains("reference rows")
    );
    bench(&["--figure", figure]).failed(1, &["--figure compares sizes or numbers of clusters"]);
}

#[test]
fn what_cannot_be_measured_is_refused() {
    let demo = Demo::new();
    let dataset = demo.at("dataset.parquet");
    bench(&[&dataset, "--widths", "32"]).failed(
        1,
        &["a width of 32 columns was asked for, the states have 31"],
    );
    bench(&["--rows", "1000", "--engines", "kd-tree", "--widths", "31"]).failed(
        1,
        &["nothing to measure: engines kd-tree on states of 31 columns"],
    );
    bench(&["--rows", "0"]).failed(2, &["expected a whole number from 1"]);
    bench(&["--rollouts", &dataset]).failed(2, &["DATASET"]);
    bench(&[&dataset, "--figure", &dataset, "--rows", "1e3,2e3"])
        .failed(1, &["would replace what is read"]);
}
