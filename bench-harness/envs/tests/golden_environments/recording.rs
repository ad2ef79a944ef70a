//! Recordings of the published environments: those in `$KSIM_GOLDEN/environments`, by default a small part of them in
//! the repository.

use std::fs::File;
use std::path::{Path, PathBuf};

use arrow::array::{Array, AsArray, RecordBatch};
use arrow::datatypes::{Float64Type, Int32Type};
use ksim_envs::EnvironmentError;
use ksim_envs::mujoco::{self, MujocoEnvironment};
use ksim_envs::registry;
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
use serde_json::Value;

/// The folder of the environments' recordings.
pub(crate) fn folder() -> PathBuf {
    match std::env::var_os("KSIM_GOLDEN") {
        Some(root) => PathBuf::from(root).join("environments"),
        None => {
            Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/fixtures/golden/environments")
        }
    }
}

/// Files of an extension in one of the folders below [`folder`], sorted; none if there is no such folder.
pub(crate) fn files(below: &str, extension: &str) -> Vec<PathBuf> {
    let Ok(entries) = std::fs::read_dir(folder().join(below)) else {
        return Vec::new();
    };
    let mut paths: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
    paths.retain(|path| path.extension().is_some_and(|found| found == extension));
    paths.sort();
    paths
}

/// A row: what a step was given and what there was after it. The row of step 0 is the state after the reset.
#[derive(Debug, Clone)]
pub(crate) struct Row {
    pub(crate) action: Vec<f64>,
    pub(crate) obs: Vec<f64>,
    pub(crate) reward: f64,
    pub(crate) terminated: bool,
    pub(crate) truncated: bool,
    pub(crate) success: Option<bool>,
    pub(crate) qpos: Vec<f64>,
    pub(crate) qvel: Vec<f64>,
    pub(crate) qacc_warmstart: Vec<f64>,
    pub(crate) torso_xpos: Vec<f64>,
    /// Empty where there is none.
    pub(crate) goal: Vec<f64>,
    /// Forward, survive, control and contact reward, where the version reports them.
    pub(crate) terms: [Option<f64>; 4],
}

/// A file of episodes of one environment.
pub(crate) struct Recording {
    pub(crate) name: String,
    pub(crate) env_id: String,
    pub(crate) metadata: Value,
    pub(crate) episodes: Vec<Vec<Row>>,
}

impl Recording {
    pub(crate) fn open(path: &Path) -> Self {
        let reader = ParquetRecordBatchReaderBuilder::try_new(File::open(path).unwrap()).unwrap();
        let metadata = &reader.schema().metadata()["golden"];
        let metadata: Value = serde_json::from_str(metadata).unwrap();
        let mut episodes: Vec<Vec<Row>> = Vec::new();
        for batch in reader.build().unwrap() {
            let batch = batch.unwrap();
            let steps = column(&batch, "step")
                .unwrap()
                .as_primitive::<Int32Type>()
                .clone();
            for row in 0..batch.num_rows() {
                if steps.value(row) == 0 {
                    episodes.push(Vec::new());
                }
                episodes.last_mut().unwrap().push(read_row(&batch, row));
            }
        }
        if metadata["env_kwargs"]["use_contact_forces"] == true {
            // What Ant-v4 then calls `reward_ctrl` is the contact's.
            for row in episodes.iter_mut().flatten() {
                row.terms.swap(2, 3);
            }
        }
        Self {
            name: path.file_stem().unwrap().to_string_lossy().into_owned(),
            env_id: metadata["env_id"].as_str().unwrap().to_owned(),
            metadata,
            episodes,
        }
    }

    /// Every recording of an environment that we have.
    pub(crate) fn all() -> Vec<Self> {
        let mut paths = files("", "parquet");
        paths.extend(files("extra", "parquet"));
        let mut recordings: Vec<Self> = paths.iter().map(|path| Self::open(path)).collect();
        recordings.retain(|recording| match recording.make() {
            Err(EnvironmentError::UnknownId { .. }) => {
                let is_known = registry::find(&recording.env_id).is_ok();
                assert!(!is_known, "{} is not replayed", recording.name);
                false
            }
            Err(error) => panic!("{}: {error}", recording.name),
            Ok(_) => true,
        });
        assert!(
            !recordings.is_empty(),
            "no recordings in {}",
            folder().display()
        );
        recordings
    }

    pub(crate) fn make(&self) -> Result<Box<dyn MujocoEnvironment>, EnvironmentError> {
        let limit = self.metadata["max_episode_steps"].as_u64().unwrap() as usize;
        let kwargs = self.metadata["env_kwargs"].as_object().unwrap();
        mujoco::make(&self.env_id, kwargs, Some(limit))
    }

    pub(crate) fn is_maze(&self) -> bool {
        self.env_id.starts_with("AntMaze")
    }

    /// Whether its runs tell this machine's last bits from others': another math library leaves the recording of
    /// HalfCheetah for good within 200 steps, but perhaps not within 60.
    pub(crate) fn is_probe(&self) -> bool {
        self.env_id.starts_with("HalfCheetah") && self.episodes.iter().all(|rows| rows.len() > 200)
    }

    /// Steps for which a free run stays within 1e-6 of the recording on any machine.
    pub(crate) fn horizon(&self) -> usize {
        match self.env_id.split(['-', '_']).next().unwrap() {
            "HalfCheetah" => 40,
            "Ant" | "AntMaze" => 60,
            _ => 200,
        }
    }
}

fn column<'a>(batch: &'a RecordBatch, name: &str) -> Option<&'a dyn Array> {
    batch.column_by_name(name).map(AsRef::as_ref)
}

fn number(batch: &RecordBatch, name: &str, row: usize) -> Option<f64> {
    let numbers = column(batch, name)?.as_primitive::<Float64Type>();
    numbers.is_valid(row).then(|| numbers.value(row))
}

fn flag(batch: &RecordBatch, name: &str, row: usize) -> Option<bool> {
    let flags = column(batch, name)?.as_boolean();
    flags.is_valid(row).then(|| flags.value(row))
}

fn list(batch: &RecordBatch, name: &str, row: usize) -> Vec<f64> {
    column(batch, name).map_or(Vec::new(), |lists| {
        let numbers = lists.as_list::<i32>().value(row);
        numbers.as_primitive::<Float64Type>().values().to_vec()
    })
}

fn read_row(batch: &RecordBatch, row: usize) -> Row {
    Row {
        action: list(batch, "action", row),
        obs: list(batch, "obs", row),
        reward: number(batch, "reward", row).unwrap(),
        terminated: flag(batch, "terminated", row).unwrap(),
        truncated: flag(batch, "truncated", row).unwrap(),
        success: flag(batch, "success", row),
        qpos: list(batch, "qpos", row),
        qvel: list(batch, "qvel", row),
        qacc_warmstart: list(batch, "qacc_warmstart", row),
        torso_xpos: list(batch, "torso_xpos", row),
        goal: list(batch, "desired_goal", row),
        terms: ["forward", "survive", "ctrl", "contact"]
            .map(|term| number(batch, &format!("reward_{term}"), row)),
    }
}
