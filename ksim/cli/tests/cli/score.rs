//! `ksim score`: the document, the per-step file, the options.

use std::sync::Arc;

use arrow::array::{
    ArrayRef, DictionaryArray, Int64Array, LargeStringArray, StringArray, StringViewArray,
};
use arrow::datatypes::Int32Type;
use serde_json::Value;

use crate::process::{Demo, Rollouts, batches, column};

/// Without what differs between two runs of the same thing.
fn timeless(mut document: Value) -> Value {
    let fields = document.as_object_mut().expect("an object");
    fields.remove("elapsed_s");
    fields.remove("threads");
    for result in fields["results"].as_array_mut().expect("an array") {
        result
            .as_object_mut()
            .expect("an object")
            .remove("elapsed_s");
    }
    document
}

fn keys(value: &Value) -> Vec<&str> {
    value
        .as_object()
        .expect("an object")
        .keys()
        .map(String::as_str)
        .collect()
}

#[test]
fn the_json_keeps_its_schema() {
    let demo = Demo::new();
    let run = demo.score(&["good.parquet", "good.parquet"], &["--format", "json"]);
    assert_eq!(run.stderr, "");
    let document = run.json();
    assert_eq!(document["schema"], "ksim.score/1");
    assert_eq!(
        keys(&document),
        [
            "schema",
            "version",
            "results",
            "dataset",
            "parameters",
            "search",
            "fingerprint",
            "threads",
            "elapsed_s"
        ]
    );
    let [first, second] = document["results"].as_array().expect("an array").as_slice() else {
        panic!("two results");
    };
    assert_eq!(first["k_sim"], second["k_sim"]);
    assert_eq!(
        keys(first),
        [
            "file",
            "planner",
            "n_episodes",
            "n_steps",
            "k_sim",
            "k_sim_episode_mean",
            "interval_95",
            "k_sim_state",
            "k_sim_state_episode_mean",
            "k_sim_action",
            "k_sim_action_episode_mean",
            "saturated_share",
            "mean_scaled_distance",
            "scaled_distance_quantiles",
            "approximation_error",
            "episodes",
            "warnings",
            "elapsed_s"
        ]
    );
    assert_eq!(
        keys(&first["scaled_distance_quantiles"]),
        ["q05", "q25", "q50", "q75", "q95"]
    );
    assert_eq!(
        keys(&first["episodes"][0]),
        [
            "episode_index",
            "n_steps",
            "k_sim",
            "k_sim_state",
            "k_sim_action",
            "saturated_share",
            "mean_scaled_distance"
        ]
    );
    assert_eq!(
        keys(&document["dataset"]),
        [
            "name",
            "path",
            "format",
            "n_episodes",
            "n_steps",
            "fingerprint",
            "episode_rule",
            "warnings"
        ]
    );
    assert_eq!(
        keys(&document["parameters"]),
        [
            "definition",
            "headline",
            "gamma",
            "n_neighbors",
            "n_clusters",
            "state_columns",
            "state_column_names",
            "state_dim",
            "action_dim",
            "seed",
            "n_resamples",
            "exclude_same_episode"
        ]
    );
    assert_eq!(
        keys(&document["search"]),
        ["requested", "engine", "exact", "clusters"]
    );
    assert_eq!(document["parameters"]["state_dim"], 31);
    assert_eq!(document["search"]["exact"], true);
    assert_eq!(
        (&first["n_episodes"], &first["n_steps"]),
        (&4.into(), &1200.into())
    );
}

#[test]
fn per_step_rows_are_the_evidence_behind_the_json() {
    let demo = Demo::new();
    let out = demo.at("steps.parquet");
    let flags = ["--format", "json", "--per-step", &out];
    let document = demo.score(&["noisy.parquet"], &flags).json();
    let names: Vec<String> = batches(&out)[0]
        .schema()
        .fields()
        .iter()
        .map(|field| field.name().clone())
        .collect();
    assert_eq!(
        names,
        [
            "episode_index",
            "step_index",
            "score",
            "distance",
            "state_distance",
            "action_distance",
            "cluster",
            "reference_row",
            "reference_episode_index",
            "reference_step_index"
        ]
    );
    let result = &document["results"][0];
    let score = column(&out, "score");
    assert_eq!(score.len(), 1200);
    let mean = score.iter().sum::<f64>() / score.len() as f64;
    assert!((mean - result["k_sim"].as_f64().unwrap()).abs() < 1e-12);
    let scaled = column(&out, "distance").iter().sum::<f64>() / 1200.0 / 39f64.sqrt();
    assert!((scaled - result["mean_scaled_distance"].as_f64().unwrap()).abs() < 1e-12);
    // The demo's dataset has episodes of 1000 steps.
    let row = column(&out, "reference_row");
    let places = column(&out, "reference_episode_index")
        .into_iter()
        .zip(column(&out, "reference_step_index"));
    for (row, (episode, step)) in row.into_iter().zip(places) {
        assert_eq!(row, episode * 1000.0 + step);
    }
    assert!(
        column(&out, "cluster")
            .iter()
            .all(|cluster| cluster.is_nan())
    );
    assert_eq!(demo.others().len(), 1);
}

#[test]
fn several_files_are_told_apart_in_the_per_step_rows() {
    let demo = Demo::new();
    let out = demo.at("steps.parquet");
    let flags = ["--search", "clusters", "--per-step", &out];
    assert_eq!(
        demo.score(&["good.parquet", "random.parquet"], &flags).code,
        0
    );
    let batches = batches(&out);
    assert_eq!(batches[0].schema().field(0).name(), "file");
    assert_eq!(
        batches
            .iter()
            .map(arrow::array::RecordBatch::num_rows)
            .sum::<usize>(),
        2400
    );
    assert!(
        column(&out, "cluster")
            .iter()
            .all(|&cluster| (0.0..50.0).contains(&cluster))
    );
}

#[test]
fn threads_do_not_change_a_bit() {
    let demo = Demo::new();
    let run = |threads: &str, out: &str| {
        let flags = [
            "--format",
            "json",
            "--search",
            "clusters",
            "--threads",
            threads,
            "--per-step",
            out,
        ];
        timeless(
            demo.score(&["good.parquet", "noisy.parquet"], &flags)
                .json(),
        )
    };
    let (one, two) = (demo.at("one.parquet"), demo.at("two.parquet"));
    assert_eq!(run("1", &one), run("2", &two));
    assert_eq!(std::fs::read(one).unwrap(), std::fs::read(two).unwrap());
}

#[test]
fn exact_engines_agree_and_share_a_fingerprint() {
    let demo = Demo::new();
    let run = |flags: &[&str]| {
        demo.score(&["noisy.parquet"], &[&["--format", "json"], flags].concat())
            .json()
    };
    let [auto, linear, blocked] =
        ["auto", "linear", "blocked"].map(|name| run(&["--search", name]));
    assert_eq!(auto["search"]["engine"], "blocked");
    for other in [&linear, &blocked] {
        assert_eq!(auto["fingerprint"], other["fingerprint"]);
        assert_eq!(auto["results"][0]["k_sim"], other["results"][0]["k_sim"]);
    }
    let tree = run(&["--search", "kd-tree", "--state-columns", "0..2"]);
    let flat = run(&["--search", "linear", "--definition", "released"]);
    assert_eq!(tree["results"][0]["k_sim"], flat["results"][0]["k_sim"]);
    assert_eq!(tree["fingerprint"], flat["fingerprint"]);
    assert_ne!(tree["fingerprint"], auto["fingerprint"]);
    assert_eq!(flat["parameters"]["headline"], "k_sim_episode_mean");
    let clusters = run(&["--search", "clusters"]);
    assert_ne!(clusters["fingerprint"], auto["fingerprint"]);
    assert_eq!(clusters["search"]["exact"], false);
    assert_eq!(clusters["parameters"]["n_clusters"], 50);
    demo.score(&["noisy.parquet"], &["--search", "kd-tree"])
        .failed(1, &["1 to 8 columns", "found 31"]);
}

#[test]
fn the_approximation_error_is_measured_on_request() {
    let demo = Demo::new();
    let flags = [
        "--format",
        "json",
        "--search",
        "clusters",
        "--approximation-error",
    ];
    let document = demo.score(&["good.parquet"], &flags).json();
    let error = &document["results"][0]["approximation_error"];
    let number = |name: &str| error[name].as_f64().expect("a number");
    assert!((0.2..1.0).contains(&number("recall_at_k")));
    assert!(number("mean_score_difference") < 0.0);
    assert!(number("max_score_difference") <= 1.0);
    assert!((0.0..1.0).contains(&number("match_differs_share")));
}

#[test]
fn the_table_says_what_its_headline_is() {
    let demo = Demo::new();
    let says = |flags: &[&str], words: &str| {
        let text = demo.score(&["good.parquet"], flags).stdout;
        assert!(text.contains(words), "no {words} in {text}");
    };
    says(
        &[],
        "* all state columns, mean over all steps (the paper's definition, by exact search);",
    );
    says(&["--search", "clusters"], "(the paper's definition);");
    says(
        &["--definition", "released"],
        "* the first two state columns, mean of the episodes' own means (as the authors' released \
         script, by exact search);",
    );
    says(
        &["--gamma", "1e300"],
        "(the paper's definition but for the flags given, by exact search);",
    );
    says(&["--gamma", "1e300"], "γ 1e300, ");
}

#[test]
fn a_saturated_score_comes_with_the_distance_behind_it() {
    let demo = Demo::new();
    let run = demo.score(&["good.parquet"], &["--gamma", "100"]);
    for part in ["100.0 % of the steps are saturated", "median ", "5–95 % "] {
        assert!(run.stderr.contains(part), "no {part} in {}", run.stderr);
    }
}

#[test]
fn given_centers_are_used() {
    let demo = Demo::new();
    let path = demo.at("centers.safetensors");
    let bytes: Vec<u8> = [0.0f64, 0.0, 1.0, 1.0]
        .iter()
        .flat_map(|v| v.to_le_bytes())
        .collect();
    let view = safetensors::tensor::TensorView::new(safetensors::Dtype::F64, vec![2, 2], &bytes);
    let file = safetensors::serialize([("xy.centers", view.unwrap())], None).unwrap();
    std::fs::write(&path, file).unwrap();
    let flags = [
        "--format",
        "json",
        "--centers",
        &path,
        "--state-columns",
        "achieved",
    ];
    demo.score(&["good.parquet"], &flags)
        .failed(1, &["achieved", "observation (0..31)"]);
    let flags = [
        "--format",
        "json",
        "--centers",
        &path,
        "--state-columns",
        "0..2",
    ];
    let document = demo.score(&["good.parquet"], &flags).json();
    assert_eq!(
        document["search"]["clusters"]["centers_tensor"],
        "xy.centers"
    );
    assert_eq!(document["search"]["clusters"]["n_clusters"], 2);
    let flags = ["--centers", &path];
    demo.score(&["good.parquet"], &flags)
        .failed(1, &["[n_clusters, 31]", "xy.centers F64 [2, 2]"]);
}

#[test]
fn a_dataset_against_itself_says_so() {
    let demo = Demo::new();
    let plain = demo.score(&["dataset.parquet"], &["--format", "json"]);
    assert!(
        plain.stderr.contains("--exclude-same-episode"),
        "{}",
        plain.stderr
    );
    assert_eq!(plain.json()["results"][0]["k_sim"], 1.0);
    let excluded = demo.score(
        &["dataset.parquet"],
        &["--format", "json", "--exclude-same-episode"],
    );
    assert_eq!(excluded.stderr, "");
    let k_sim = excluded.json()["results"][0]["k_sim"].as_f64().unwrap();
    assert!((0.5..0.95).contains(&k_sim), "{k_sim}");
    let other = demo.score(&["good.parquet"], &["--exclude-same-episode"]);
    other.failed(1, &["good.parquet", "scoring a dataset against itself"]);
}

#[test]
fn one_episode_has_no_interval() {
    let demo = Demo::new();
    Rollouts::new(&[3, 3, 3], [31, 8]).write(demo.at("one.parquet"));
    let run = demo.score(&["one.parquet"], &["--format", "json"]);
    assert!(
        run.stderr.contains("a single episode has no interval"),
        "{}",
        run.stderr
    );
    assert_eq!(run.json()["results"][0]["interval_95"], Value::Null);
    let quiet = demo.score(&["one.parquet"], &["--quiet"]);
    assert_eq!((quiet.code, quiet.stderr.as_str()), (0, ""));
}

#[test]
fn planners_of_one_file_get_rows_of_their_own() {
    let demo = Demo::new();
    let names = ["b", "b", "a", "b"];
    let dictionary: DictionaryArray<Int32Type> = names.into_iter().collect();
    for planners in [
        Arc::new(StringArray::from(names.to_vec())) as ArrayRef,
        Arc::new(LargeStringArray::from(names.to_vec())),
        Arc::new(StringViewArray::from(names.to_vec())),
        Arc::new(dictionary),
    ] {
        Rollouts {
            planners: Some(planners),
            ..Rollouts::new(&[0, 0, 1, 2], [31, 8])
        }
        .write(demo.at("two.parquet"));
        let out = demo.at("steps.parquet");
        let flags = ["--format", "json", "--per-step", &out];
        let document = demo.score(&["two.parquet"], &flags).json();
        let results = document["results"].as_array().unwrap();
        let rows: Vec<_> = results
            .iter()
            .map(|r| (&r["planner"], &r["n_episodes"], &r["n_steps"]))
            .collect();
        assert_eq!(
            rows,
            [
                (&"b".into(), &2.into(), &3.into()),
                (&"a".into(), &1.into(), &1.into())
            ]
        );
        assert_eq!(batches(&out)[0].schema().field(0).name(), "planner");
    }
}

#[test]
fn planners_that_are_no_text_are_ignored_aloud() {
    let demo = Demo::new();
    Rollouts {
        planners: Some(Arc::new(Int64Array::from(vec![1, 1, 2]))),
        ..Rollouts::new(&[0, 0, 1], [31, 8])
    }
    .write(demo.at("two.parquet"));
    let run = demo.score(&["two.parquet"], &["--format", "json"]);
    let warning = "column \"planner\" is ignored: it holds Int64, expected text";
    assert!(run.stderr.contains(warning), "{}", run.stderr);
    let document = run.json();
    assert_eq!(document["results"].as_array().map(Vec::len), Some(1));
    assert_eq!(document["results"][0]["warnings"][0], warning);
}

#[test]
fn columns_of_other_names_are_named_on_the_command_line() {
    let demo = Demo::new();
    let names = ["trial", "sensors", "torque"];
    Rollouts {
        names,
        ..Rollouts::new(&[0, 0, 1], [31, 8])
    }
    .write(demo.at("own.parquet"));
    demo.score(&["own.parquet"], &[])
        .failed(1, &["own.parquet", "no observation column"]);
    let flags = [
        "--observation-columns=sensors",
        "--action-columns=torque",
        "--episode-column=trial",
        "--dataset-observation-columns=observation",
        "--dataset-action-columns=action",
        "--dataset-episode-column=episode_index",
        "--format=json",
    ];
    assert_eq!(
        demo.score(&["own.parquet"], &flags).json()["results"][0]["n_episodes"],
        2
    );
}
