//! Writing LeRobot folders: what comes back is what went in, and LeRobot itself loads it.
#![expect(clippy::unwrap_used, reason = "tests")]

#[path = "support/mod.rs"]
#[expect(dead_code, reason = "shared with the tests of other formats")]
mod support;

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;

use arrow::array::{
    Array, ArrayRef, AsArray, BinaryArray, BooleanArray, FixedSizeListArray, Float32Array,
    Float64Array, Int64Array, RecordBatch, StringArray, StructArray,
};
use arrow::datatypes::{DataType, Field, Schema, SchemaRef};
use ksim_datasets::{
    DatasetError, DatasetInfo, DatasetSource, EpisodeEnd, EpisodeRecord, Format, Loss, LossEffect,
    OpenOptions, Scan, SinkInput, WriteOptions, Written, conformance, create, open, schema,
};
use proptest::prelude::*;
use serde_json::{Value, json};
use support::{files, golden, read_json};

fn read(source: &dyn DatasetSource) -> RecordBatch {
    let reader = source.scan(&Scan::default()).unwrap();
    let schema = reader.schema();
    let batches: Vec<_> = reader.collect::<Result<_, _>>().unwrap();
    arrow::compute::concat_batches(&schema, &batches).unwrap()
}

fn opened(path: &Path) -> Box<dyn DatasetSource> {
    open(path, &OpenOptions::default()).unwrap()
}

/// Writes batches of a few rows.
fn write(
    path: &Path,
    rows: &RecordBatch,
    info: &DatasetInfo,
    episodes: &[EpisodeRecord],
    options: &WriteOptions,
) -> Result<Written, DatasetError> {
    let schema = rows.schema();
    let input = SinkInput {
        schema: &schema,
        info,
        episodes,
    };
    let mut sink = create(path, Format::LeRobot, &input, options)?;
    let mut start = 0;
    while start < rows.num_rows() {
        let n = 7.min(rows.num_rows() - start);
        sink.write(&rows.slice(start, n))?;
        start += n;
    }
    assert!(
        !path.exists(),
        "nothing is visible before the sink finishes"
    );
    sink.finish()
}

fn convert(source: &dyn DatasetSource, path: &Path, options: &WriteOptions) -> Written {
    let episodes = source.episodes().unwrap();
    write(path, &read(source), source.info(), &episodes, options).unwrap()
}

/// The same columns with the same values, whatever the order of columns.
fn assert_same_rows(before: &RecordBatch, after: &RecordBatch) {
    assert_eq!(before.num_rows(), after.num_rows());
    assert_eq!(before.num_columns(), after.num_columns());
    for (field, column) in before.schema().fields().iter().zip(before.columns()) {
        let (place, same) = after.schema_ref().column_with_name(field.name()).unwrap();
        assert_eq!(field.as_ref(), same);
        assert_eq!(column, after.column(place), "{}", field.name());
    }
}

#[test]
fn golden_lerobot_round_trips_are_exact() {
    for expected in files(&golden("formats/lerobot"), ".expected.json") {
        let name = expected.to_string_lossy();
        let folder = PathBuf::from(name.strip_suffix(".expected.json").unwrap());
        let source = opened(&folder);
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("copy");
        let written = convert(source.as_ref(), &path, &WriteOptions::default());
        let lost = written
            .losses
            .iter()
            .filter(|loss| !loss.item.starts_with("statistics of"));
        assert_eq!(lost.count(), 0, "{name}: {:?}", written.losses);
        let copy = opened(&path);
        assert_eq!(copy.info().warnings, []);
        assert_same_rows(&read(source.as_ref()), &read(copy.as_ref()));
        assert_eq!(source.episodes().unwrap(), copy.episodes().unwrap());
        conformance::check_source(copy.as_ref()).unwrap();
        check_statistics(&folder, &path);
    }
}

/// The exact part of the statistics is what LeRobot computes; versions before 3.0 have none for all rows.
fn check_statistics(recorded: &Path, written: &Path) {
    let Ok(text) = std::fs::read_to_string(recorded.join("meta/stats.json")) else {
        return;
    };
    let recorded: Value = serde_json::from_str(&text).unwrap();
    let written = read_json(&written.join("meta/stats.json"));
    for (feature, stats) in recorded.as_object().unwrap() {
        if feature.contains("images") {
            continue;
        }
        for name in ["min", "max", "mean", "std", "count"] {
            let of = |value: &Value| -> Vec<f64> {
                let list = value[feature][name].as_array().unwrap().iter();
                list.map(|number| number.as_f64().unwrap()).collect()
            };
            let (ours, theirs) = (of(&written), of(&recorded));
            assert_eq!(ours.len(), theirs.len());
            for (a, b) in ours.iter().zip(&theirs) {
                assert!((a - b).abs() < 1e-6, "{feature} {name}: {a} {b} {stats}");
            }
        }
    }
}

/// Rows as a generator gives them.
#[derive(Debug, Clone)]
struct Made {
    lengths: Vec<usize>,
    with_final: bool,
    seed: u64,
    with_time: bool,
}

fn number(made: &Made, i: usize) -> f64 {
    let bits = (i as u64 + made.seed).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    (bits >> 20) as f64 / 1e6 - 1e6
}

fn list(values: Vec<f64>, shape: &[usize], name: &str) -> (Field, ArrayRef) {
    let field = schema::leaf_field(name, DataType::Float64, shape, false);
    let DataType::FixedSizeList(child, width) = field.data_type() else {
        panic!("{field:?}")
    };
    let values = Arc::new(Float64Array::from(values));
    let array = FixedSizeListArray::new(child.clone(), *width, values, None);
    (field, Arc::new(array))
}

fn table(made: &Made) -> RecordBatch {
    let n_rows: Vec<usize> = made
        .lengths
        .iter()
        .map(|n| n + usize::from(made.with_final))
        .collect();
    let rows = || {
        n_rows
            .iter()
            .enumerate()
            .flat_map(|(e, n)| (0..*n).map(move |s| (e, s)))
    };
    let n: usize = n_rows.iter().sum();
    let is_final = |(e, s): (usize, usize)| made.with_final && s == made.lengths[e];
    let step = |place: (usize, usize), value: f64| (!is_final(place)).then_some(value);
    let numbers = |n: usize, salt: usize| (0..n).map(|i| number(made, i * 31 + salt)).collect();
    let mut columns: Vec<(Field, ArrayRef)> = vec![
        (
            Field::new(schema::EPISODE_INDEX, DataType::Int64, false),
            Arc::new(Int64Array::from_iter_values(rows().map(|(e, _)| e as i64))),
        ),
        (
            Field::new(schema::STEP_INDEX, DataType::Int64, false),
            Arc::new(Int64Array::from_iter_values(rows().map(|(_, s)| s as i64))),
        ),
        list(numbers(n * 3, 0), &[3], "observation.achieved_goal"),
        list(numbers(n * 6, 1), &[2, 3], "observation.map"),
        (
            Field::new("observation.a~1b", DataType::Float64, false),
            Arc::new(Float64Array::from(numbers(n, 2))),
        ),
        (
            Field::new("action", DataType::Float64, true),
            Arc::new(
                rows()
                    .map(|p| step(p, number(made, p.1)))
                    .collect::<Float64Array>(),
            ),
        ),
        (
            Field::new(schema::REWARD, DataType::Float32, true),
            Arc::new(
                rows()
                    .map(|p| step(p, p.1 as f64).map(|v| v as f32))
                    .collect::<Float32Array>(),
            ),
        ),
        (
            Field::new(schema::TERMINATED, DataType::Boolean, true),
            Arc::new(
                rows()
                    .map(|p| step(p, 0.0).map(|_| p.1 % 3 == 2))
                    .collect::<BooleanArray>(),
            ),
        ),
        (
            Field::new(schema::TRUNCATED, DataType::Boolean, true),
            Arc::new(
                rows()
                    .map(|p| step(p, 0.0).map(|_| p.1 % 5 == 4))
                    .collect::<BooleanArray>(),
            ),
        ),
        (
            Field::new("info.timestamp", DataType::Int64, true),
            Arc::new(Int64Array::from_iter_values(
                rows().map(|(e, s)| (e * s) as i64),
            )),
        ),
        (
            Field::new("info.task", DataType::Utf8, true),
            Arc::new(
                rows()
                    .map(|(e, s)| Some(format!("task {}", (e + s / 4) % 9)))
                    .collect::<StringArray>(),
            ),
        ),
        (
            Field::new("info.note", DataType::Utf8, true),
            Arc::new(
                rows()
                    .map(|(e, s)| Some(format!("é{e}{s}")))
                    .collect::<StringArray>(),
            ),
        ),
    ];
    if made.with_time {
        let times = rows().map(|(_, s)| s as i64 * 50_000_000 + (s as i64 % 3) * 1_234_567);
        let field = Field::new(schema::T_NS, DataType::Int64, true);
        columns.push((field, Arc::new(Int64Array::from_iter_values(times))));
    }
    let (fields, arrays): (Vec<Field>, Vec<ArrayRef>) = columns.into_iter().unzip();
    RecordBatch::try_new(Arc::new(Schema::new(fields)), arrays).unwrap()
}

/// A description for the sink, which only looks at the schema and the episodes.
fn any_info() -> DatasetInfo {
    let first = files(&golden("formats/lerobot"), ".expected.json").remove(0);
    let name = first.to_string_lossy();
    opened(Path::new(name.strip_suffix(".expected.json").unwrap()))
        .info()
        .clone()
}

fn without_final(rows: &RecordBatch) -> RecordBatch {
    let keep = arrow::compute::is_not_null(rows.column_by_name(schema::REWARD).unwrap()).unwrap();
    arrow::compute::filter_record_batch(rows, &keep).unwrap()
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 24, ..ProptestConfig::default() })]

    #[test]
    fn generated_tables_come_back(
        lengths in prop::collection::vec(prop_oneof![Just(1usize), 1usize..40], 1..12),
        with_final: bool,
        with_time: bool,
        seed: u64,
    ) {
        let made = Made { lengths, with_final, with_time, seed };
        let rows = table(&made);
        let dir = tempfile::tempdir().unwrap();
        let (first, second) = (dir.path().join("first"), dir.path().join("second"));
        let written = write(&first, &rows, &any_info(), &[], &WriteOptions::default()).unwrap();
        let dropped: Vec<_> = written.losses.iter().filter(|l| l.effect == LossEffect::Dropped).collect();
        prop_assert_eq!(dropped.len(), usize::from(with_final), "{:?}", dropped);
        if with_final {
            prop_assert_eq!(dropped[0].count, Some(made.lengths.len() as u64));
        }
        let source = opened(&first);
        let once = read(source.as_ref());
        let mut expected = without_final(&rows);
        if !with_time {
            // LeRobot always has times: what comes back is the grid.
            let (place, field) = once.schema_ref().column_with_name(schema::T_NS).unwrap();
            let mut fields: Vec<Field> = expected.schema().fields().iter().map(|f| f.as_ref().clone()).collect();
            fields.push(field.clone());
            let mut columns = expected.columns().to_vec();
            columns.push(once.column(place).clone());
            expected = RecordBatch::try_new(Arc::new(Schema::new(fields)), columns).unwrap();
        }
        assert_same_rows(&expected, &once);
        conformance::check_source(source.as_ref()).unwrap();
        convert(source.as_ref(), &second, &WriteOptions::default());
        let again = opened(&second);
        let twice = read(again.as_ref());
        prop_assert_eq!(once.schema_ref().fields(), twice.schema_ref().fields());
        prop_assert_eq!(once.columns(), twice.columns());
        prop_assert_eq!(source.episodes().unwrap(), again.episodes().unwrap());
    }
}

fn made(lengths: &[usize]) -> Made {
    Made {
        lengths: lengths.to_vec(),
        with_final: false,
        seed: 5,
        with_time: true,
    }
}

fn written(lengths: &[usize]) -> (tempfile::TempDir, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("set");
    let rows = table(&made(lengths));
    write(&path, &rows, &any_info(), &[], &WriteOptions::default()).unwrap();
    (dir, path)
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

/// Changes a column of a Parquet file.
fn change(path: &Path, column: &str, to: impl Fn(&ArrayRef) -> (DataType, ArrayRef)) {
    let file = std::fs::File::open(path).unwrap();
    let reader =
        parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder::try_new(file).unwrap();
    let schema: SchemaRef = reader.schema().clone();
    let batches: Vec<_> = reader.build().unwrap().collect::<Result<_, _>>().unwrap();
    let rows = arrow::compute::concat_batches(&schema, &batches).unwrap();
    let place = schema.index_of(column).unwrap();
    let (data_type, array) = to(rows.column(place));
    let mut fields: Vec<Field> = schema.fields().iter().map(|f| f.as_ref().clone()).collect();
    fields[place] = Field::new(column, data_type, true);
    let mut columns = rows.columns().to_vec();
    columns[place] = array;
    let changed = Arc::new(Schema::new_with_metadata(fields, schema.metadata().clone()));
    let rows = RecordBatch::try_new(Arc::clone(&changed), columns).unwrap();
    let file = std::fs::File::create(path).unwrap();
    let mut writer = parquet::arrow::ArrowWriter::try_new(file, changed, None).unwrap();
    writer.write(&rows).unwrap();
    writer.close().unwrap();
}

fn integers(array: &ArrayRef, change: impl Fn(usize, i64) -> i64) -> (DataType, ArrayRef) {
    let values = array.as_primitive::<arrow::datatypes::Int64Type>().values();
    let changed = values
        .iter()
        .enumerate()
        .map(|(row, value)| change(row, *value));
    (
        DataType::Int64,
        Arc::new(Int64Array::from_iter_values(changed)),
    )
}

const DATA: &str = "data/chunk-000/file-000.parquet";

#[test]
fn wrong_indices_are_errors_that_name_the_row() {
    for (column, bad) in [
        ("index", 100),
        ("episode_index", 7),
        ("frame_index", 0),
        ("task_index", 99),
    ] {
        let (_dir, path) = written(&[5, 4]);
        let wrong = |row: usize, value: i64| if row == 6 { bad } else { value };
        change(&path.join(DATA), column, |array| integers(array, wrong));
        let error = failure(&path);
        assert_eq!(error.to_string(), path.join(DATA).display().to_string());
        let text = error.cause().to_string();
        let expected = format!("row 6 of \"{column}\" is {bad}");
        assert!(text.contains(&expected), "{text}");
        // The rows of the episode before it can still be had alone.
        let source = opened(&path);
        let one = Scan {
            episodes: Some(vec![0]),
            ..Scan::default()
        };
        assert!(source.scan(&one).unwrap().all(|batch| batch.is_ok()));
        let options = OpenOptions {
            recover: true,
            ..OpenOptions::default()
        };
        let rest = open(&path, &options).unwrap();
        assert_eq!(rest.info().n_steps, Some(5));
        assert_eq!(rest.info().warnings.len(), 1, "{:?}", rest.info().warnings);
        conformance::check_source(rest.as_ref()).unwrap();
    }
}

#[test]
fn lists_of_another_length_are_errors() {
    let (_dir, path) = written(&[5, 4]);
    change(&path.join(DATA), "observation.achieved_goal", |array| {
        let list = array.as_fixed_size_list();
        let mut lists = arrow::array::ListBuilder::new(arrow::array::Float64Builder::new());
        for row in 0..list.len() {
            let values = list.value(row);
            let values = values.as_primitive::<arrow::datatypes::Float64Type>();
            lists
                .values()
                .append_slice(&values.values()[..if row == 7 { 2 } else { 3 }]);
            lists.append(true);
        }
        let array = lists.finish();
        (array.data_type().clone(), Arc::new(array))
    });
    let error = failure(&path);
    assert!(
        matches!(
            error.cause(),
            DatasetError::RaggedList {
                row: 7,
                actual: 2,
                expected: 3,
                ..
            }
        ),
        "{error:?}"
    );
}

#[test]
fn wrong_counts_are_errors() {
    let (_dir, path) = written(&[5, 4]);
    let episodes = path.join("meta/episodes/chunk-000/file-000.parquet");
    change(&episodes, "dataset_to_index", |array| {
        integers(array, |_, to| to + 1)
    });
    assert_eq!(failure(&path).to_string(), episodes.display().to_string());
    let (_dir, path) = written(&[5, 4]);
    let episodes = path.join("meta/episodes/chunk-000/file-000.parquet");
    let one_less = |row: usize, value: i64| value - i64::from(row == 1);
    change(&episodes, "dataset_to_index", |array| {
        integers(array, one_less)
    });
    change(&episodes, "length", |array| integers(array, one_less));
    let info = path.join("meta/info.json");
    let mut counts = read_json(&info);
    counts["total_frames"] = json!(8);
    std::fs::write(&info, counts.to_string()).unwrap();
    let error = failure(&path);
    let cause = error.cause();
    assert!(
        matches!(
            cause,
            DatasetError::LengthMismatch {
                actual: 9,
                expected: 8,
                ..
            }
        ),
        "{error:?}"
    );
}

#[test]
fn path_templates_stay_inside() {
    for template in [
        "../{chunk_index}/{file_index}.parquet",
        "/etc/passwd",
        "data/{user}.parquet",
    ] {
        let (_dir, path) = written(&[2]);
        let info = path.join("meta/info.json");
        let mut value = read_json(&info);
        value["data_path"] = json!(template);
        std::fs::write(&info, value.to_string()).unwrap();
        let error = failure(&path);
        assert!(
            matches!(error.cause(), DatasetError::Metadata { .. }),
            "{template}: {error:?}"
        );
    }
}

#[test]
fn missing_files_are_named() {
    let (_dir, path) = written(&[2, 3]);
    for name in [
        DATA,
        "meta/tasks.parquet",
        "meta/episodes/chunk-000/file-000.parquet",
    ] {
        let file = path.join(name);
        let bytes = std::fs::read(&file).unwrap();
        std::fs::remove_file(&file).unwrap();
        let error = failure(&path).to_string();
        let folder = path.join("meta/episodes").display().to_string();
        let expected = file.display().to_string();
        assert!(
            error == expected || name.contains("episodes") && error == folder,
            "{name}: {error}"
        );
        std::fs::write(&file, bytes).unwrap();
    }
}

#[test]
fn seeds_and_attributes_are_columns_of_the_episodes() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("set");
    let rows = table(&made(&[2, 3]));
    let (_other, source) = written(&[2, 3]);
    let mut episodes = opened(&source).episodes().unwrap();
    for (episode, attributes) in episodes.iter_mut().zip([
        json!({"a": 1, "b": 0.5, "c": "x", "d": {"deep": [1, null]}, "e": true, "big": u64::MAX}),
        json!({"a": -2, "b": 2.0, "c": "y", "d": "text", "big": 1}),
    ]) {
        let Value::Object(attributes) = attributes else {
            panic!()
        };
        episode.seed = Some(u64::MAX - episode.length);
        episode.attributes.extend(attributes);
    }
    write(
        &path,
        &rows,
        &any_info(),
        &episodes,
        &WriteOptions::default(),
    )
    .unwrap();
    assert_eq!(opened(&path).episodes().unwrap(), episodes);
}

#[test]
fn what_is_made_up_is_said() {
    let dir = tempfile::tempdir().unwrap();
    let rows = table(&Made {
        with_time: false,
        ..made(&[3, 1])
    });
    let without = rows.schema().index_of("info.task").unwrap();
    let keep: Vec<usize> = (0..rows.num_columns()).filter(|i| *i != without).collect();
    let rows = rows.project(&keep).unwrap();
    let effects = |written: &Written| -> HashMap<String, LossEffect> {
        written
            .losses
            .iter()
            .map(|loss| (loss.item.clone(), loss.effect))
            .collect()
    };
    let info = any_info();
    let options = WriteOptions::default();
    let plain = write(&dir.path().join("a"), &rows, &info, &[], &options).unwrap();
    let plain = effects(&plain);
    assert_eq!(plain.get("fps"), Some(&LossEffect::Invented));
    assert_eq!(plain.get("task"), Some(&LossEffect::Invented));
    let options = WriteOptions {
        fps: Some(29.97),
        task: Some("pick".to_owned()),
        robot_type: Some("arm".to_owned()),
        ..WriteOptions::default()
    };
    let path = dir.path().join("b");
    let chosen = effects(&write(&path, &rows, &info, &[], &options).unwrap());
    assert_eq!(chosen.get("fps"), Some(&LossEffect::Changed));
    assert_eq!(chosen.get("task"), None);
    let info = read_json(&path.join("meta/info.json"));
    assert_eq!(
        (&info["fps"], &info["robot_type"]),
        (&json!(30), &json!("arm"))
    );
    assert_eq!(
        opened(&path).episodes().unwrap()[0].attributes["tasks"],
        json!(["pick"])
    );
}

/// Episodes of these lengths with a final observation each.
fn records(lengths: &[u64]) -> Vec<EpisodeRecord> {
    let mut first_row = 0;
    let record = |(episode_index, &length)| {
        first_row += length + 1;
        EpisodeRecord {
            episode_index,
            length,
            first_row: first_row - length - 1,
            n_rows: length + 1,
            end: EpisodeEnd::Unknown,
            has_final_obs: true,
            seed: None,
            success: None,
            total_return: None,
            attributes: serde_json::Map::new(),
        }
    };
    (0..).zip(lengths).map(record).collect()
}

#[test]
fn final_observations_are_no_steps_where_no_column_tells_them_apart() {
    let rows = table(&Made {
        with_final: true,
        ..made(&[3, 9, 1])
    });
    let fields = rows.schema();
    let keep: Vec<usize> = (0..rows.num_columns())
        .filter(|place| {
            let name = fields.field(*place).name();
            name.ends_with("_index") || schema::belongs_to(name, schema::OBSERVATION)
        })
        .collect();
    let rows = rows.project(&keep).unwrap();
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("out");
    let options = WriteOptions::default();
    let written = write(&path, &rows, &any_info(), &records(&[3, 9, 1]), &options).unwrap();
    assert_eq!(written.info.n_steps, Some(13));
    let is_final = |loss: &&Loss| loss.item == "final observations";
    let dropped = written.losses.iter().find(is_final).unwrap();
    assert_eq!(dropped.count, Some(3));
}

#[test]
fn the_rate_asked_for_wins_over_the_recorded_one() {
    let rows = table(&made(&[3]));
    let metadata = HashMap::from([(schema::FPS.to_owned(), "30".to_owned())]);
    let schema = rows.schema().as_ref().clone().with_metadata(metadata);
    let rows = rows.with_schema(Arc::new(schema)).unwrap();
    let dir = tempfile::tempdir().unwrap();
    for (fps, expected, n_losses) in [(None, 30, 0), (Some(30.0), 30, 0), (Some(20.0), 20, 1)] {
        let path = dir.path().join(format!("{fps:?}"));
        let options = WriteOptions {
            fps,
            ..WriteOptions::default()
        };
        let written = write(&path, &rows, &any_info(), &[], &options).unwrap();
        let about_rate = written.losses.iter().filter(|loss| loss.item == "fps");
        assert_eq!(about_rate.count(), n_losses, "{fps:?}");
        let info = read_json(&path.join("meta/info.json"));
        assert_eq!(info["fps"], json!(expected), "{fps:?}");
    }
}

#[test]
fn pictures_must_be_what_they_are_said_to_be() {
    let png = |width: u8, color: u8| {
        let mut bytes = b"\x89PNG\r\n\x1a\n\0\0\0\x0dIHDR\0\0\0".to_vec();
        bytes.extend([width, 0, 0, 0, 4, 8, color]);
        bytes
    };
    let dir = tempfile::tempdir().unwrap();
    for (name, picture, fits) in [
        ("a", png(6, 2), true),
        ("b", png(5, 2), false),
        ("c", png(6, 0), false),
        ("d", vec![0; 40], false),
    ] {
        let rows = table(&made(&[2]));
        let field = schema::image_field("observation.images.top", "png", &[4, 6, 3]);
        let pictures = BinaryArray::from_iter_values([png(6, 2), picture]);
        let mut fields: Vec<Field> = rows
            .schema()
            .fields()
            .iter()
            .map(|f| f.as_ref().clone())
            .collect();
        fields.push(field);
        let mut columns = rows.columns().to_vec();
        columns.push(Arc::new(pictures));
        let rows = RecordBatch::try_new(Arc::new(Schema::new(fields)), columns).unwrap();
        let path = dir.path().join(name);
        let result = write(&path, &rows, &any_info(), &[], &WriteOptions::default());
        assert_eq!(result.is_ok(), fits, "{name}");
        assert_eq!(path.exists(), fits);
        if fits {
            assert_same_rows(&rows, &read(opened(&path).as_ref()));
            // A picture that is only the name of a file is not looked for.
            change(&path.join(DATA), "observation.images.top", |array| {
                let (fields, columns, _) = array.as_struct().clone().into_parts();
                let nothing = BinaryArray::new_null(columns[0].len());
                let array =
                    StructArray::new(fields, vec![Arc::new(nothing), columns[1].clone()], None);
                (array.data_type().clone(), Arc::new(array))
            });
            let source = opened(&path);
            assert_eq!(
                source.info().warnings.len(),
                1,
                "{:?}",
                source.info().warnings
            );
            assert!(source.schema().index_of("observation.images.top").is_err());
        }
    }
}

/// Runs only where Python (`$KSIM_PYTHON`, else `python3`) has the library.
#[test]
fn written_lerobot_is_loaded_by_lerobot() {
    let python = std::env::var("KSIM_PYTHON").unwrap_or_else(|_| "python3".to_owned());
    let has_lerobot = Command::new(&python)
        .args(["-c", "import lerobot"])
        .output();
    if !has_lerobot.is_ok_and(|output| output.status.success()) {
        eprintln!("skipped: {python} has no lerobot");
        return;
    }
    let dir = tempfile::tempdir().unwrap();
    let lengths = [5, 1, 140, 3];
    let generated = dir.path().join("generated");
    let rows = table(&made(&lengths));
    let options = WriteOptions {
        robot_type: Some("arm".to_owned()),
        ..WriteOptions::default()
    };
    write(&generated, &rows, &any_info(), &[], &options).unwrap();
    let mut written = vec![(generated, json!(lengths), json!("arm"))];
    for expected in files(&golden("formats/lerobot"), ".expected.json") {
        let name = expected.to_string_lossy();
        let source = opened(Path::new(name.strip_suffix(".expected.json").unwrap()));
        let path = dir.path().join(expected.file_stem().unwrap());
        convert(source.as_ref(), &path, &WriteOptions::default());
        let episodes = read_json(&expected)["episodes"].clone();
        let lengths = episodes
            .as_array()
            .unwrap()
            .iter()
            .map(|e| e["length"].clone());
        let robot = source.info().metadata["robot_type"].clone();
        written.push((path, lengths.collect(), robot));
    }
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../scripts/check_lerobot.py");
    for (path, lengths, robot) in written {
        let output = Command::new(&python)
            .arg(&script)
            .arg(&path)
            .output()
            .unwrap();
        let errors = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{}: {errors}", path.display());
        let text = String::from_utf8_lossy(&output.stdout);
        let report: Value = serde_json::from_str(text.lines().last().unwrap()).unwrap();
        assert_eq!(report["lengths"], lengths);
        assert_eq!(report["robot_type"], robot);
        let source = opened(&path);
        let rows = read(source.as_ref());
        for (column, feature) in [
            ("action", "action"),
            ("reward", "next.reward"),
            ("observation.state", "observation.state"),
            ("observation.map", "observation.map"),
        ] {
            let Some(array) = rows.column_by_name(column) else {
                continue;
            };
            let values = match array.as_fixed_size_list_opt() {
                Some(list) => list.values().clone(),
                None => array.clone(),
            };
            let values = arrow::compute::cast(&values, &DataType::Float64).unwrap();
            let values = values
                .as_primitive::<arrow::datatypes::Float64Type>()
                .values();
            let sum: f64 = values.iter().sum();
            let size: f64 = values.iter().map(|value| value.abs()).sum();
            let theirs = report["sums"][feature].as_f64().unwrap();
            // The library hands out float32, whatever is stored.
            let tolerance = 1e-7 * size + 1e-9;
            assert!(
                (sum - theirs).abs() <= tolerance,
                "{column}: {sum} {theirs}"
            );
        }
        let tasks = rows.column_by_name("info.task").unwrap().as_string::<i32>();
        let first: Vec<Value> = source
            .episodes()
            .unwrap()
            .iter()
            .map(|e| json!(tasks.value(usize::try_from(e.first_row).unwrap())))
            .collect();
        assert_eq!(report["tasks"], json!(first));
    }
}
