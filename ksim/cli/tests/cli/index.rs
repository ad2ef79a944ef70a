//! `ksim index` and `ksim score --index`.

use std::fs;

use crate::process::{Demo, Run, ksim};

fn build(demo: &Demo, flags: &[&str]) -> String {
    let index = demo.at("demo.ksimidx");
    let dataset = demo.at("dataset.parquet");
    let run = ksim([&["index", "build", &dataset, "-o", &index], flags].concat());
    assert_eq!(run.code, 0, "{}", run.stderr);
    assert_eq!(run.stdout, "");
    index
}

fn score(demo: &Demo, index: &str, flags: &[&str]) -> Run {
    demo.score(&["good.parquet"], &[&["--index", index], flags].concat())
}

/// A result without what may differ between two runs.
fn timeless(run: &Run) -> serde_json::Value {
    let mut document = run.json();
    document["elapsed_s"] = 0.into();
    if let Some(search) = document["search"].as_object_mut() {
        search.remove("index");
    }
    for result in document["results"]
        .as_array_mut()
        .expect("a list of results")
    {
        result["elapsed_s"] = 0.into();
    }
    document
}

#[test]
fn scores_with_an_index_are_those_without() {
    let demo = Demo::new();
    let index = build(&demo, &[]);
    let files = ["good.parquet", "random.parquet"];
    for flags in [
        &[][..],
        &["--search", "clusters", "--approximation-error"],
        &["--search", "linear", "--gamma", "0.3", "--n-neighbors", "7"],
    ] {
        let (with, without) = (demo.at("with.parquet"), demo.at("without.parquet"));
        let json = [flags, &["--format", "json", "--per-step"]].concat();
        let own = demo.score(&files, &[&json[..], &[&without]].concat());
        let indexed = demo.score(&files, &[&json[..], &[&with, "--index", &index]].concat());
        assert_eq!(indexed.json()["search"]["index"], index.as_str());
        assert_eq!(timeless(&own), timeless(&indexed), "{flags:?}");
        assert!(
            fs::read(with).unwrap() == fs::read(without).unwrap(),
            "{flags:?}"
        );
    }
}

#[test]
fn an_index_serves_its_columns_and_clusters_only() {
    let demo = Demo::new();
    let index = build(
        &demo,
        &[
            "--definition",
            "released",
            "--n-clusters",
            "9",
            "--seed",
            "3",
        ],
    );
    score(&demo, &index, &[]).failed(
        1,
        &[
            "demo.ksimidx",
            "it holds the state columns 0 (",
            "(31 in all)",
        ],
    );
    let released = ["--definition", "released"];
    let run = score(&demo, &index, &released);
    assert_eq!(run.code, 0, "{}", run.stderr);
    let clusters = [&released[..], &["--search", "clusters"]].concat();
    score(&demo, &index, &clusters).failed(
        1,
        &[
            "9 clusters fitted by ksim with seed 3",
            "asked for are 50 clusters fitted by ksim with seed 0",
        ],
    );
    let run = score(
        &demo,
        &index,
        &[&clusters[..], &["--n-clusters", "9", "--seed", "3"]].concat(),
    );
    assert_eq!(run.code, 0, "{}", run.stderr);
    let bare = build(&demo, &["--no-clusters", "--state-columns", "0..2"]);
    score(&demo, &bare, &clusters).failed(1, &["it holds no clusters"]);
    let usage = [
        "index",
        "build",
        &demo.at("dataset.parquet"),
        "-o",
        &bare,
        "--no-clusters",
        "--seed",
        "1",
    ];
    ksim(usage).failed(2, &["--no-clusters"]);
}

#[test]
fn a_changed_dataset_is_refused_and_a_copied_one_is_not() {
    let demo = Demo::new();
    let index = build(&demo, &[]);
    let dataset = demo.at("dataset.parquet");
    // Another time, the same content.
    let bytes = fs::read(&dataset).unwrap();
    fs::remove_file(&dataset).unwrap();
    fs::write(&dataset, &bytes).unwrap();
    let run = score(&demo, &index, &[]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    assert!(
        run.stderr.contains("comparing its content"),
        "{}",
        run.stderr
    );
    // Other content under the same name.
    fs::copy(demo.at("random.parquet"), &dataset).unwrap();
    score(&demo, &index, &[]).failed(
        1,
        &["the dataset has changed", "fingerprint", "build it again"],
    );
    let other = [
        "score",
        &demo.at("good.parquet"),
        "--dataset",
        &demo.at("noisy.parquet"),
        "--index",
        &index,
    ];
    ksim(other).failed(1, &["it is of another dataset, ", "dataset.parquet"]);
}

#[test]
fn damage_and_truncation_are_refused() {
    let demo = Demo::new();
    let index = build(&demo, &["--no-clusters"]);
    let whole = fs::read(&index).unwrap();
    let run = ksim(["index", "info", &index, "--check"]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    let mut state = 0x2545_f491_4f6c_dd1d_u64;
    for _ in 0..40 {
        // Xorshift: places that no pattern of the file can dodge.
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        let at = (state % whole.len() as u64) as usize;
        let mut bytes = whole.clone();
        bytes[at] ^= 0x40;
        fs::write(&index, &bytes).unwrap();
        let run = ksim(["index", "info", &index, "--check"]);
        assert_eq!((run.code, run.stdout.as_str()), (1, ""), "byte {at}");
        assert!(
            run.stderr.contains("demo.ksimidx") && !run.stderr.contains("panicked"),
            "{}",
            run.stderr
        );
    }
    // In the middle of the values, which is where most bytes are.
    let mut bytes = whole.clone();
    bytes[whole.len() / 2] ^= 1;
    fs::write(&index, &bytes).unwrap();
    score(&demo, &index, &[]).failed(
        1,
        &[
            "demo.ksimidx",
            "damaged",
            "section `state.",
            "build it again",
        ],
    );
    fs::write(&index, &whole[..whole.len() - 100]).unwrap();
    score(&demo, &index, &[]).failed(1, &["demo.ksimidx", "incomplete"]);
    fs::copy(demo.at("good.parquet"), &index).unwrap();
    score(&demo, &index, &[]).failed(1, &["this is no index"]);
    score(&demo, &demo.at("none"), &[]).failed(1, &["cannot open the index"]);
}

#[test]
fn info_says_what_an_index_was_built_from() {
    let demo = Demo::new();
    let index = build(&demo, &["--n-clusters", "12"]);
    let shown = ksim(["index", "info", &index, "--format", "json"]).json();
    assert_eq!(shown["schema"], "ksim.index/1");
    assert_eq!(shown["dataset"]["n_steps"], 12_000);
    assert_eq!(shown["clusters"]["n_clusters"], 12);
    assert_eq!(shown["state_columns"].as_array().unwrap().len(), 31);
    let scored = demo.score(&["good.parquet"], &["--format", "json"]).json();
    assert_eq!(
        shown["dataset"]["fingerprint"],
        scored["dataset"]["fingerprint"]
    );
    let text = ksim(["index", "info", &index, "--check"]);
    assert_eq!(text.code, 0, "{}", text.stderr);
    for part in [
        "12, fitted by ksim with seed 0",
        "12000 of 12 episodes",
        "every byte",
    ] {
        assert!(text.stdout.contains(part), "no {part:?} in {}", text.stdout);
    }
}

#[test]
fn a_failed_build_leaves_nothing() {
    let demo = Demo::new();
    let index = demo.at("demo.ksimidx");
    let dataset = demo.at("dataset.parquet");
    let build =
        |flags: &[&str]| ksim([&["index", "build", &dataset, "-o", &index], flags].concat());
    build(&["--n-clusters", "100000"]).failed(1, &["12000 rows cannot make 100000 clusters"]);
    build(&["--state-columns", "0..99"]).failed(1, &["dataset.parquet"]);
    ksim(["index", "build", &dataset, "-o", &dataset]).failed(1, &["would replace what is read"]);
    assert_eq!(demo.others(), Vec::<std::path::PathBuf>::new());
}
