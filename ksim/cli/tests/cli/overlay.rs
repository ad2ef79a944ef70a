//! `ksim export mcap`: the recording, read back.

use std::path::Path;
use std::sync::Arc;

use arrow::array::{ArrayRef, Int64Array};
use serde_json::Value;

use crate::process::{Demo, Rollouts, column, ksim, list, write_parquet};

/// The JSON messages on a topic, in order.
fn messages(file: &str, topic: &str) -> Vec<Value> {
    let bytes = std::fs::read(file).expect("it is as the test made it");
    let messages = mcap::MessageStream::new(&bytes)
        .expect("it is as the test made it")
        .map(Result::unwrap);
    let own = messages.filter(|message| message.channel.topic == topic);
    own.map(|message| {
        assert_eq!(message.channel.message_encoding, "json");
        assert_eq!(
            message
                .channel
                .schema
                .as_ref()
                .expect("it is as the test made it")
                .encoding,
            "jsonschema"
        );
        serde_json::from_slice(&message.data).expect("it is as the test made it")
    })
    .collect()
}

#[test]
fn the_recording_has_scores_and_demonstrations_beside_the_rollouts() {
    let demo = Demo::new();
    let (out, steps) = (demo.at("overlay.mcap"), demo.at("steps.parquet"));
    let (rollouts, dataset) = (demo.at("good.parquet"), demo.at("dataset.parquet"));
    let score = demo
        .score(
            &["good.parquet"],
            &["--format", "json", "--per-step", &steps],
        )
        .json();
    let run = ksim([
        "export",
        "mcap",
        &rollouts,
        "--dataset",
        &dataset,
        "-o",
        &out,
    ]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    assert!(run.stdout.contains("1200 steps"), "{}", run.stdout);

    let scores = messages(&out, "/k_sim");
    let own: Vec<f64> = scores
        .iter()
        .map(|score| score["score"].as_f64().unwrap())
        .collect();
    assert_eq!(own, column(&steps, "score"));
    for (name, width) in [
        ("distance", 39.0),
        ("state_distance", 31.0),
        ("action_distance", 8.0),
    ] {
        for (score, distance) in scores.iter().zip(column(&steps, name)) {
            let scaled = score[format!("scaled_{name}")].as_f64().unwrap();
            assert!(
                (scaled * f64::sqrt(width) - distance).abs() < 1e-9,
                "{name}"
            );
        }
    }
    let is_right = |score: &Value| score["saturated"] == Value::Bool(score["score"] == 1.0);
    assert!(scores.iter().all(is_right));
    let matches = messages(&out, "/demonstration");
    let numbers: Vec<f64> = matches
        .iter()
        .map(|step| step["step_index"].as_f64().unwrap())
        .collect();
    assert_eq!(numbers, column(&steps, "reference_step_index"));
    let actions = matches[0]["action"].as_array().unwrap().len();
    assert_eq!(
        (actions, matches[0]["observation"].as_array().unwrap().len()),
        (8, 31)
    );
    assert_eq!(messages(&out, "/observation").len(), matches.len());

    // It is still a recording of the same rollouts.
    let again = ksim(["score", &out, "--dataset", &dataset, "--format", "json"]).json();
    assert_eq!(again["results"][0]["k_sim"], score["results"][0]["k_sim"]);
    // Exported anew, the scores are not there twice.
    let twice = demo.at("twice.mcap");
    let run = ksim(["export", "mcap", &out, "--dataset", &dataset, "-o", &twice]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    assert_eq!(messages(&twice, "/k_sim"), scores);
}

#[test]
fn a_demonstration_is_in_raw_units_and_an_input_is_not_overwritten() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let mut data = Rollouts::new(&[3; 6], [2, 1]);
    data.write(at("data.parquet"));
    let all = data.observations.clone();
    // The rollout is the dataset's third step.
    data.episodes = vec![0];
    data.observations = all[4..6].to_vec();
    data.actions.drain(..2);
    data.actions.truncate(1);
    data.write(at("one.parquet"));
    let (one, dataset, out) = (at("one.parquet"), at("data.parquet"), at("out.mcap"));
    let run = ksim(["export", "mcap", &one, "--dataset", &dataset, "-o", &out]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    let found = &messages(&out, "/demonstration")[0];
    assert_eq!(
        (&found["episode_index"], &found["step_index"]),
        (&Value::from(3), &Value::from(2))
    );
    for (value, expected) in found["observation"]
        .as_array()
        .unwrap()
        .iter()
        .zip(&all[4..6])
    {
        assert!((value.as_f64().unwrap() - f64::from(*expected)).abs() < 1e-6);
    }
    ksim(["export", "mcap", &one, "--dataset", &dataset, "-o", &one])
        .failed(1, &["would replace what is read"]);
    assert!(Path::new(&one).exists());
}

#[test]
fn parts_of_the_state_may_have_the_names_of_other_columns() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let (data, out) = (at("data.parquet"), at("out.mcap"));
    let values: Vec<f32> = (0..24).map(|i| (i as f32 * 0.7).sin()).collect();
    let columns: Vec<(&str, ArrayRef)> = vec![
        ("episode_index", Arc::new(Int64Array::from(vec![0; 6]))),
        ("observation.action", list(2, &values[..12])),
        ("observation.step_index", list(1, &values[12..18])),
        ("action", list(1, &values[18..])),
    ];
    write_parquet(&data, columns);
    let run = ksim(["export", "mcap", &data, "--dataset", &data, "-o", &out]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    let found = &messages(&out, "/demonstration")[0];
    assert_eq!(found["step_index"], Value::from(0));
    for (name, expected) in [
        ("observation_action", &values[..2]),
        ("observation_step_index", &values[12..13]),
        ("action", &values[18..19]),
    ] {
        let own: Vec<f64> = serde_json::from_value(found[name].clone()).unwrap();
        assert_eq!(own.len(), expected.len(), "{name}");
        let near = |(own, expected): (&f64, &f32)| (own - f64::from(*expected)).abs() < 1e-6;
        assert!(own.iter().zip(expected).all(near), "{name}");
    }
}
