//! Parquet files: foreign layouts, faults, and round trips.
#![expect(clippy::unwrap_used, reason = "tests")]

use std::fs::File;
use std::path::Path;
use std::sync::Arc;

use arrow::array::{
    ArrayRef, AsArray, BooleanArray, FixedSizeListArray, Float32Array, Float64Array, Int64Array,
    ListArray, RecordBatch, StringArray,
};
use arrow::datatypes::{DataType, Field, Float32Type, Float64Type, Int64Type, Schema};
use ksim_datasets::{
    ColumnNames, DatasetError, DatasetSink, DatasetSource, EpisodeEnd, ObservationLayout,
    OpenOptions, ParquetSink, Scan, TransitionOptions, TransitionReader, conformance, open, schema,
    summarize,
};
use parquet::arrow::ArrowWriter;
use proptest::prelude::*;

fn write(path: &Path, columns: Vec<(&str, ArrayRef)>) {
    let batch = RecordBatch::try_from_iter(columns).unwrap();
    let mut writer =
        ArrowWriter::try_new(File::create(path).unwrap(), batch.schema(), None).unwrap();
    writer.write(&batch).unwrap();
    writer.close().unwrap();
}

type Rows = Vec<Option<Vec<Option<f32>>>>;

fn rows(n: u16, width: u16) -> Rows {
    (0..n)
        .map(|row| Some((0..width).map(|i| Some(f32::from(row * 10 + i))).collect()))
        .collect()
}

fn list(rows: Rows) -> ArrayRef {
    Arc::new(ListArray::from_iter_primitive::<Float32Type, _, _>(rows))
}

fn doubles(n: u16, width: i32) -> ArrayRef {
    let row = |row: u16| {
        Some(
            (0..width)
                .map(|i| Some(f64::from(row) + f64::from(i) / 8.0))
                .collect::<Vec<_>>(),
        )
    };
    Arc::new(FixedSizeListArray::from_iter_primitive::<Float64Type, _, _>((0..n).map(row), width))
}

fn integers(values: &[i64]) -> ArrayRef {
    Arc::new(Int64Array::from(values.to_vec()))
}

fn opened(path: &Path) -> Box<dyn DatasetSource> {
    open(path, &OpenOptions::default()).unwrap()
}

/// The error of reading everything, with the path checked.
fn failure(columns: Vec<(&str, ArrayRef)>) -> DatasetError {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("rollout.parquet");
    write(&path, columns);
    let source = match open(&path, &OpenOptions::default()) {
        Ok(source) => source,
        Err(error) => return named(error),
    };
    let result: Result<Vec<_>, _> =
        TransitionReader::new(source.as_ref(), &TransitionOptions::default())
            .unwrap()
            .collect();
    named(result.unwrap_err())
}

fn named(error: DatasetError) -> DatasetError {
    let DatasetError::InFile { path, source } = error else {
        panic!("{error:?} has no path")
    };
    assert!(path.ends_with("rollout.parquet"));
    *source
}

#[test]
fn a_foreign_file_becomes_transitions() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("mine.parquet");
    write(
        &path,
        vec![
            ("episode_id", integers(&[4, 4, 7, 7, 7])),
            ("obs", list(rows(5, 3))),
            ("actions", doubles(5, 2)),
            (
                "rewards",
                Arc::new(Float32Array::from(vec![0.0, 1.0, 0.5, 0.5, 1.0])),
            ),
            ("done", integers(&[0, 0, 0, 0, 2])),
            (
                "success",
                Arc::new(BooleanArray::from(vec![false, true, false, false, false])),
            ),
            (
                "planner",
                Arc::new(StringArray::from(vec!["a", "a", "b", "b", "b"])),
            ),
        ],
    );
    let source = opened(&path);
    conformance::check_source(source.as_ref()).unwrap();
    conformance::check_parquet_round_trip(source.as_ref(), dir.path()).unwrap();
    let summary = summarize(source.as_ref()).unwrap();
    assert_eq!(
        (summary.n_episodes, summary.n_steps, summary.success_rate),
        (2, 5, Some(0.5))
    );
    assert_eq!(
        summary.ends,
        [(EpisodeEnd::Terminated, 1), (EpisodeEnd::Cut, 1)]
    );
    let layout = ObservationLayout::new(&source.info().observation);
    let options = TransitionOptions {
        batch_rows: 2,
        state_columns: Some(layout.select("2,0").unwrap()),
        rewards: true,
        flags: true,
        success: true,
        text_column: Some("info.planner".to_owned()),
        ..TransitionOptions::default()
    };
    let batches: Vec<_> = TransitionReader::new(source.as_ref(), &options)
        .unwrap()
        .collect::<Result<_, _>>()
        .unwrap();
    assert_eq!(
        batches
            .iter()
            .map(|batch| batch.n_rows())
            .collect::<Vec<_>>(),
        [2, 2, 1]
    );
    assert_eq!(batches[0].states, [2.0, 0.0, 12.0, 10.0]);
    assert_eq!(batches[1].episode_index, [7, 7]);
    assert_eq!(batches[1].step_index, [0, 1]);
    assert_eq!(batches[2].actions, [4.0, 4.125]);
    assert_eq!(batches[2].terminated, Some(vec![true]));
    assert_eq!(batches[2].truncated, None);
    assert_eq!(batches[0].success, Some(vec![Some(false), Some(true)]));
    assert_eq!(batches[2].text, Some(vec![Some("b".to_owned())]));
}

#[test]
fn columns_can_be_named_and_concatenated() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("mine.parquet");
    write(
        &path,
        vec![
            ("pos", doubles(2, 2)),
            ("speed", integers(&[3, 4])),
            ("u", doubles(2, 1)),
        ],
    );
    let names = ColumnNames {
        observation: vec!["speed".to_owned(), "pos".to_owned()],
        action: vec!["u".to_owned()],
        ..ColumnNames::default()
    };
    let source = open(
        &path,
        &OpenOptions {
            columns: names,
            ..OpenOptions::default()
        },
    )
    .unwrap();
    assert!(
        source
            .info()
            .warnings
            .iter()
            .any(|warning| warning.to_string().contains("one episode"))
    );
    let batch = TransitionReader::new(source.as_ref(), &TransitionOptions::default())
        .unwrap()
        .next();
    assert_eq!(
        batch.unwrap().unwrap().states,
        [3.0, 0.0, 0.125, 4.0, 1.0, 1.125]
    );
}

#[test]
fn a_null_action_ends_an_episode_and_nothing_else() {
    let with_null = |at: usize| {
        let mut actions = rows(4, 1);
        actions[at] = None;
        vec![
            ("episode", integers(&[0, 0, 1, 1])),
            ("obs", list(rows(4, 2))),
            ("act", list(actions)),
        ]
    };
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("n_plus_one.parquet");
    write(&path, with_null(1));
    let source = opened(&path);
    conformance::check_source(source.as_ref()).unwrap();
    let episodes = source.episodes().unwrap();
    assert_eq!((episodes[0].length, episodes[0].has_final_obs), (1, true));
    assert_eq!((episodes[1].length, episodes[1].has_final_obs), (2, false));
    assert!(matches!(
        failure(with_null(2)),
        DatasetError::NullValue { row: 2, .. }
    ));
}

#[test]
fn a_null_reward_inside_an_episode_is_no_final_observation() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("sparse.parquet");
    let rewards: ArrayRef = Arc::new(Float64Array::from(vec![None, None, Some(1.0)]));
    write(
        &path,
        vec![
            ("obs", list(rows(3, 2))),
            ("act", list(rows(3, 1))),
            ("reward", rewards),
        ],
    );
    let error = opened(&path).episodes().unwrap_err();
    assert_eq!(
        error.cause().to_string(),
        "row 0 of column \"reward\" is null or holds a null"
    );
}

#[test]
fn faults_name_column_and_row() {
    let good = || ("act", list(rows(3, 1)));
    let mut ragged = rows(3, 2);
    ragged[2] = Some(vec![Some(1.0)]);
    let error = failure(vec![("obs", list(ragged)), good()]).to_string();
    assert_eq!(error, "row 2 of column \"obs\" has 1 values, expected 2");
    let mut holed = rows(3, 2);
    holed[1] = Some(vec![Some(1.0), None]);
    let error = failure(vec![("obs", list(holed)), good()]).to_string();
    assert_eq!(error, "row 1 of column \"obs\" is null or holds a null");
    let torn = ("episode", integers(&[0, 1, 0]));
    let error = failure(vec![torn, ("obs", list(rows(3, 2))), good()]).to_string();
    assert_eq!(
        error,
        "row 2: episode 0 in column \"episode\" comes back after other episodes"
    );
    let steps = ("step", integers(&[0, 2, 1]));
    let error = failure(vec![steps, ("obs", list(rows(3, 2))), good()]);
    assert!(
        matches!(
            error,
            DatasetError::StepOrder {
                row: 2,
                previous: 2,
                actual: 1,
                ..
            }
        ),
        "{error:?}"
    );
    let error = failure(vec![("obs", list(vec![])), ("act", list(vec![]))]);
    assert!(matches!(error, DatasetError::Empty), "{error:?}");
    let large = ("obs", integers(&[0, 1, (1 << 53) + 1]));
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("large.parquet");
    write(&path, vec![large, good()]);
    let source = opened(&path);
    let result = TransitionReader::new(source.as_ref(), &TransitionOptions::default())
        .unwrap()
        .next();
    assert!(matches!(
        result,
        Some(Err(DatasetError::InexactInteger { row: 2, .. }))
    ));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    #[test]
    fn any_table_survives_parquet(
        lengths in prop::collection::vec(1usize..9, 1..6),
        values in prop::collection::vec(any::<f32>(), 40 * 2),
    ) {
        let episodes: Vec<i64> =
            lengths.iter().enumerate().flat_map(|(e, &n)| vec![i64::try_from(e).unwrap(); n]).collect();
        let observations = values.chunks_exact(2).take(episodes.len());
        let observations = observations.map(|row| Some(row.iter().copied().map(Some).collect())).collect();
        let n = u16::try_from(episodes.len()).unwrap();
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("any.parquet");
        write(&path, vec![("episode", integers(&episodes)), ("obs", list(observations)), ("act", doubles(n, 3))]);
        let source = opened(&path);
        // NaN is not equal to itself, so compare where there is none.
        prop_assume!(values.iter().all(|value| !value.is_nan()));
        conformance::check_source(source.as_ref()).unwrap();
        conformance::check_parquet_round_trip(source.as_ref(), dir.path()).unwrap();
    }
}

#[cfg(not(feature = "hdf5"))]
#[test]
fn a_build_without_hdf5_says_so() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("hopper.hdf5");
    std::fs::write(&path, b"\x89HDF\r\n\x1a\n........").unwrap();
    let error = open(&path, &OpenOptions::default()).err().unwrap();
    assert!(
        matches!(
            error.cause(),
            DatasetError::MissingFeature {
                feature: "hdf5",
                ..
            }
        ),
        "{error:?}"
    );
}

#[test]
fn episodes_named_by_text_are_numbered_as_they_appear() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("rollout.parquet");
    let names = |names: [&str; 5]| Arc::new(StringArray::from(names.to_vec())) as ArrayRef;
    let columns = |text| {
        vec![
            ("episode_id", names(text)),
            ("obs", list(rows(5, 2))),
            ("act", list(rows(5, 1))),
        ]
    };
    write(&path, columns(["zeta", "zeta", "alpha", "alpha", "9"]));
    let source = opened(&path);
    conformance::check_source(source.as_ref()).unwrap();
    let episodes = source.episodes().unwrap();
    let numbered: Vec<(i64, u64)> = episodes
        .iter()
        .map(|episode| (episode.episode_index, episode.length))
        .collect();
    assert_eq!(numbered, [(0, 2), (1, 2), (2, 1)]);
    let with_names = TransitionOptions {
        text_column: Some("info.episode_id".to_owned()),
        ..TransitionOptions::default()
    };
    let mut batches = TransitionReader::new(source.as_ref(), &with_names).unwrap();
    let batch = batches.next().unwrap().unwrap();
    let text: Vec<String> = batch.text.unwrap().into_iter().flatten().collect();
    assert_eq!(text, ["zeta", "zeta", "alpha", "alpha", "9"]);
    let back = failure(columns(["a", "b", "a", "a", "a"]));
    assert!(
        matches!(
            back,
            DatasetError::NonContiguousEpisode {
                row: 2,
                episode: 0,
                ..
            }
        ),
        "{back:?}"
    );
}

#[test]
fn row_groups_come_in_order_and_only_those_that_are_needed() {
    const EPISODES: i64 = 120;
    const STEPS: i64 = 1_000;
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("groups.parquet");
    let schema = Arc::new(Schema::new(vec![
        Field::new(schema::EPISODE_INDEX, DataType::Int64, false),
        Field::new(schema::STEP_INDEX, DataType::Int64, false),
        Field::new("observation", DataType::Int64, false),
        Field::new("action", DataType::Int64, false),
    ]));
    let mut sink = ParquetSink::create(&path, Arc::clone(&schema)).unwrap();
    for episode in 0..EPISODES {
        let rows: ArrayRef = Arc::new(Int64Array::from_iter_values(
            episode * STEPS..(episode + 1) * STEPS,
        ));
        let number = Arc::new(Int64Array::from_value(episode, 1_000));
        let steps = Arc::new(Int64Array::from_iter_values(0..STEPS));
        let columns: Vec<ArrayRef> = vec![number, steps, Arc::clone(&rows), rows];
        sink.write(&RecordBatch::try_new(Arc::clone(&schema), columns).unwrap())
            .unwrap();
    }
    Box::new(sink).finish().unwrap();
    let source = open(&path, &OpenOptions::default()).unwrap();
    let observations = |episodes: Option<Vec<i64>>| -> Vec<i64> {
        let scan = Scan {
            episodes,
            batch_rows: 700,
            ..Scan::default()
        };
        let mut values = Vec::new();
        for batch in source.scan(&scan).unwrap() {
            let batch = batch.unwrap();
            values.extend_from_slice(batch["observation"].as_primitive::<Int64Type>().values());
        }
        values
    };
    let all: Vec<i64> = (0..EPISODES * STEPS).collect();
    assert_eq!(observations(None), all);
    let chosen = observations(Some(vec![119, 3]));
    assert_eq!(chosen, [&all[3_000..4_000], &all[119_000..]].concat());

    // A damaged group is not touched when another one is read, and not passed over when it is.
    let mut bytes = std::fs::read(&path).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle..middle + 2_000].fill(0xFF);
    std::fs::write(&path, bytes).unwrap();
    assert_eq!(observations(Some(vec![3])), all[3_000..4_000]);
    let damaged = source.scan(&Scan::default()).unwrap();
    assert!(damaged.into_iter().any(|batch| batch.is_err()));
}
