//! Everything a training goes on from, as one file.

use std::collections::BTreeMap;
use std::path::Path;

use serde::{Deserialize, Serialize};

use super::history::History;
use crate::error::PlannerError;
use crate::nets::{TrainingState, Weights};
use crate::tensor_file::TensorFile;

/// Name of the file in a run folder.
pub(crate) const CHECKPOINT_FILE: &str = "checkpoint.safetensors";
/// Version of the format; a file of another one is refused.
const FORMAT: u32 = 1;

/// Where a training stands.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct Checkpoint {
    /// Phases done.
    pub(crate) n_phases: usize,
    /// Updates done in the phase after them.
    pub(crate) update: u64,
    /// Networks of the phases done, and random targets.
    pub(crate) finished: BTreeMap<String, Weights>,
    /// Updates of the networks of the phases done.
    pub(crate) n_updates: BTreeMap<String, u64>,
    /// Networks under training.
    pub(crate) learning: BTreeMap<String, TrainingState>,
    /// Losses so far.
    pub(crate) history: History,
}

/// What stands beside the tensors. The random numbers of an update follow from seed and counters: there is no other
/// state of a generator.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Meta {
    format: u32,
    /// Identifies family, settings, seed and dataset.
    run: String,
    seed: u64,
    generator: String,
    n_phases: usize,
    update: u64,
    finished: BTreeMap<String, u64>,
    learning: BTreeMap<String, u64>,
    history: History,
}

impl Checkpoint {
    /// Writes the file. It appears whole or not at all.
    ///
    /// # Errors
    /// The file cannot be written; what was there stays.
    pub(crate) fn write(&self, path: &Path, run: &str, seed: u64) -> Result<(), PlannerError> {
        let mut file = TensorFile::default();
        for (name, weights) in &self.finished {
            file.insert(&format!("{name}.final"), weights);
        }
        for (name, state) in &self.learning {
            file.insert(&format!("{name}.weights"), &state.weights);
            file.insert(&format!("{name}.ema"), &state.ema);
            file.insert(&format!("{name}.first-moment"), &state.first_moment);
            file.insert(&format!("{name}.second-moment"), &state.second_moment);
        }
        let updates = |name: &String| self.n_updates.get(name).copied().unwrap_or(0);
        let meta = Meta {
            format: FORMAT,
            run: run.to_owned(),
            seed,
            generator: "ChaCha8, a stream for each purpose and update".to_owned(),
            n_phases: self.n_phases,
            update: self.update,
            finished: self
                .finished
                .keys()
                .map(|name| (name.clone(), updates(name)))
                .collect(),
            learning: self
                .learning
                .iter()
                .map(|(name, state)| (name.clone(), state.n_updates))
                .collect(),
            history: self.history.clone(),
        };
        file.write(path, &meta)
    }

    /// Reads the file of the run that `run` identifies.
    ///
    /// # Errors
    /// The file cannot be read, is damaged, or of another run or version.
    pub(crate) fn read(path: &Path, run: &str) -> Result<Self, PlannerError> {
        let (mut file, meta): (TensorFile, Meta) = TensorFile::read(path)?;
        let mismatch = |what: &str, expected: String, found: String| PlannerError::Mismatch {
            path: path.to_owned(),
            what: what.to_owned(),
            expected,
            found,
        };
        if meta.format != FORMAT {
            return Err(mismatch(
                "the format",
                FORMAT.to_string(),
                meta.format.to_string(),
            ));
        }
        if meta.run != run {
            return Err(mismatch(
                "the run (planner, settings, seed and dataset)",
                format!("that of the manifest ({run})"),
                meta.run,
            ));
        }
        let mut finished = BTreeMap::new();
        for name in meta.finished.keys() {
            finished.insert(name.clone(), file.take(&format!("{name}.final")));
        }
        let mut learning = BTreeMap::new();
        for (name, &n_updates) in &meta.learning {
            let state = TrainingState {
                weights: file.take(&format!("{name}.weights")),
                ema: file.take(&format!("{name}.ema")),
                first_moment: file.take(&format!("{name}.first-moment")),
                second_moment: file.take(&format!("{name}.second-moment")),
                n_updates,
            };
            learning.insert(name.clone(), state);
        }
        if let Some(name) = file.tensors.keys().next() {
            return Err(mismatch(
                "a tensor",
                "none beside the networks'".to_owned(),
                name.clone(),
            ));
        }
        Ok(Self {
            n_phases: meta.n_phases,
            update: meta.update,
            finished,
            n_updates: meta.finished,
            learning,
            history: meta.history,
        })
    }
}
