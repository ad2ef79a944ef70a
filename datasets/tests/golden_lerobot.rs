//! The LeRobot reader against recordings of LeRobot itself.
//!
//! The folder is `$KSIM_GOLDEN`, by default a small part of it in the repository. Whatever is found there is
//! checked: other recordings with other values must pass as well.
#![expect(clippy::unwrap_used, reason = "tests")]

#[path = "support/mod.rs"]
#[expect(dead_code, reason = "shared with the tests of other formats")]
mod support;

use std::path::{Path, PathBuf};

use arrow::array::{AsArray, RecordBatch};
use arrow::datatypes::{DataType, Int64Type};
use ksim_datasets::{
    DatasetError, DatasetSource, Format, LeafKind, OpenOptions, Scan, Warning, conformance, detect,
    open, schema,
};
use serde_json::Value;
use support::{Table, files, golden, read_json};

const EXPECTED: &str = ".expected.json";

/// The samples: folder and what is expected of it.
fn samples() -> Vec<(PathBuf, Value)> {
    let root = golden("formats/lerobot");
    let expected = files(&root, EXPECTED).into_iter();
    let samples: Vec<_> = expected
        .map(|path| {
            let name = path.to_string_lossy();
            let folder = PathBuf::from(name.strip_suffix(EXPECTED).unwrap());
            (folder, read_json(&path))
        })
        .collect();
    assert!(!samples.is_empty(), "no samples in {}", root.display());
    samples
}

fn opened(path: &Path) -> Box<dyn DatasetSource> {
    open(path, &OpenOptions::default()).unwrap()
}

fn read(source: &dyn DatasetSource, scan: &Scan) -> RecordBatch {
    let reader = source.scan(scan).unwrap();
    let schema = reader.schema();
    let batches: Vec<_> = reader.collect::<Result<_, _>>().unwrap();
    arrow::compute::concat_batches(&schema, &batches).unwrap()
}

fn numbers(value: &Value) -> Vec<f64> {
    let list = value.as_array().unwrap().iter();
    list.map(|number| number.as_f64().unwrap()).collect()
}

#[test]
fn golden_lerobot_episodes_are_as_the_library_reads_them() {
    for (folder, expected) in samples() {
        let place = folder.display();
        assert_eq!(detect(&folder).unwrap(), Format::LeRobot);
        let source = opened(&folder);
        let episodes = expected["episodes"].as_array().unwrap();
        let info = source.info();
        assert_eq!(info.warnings, [], "{place}");
        assert_eq!(info.n_steps, expected["loaded_frames"].as_u64(), "{place}");
        let n_episodes = expected["loaded_episodes"].as_u64();
        assert_eq!(info.n_episodes, n_episodes, "{place}");
        let schema = source.schema();
        let text = |key: &str| schema.metadata().get(key).map(String::as_str);
        assert_eq!(
            text(schema::SOURCE_VERSION),
            expected["codebase_version"].as_str()
        );
        assert_eq!(text(schema::FPS).unwrap(), expected["fps"].to_string());
        let verbatim = std::fs::read_to_string(folder.join("meta/info.json")).unwrap();
        assert_eq!(text(schema::SOURCE_METADATA), Some(verbatim.as_str()));
        let records = source.episodes().unwrap();
        assert_eq!(records.len(), episodes.len(), "{place}");
        for (record, episode) in records.iter().zip(episodes) {
            let number = episode["episode_index"].as_i64().unwrap();
            assert_eq!(record.episode_index, number, "{place}");
            assert_eq!(Some(record.length), episode["length"].as_u64(), "{place}");
            assert_eq!(Some(record.first_row), episode["index_first"].as_u64());
            assert_eq!(record.attributes["tasks"][0], episode["task"], "{place}");
            check_episode(source.as_ref(), episode, expected["fps"].as_f64().unwrap());
        }
    }
}

fn check_episode(source: &dyn DatasetSource, episode: &Value, fps: f64) {
    let number = episode["episode_index"].as_i64().unwrap();
    let table = Table::read_episode(source, number);
    let states = table.row_bytes("observation.state");
    assert_eq!(states.first(), Some(&numbers(&episode["state_first"])));
    assert_eq!(states.last(), Some(&numbers(&episode["state_last"])));
    let actions = table.row_bytes("action");
    assert_eq!(actions.last(), Some(&numbers(&episode["action_last"])));
    let columns = ["t_ns", "info.task"].map(str::to_owned);
    let rows = read(
        source,
        &Scan {
            columns: Some(columns.to_vec()),
            episodes: Some(vec![number]),
            ..Scan::default()
        },
    );
    let times = rows.column(0).as_primitive::<Int64Type>();
    for (step, time) in times.iter().enumerate() {
        let exact = step as f64 * 1e9 / fps;
        assert!((time.unwrap() as f64 - exact).abs() <= 0.5, "step {step}");
    }
    let last = times.value(times.len() - 1) as f64 / 1e9;
    let recorded = episode["timestamp_last"].as_f64().unwrap();
    assert!((last - recorded).abs() <= recorded * 1e-7);
    let tasks = rows.column(1).as_string::<i32>();
    assert!(tasks.iter().all(|task| task == episode["task"].as_str()));
}

/// Every feature that `info.json` declares is there, with its type, shape and names.
#[test]
fn golden_lerobot_features_are_columns() {
    for (folder, _) in samples() {
        let info = read_json(&folder.join("meta/info.json"));
        let source = opened(&folder);
        let schema = source.schema();
        let mut n_leaves = 0;
        for (name, feature) in info["features"].as_object().unwrap() {
            let column = match name.as_str() {
                "episode_index" | "index" => continue,
                "frame_index" => schema::STEP_INDEX.to_owned(),
                "timestamp" => schema::T_NS.to_owned(),
                "task_index" => "info.task".to_owned(),
                "next.reward" => schema::REWARD.to_owned(),
                "next.success" => schema::INFO_SUCCESS.to_owned(),
                name if name.starts_with("observation") || name.starts_with("action") => {
                    n_leaves += 1;
                    name.to_owned()
                }
                name => format!("info.{name}"),
            };
            let field = schema.field_with_name(&column).unwrap();
            let (data_type, shape) = schema::row_shape(field).unwrap();
            let mut declared: Vec<usize> =
                serde_json::from_value(feature["shape"].clone()).unwrap();
            if declared == [1] {
                declared.clear();
            }
            assert_eq!(shape, declared, "{name}");
            match feature["dtype"].as_str().unwrap() {
                "image" => assert_eq!(data_type, DataType::Binary),
                "bool" => assert_eq!(data_type, DataType::Boolean),
                "float32" if name != "timestamp" => assert_eq!(data_type, DataType::Float32),
                _ => {}
            }
            if let Some(names) = feature["names"].as_array().filter(|_| shape.len() == 1) {
                let recorded: Value =
                    serde_json::from_str(&field.metadata()[schema::NAMES]).unwrap();
                assert_eq!(recorded.as_array(), Some(names), "{name}");
            }
        }
        let leaves = source.info().observation.len() + source.info().action.len();
        assert_eq!(leaves, n_leaves, "{}", folder.display());
    }
}

#[test]
fn golden_lerobot_pictures_stay_encoded() {
    let mut n_pictures = 0;
    for (folder, _) in samples() {
        let source = opened(&folder);
        let is_image = |leaf: &&ksim_datasets::LeafSpec| leaf.kind == LeafKind::Image;
        for leaf in source.info().observation.iter().filter(is_image) {
            let columns = Some(vec![leaf.column.clone()]);
            let rows = read(
                source.as_ref(),
                &Scan {
                    columns,
                    ..Scan::default()
                },
            );
            let codec = source
                .schema()
                .field_with_name(&leaf.column)
                .unwrap()
                .metadata()[schema::IMAGE_CODEC]
                .clone();
            for picture in rows.column(0).as_binary::<i32>() {
                let magic: &[u8] = if codec == "png" {
                    b"\x89PNG"
                } else {
                    b"\xFF\xD8"
                };
                assert!(picture.unwrap().starts_with(magic));
                n_pictures += 1;
            }
        }
    }
    assert!(n_pictures > 0);
}

#[test]
fn golden_lerobot_sources_conform() {
    for (folder, _) in samples() {
        let source = opened(&folder);
        let dir = tempfile::tempdir().unwrap();
        conformance::check_source(source.as_ref()).unwrap();
        conformance::check_parquet_round_trip(source.as_ref(), dir.path()).unwrap();
    }
}

/// The same recording written by both versions of the library has the same rows.
#[test]
fn golden_lerobot_versions_have_the_same_columns() {
    for (folder, _) in samples() {
        let name = folder.file_name().unwrap().to_string_lossy();
        let Some(rest) = name.strip_prefix("v21_") else {
            continue;
        };
        let twin = folder.with_file_name(format!("v3_{rest}"));
        if twin.exists() {
            let (old, new) = (opened(&folder).schema(), opened(&twin).schema());
            assert_eq!(old.fields(), new.fields(), "{rest}");
        }
    }
}

/// Copies a dataset, so that it can be spoilt.
fn copy_of(dataset: &Path) -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    for file in files(dataset, "") {
        let copy = dir.path().join(file.strip_prefix(dataset).unwrap());
        std::fs::create_dir_all(copy.parent().unwrap()).unwrap();
        std::fs::write(copy, std::fs::read(file).unwrap()).unwrap();
    }
    dir
}

fn failure(path: &Path) -> DatasetError {
    match open(path, &OpenOptions::default()) {
        Err(error) => error,
        Ok(source) => {
            let mut batches = source.scan(&Scan::default()).unwrap();
            let error = batches.find_map(Result::err).expect("nothing was noticed");
            DatasetError::from(error)
        }
    }
}

#[test]
fn golden_lerobot_damaged_files_are_named() {
    for (folder, _) in samples() {
        let dir = copy_of(&folder);
        for file in files(dir.path(), "") {
            let name = file.to_string_lossy().into_owned();
            if name.ends_with("stats.json") || name.ends_with("stats.jsonl") {
                continue;
            }
            let bytes = std::fs::read(&file).unwrap();
            let mut kept = vec![0, 4, bytes.len() / 2];
            // The last byte of a file of lines is only a line feed.
            if !name.ends_with(".jsonl") {
                kept.push(bytes.len() - 1);
            }
            for n_kept in kept {
                std::fs::write(&file, &bytes[..n_kept]).unwrap();
                let error = failure(dir.path());
                let is_named = error.to_string() == name || name.contains("tasks.jsonl");
                assert!(is_named, "{name} cut at {n_kept}: {error:?}");
            }
            std::fs::remove_file(&file).unwrap();
            let error = failure(dir.path());
            let folder_of_files = name.contains("meta/episodes/");
            let is_info = name.ends_with("info.json");
            assert!(
                error.to_string() == name || folder_of_files || is_info,
                "{name} missing: {error:?}"
            );
            std::fs::write(&file, &bytes).unwrap();
        }
        assert_eq!(opened(dir.path()).info().warnings, []);
    }
}

#[test]
fn golden_lerobot_recovery_leaves_out_what_is_lost() {
    let mut n_checked = 0;
    for (folder, expected) in samples() {
        let dir = copy_of(&folder);
        let data = files(&dir.path().join("data"), ".parquet");
        let options = OpenOptions {
            recover: true,
            ..OpenOptions::default()
        };
        let whole = open(dir.path(), &options).unwrap();
        assert_eq!(whole.info().warnings, []);
        if data.len() == 1 {
            // Without its only file nothing is left.
            std::fs::write(&data[0], b"PAR1").unwrap();
            let error = open(dir.path(), &options).err().unwrap();
            assert_eq!(error.to_string(), data[0].display().to_string());
            continue;
        }
        std::fs::remove_file(&data[0]).unwrap();
        let source = open(dir.path(), &options).unwrap();
        let [Warning::Lost { what }] = &source.info().warnings[..] else {
            panic!("{:?}", source.info().warnings)
        };
        assert!(what.starts_with("episode 0 of data/"), "{what}");
        let lost = expected["episodes"][0]["length"].as_u64().unwrap();
        let n_steps = expected["loaded_frames"].as_u64().unwrap() - lost;
        assert_eq!(source.info().n_steps, Some(n_steps));
        conformance::check_source(source.as_ref()).unwrap();
        n_checked += 1;
    }
    assert!(n_checked > 0);
}
