//! The run folder of a baseline: a manifest, and the demonstrations.

use std::collections::HashMap;
use std::fs;
use std::io;
use std::path::Path;

use safetensors::tensor::TensorView;
use safetensors::{Dtype, SafeTensorError, SafeTensors};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use super::demonstrations::Demonstrations;
use crate::error::PlannerError;
use crate::family::{TrainRequest, TrainSummary};
use crate::run_folder::{DEMONSTRATIONS, refuse_leftovers};
use crate::tensor_file::write_atomically;

/// Names of the files in a run folder.
const MANIFEST: &str = "manifest.json";
/// Version of the format.
const FORMAT: u32 = 1;
/// Key of the dataset's id in the metadata of the tensors.
const NAME: &str = "dataset";

/// What a run is.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Manifest<T> {
    format: u32,
    family: String,
    preset: String,
    seed: u64,
    pub(super) config: T,
    pub(super) dataset: Dataset,
    program: Program,
}

/// What it was made of.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Dataset {
    id: String,
    fingerprint: String,
    pub(super) observation_dim: usize,
    action_dim: usize,
    n_episodes: usize,
    n_steps: usize,
}

/// What it was made with.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
struct Program {
    name: String,
    version: String,
}

impl<T: DeserializeOwned> Manifest<T> {
    /// Reads the manifest of a run of this family.
    pub(super) fn read(run: &Path, family: &str) -> Result<Self, PlannerError> {
        let path = run.join(MANIFEST);
        let mismatch = |what: &str, found: &str, expected: &str| PlannerError::Mismatch {
            path: path.clone(),
            what: what.to_owned(),
            expected: expected.to_owned(),
            found: found.to_owned(),
        };
        let found = crate::family_of(run)?;
        if found != family {
            return Err(mismatch("the planner", &found, family));
        }
        let text = fs::read_to_string(&path).map_err(|source| PlannerError::File {
            path: path.clone(),
            action: "read",
            source,
        })?;
        let manifest: Self = serde_json::from_str(&text).map_err(|source| PlannerError::Json {
            path: path.clone(),
            source,
        })?;
        match manifest.format {
            FORMAT => Ok(manifest),
            other => Err(mismatch(
                "the format",
                &other.to_string(),
                &FORMAT.to_string(),
            )),
        }
    }
}

/// Refuses a folder with another run before anything is read for it.
pub(super) fn check_folder<T: Serialize + DeserializeOwned>(
    family: &str,
    request: &TrainRequest,
    run: &Path,
) -> Result<Option<Manifest<T>>, PlannerError> {
    let path = run.join(MANIFEST);
    let mismatch = |what: &str, expected: &str, found: String| PlannerError::Mismatch {
        path: path.clone(),
        what: what.to_owned(),
        expected: expected.to_owned(),
        found,
    };
    match (path.exists(), request.resume) {
        (false, false) => refuse_leftovers(run).map(|()| None),
        (false, true) => Err(mismatch(
            "the run to go on with",
            "a manifest",
            "missing".to_owned(),
        )),
        (true, false) => {
            let found = format!("a run of {}", crate::family_of(run)?);
            Err(mismatch("the folder", "no run", found))
        }
        (true, true) => Manifest::read(run, family).map(Some),
    }
}

impl<T: Serialize> Manifest<T> {
    /// Whether a run is the one that was asked for.
    fn check_same(&self, asked: &Manifest<&T>, run: &Path) -> Result<(), PlannerError> {
        let config = |config: &T| serde_json::to_string(config).unwrap_or_default();
        let pairs = [
            ("the seed", self.seed.to_string(), asked.seed.to_string()),
            ("the settings", config(&self.config), config(asked.config)),
            (
                "the dataset",
                self.dataset.fingerprint.clone(),
                asked.dataset.fingerprint.clone(),
            ),
        ];
        match pairs.into_iter().find(|(_, found, asked)| found != asked) {
            None => Ok(()),
            Some((what, found, asked)) => Err(PlannerError::Mismatch {
                path: run.join(MANIFEST),
                what: format!("{what} of the run"),
                expected: format!("{asked} as asked for"),
                found,
            }),
        }
    }
}

/// Writes a run, the manifest last: a folder without one is no run.
pub(super) fn write<T: Serialize + DeserializeOwned>(
    family: &str,
    request: &TrainRequest,
    config: &T,
    demonstrations: &Demonstrations,
    run: &Path,
    keeps_demonstrations: bool,
) -> Result<TrainSummary, PlannerError> {
    let begun = check_folder::<T>(family, request, run)?;
    let path = run.join(MANIFEST);
    let manifest = Manifest {
        format: FORMAT,
        family: family.to_owned(),
        preset: "default".to_owned(),
        seed: request.seed,
        config,
        dataset: Dataset {
            id: demonstrations.name().to_owned(),
            fingerprint: demonstrations.fingerprint(),
            observation_dim: demonstrations.observation_dim(),
            action_dim: demonstrations.action_dim(),
            n_episodes: demonstrations.n_episodes(),
            n_steps: demonstrations.n_steps(),
        },
        program: Program {
            name: env!("CARGO_PKG_NAME").to_owned(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
        },
    };
    if let Some(begun) = begun {
        begun.check_same(&manifest, run)?;
    }
    fs::create_dir_all(run).map_err(|source| PlannerError::File {
        path: run.to_owned(),
        action: "create",
        source,
    })?;
    if keeps_demonstrations {
        keep(demonstrations, &run.join(DEMONSTRATIONS))?;
    }
    let json = serde_json::to_string_pretty(&manifest).map_err(|source| PlannerError::Json {
        path: path.clone(),
        source,
    })?;
    write_atomically(&path, |file| fs::write(file, json + "\n"))?;
    Ok(TrainSummary {
        finished: true,
        total_update: 0,
        total_updates: 0,
        final_losses: Vec::new(),
    })
}

/// Writes demonstrations as tensors: observations and rewards as f64, actions as f32, lengths of episodes as u64.
fn keep(demonstrations: &Demonstrations, path: &Path) -> Result<(), PlannerError> {
    let n_steps = demonstrations.n_steps();
    let of_f64 = |values: &[f64]| {
        values
            .iter()
            .flat_map(|value| value.to_le_bytes())
            .collect()
    };
    let observations: Vec<u8> = of_f64(&demonstrations.observations);
    let rewards: Vec<u8> = of_f64(&demonstrations.rewards);
    let actions: Vec<u8> = demonstrations
        .actions
        .iter()
        .flat_map(|value| value.to_le_bytes())
        .collect();
    let lengths = demonstrations.episodes.iter().map(|rows| rows.len() as u64);
    let lengths: Vec<u8> = lengths.flat_map(u64::to_le_bytes).collect();
    let [width, action_dim] = [demonstrations.observation_dim, demonstrations.action_dim];
    let parts = [
        ("actions", Dtype::F32, vec![n_steps, action_dim], &actions),
        (
            "lengths",
            Dtype::U64,
            vec![demonstrations.n_episodes()],
            &lengths,
        ),
        (
            "observations",
            Dtype::F64,
            vec![n_steps, width],
            &observations,
        ),
        (
            "rewards",
            Dtype::F64,
            vec![demonstrations.rewards.len()],
            &rewards,
        ),
    ];
    let damaged = |source| PlannerError::Safetensors {
        path: path.to_owned(),
        source,
    };
    let mut views = Vec::with_capacity(parts.len());
    for (name, dtype, shape, bytes) in parts {
        views.push((name, TensorView::new(dtype, shape, bytes).map_err(damaged)?));
    }
    let metadata = HashMap::from([(NAME.to_owned(), demonstrations.name().to_owned())]);
    write_atomically(path, |file| {
        let written = safetensors::serialize_to_file(views, Some(metadata), file);
        written.map_err(|source| match source {
            SafeTensorError::IoError(source) => source,
            other => io::Error::other(other),
        })
    })
}

/// Reads what [`keep`] wrote.
pub(super) fn read(path: &Path) -> Result<Demonstrations, PlannerError> {
    let bytes = fs::read(path).map_err(|source| PlannerError::File {
        path: path.to_owned(),
        action: "read",
        source,
    })?;
    let damaged = |source| PlannerError::Safetensors {
        path: path.to_owned(),
        source,
    };
    let tensors = SafeTensors::deserialize(&bytes).map_err(damaged)?;
    let (_, header) = SafeTensors::read_metadata(&bytes).map_err(damaged)?;
    let metadata = header.metadata().as_ref();
    let name = metadata
        .and_then(|metadata| metadata.get(NAME))
        .cloned()
        .unwrap_or_default();
    let tensor = |name: &str, dtype: Dtype| -> Result<(Vec<usize>, &[u8]), PlannerError> {
        let tensor = tensors.tensor(name).map_err(damaged)?;
        match tensor.dtype() == dtype {
            true => Ok((tensor.shape().to_vec(), tensor.data())),
            false => Err(PlannerError::Mismatch {
                path: path.to_owned(),
                what: format!("the type of tensor \"{name}\""),
                expected: format!("{dtype:?}"),
                found: format!("{:?}", tensor.dtype()),
            }),
        }
    };
    let (observed, observations) = tensor("observations", Dtype::F64)?;
    let (acted, actions) = tensor("actions", Dtype::F32)?;
    let (_, rewards) = tensor("rewards", Dtype::F64)?;
    let (_, lengths) = tensor("lengths", Dtype::U64)?;
    let of_f64 = |bytes: &[u8]| -> Vec<f64> {
        let (numbers, _) = bytes.as_chunks::<8>();
        numbers
            .iter()
            .map(|bytes| f64::from_le_bytes(*bytes))
            .collect()
    };
    let (actions, _) = actions.as_chunks::<4>();
    let (lengths, _) = lengths.as_chunks::<8>();
    let length =
        |bytes: &[u8; 8]| usize::try_from(u64::from_le_bytes(*bytes)).unwrap_or(usize::MAX);
    let width = |shape: &[usize]| shape.get(1).copied().unwrap_or(0);
    let read = Demonstrations::from_parts(
        name,
        [width(&observed), width(&acted)],
        of_f64(observations),
        actions
            .iter()
            .map(|bytes| f32::from_le_bytes(*bytes))
            .collect(),
        of_f64(rewards),
        &lengths.iter().map(length).collect::<Vec<_>>(),
    );
    read.ok_or_else(|| PlannerError::Mismatch {
        path: path.to_owned(),
        what: "its content".to_owned(),
        expected: "finite numbers, as many as the lengths of the episodes say".to_owned(),
        found: format!(
            "shapes {observed:?} and {acted:?} for {} episodes",
            lengths.len()
        ),
    })
}
