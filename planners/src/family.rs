//! One algorithm as the registry knows it: how it is trained and loaded.

use std::fmt;
use std::path::{Path, PathBuf};

use ksim_datasets::DatasetSource;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use crate::error::PlannerError;
use crate::planner::Planner;

/// An algorithm that makes planners: trains them on a dataset into a run folder, and loads them from one.
pub trait PlannerFamily: Send + Sync {
    /// Stable id, such as `diffuser`: the value on the command line and the key in a run's manifest.
    fn id(&self) -> &'static str;

    /// One line on what it does.
    fn summary(&self) -> &'static str;

    /// Names of its presets, the default first; empty if there is nothing to choose.
    fn presets(&self) -> &[Preset] {
        &[]
    }

    /// Trains on a dataset and writes a run folder, which [`PlannerFamily::load`] takes. A run that was stopped goes
    /// on where its last checkpoint is, with [`TrainRequest::resume`].
    ///
    /// # Errors
    /// Dataset and preset do not go together, the run folder holds another run, the loss is no number any more, or
    /// a file could not be read or written. The last good checkpoint stays.
    fn train(
        &self,
        request: &TrainRequest,
        data: &dyn DatasetSource,
        run: &Path,
        observer: &mut dyn TrainObserver,
    ) -> Result<TrainSummary, PlannerError>;

    /// Loads a planner from a run folder.
    ///
    /// # Errors
    /// The folder holds no planner of this family, or the options do not fit it. One whose training is not finished is
    /// loaded as it is; [`crate::run_info`] tells.
    fn load(&self, run: &Path, options: &LoadOptions) -> Result<Box<dyn Planner>, PlannerError>;
}

/// A named set of hyperparameters.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Preset {
    /// Its name, such as `cpu`.
    pub name: &'static str,
    /// One line on what it is for.
    pub summary: &'static str,
}

/// What to train, and how.
#[derive(Debug, Clone, PartialEq)]
pub struct TrainRequest {
    /// Name of the preset; `None` takes the family's first.
    pub preset: Option<String>,
    /// Settings in place of the preset's, as a table of the names in the run's `manifest.json`, nested as there.
    /// Unknown names are refused.
    pub overrides: Map<String, Value>,
    /// Seed of everything that is drawn.
    pub seed: u64,
    /// Name of the backend, `native` or `torch`; `None` takes the first that this build has.
    pub backend: Option<String>,
    /// Device, such as `cpu` or `cuda`; `None` takes the backend's default.
    pub device: Option<String>,
    /// Threads of the backend; `None` takes all.
    pub n_threads: Option<usize>,
    /// A finished run on the same dataset whose networks are taken over instead of trained, as far as the family
    /// has them too: a Diffuser for the other two.
    pub base: Option<PathBuf>,
    /// Go on with the run in the folder. Preset, overrides, seed and dataset must be those it was begun with.
    pub resume: bool,
    /// Updates between two checkpoints; `None` takes the preset's.
    pub checkpoint_interval: Option<u64>,
}

impl Default for TrainRequest {
    fn default() -> Self {
        Self {
            preset: None,
            overrides: Map::new(),
            seed: 0,
            backend: None,
            device: None,
            n_threads: None,
            base: None,
            resume: false,
            checkpoint_interval: None,
        }
    }
}

/// How far a training is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrainProgress<'a> {
    /// What is being trained, such as `diffusion` or `curiosity`.
    pub phase: &'a str,
    /// Updates done in this phase, from 1.
    pub update: u64,
    /// Updates of this phase in all.
    pub n_updates: u64,
    /// Loss of the phase's first network in this update.
    pub loss: f64,
    /// Updates done in all phases.
    pub total_update: u64,
    /// Updates of all phases in all.
    pub total_updates: u64,
}

/// What an observer wants next.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TrainControl {
    /// Train on.
    Continue,
    /// Write a checkpoint and return.
    Stop,
}

/// Watches a training and may stop it.
pub trait TrainObserver {
    /// Called after every update.
    fn progress(&mut self, progress: &TrainProgress<'_>) -> TrainControl;

    /// Called when a checkpoint has been written.
    fn checkpoint(&mut self, _path: &Path, _total_update: u64) {}

    /// Called before every part of something that a training makes between two updates, such as plans to learn from:
    /// `done` of `of` parts are there. `Stop` ends the training at the checkpoint before.
    fn preparing(&mut self, _what: &str, _done: u64, _of: u64) -> TrainControl {
        TrainControl::Continue
    }

    /// Something the user ought to know that does not stop the training.
    fn notice(&mut self, _message: &str) {}
}

/// An observer that looks away.
#[derive(Debug, Clone, Copy, Default)]
pub struct SilentObserver;

impl TrainObserver for SilentObserver {
    fn progress(&mut self, _progress: &TrainProgress<'_>) -> TrainControl {
        TrainControl::Continue
    }
}

/// What a training came to.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct TrainSummary {
    /// Whether all updates are done; `false` after [`TrainControl::Stop`].
    pub finished: bool,
    /// Updates done in all phases, earlier sessions included.
    pub total_update: u64,
    /// Updates of all phases in all.
    pub total_updates: u64,
    /// Mean loss over the last updates of every network, in the order of training.
    pub final_losses: Vec<(String, f64)>,
}

/// How numbers are computed during planning.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Precision {
    /// 32-bit floating point.
    #[default]
    F32,
    /// 16-bit brain floating point, where the backend has it.
    Bf16,
}

impl fmt::Display for Precision {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::F32 => "f32",
            Self::Bf16 => "bf16",
        })
    }
}

/// How a loaded planner plans. What is `None` is as the run's preset says.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct LoadOptions {
    /// Name of the backend, `native` or `torch`; `None` takes the first that this build has.
    pub backend: Option<String>,
    /// Device, such as `cpu` or `cuda`.
    pub device: Option<String>,
    /// Threads of the backend.
    pub n_threads: Option<usize>,
    /// How numbers are computed.
    pub precision: Precision,
    /// Candidates per slot, at least 1.
    pub n_candidates: Option<usize>,
    /// Denoising steps of a plan, at least 1.
    pub sampling_steps: Option<usize>,
    /// Weight of guidance w_cg, ≥ 0.
    pub guidance_weight: Option<f64>,
    /// Weight of curiosity λ, ≥ 0; 0 is Diffuser.
    pub curiosity_weight: Option<f64>,
    /// Factor of the initial noise, ≥ 0.
    pub temperature: Option<f64>,
    /// Share of the diffusion time at which a plan starts from the one before, in (0, 1]; `None` starts from noise.
    pub warm_start: Option<f64>,
    /// Steps executed between two plans, by which a warm start shifts the plan before; `None` is 1.
    pub replan_interval: Option<usize>,
}
