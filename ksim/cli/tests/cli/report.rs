//! `ksim report`: the page as a file, and, where `KSIM_BROWSER` says so, in a browser.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;

use arrow::array::{ArrayRef, Float64Array, Int64Array, StringArray};
use serde_json::Value;

use crate::process::{Demo, Run, batches, column, ksim, list, write_parquet};
use crate::walks::{Goals, Walks};

/// Text that would be markup, if it were not taken for text.
const EVIL: &str =
    "</script><script>window.injected=1</script><img src=x onerror='window.injected=1'>";

/// A folder with a dataset and rollouts.
struct World {
    folder: tempfile::TempDir,
}

impl World {
    fn new() -> Self {
        let folder = tempfile::tempdir().expect("it is as the test made it");
        Walks::new(12, 200, 0.02).write(folder.path().join("data.parquet"));
        Self { folder }
    }

    fn at(&self, name: &str) -> String {
        self.folder
            .path()
            .join(name)
            .to_str()
            .expect("it is as the test made it")
            .to_owned()
    }

    fn write(&self, name: &str, walks: Walks) -> String {
        walks.write(self.at(name));
        self.at(name)
    }

    /// `command` of the rollouts against the dataset.
    fn run(&self, command: &str, rollouts: &[&str], flags: &[&str]) -> Run {
        let dataset = self.at("data.parquet");
        let start = [command, "--dataset", &dataset];
        ksim(start.iter().chain(rollouts).chain(flags))
    }

    /// Writes a page; its data.
    fn report(&self, rollouts: &[&str], flags: &[&str]) -> Value {
        let out = self.at("page.html");
        let flags: Vec<&str> = ["-o", &out].iter().chain(flags).copied().collect();
        let run = self.run("report", rollouts, &flags);
        assert_eq!(run.code, 0, "{}", run.stderr);
        data(&read(out))
    }

    /// Writes a page and what it must agree with beside each other into `folder`.
    fn page(&self, folder: &Path, name: &str, rollouts: &[&str], flags: &[&str]) {
        let file = |ending: &str| folder.join(format!("{name}.{ending}"));
        let html = file("html");
        let output = ["-o", html.to_str().expect("it is as the test made it")];
        let flags: Vec<&str> = output.iter().chain(flags).copied().collect();
        let run = self.run("report", rollouts, &flags);
        assert_eq!(run.code, 0, "{}", run.stderr);
        let steps = self.at("steps.parquet");
        let flags = ["--format", "json", "--per-step", &steps];
        let mut json = self.run("score", rollouts, &flags).json();
        for name in EVIDENCE {
            json["steps"][name] = column(&steps, name).into();
        }
        std::fs::write(file("json"), json.to_string()).expect("it is as the test made it");
    }
}

/// Columns of `--per-step` that a page has, too.
const EVIDENCE: [&str; 7] = [
    "step_index",
    "score",
    "distance",
    "state_distance",
    "action_distance",
    "reference_episode_index",
    "reference_step_index",
];

fn from_base64(text: &str) -> Vec<u8> {
    let (mut bits, mut n_bits, mut bytes) = (0u32, 0, Vec::new());
    for c in text.bytes().filter(|c| *c != b'=') {
        let value = match c {
            b'A'..=b'Z' => c - b'A',
            b'a'..=b'z' => c - b'a' + 26,
            b'0'..=b'9' => c - b'0' + 52,
            b'+' => 62,
            _ => 63,
        };
        (bits, n_bits) = (bits << 6 | u32::from(value), n_bits + 6);
        if n_bits >= 8 {
            n_bits -= 8;
            bytes.push((bits >> n_bits) as u8);
        }
    }
    bytes
}

/// The numbers of a packed column.
fn unpacked(column: &Value) -> Vec<f64> {
    let bytes = from_base64(column["base64"].as_str().expect("a packed column"));
    let (low, high) = (column["low"].as_f64(), column["high"].as_f64());
    let number = |bytes: &[u8]| match (column["type"].as_str(), bytes) {
        (Some("u16"), &[a, b]) => f64::from(u16::from_le_bytes([a, b])),
        (Some("f32"), &[a, b, c, d]) => f64::from(f32::from_le_bytes([a, b, c, d])),
        (other, _) => panic!("{other:?}"),
    };
    let width = if column["type"] == "f32" { 4 } else { 2 };
    let numbers = bytes.chunks(width).map(number);
    match low.zip(high) {
        Some((low, high)) => numbers.map(|n| low + (high - low) * n / 65_535.0).collect(),
        None => numbers.collect(),
    }
}

/// One of two columns of a list in a file.
fn part(path: &str, name: &str, place: usize) -> Vec<f64> {
    use arrow::array::AsArray as _;
    use arrow::datatypes::Float32Type;
    let values = |batch: &arrow::array::RecordBatch| {
        let list = batch.column_by_name(name).expect("the column is there");
        let values = list
            .as_fixed_size_list()
            .values()
            .as_primitive::<Float32Type>();
        values
            .values()
            .iter()
            .skip(place)
            .step_by(2)
            .map(|v| f64::from(*v))
            .collect::<Vec<_>>()
    };
    batches(path).iter().flat_map(values).collect()
}

#[track_caller]
fn assert_near(found: &[f64], expected: &[f64], tolerance: f64, what: &str) {
    assert_eq!(found.len(), expected.len(), "{what}");
    for (row, (a, b)) in found.iter().zip(expected).enumerate() {
        assert!(
            (a - b).abs() <= tolerance,
            "{what}, row {row}: {a}, expected {b}"
        );
    }
}

/// The data of a page.
fn data(html: &str) -> Value {
    let (_, rest) = html
        .split_once("<script type=\"application/json\" id=\"data\">")
        .expect("it is as the test made it");
    serde_json::from_str(
        rest.split_once("</script>")
            .expect("it is as the test made it")
            .0,
    )
    .expect("it is as the test made it")
}

fn read(path: impl AsRef<Path>) -> String {
    std::fs::read_to_string(path).expect("it is as the test made it")
}

#[test]
fn the_page_has_the_numbers_of_score_and_is_the_same_every_time() {
    let demo = Demo::new();
    let rollouts = ["good.parquet", "random.parquet"].map(|name| demo.at(name));
    let score = demo
        .score(&["good.parquet", "random.parquet"], &["--format", "json"])
        .json();
    let write = |name: &str| {
        let out = demo.at(name);
        let run = ksim([
            "report",
            &rollouts[0],
            &rollouts[1],
            "--dataset",
            &demo.at("dataset.parquet"),
            "-o",
            &out,
        ]);
        assert_eq!(run.code, 0, "{}", run.stderr);
        assert!(run.stdout.starts_with("wrote "), "{}", run.stdout);
        read(out)
    };
    let html = write("a.html");
    assert_eq!(html, write("b.html"));
    let data = data(&html);
    for (place, result) in score["results"].as_array().unwrap().iter().enumerate() {
        let shown = data["document"]["results"][place].as_object().unwrap();
        for (field, value) in shown {
            assert_eq!(*value, result[field], "{field}");
        }
        assert!(shown.contains_key("k_sim") && !shown.contains_key("elapsed_s"));
        for (number, episode) in result["episodes"].as_array().unwrap().iter().enumerate() {
            for (field, value) in episode.as_object().unwrap() {
                assert_eq!(
                    data["groups"][place]["episodes"][field][number], *value,
                    "{field}"
                );
            }
        }
    }
    assert_eq!(data["document"]["fingerprint"], score["fingerprint"]);
    assert_eq!(data["map"]["kind"], "projection");
    // Nothing of the machine, and nothing that would be loaded.
    assert!(!html.contains(demo.at("").trim_end_matches('/')));
    assert!(html.contains("default-src 'none'; script-src 'sha256-"));
    for part in [" src=", "@import", "<link rel=\"stylesheet"] {
        assert!(!html.contains(part), "{part}");
    }
    let held = &data["held_out"];
    assert_eq!(held["n_episodes"], 2);
    assert!(held["mean_scaled_distance"].as_f64().unwrap() > 0.0);
}

#[test]
fn paths_lie_in_the_maze_with_goals_success_and_novelty() {
    let world = World::new();
    let facts = Walks {
        facts: true,
        ..Walks::new(4, 60, 0.3)
    };
    let rollouts = world.write("walks.parquet", facts);
    let out = world.at("page.html");
    let run = world.run(
        "report",
        &[&rollouts],
        &["-o", &out, "--env", "antmaze-umaze"],
    );
    assert_eq!(run.code, 0, "{}", run.stderr);
    let data = data(&read(&out));
    assert_eq!(data["map"]["kind"], "maze");
    assert_eq!(
        data["map"]["rows"],
        serde_json::json!(["11111", "10001", "11101", "10001", "11111"])
    );
    let episodes = &data["groups"][0]["episodes"];
    assert_eq!(
        episodes["success"],
        serde_json::json!([false, true, true, false])
    );
    assert_eq!(episodes["return"], serde_json::json!([0.0, 1.0, 1.0, 0.0]));
    let goals = &episodes["goals"];
    assert_eq!(goals["n"], serde_json::json!([1, 1, 1, 1]));
    assert_near(&unpacked(&goals["x"]), &[-4.0; 4], 1e-3, "goals");
    assert_eq!(data["groups"][0]["steps"]["novelty"]["type"], "f32");
    // The dataset does not say what it was made in.
    let run = world.run("report", &[&rollouts], &["-o", &out]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    assert_eq!(self::data(&read(&out))["map"]["kind"], "projection");
    world
        .run("report", &[&rollouts], &["-o", &out, "--env", "Hopper-v5"])
        .failed(1, &["`Hopper-v5` has no maze"]);
}

#[test]
fn names_in_files_stay_text() {
    let world = World::new();
    let evil = Walks {
        planner: Some(EVIL),
        ..Walks::new(4, 30, 0.3)
    };
    let rollouts = world.write("<img src=x onerror='window.injected=1'>.parquet", evil);
    let out = world.at("page.html");
    let run = world.run("report", &[&rollouts], &["-o", &out]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    let html = read(&out);
    assert!(!html.contains("<img") && !html.contains("<script>window"));
    assert!(html.contains("<title>K-Sim of &lt;img src=x onerror='window.injected=1'&gt;.parquet"));
    let label = data(&html)["groups"][0]["label"]
        .as_str()
        .unwrap()
        .to_owned();
    assert!(label.ends_with(EVIL), "{label}");
}

#[test]
fn what_cannot_be_shown_is_said_and_leaves_no_page() {
    let world = World::new();
    let out = world.at("page.html");
    let refused = |rollouts: &str, parts: &[&str]| {
        world
            .run("report", &[rollouts], &["-o", &out])
            .failed(1, parts);
        assert!(!Path::new(&out).exists());
    };
    let none = world.write("none.parquet", Walks::new(0, 1, 0.0));
    refused(&none, &["none.parquet: no steps"]);
    let nan = world.write("nan.parquet", Walks::new(2, 5, f64::NAN));
    refused(
        &nan,
        &[
            "nan.parquet",
            "episode 0, step 0",
            "holds NaN, expected a finite number",
        ],
    );
    let huge = Walks {
        gap: 10_000_000_000_000_000,
        ..Walks::new(1, 2, 0.0)
    };
    let huge = world.write("huge.parquet", huge);
    refused(
        &huge,
        &["huge.parquet: episode 0: a step has number 10000000000000000, a page holds"],
    );
    let text = world.write("text.parquet", Walks::new(1, 2, 0.0));
    let novelty = Arc::new(StringArray::from(vec!["a", "b"])) as ArrayRef;
    with_column(&text, "info.novelty", novelty);
    refused(
        &text,
        &["text.parquet: column \"info.novelty\" holds Utf8, expected numbers"],
    );
    // Before the dataset is read, which holds no number.
    let many = world.write("many.parquet", Walks::new(10_001, 1, 0.1));
    Walks::new(1, 5, f64::NAN).write(world.at("data.parquet"));
    refused(&many, &["10001 episodes, a page holds 10000"]);
    world
        .run("report", &[&many], &["-o", &out, "--env", "antmaze-typo"])
        .failed(1, &["antmaze-typo"]);
    Walks::new(12, 200, 0.02).write(world.at("data.parquet"));
    let own = world.write("own.parquet", Walks::new(2, 5, 0.1));
    world
        .run("report", &[&own], &["-o", &own])
        .failed(1, &["would replace what is read"]);
}

#[test]
fn one_step_and_a_novelty_without_a_number_give_a_page() {
    let world = World::new();
    let one = world.write("one.parquet", Walks::new(1, 1, 0.1));
    let out = world.at("page.html");
    let run = world.run("report", &[&one], &["-o", &out]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    let data = data(&read(&out));
    assert_eq!(data["groups"][0]["steps"]["n"], serde_json::json!([1]));
    assert_eq!(data["document"]["results"][0]["interval_95"], Value::Null);
    let n = 20;
    write_parquet(
        world.at("nan.parquet"),
        vec![
            (
                "episode_index",
                Arc::new(Int64Array::from(vec![0; n])) as ArrayRef,
            ),
            ("observation", list(10, &vec![0.5; 10 * n])),
            ("action", list(3, &vec![0.5; 3 * n])),
            (
                "info.novelty",
                Arc::new(Float64Array::from(vec![f64::NAN; n])),
            ),
            ("reward", Arc::new(Float64Array::from(vec![f64::NAN; n]))),
        ],
    );
    let run = world.run("report", &[&world.at("nan.parquet")], &["-o", &out]);
    assert_eq!(run.code, 0, "{}", run.stderr);
    let steps = &self::data(&read(&out))["groups"][0];
    assert_eq!(steps["steps"]["novelty"], Value::Null);
    assert_eq!(steps["episodes"].get("return"), None);
}

/// Adds a column to a file.
fn with_column(path: &str, name: &str, values: ArrayRef) {
    let batch = &batches(path)[0];
    let schema = batch.schema();
    let names = schema.fields().iter().map(|field| field.name().as_str());
    let known = names.zip(batch.columns().iter().cloned());
    write_parquet(path, known.chain([(name, values)]).collect());
}

/// Writes into a file in which environment it was made.
fn made_in(path: &str, spec: &str) {
    let batch = &batches(path)[0];
    let metadata = [(ksim_datasets::schema::ENV_SPEC.to_owned(), spec.to_owned())];
    let fields = batch.schema().fields().clone();
    let schema = arrow::datatypes::Schema::new_with_metadata(fields, metadata.into());
    let schema = Arc::new(schema);
    let columns = batch.columns().to_vec();
    let batch = arrow::array::RecordBatch::try_new(Arc::clone(&schema), columns);
    let file = std::fs::File::create(path).expect("a file");
    let mut writer = parquet::arrow::ArrowWriter::try_new(file, schema, None).expect("a writer");
    writer
        .write(&batch.expect("a batch"))
        .expect("rows are written");
    writer.close().expect("the file is complete");
}

#[test]
fn every_step_is_as_the_evidence_has_it() {
    let world = World::new();
    let smooth = world.write("smooth.parquet", Walks::new(3, 40, 0.1));
    let gaps = Walks {
        gap: 5,
        ..Walks::new(4, 30, 0.8)
    };
    let rough = world.write("rough.parquet", gaps);
    let rollouts = [&*smooth, &*rough];
    let steps = world.at("steps.parquet");
    // Not a power of two, so that singles lie on both sides of it.
    let gamma = ["--gamma", "0.37"];
    let flags = ["--per-step", &steps, "--format", "json"];
    let score = world
        .run("score", &rollouts, &[&gamma[..], &flags].concat())
        .json();
    let page = world.report(
        &rollouts,
        &[&gamma[..], &["--env", "antmaze-umaze"]].concat(),
    );
    let of = |name: &str| column(&steps, name);
    let parameters = &score["parameters"];
    let width = |name: &str| parameters[name].as_f64().unwrap();
    let (states, actions) = (width("state_dim"), width("action_dim"));
    let by = |name: &str, width: f64| -> Vec<f64> {
        of(name)
            .iter()
            .map(|distance| distance / width.sqrt())
            .collect()
    };
    let scaled = by("distance", states + actions);
    let state = by("state_distance", states);
    let action = by("action_distance", actions);
    let reference: Vec<usize> = of("reference_row")
        .iter()
        .map(|row| *row as usize)
        .collect();
    let mut start = 0;
    for (place, path) in rollouts.iter().enumerate() {
        let (group, result) = (&page["groups"][place], &score["results"][place]);
        let n = result["n_steps"].as_u64().unwrap() as usize;
        let rows = start..start + n;
        start += n;
        let packed = |name: &str| unpacked(&group["steps"][name]);
        assert_near(&packed("scaled"), &scaled[rows.clone()], 1e-6, "scaled");
        assert_near(&packed("state"), &state[rows.clone()], 1e-6, "state");
        assert_near(&packed("action"), &action[rows.clone()], 1e-6, "action");
        let n_within = packed("scaled")
            .iter()
            .filter(|value| **value <= 0.37)
            .count();
        assert_eq!(
            Some(n_within as f64 / n as f64),
            result["saturated_share"].as_f64()
        );
        match place {
            0 => assert_eq!(group["steps"]["step"], Value::Null),
            _ => assert_eq!(packed("step"), of("step_index")[rows.clone()]),
        }
        assert_eq!(
            packed("match_step"),
            of("reference_step_index")[rows.clone()]
        );
        let episodes = &page["reference"]["episodes"];
        let episodes = packed("match_episode")
            .into_iter()
            .map(|place| episodes[place as usize].as_f64().unwrap());
        assert_eq!(
            episodes.collect::<Vec<_>>(),
            of("reference_episode_index")[rows.clone()]
        );
        for (axis, [own, other]) in [["x", "match_x"], ["y", "match_y"]].into_iter().enumerate() {
            // The maze is 20 m wide.
            let tolerance = 20.0 / 65_535.0;
            let [low, high] = [0, 1].map(|end| page["map"][own][end].as_f64().unwrap());
            let shown = |at: &f64| at.clamp(low, high);
            let at: Vec<f64> = part(path, "observation.achieved_goal", axis)
                .iter()
                .map(shown)
                .collect();
            assert_near(&packed(own), &at, tolerance, own);
            let all = part(&world.at("data.parquet"), "observation.achieved_goal", axis);
            let matched: Vec<f64> = reference[rows.clone()]
                .iter()
                .map(|row| shown(&all[*row]))
                .collect();
            assert_near(&packed(other), &matched, tolerance, other);
        }
    }
    let worst = &page["worst"][0];
    let farthest = (0..scaled.len())
        .max_by(|a, b| scaled[*a].total_cmp(&scaled[*b]))
        .unwrap();
    for (name, all) in [("scaled", &scaled), ("state", &state), ("action", &action)] {
        assert_eq!(worst[name].as_f64(), Some(all[farthest]), "{name}");
    }
    assert_eq!(worst["step"].as_f64(), Some(of("step_index")[farthest]));
}

#[test]
fn places_on_the_machine_are_not_on_the_page() {
    let world = World::new();
    for folder in ["run1", "run2"] {
        std::fs::create_dir(world.at(folder)).unwrap();
    }
    let one = world.write("run1/walks.parquet", Walks::new(3, 20, 0.1));
    let two = world.write("run2/walks.parquet", Walks::new(3, 20, 0.5));
    let bytes: Vec<u8> = (0..20)
        .flat_map(|i| (f64::from(i) / 10.0 - 1.0).to_le_bytes())
        .collect();
    let view = safetensors::tensor::TensorView::new(safetensors::Dtype::F64, vec![2, 10], &bytes);
    let file = safetensors::serialize([("centers", view.unwrap())], None).unwrap();
    let centers = world.at("centers.safetensors");
    std::fs::write(&centers, file).unwrap();
    let page = world.report(
        &[&one, &two],
        &["--centers", &centers, "--approximation-error"],
    );
    let html = read(world.at("page.html"));
    assert!(!html.contains(world.folder.path().to_str().unwrap()));
    let labels = [0, 1].map(|place| page["groups"][place]["label"].clone());
    assert_eq!(labels, ["run1/walks.parquet", "run2/walks.parquet"]);
    let clusters = &page["document"]["search"]["clusters"];
    assert_eq!(clusters["centers_file"], "centers.safetensors");
    let error = &page["document"]["results"][1]["approximation_error"];
    assert!(error["recall_at_k"].is_f64(), "{error}");
}

#[test]
fn goals_and_positions_that_cannot_be_drawn_do_not_keep_a_page_from_being_made() {
    let world = World::new();
    let in_maze = ["--env", "antmaze-umaze", "--state-columns", "observation"];
    let nan = Walks {
        goals: Goals::Nan,
        ..Walks::new(3, 20, 0.1)
    };
    let nan = world.write("nan.parquet", nan);
    let page = world.report(&[&nan], &in_maze);
    assert_eq!(page["map"]["kind"], "maze");
    assert_eq!(page["groups"][0]["episodes"].get("goals"), None);
    let notes = page["notes"].to_string();
    assert!(notes.contains("Goals are missing of 3 episodes"), "{notes}");
    // Many goals are as small as places are, and lie where they were.
    let moving = Walks {
        goals: Goals::Moving,
        ..Walks::new(100, 1000, 0.4)
    };
    let moving = world.write("moving.parquet", moving);
    let page = world.report(&[&moving], &in_maze);
    let size = Path::new(&world.at("page.html")).metadata().unwrap().len();
    assert!(
        size <= 5_000_000,
        "100 episodes of 1000 steps take {size} bytes"
    );
    let goals = &page["groups"][0]["episodes"]["goals"];
    let expected = part(&moving, "observation.desired_goal", 1);
    assert_near(&unpacked(&goals["y"]), &expected, 1e-3, "goals");
    // Positions of a simulator do as well.
    let simulated = Walks {
        names: ["info.qpos", "observation.other"],
        ..Walks::new(3, 20, 0.1)
    };
    let simulated = world.write("simulated.parquet", simulated);
    with_column(&simulated, "info.goal", list(2, &[1.5; 120]));
    let page = world.report(&[&simulated], &in_maze);
    assert_eq!(page["map"]["kind"], "maze");
    assert_eq!(
        page["groups"][0]["episodes"]["goals"]["n"],
        serde_json::json!([1, 1, 1])
    );
    // So do the places of a single vector that go with the dataset's.
    let vector = world.at("vector.parquet");
    let n = 40;
    let states: Vec<f32> = (0..10 * n).map(|i| (i as f32 * 0.3).sin()).collect();
    let columns = vec![
        (
            "episode_index",
            Arc::new(Int64Array::from(vec![0; n])) as ArrayRef,
        ),
        ("observation", list(10, &states)),
        ("action", list(3, &vec![0.5; 3 * n])),
    ];
    write_parquet(&vector, columns);
    let page = world.report(&[&vector], &["--env", "antmaze-umaze"]);
    let group = &page["groups"][0];
    let at = |place: usize| -> Vec<f64> {
        let rows = states.chunks(10);
        rows.map(|row| f64::from(row[place])).collect()
    };
    assert_near(&unpacked(&group["steps"]["y"]), &at(1), 1e-3, "positions");
    let goals = &group["episodes"]["goals"];
    assert_near(&unpacked(&goals["x"]), &at(8), 1e-3, "goals");
    // Without any, what was asked for is refused; what was not is left out, and that is said.
    let lost = Walks {
        names: ["observation.a", "observation.b"],
        ..Walks::new(3, 20, 0.1)
    };
    let lost = world.write("lost.parquet", lost);
    let none = world.at("none.html");
    let flags = [&["-o", &none], &in_maze[..]].concat();
    let missing =
        "lost.parquet: no positions: expected column observation.achieved_goal or info.qpos";
    world.run("report", &[&lost], &flags).failed(1, &[missing]);
    made_in(&world.at("data.parquet"), r#"{"id": "AntMaze_UMaze-v5"}"#);
    let report = |rollouts: &str| world.report(&[rollouts], &["--state-columns", "observation"]);
    assert_eq!(report(&simulated)["map"]["kind"], "maze");
    let page = report(&lost);
    assert_eq!(page["map"]["kind"], "projection");
    let notes = page["notes"].to_string();
    assert!(
        notes.contains(missing) && !notes.contains(&world.at("")),
        "{notes}"
    );
}

#[test]
fn large_numbers_of_episodes_and_missing_novelties_are_told() {
    let world = World::new();
    let far = Walks {
        first: 9_007_199_254_740_993,
        ..Walks::new(3, 10, 0.1)
    };
    let far = world.write("far.parquet", far);
    let novelty = |row: i32| (row < 20).then(|| f64::from(row));
    with_column(
        &far,
        "info.novelty",
        Arc::new((0..30).map(novelty).collect::<Float64Array>()),
    );
    let page = world.report(&[&far], &[]);
    let group = &page["groups"][0];
    let expected = ["9007199254740993", "9007199254740994", "9007199254740995"];
    assert_eq!(
        group["episodes"]["episode_index"],
        serde_json::json!(expected)
    );
    let novelty = unpacked(&group["steps"]["novelty"]);
    assert_eq!(novelty[19], 19.0);
    assert!(novelty[20..].iter().all(|value| value.is_nan()));
}

/// Where the script of the browser lies.
fn browser_tests() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/browser")
}

/// Episodes of some lengths in one state, so that their means differ by rounding alone.
fn constant(path: &str, lengths: &[usize], value: f32) {
    let n = lengths.iter().sum::<usize>();
    let episodes = lengths.iter().enumerate();
    let episodes = episodes.flat_map(|(number, n)| std::iter::repeat_n(number as i64, *n));
    let all = |width: usize| list(width, &vec![value; width * n]);
    let columns = vec![
        (
            "episode_index",
            Arc::new(episodes.collect::<Int64Array>()) as ArrayRef,
        ),
        ("observation.achieved_goal", all(2)),
        ("observation.observation", all(6)),
        ("observation.desired_goal", all(2)),
        ("action", all(3)),
    ];
    write_parquet(path, columns);
}

/// Opens pages in a browser: `KSIM_BROWSER=1` after `npm ci` in `tests/browser`. `KSIM_PAGES` keeps them in a folder.
#[test]
fn pages_work_in_a_browser() {
    let in_browser = std::env::var_os("KSIM_BROWSER").is_some();
    let kept = std::env::var_os("KSIM_PAGES").map(PathBuf::from);
    if !in_browser && kept.is_none() {
        return;
    }
    let world = World::new();
    let folder = kept.unwrap_or_else(|| world.folder.path().join("pages"));
    std::fs::create_dir_all(&folder).unwrap();
    let facts = |walks: Walks| Walks {
        facts: true,
        ..walks
    };
    let rough = world.write("rough.parquet", facts(Walks::new(6, 300, 0.8)));
    let smooth = world.write("smooth.parquet", facts(Walks::new(8, 300, 0.1)));
    world.page(
        &folder,
        "maze",
        &[&smooth, &rough],
        &["--env", "antmaze-umaze"],
    );
    let evil = Walks {
        planner: Some(EVIL),
        ..Walks::new(30, 60, 0.4)
    };
    let evil = world.write("<img src=x onerror='window.injected=1'>.parquet", evil);
    world.page(&folder, "names", &[&evil], &[]);
    let one = world.write("one.parquet", Walks::new(1, 1, 0.1));
    world.page(&folder, "one", &[&one], &[]);
    let gaps = Walks {
        gap: 5,
        ..Walks::new(3, 100, 0.5)
    };
    let gaps = world.write("gaps.parquet", gaps);
    world.page(&folder, "gaps", &[&gaps], &[]);
    let flat = world.at("flat.parquet");
    constant(&flat, &[5, 7, 10], 2.7);
    world.page(&folder, "flat", &[&flat], &[]);
    let nine: Vec<String> = (1..=9)
        .map(|i| {
            let walks = Walks::new(3, 60, 0.1 * f64::from(i));
            world.write(&format!("noise{i}.parquet"), walks)
        })
        .collect();
    let nine: Vec<&str> = nine.iter().map(String::as_str).collect();
    world.page(&folder, "nine", &nine, &[]);
    let large = world.write("large.parquet", facts(Walks::new(100, 1000, 0.4)));
    world.page(&folder, "large", &[&large], &["--env", "antmaze-umaze"]);
    let size = folder.join("large.html").metadata().unwrap().len();
    assert!(
        size <= 5_000_000,
        "100 episodes of 1000 steps take {size} bytes"
    );
    let many = world.write("many.parquet", facts(Walks::new(10_000, 15, 0.4)));
    world.page(&folder, "many", &[&many], &[]);
    let notes = data(&read(folder.join("many.html")))["notes"].to_string();
    assert!(notes.contains("of every 2 steps of an episode"), "{notes}");
    if in_browser {
        let script = browser_tests().join("check.mjs");
        let output = Command::new("node")
            .arg(script)
            .arg(&folder)
            .output()
            .unwrap();
        let said = String::from_utf8_lossy(&output.stdout);
        assert!(
            output.status.success(),
            "{said}\n{}",
            String::from_utf8_lossy(&output.stderr)
        );
    }
}
