//! The environments of datasets as they are opened: a converted Minari dataset, a D4RL file, and one that says nothing.

#![expect(clippy::unwrap_used, reason = "a test stops where a step fails")]

use std::collections::HashMap;
use std::fs::File;
use std::path::Path;
use std::sync::Arc;

use arrow::array::{ArrayRef, Float64Array, Int64Array, RecordBatch};
use arrow::datatypes::{DataType, Field, Schema};
use ksim_datasets::{OpenOptions, open, schema};
use ksim_envs::EnvironmentError;
use ksim_envs::maze::Maze;
use ksim_envs::registry::{DatasetEnvironment, for_d4rl, for_dataset};
use parquet::arrow::ArrowWriter;
use serde_json::{Value, json};

/// The environment of a canonical Parquet file of one step, with these entries in its schema.
fn environment_of(
    name: &str,
    entries: &[(&str, String)],
) -> Result<DatasetEnvironment, EnvironmentError> {
    let path = Path::new(env!("CARGO_TARGET_TMPDIR")).join(name);
    let field = |name: &str, data_type| Field::new(name, data_type, false);
    let fields = vec![
        field(schema::EPISODE_INDEX, DataType::Int64),
        field(schema::STEP_INDEX, DataType::Int64),
        field(schema::OBSERVATION, DataType::Float64),
        field(schema::ACTION, DataType::Float64),
    ];
    let entries = entries
        .iter()
        .map(|(key, value)| ((*key).to_owned(), value.clone()));
    let schema = Schema::new_with_metadata(fields, entries.collect::<HashMap<_, _>>());
    let columns: [ArrayRef; 4] = [
        Arc::new(Int64Array::from(vec![0])),
        Arc::new(Int64Array::from(vec![0])),
        Arc::new(Float64Array::from(vec![0.5])),
        Arc::new(Float64Array::from(vec![0.5])),
    ];
    let rows = RecordBatch::try_new(Arc::new(schema), columns.to_vec()).unwrap();
    let mut writer =
        ArrowWriter::try_new(File::create(&path).unwrap(), rows.schema(), None).unwrap();
    writer.write(&rows).unwrap();
    writer.close().unwrap();
    for_dataset(open(&path, &OpenOptions::default()).unwrap().info())
}

fn maze_spec(map: &Maze) -> Value {
    json!({
        "id": "AntMaze_Medium-v4",
        "entry_point": "gymnasium_robotics.envs.maze.ant_maze_v4:AntMazeEnv",
        "max_episode_steps": 1000,
        "kwargs": {"maze_map": map.to_json(), "reset_target": false},
        "additional_wrappers": [],
    })
}

#[test]
fn a_minari_dataset_has_its_own_maze_to_judge_policies_in() {
    let maze = Maze::published("Medium").unwrap();
    let judged = Maze::evaluation("Medium").unwrap();
    let metadata = json!({
        "eval_env_spec": maze_spec(&judged).to_string(),
        "ref_min_score": 0.0,
        "ref_max_score": 609.5,
    });
    let found = environment_of(
        "minari.parquet",
        &[
            (schema::ENV_SPEC, maze_spec(&maze).to_string()),
            (schema::SOURCE_METADATA, metadata.to_string()),
        ],
    )
    .unwrap();
    assert_eq!(found.reference, Some((0.0, 609.5)));
    assert_eq!(found.request.id, "AntMaze_Medium-v4");
    assert_eq!(found.request.kwargs["maze_map"], maze.to_json());
    assert_eq!(found.evaluation.kwargs["maze_map"], judged.to_json());
}

#[test]
fn without_evaluation_and_scores_the_environment_itself_counts() {
    let spec = maze_spec(&Maze::published("Medium").unwrap()).to_string();
    let found = environment_of("plain.parquet", &[(schema::ENV_SPEC, spec)]).unwrap();
    assert_eq!((&found.evaluation, found.reference), (&found.request, None));
}

#[test]
fn a_d4rl_file_is_known_by_its_name() {
    for name in ["hopper_medium-v2.parquet", "hopper-medium-v2.parquet"] {
        assert_eq!(
            environment_of(name, &[]),
            for_d4rl("hopper-medium-v2"),
            "{name}"
        );
    }
}

#[test]
fn a_dataset_that_says_nothing_is_an_error() {
    let error = environment_of("mine.parquet", &[]).unwrap_err().to_string();
    assert_eq!(
        error,
        "mine: it does not say in which environment it was made"
    );
}
