//! Recordings as datasets: alignment, episodes and proposals against files of the official writers.
//!
//! The folder is `$KSIM_GOLDEN`, by default a small part of it in the repository. Whatever is found there is
//! checked: other recordings with other values must pass as well.
#![cfg(feature = "mcap")]
#![expect(clippy::unwrap_used, reason = "tests")]

#[path = "support/mod.rs"]
#[expect(dead_code, reason = "shared with the tests of other formats")]
mod support;

use std::fmt::Write;
use std::path::{Path, PathBuf};

use arrow::array::{Array, AsArray, RecordBatch};
use arrow::datatypes::{Float64Type, Int64Type, UInt8Type};
use ksim_datasets::{
    DatasetError, DatasetSource, OpenOptions, Scan, Warning, conformance, mcap, open, schema,
};
use serde_json::Value as Json;
use support::{files, golden, read_json};

fn root() -> PathBuf {
    golden("formats/mcap")
}

fn open_with(
    path: &Path,
    mapping: &str,
    recover: bool,
) -> Result<Box<dyn DatasetSource>, DatasetError> {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("mapping.toml");
    std::fs::write(&file, mapping).unwrap();
    let mapping = Some(file);
    open(
        path,
        &OpenOptions {
            mapping,
            recover,
            ..OpenOptions::default()
        },
    )
}

fn rows(source: &dyn DatasetSource) -> RecordBatch {
    let reader = source.scan(&Scan::default()).unwrap();
    let schema = reader.schema();
    let batches: Vec<_> = reader.collect::<Result<_, _>>().unwrap();
    arrow::compute::concat_batches(&schema, &batches).unwrap()
}

fn vector(batch: &RecordBatch, column: &str, row: usize) -> Vec<f64> {
    let list = batch
        .column_by_name(column)
        .unwrap()
        .as_fixed_size_list()
        .value(row);
    list.as_primitive::<Float64Type>().values().to_vec()
}

fn numbers(json: &Json) -> Vec<f64> {
    json.as_array()
        .unwrap()
        .iter()
        .map(|v| v.as_f64().unwrap())
        .collect()
}

/// A mapping of all topics of a ROS 2 recording, by their types.
fn all_topics(recording: &Json, align: &str) -> String {
    let mut toml = String::new();
    for (topic, description) in recording["topics"].as_object().unwrap() {
        let name = topic.trim_start_matches('/').replace('/', "_");
        let field = match description["schema_name"].as_str().unwrap() {
            "sensor_msgs/msg/JointState" => format!("field = \"position\"\nalign = \"{align}\""),
            "geometry_msgs/msg/PoseStamped" => {
                "field = \"pose.orientation\"\nkind = \"quaternion_xyzw\"".to_owned()
            }
            "std_msgs/msg/Float64MultiArray" => "field = \"data\"".to_owned(),
            "sensor_msgs/msg/CompressedImage" => "kind = \"image\"".to_owned(),
            _ => continue,
        };
        let _ = writeln!(toml, "[observation.{name}]\ntopic = \"{topic}\"\n{field}");
    }
    toml
}

#[test]
fn golden_mcap_alignment_is_that_of_the_reference() {
    let mut n_files = 0;
    for path in files(&root(), ".expected.json") {
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        let Some((stem, _)) = name.split_once(".align") else {
            continue;
        };
        n_files += 1;
        let expected = read_json(&path);
        let file = root().join(expected["file"].as_str().unwrap());
        let recording = read_json(&root().join(format!("{stem}.mcap.expected.json")));
        for (policy, align) in [
            ("latest_before", "latest"),
            ("nearest", "nearest"),
            ("linear", "linear"),
        ] {
            let step = &expected["step_ns"];
            let toml = format!(
                "[grid]\nstep_ns = {step}\n{}",
                all_topics(&recording, align)
            );
            let source = open_with(&file, &toml, false).unwrap();
            let batch = rows(source.as_ref());
            let n_rows = usize::try_from(expected["rows"].as_u64().unwrap()).unwrap();
            assert_eq!(batch.num_rows(), n_rows, "{name} {align}");
            let start = &source.episodes().unwrap()[0].attributes["start_time_ns"];
            assert_eq!(start, &expected["t_start"], "{name}");
            let t_ns = batch
                .column_by_name(schema::T_NS)
                .unwrap()
                .as_primitive::<Int64Type>();
            let last = expected["t_last"].as_i64().unwrap() - expected["t_start"].as_i64().unwrap();
            assert_eq!(t_ns.value(n_rows - 1), last, "{name}");
            for (place, row) in [("first", 0), ("mid", n_rows / 2), ("last", n_rows - 1)] {
                let check = |key: &str, expected: &Json| {
                    let (topic, _) = key.split_once('.').unwrap();
                    let column = format!(
                        "observation.{}",
                        topic.trim_start_matches('/').replace('/', "_")
                    );
                    let actual = vector(&batch, &column, row);
                    for (a, e) in actual.iter().zip(numbers(expected)) {
                        let near = if align == "linear" { 1e-12 } else { 0.0 };
                        assert!((a - e).abs() <= near, "{name} {align} {place}: {a} {e}");
                    }
                    assert_eq!(actual.len(), numbers(expected).len());
                };
                check(
                    expected["state_topic"].as_str().unwrap(),
                    &expected[policy][place],
                );
                if align == "latest" {
                    check(
                        expected["action_topic"].as_str().unwrap(),
                        &expected["action_latest_before"][place],
                    );
                }
            }
        }
    }
    assert!(n_files > 0, "no alignment samples");
}

#[test]
fn golden_mcap_episodes_by_marker_and_by_gap() {
    let mut n_files = 0;
    for path in files(&root(), ".mcap.expected.json") {
        let expected = read_json(&path);
        let Some(episodes) = expected["episodes"].as_array() else {
            continue;
        };
        n_files += 1;
        let file = root().join(expected["file"].as_str().unwrap());
        let column = "[grid]\ntopic = \"/joint_states\"\n[observation.q]\ntopic = \"/joint_states\"\nfield = \"position\"\n";
        let marker = "[episodes]\nby = \"marker\"\ntopic = \"/episode\"\nstart = \"start\"\nend = \"end\"\nsuccess = \"success\"\n";
        let gap = "[episodes]\nby = \"gap\"\ntopic = \"/joint_states\"\ngap_s = 1.0\n";
        for (rule, knows_success) in [(marker, true), (gap, false)] {
            let source = open_with(&file, &format!("{column}{rule}"), false).unwrap();
            let records = source.episodes().unwrap();
            assert_eq!(records.len(), episodes.len(), "{rule}");
            for (record, episode) in records.iter().zip(episodes) {
                assert_eq!(
                    Some(record.n_rows),
                    episode["counts"]["/joint_states"].as_u64(),
                    "{rule}"
                );
                let success = episode["success"].as_bool().filter(|_| knows_success);
                assert_eq!(record.success, success, "{rule}");
                let start = record.attributes["start_time_ns"].as_i64().unwrap();
                assert!(start >= episode["start"].as_i64().unwrap());
                assert!(start <= episode["end"].as_i64().unwrap());
            }
            conformance::check_source(source.as_ref()).unwrap();
        }
        assert_eq!(
            expected["gaps_s_over_1"].as_u64().map(|n| n + 1),
            Some(episodes.len() as u64)
        );
    }
    assert!(n_files > 0, "no samples with episodes");
}

#[test]
fn golden_mcap_proposals_open_their_recordings() {
    let mut n_opened = 0;
    for path in files(&root(), ".mcap.expected.json") {
        let expected = read_json(&path);
        let name = expected["file"].as_str().unwrap();
        let is_whole = expected["fault"].is_null()
            || expected["cut_at_byte"].is_null() && expected["bad_chunk"].is_null();
        if !is_whole || !expected["must"].is_null() {
            continue;
        }
        let file = root().join(name);
        let inspection = mcap::inspect(&file, false).unwrap();
        for topic in &inspection.topics {
            let count = expected["topics"][&topic.topic]["count"].as_u64();
            assert_eq!(
                topic.n_messages,
                count.unwrap_or(0),
                "{name} {}",
                topic.topic
            );
        }
        let toml = match inspection.propose() {
            Ok(toml) => toml,
            Err(error) => {
                assert!(matches!(error, DatasetError::Empty), "{name}: {error}");
                assert_eq!(expected["total_messages_read"], 0, "{name}");
                continue;
            }
        };
        let source = open_with(&file, &toml, false)
            .unwrap_or_else(|error| panic!("{name}: {error:?}\n{toml}"));
        assert!(source.info().n_steps.unwrap() > 0, "{name}\n{toml}");
        conformance::check_source(source.as_ref()).unwrap();
        // The Parquet reader wants an action, which a recording of a camera alone has not.
        if !source.info().action.is_empty() {
            let folder = tempfile::tempdir().unwrap();
            conformance::check_parquet_round_trip(source.as_ref(), folder.path()).unwrap();
        }
        n_opened += 1;
    }
    assert!(n_opened > 5, "only {n_opened} recordings");
}

#[test]
fn golden_mcap_raw_pictures_are_tensors_with_red_first() {
    for path in files(&root(), "raw_image.mcap") {
        let mapping = "[grid]\ntopic = \"/camera/front/image_raw\"\n[observation.front]\ntopic = \"/camera/front/image_raw\"\nkind = \"image\"\n";
        let source = open_with(&path, mapping, false).unwrap();
        let fields = source.schema();
        let field = fields.field_with_name("observation.front").unwrap();
        let (_, shape) = schema::row_shape(field).unwrap();
        assert_eq!(shape.len(), 3);
        assert_eq!(field.metadata()["source.encoding"], "bgr8");
        let batch = rows(source.as_ref());
        let pixels = batch
            .column_by_name("observation.front")
            .unwrap()
            .as_fixed_size_list();
        let recording = mcap::Recording::open(&path, false).unwrap();
        let mut messages = recording
            .messages(&mcap::MessageOptions::default())
            .unwrap();
        let mut row = 0;
        while let Some(message) = messages.next().unwrap() {
            let decoder = mcap::Decoder::new(message.channel).unwrap();
            let mcap::Value::Bytes(bytes) = decoder
                .decode(&message)
                .unwrap()
                .member("data")
                .unwrap()
                .clone()
            else {
                panic!("bytes");
            };
            let values = pixels.value(row);
            let values = values.as_primitive::<UInt8Type>().values();
            let swapped: Vec<u8> = bytes.chunks(3).flat_map(|p| [p[2], p[1], p[0]]).collect();
            assert_eq!(&values[..], &swapped[..]);
            row += 1;
        }
        assert_eq!(row, batch.num_rows());
    }
}

#[test]
fn golden_mcap_damage_is_an_error_or_a_loss() {
    let mapping = "[grid]\nrate_hz = 30\n[observation.q]\ntopic = \"/joint_states\"\nfield = \"position\"\n[action]\ntopic = \"/joint_cmd\"\nfield = \"position\"\n";
    for path in files(&root(), ".mcap.expected.json") {
        let expected = read_json(&path);
        if expected["bad_chunk"].is_null() && expected["cut_at_byte"].is_null() {
            continue;
        }
        let file = root().join(expected["file"].as_str().unwrap());
        assert!(
            open_with(&file, mapping, false).is_err(),
            "{}",
            file.display()
        );
        let source = open_with(&file, mapping, true).unwrap();
        let lost = |warning: &Warning| matches!(warning, Warning::Lost { .. });
        assert!(
            source.info().warnings.iter().any(lost),
            "{}",
            file.display()
        );
        conformance::check_source(source.as_ref()).unwrap();
    }
}

/// A recording, and columns of it.
const COLUMNS: &str = "[observation.q]\ntopic = \"/joint_states\"\nfield = \"position\"\n[action]\ntopic = \"/joint_cmd\"\nfield = \"position\"\n";

#[test]
fn golden_mcap_actions_from_commands_and_from_the_next_state() {
    let file = root().join("ros2_zstd.mcap");
    let next = "[grid]\nrate_hz = 20\n[observation.q]\ntopic = \"/joint_states\"\nfield = \"position\"\nkind = \"angle\"\n[action]\nnext_of = \"q\"\n";
    let source = open_with(&file, next, false).unwrap();
    conformance::check_source(source.as_ref()).unwrap();
    let batch = rows(source.as_ref());
    let last = batch.num_rows() - 1;
    for row in 0..last {
        assert_eq!(
            vector(&batch, "action", row),
            vector(&batch, "observation.q", row + 1)
        );
    }
    assert!(batch.column_by_name("action").unwrap().is_null(last));
    let record = &source.episodes().unwrap()[0];
    assert!(record.has_final_obs);
    assert_eq!(source.info().n_steps, Some(record.length));
    let field =
        |name: &str| source.schema().field_with_name(name).unwrap().metadata()["kind"].clone();
    assert_eq!(
        (field("action"), field("observation.q")),
        ("angle".to_owned(), "angle".to_owned())
    );
    let commands = format!("[grid]\nrate_hz = 20\n{COLUMNS}align = \"next\"\n");
    let source = open_with(&file, &commands, false).unwrap();
    conformance::check_source(source.as_ref()).unwrap();
}

#[test]
fn golden_mcap_misses_cut_drop_or_fail() {
    let file = root().join("ros2_zstd.mcap");
    // States come at 100 Hz and commands at 30: at 100 Hz most steps have no command in the last 5 ms.
    let with = |on_miss: &str| {
        let toml = format!(
            "[grid]\ntopic = \"/joint_states\"\n{COLUMNS}max_age_s = 0.005\non_miss = \"{on_miss}\"\n"
        );
        open_with(&file, &toml, false)
    };
    let drop = with("drop").unwrap();
    let split = with("split").unwrap();
    let kept = |source: &dyn DatasetSource| rows(source).column_by_name("action").unwrap().clone();
    assert_eq!(
        &kept(drop.as_ref()),
        &kept(split.as_ref()),
        "the same steps stay"
    );
    assert_eq!(drop.info().n_episodes, Some(1));
    assert!(split.info().n_episodes.unwrap() > 10);
    let left_out = |warning: &Warning| matches!(warning, Warning::StepsLeftOut { .. });
    assert!(drop.info().warnings.iter().any(left_out));
    assert!(split.info().warnings.iter().any(left_out));
    for source in [drop, split] {
        conformance::check_source(source.as_ref()).unwrap();
    }
    let error = with("error").map(|_| ()).unwrap_err();
    assert!(
        matches!(error.cause(), DatasetError::NoSample { .. }),
        "{error:?}"
    );
    let error = with("null").map(|_| ()).unwrap_err();
    assert!(
        matches!(error.cause(), DatasetError::Mapping { .. }),
        "{error:?}"
    );
}

#[test]
fn golden_mcap_joints_are_picked_by_name_and_clocks_agree() {
    let file = root().join("ros2_zstd.mcap");
    let toml = |names: &str, clock: &str| {
        format!(
            "clock = \"{clock}\"\n[grid]\ntopic = \"/joint_states\"\n[observation.q]\ntopic = \"/joint_states\"\nfield = \"position\"\n{names}\n"
        )
    };
    let all = rows(open_with(&file, &toml("", "log"), false).unwrap().as_ref());
    for clock in ["log", "publish", "header"] {
        let source = open_with(
            &file,
            &toml("names = [\"gripper\", \"joint2\"]", clock),
            false,
        )
        .unwrap();
        let two = rows(source.as_ref());
        assert_eq!(two.num_rows(), all.num_rows());
        for row in 0..two.num_rows() {
            let q = vector(&all, "observation.q", row);
            assert_eq!(vector(&two, "observation.q", row), [q[6], q[1]]);
        }
        let schema = source.schema();
        let names = &schema.field_with_name("observation.q").unwrap().metadata()["names"];
        assert_eq!(names, "[\"gripper\",\"joint2\"]");
    }
    let missing = "names = [\"joint2\", \"elbow\"]";
    let error = open_with(&file, &toml(missing, "log"), false).unwrap();
    let failed = error
        .scan(&Scan::default())
        .unwrap()
        .any(|batch| batch.is_err());
    assert!(failed, "a joint that no message lists is an error");
    let source = open_with(
        &file,
        &toml(&format!("{missing}\nmissing = \"null\""), "log"),
        false,
    )
    .unwrap();
    let batch = rows(source.as_ref());
    assert_eq!(
        batch.column_by_name("observation.q").unwrap().null_count(),
        batch.num_rows()
    );
}

#[test]
fn golden_mcap_a_folder_is_its_files_in_order() {
    let folder = tempfile::tempdir().unwrap();
    for (from, to) in [
        ("ros2_zstd.mcap", "b.mcap"),
        ("ros2_no_summary.mcap", "a.mcap"),
    ] {
        std::fs::copy(root().join(from), folder.path().join(to)).unwrap();
    }
    std::fs::write(folder.path().join("metadata.yaml"), "rosbag2: {}").unwrap();
    let source = open_with(
        folder.path(),
        &format!("[grid]\nrate_hz = 10\n{COLUMNS}"),
        false,
    )
    .unwrap();
    let files: Vec<_> = source
        .episodes()
        .unwrap()
        .iter()
        .map(|record| {
            record.attributes["source_file"]
                .as_str()
                .unwrap()
                .to_owned()
        })
        .collect();
    assert_eq!(files, ["a.mcap", "b.mcap"]);
    conformance::check_source(source.as_ref()).unwrap();
}

#[test]
fn golden_mcap_what_is_wrong_with_a_mapping_is_named() {
    let file = root().join("ros2_zstd.mcap");
    let error = open(&file, &OpenOptions::default())
        .map(|_| ())
        .unwrap_err();
    assert!(error.cause().to_string().contains("--propose"), "{error:?}");
    for (toml, parts) in [
        (
            "[grid]\nrate_hz = 30\n[observation.q]\ntopic = \"/none\"\nfield = \"position\"\n",
            &["/none", "/joint_states"][..],
        ),
        (
            "[grid]\nrate_hz = 30\n[observation.q]\ntopic = \"/joint_states\"\nfield = \"positions\"\n",
            &["positions"],
        ),
        (
            "[grid]\nrate_hz = 30\n[observation.q]\ntopic = \"/joint_states\"\nfeld = \"position\"\n",
            &["line 5", "feld"],
        ),
        (
            "[grid]\nrate_hz = 0\n[observation.q]\ntopic = \"/joint_states\"\nfield = \"position\"\n",
            &["line 1", "rate_hz"],
        ),
        (
            "[observation.q]\ntopic = \"/joint_states\"\nfield = \"position\"\n",
            &["grid"],
        ),
        (
            "[grid]\nrate_hz = 30\n[observation.q]\ntopic = \"/joint_states\"\nfield = \"header\"\n",
            &["header"],
        ),
        (
            "[grid]\nrate_hz = 30\n[observation.q]\ntopic = \"/joint_states\"\nkind = \"image\"\n",
            &["picture"],
        ),
    ] {
        let error = open_with(&file, toml, false).map(|_| ()).unwrap_err();
        let mut text = error.to_string();
        let mut source = std::error::Error::source(&error);
        while let Some(cause) = source {
            let _ = write!(text, ": {cause}");
            source = cause.source();
        }
        for part in parts {
            assert!(text.contains(part), "{toml}\n{text}");
        }
    }
}
