//! Where a planner comes from, as a user writes it.

use std::fmt;
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use ksim_datasets::{DatasetError, OpenOptions, SearchRoots};
use ksim_envs::EnvironmentSpec;
use ksim_planners::baselines::{
    Choice, Demonstrations, Nearest, NearestOptions, Random, Replay, ReplayOptions,
};
use ksim_planners::process::{ProcessPlanner, Setting, Timeouts};
use ksim_planners::{LoadOptions, Planner, PlannerError, Precision, Registry, run_info};

/// What may be written, and what it is.
pub const SOURCES: &[(&str, &str)] = &[
    (
        "RUN",
        "the folder that `ksim train` wrote, or its planner.safetensors alone",
    ),
    ("random", "actions drawn from the action space"),
    (
        "nearest:DATASET",
        "goes on as the dataset did in the state nearest to the current one",
    ),
    (
        "nearest-return:DATASET",
        "of several such continuations the one with the highest recorded return",
    ),
    (
        "replay:DATASET",
        "the recorded episode that began nearest, without looking again",
    ),
    (
        "process:COMMAND",
        "another program, see docs/planner-processes.md",
    ),
];

/// Candidates of `nearest-return` where none are asked for.
const RETURN_CANDIDATES: usize = 10;
/// Actions in a plan of a baseline where it is not executed for longer.
const BASELINE_HORIZON: usize = 32;

/// A planner as it is named on a command line or in a suite.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum PlannerSource {
    /// A run folder, or the file of a planner alone.
    Run(PathBuf),
    /// [`Random`].
    Random,
    /// [`Nearest`].
    Nearest {
        /// Name or path of the dataset.
        dataset: String,
        /// Which continuation is executed.
        choice: Choice,
    },
    /// [`Replay`].
    Replay {
        /// Name or path of the dataset.
        dataset: String,
    },
    /// [`ProcessPlanner`].
    Process {
        /// The command with its arguments.
        command: String,
    },
}

/// How a planner is opened.
#[derive(Debug, Clone, PartialEq)]
pub struct OpenPlanner {
    /// For planners of a run; the number of candidates also for those without a network. The interval between two
    /// plans is [`OpenPlanner::replan_interval`].
    pub load: LoadOptions,
    /// Steps between two plans.
    pub replan_interval: NonZeroUsize,
    /// How long a process may take.
    pub timeouts: Timeouts,
}

impl Default for OpenPlanner {
    fn default() -> Self {
        Self {
            load: LoadOptions::default(),
            replan_interval: NonZeroUsize::MIN,
            timeouts: Timeouts::default(),
        }
    }
}

/// Why a planner cannot be had.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SourceError {
    /// Something that names no planner.
    #[error("no planner `{found}`: expected {}", known())]
    Unknown {
        /// What was written.
        found: String,
    },
    /// An option that this planner does not have.
    #[error("planner `{planner}` has no {option}")]
    Option {
        /// The planner.
        planner: String,
        /// The option.
        option: &'static str,
    },
    /// The dataset cannot be read.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// The planner cannot be loaded.
    #[error("planner `{planner}`")]
    Planner {
        /// The planner.
        planner: String,
        /// Why not.
        source: PlannerError,
    },
}

fn known() -> String {
    let syntax: Vec<&str> = SOURCES.iter().map(|(syntax, _)| *syntax).collect();
    syntax.join(", ")
}

impl PlannerSource {
    /// Reads what was written; opens nothing. What is none of the kinds is the path of a run.
    ///
    /// # Errors
    /// A kind without what must follow it, or nothing at all.
    pub fn parse(text: &str) -> Result<Self, SourceError> {
        let (kind, rest) = match text.split_once(':') {
            Some((kind, rest)) => (kind, Some(rest)),
            None => (text, None),
        };
        let is_known = SOURCES[1..]
            .iter()
            .any(|(syntax, _)| syntax.split(':').next() == Some(kind));
        let nearest = |dataset: &str, choice| Self::Nearest {
            dataset: dataset.to_owned(),
            choice,
        };
        match (kind, rest.filter(|rest| !rest.trim().is_empty())) {
            ("random", None) if rest.is_none() => Ok(Self::Random),
            ("nearest", Some(dataset)) => Ok(nearest(dataset, Choice::Nearest)),
            ("nearest-return", Some(dataset)) => Ok(nearest(dataset, Choice::Return)),
            ("replay", Some(dataset)) => Ok(Self::Replay {
                dataset: dataset.to_owned(),
            }),
            ("process", Some(command)) => Ok(Self::Process {
                command: command.to_owned(),
            }),
            _ if is_known || text.is_empty() => Err(SourceError::Unknown {
                found: text.to_owned(),
            }),
            _ => Ok(Self::Run(text.into())),
        }
    }

    /// Makes the planner, to act in `environment`.
    ///
    /// # Errors
    /// It cannot be loaded, or has no such option.
    pub fn open(
        &self,
        registry: &Registry,
        environment: &EnvironmentSpec,
        options: &OpenPlanner,
    ) -> Result<Box<dyn Planner>, SourceError> {
        self.refuse_options(&options.load)?;
        let failed = |source| SourceError::Planner {
            planner: self.to_string(),
            source,
        };
        let horizon = options.replan_interval.get().max(BASELINE_HORIZON);
        let n_candidates = options.load.n_candidates;
        let planner: Result<Box<dyn Planner>, PlannerError> = match self {
            Self::Run(run) => {
                let load = LoadOptions {
                    replan_interval: Some(options.replan_interval.get()),
                    ..options.load.clone()
                };
                registry.load(run, &load)
            }
            Self::Random => {
                let bounds = [&environment.action_low, &environment.action_high]
                    .map(|bounds| bounds.iter().map(|value| *value as f32).collect());
                Random::new(
                    environment.observation_dim(),
                    bounds,
                    horizon,
                    n_candidates.unwrap_or(1),
                )
                .map(boxed)
            }
            Self::Nearest { dataset, choice } => {
                let default = match choice {
                    Choice::Nearest => 1,
                    Choice::Return => RETURN_CANDIDATES,
                };
                let options = NearestOptions {
                    horizon,
                    n_candidates: n_candidates.unwrap_or(default),
                    choice: *choice,
                };
                Nearest::new(demonstrations(dataset).map_err(failed)?, options).map(boxed)
            }
            Self::Replay { dataset } => {
                let options = ReplayOptions {
                    horizon,
                    stride: options.replan_interval.get(),
                };
                Replay::new(demonstrations(dataset).map_err(failed)?, options).map(boxed)
            }
            Self::Process { command } => {
                let setting = Setting {
                    environment: environment.id.clone(),
                    observation_dim: environment.observation_dim(),
                    action_dim: environment.action_dim(),
                    action_low: environment.action_low.clone(),
                    action_high: environment.action_high.clone(),
                };
                ProcessPlanner::start(command, setting, options.timeouts).map(boxed)
            }
        };
        planner.map_err(failed)
    }

    /// Whether the training of a run is finished; `None` for what is no run, or cannot be read.
    pub fn is_finished(&self) -> Option<bool> {
        match self {
            Self::Run(run) => run_info(run).ok().map(|info| info.finished),
            _ => None,
        }
    }

    /// Refuses what only the planner of a run has.
    fn refuse_options(&self, load: &LoadOptions) -> Result<(), SourceError> {
        let counts = matches!(self, Self::Random | Self::Nearest { .. });
        let options = [
            (
                "number of candidates",
                load.n_candidates.is_some() && !counts,
            ),
            ("sampling steps", load.sampling_steps.is_some()),
            ("weight of guidance", load.guidance_weight.is_some()),
            ("weight of curiosity", load.curiosity_weight.is_some()),
            ("temperature", load.temperature.is_some()),
            ("warm start", load.warm_start.is_some()),
            ("backend", load.backend.is_some()),
            ("device", load.device.is_some()),
            ("precision", load.precision != Precision::F32),
        ];
        let is_run = matches!(self, Self::Run(_));
        match options
            .into_iter()
            .find(|(_, is_given)| *is_given && !is_run)
        {
            Some((option, _)) => Err(SourceError::Option {
                planner: self.to_string(),
                option,
            }),
            None => Ok(()),
        }
    }
}

fn boxed(planner: impl Planner + 'static) -> Box<dyn Planner> {
    Box::new(planner)
}

fn demonstrations(dataset: &str) -> Result<Arc<Demonstrations>, PlannerError> {
    let resolved = ksim_datasets::resolve(dataset, &SearchRoots::from_env())?;
    let source = ksim_datasets::open(&resolved.path, &OpenOptions::default())?;
    let read = Demonstrations::read(source.as_ref()).map(Arc::new);
    read.map_err(PlannerError::from)
}

/// The name for tables and files: without folders, of a command only the program.
impl fmt::Display for PlannerSource {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Run(path) => f.write_str(&last(path)),
            Self::Random => f.write_str("random"),
            Self::Nearest {
                dataset,
                choice: Choice::Nearest,
            } => write!(f, "nearest:{}", dataset_name(dataset)),
            Self::Nearest { dataset, .. } => write!(f, "nearest-return:{}", dataset_name(dataset)),
            Self::Replay { dataset } => write!(f, "replay:{}", dataset_name(dataset)),
            Self::Process { command } => {
                let program = command.split_whitespace().next().unwrap_or_default();
                write!(f, "process:{}", last(Path::new(program)))
            }
        }
    }
}

/// The name of a folder, or what stands for it.
fn last(path: &Path) -> String {
    let name = path.components().next_back();
    name.map_or_else(String::new, |name| {
        name.as_os_str().to_string_lossy().into_owned()
    })
}

/// A path by its last part; a dataset's name whole.
fn dataset_name(dataset: &str) -> String {
    match Path::new(dataset).exists() {
        true => Path::new(dataset).file_stem().map_or_else(
            || dataset.to_owned(),
            |stem| stem.to_string_lossy().into_owned(),
        ),
        false => dataset.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sources_are_read_and_named() {
        for (text, name) in [
            ("random", "random"),
            ("nearest:antmaze-large-play", "nearest:antmaze-large-play"),
            ("nearest-return:D4RL/x/y-v1", "nearest-return:D4RL/x/y-v1"),
            ("replay:a", "replay:a"),
            ("process:/usr/bin/python3 mine.py --x=1", "process:python3"),
            ("runs/hopper", "hopper"),
            ("./runs/nearest", "nearest"),
            (r"C:\runs\hopper", r"C:\runs\hopper"),
        ] {
            assert_eq!(PlannerSource::parse(text).unwrap().to_string(), name);
        }
    }

    #[test]
    fn kinds_need_what_follows_them() {
        for text in ["", "nearest", "nearest:", "process: ", "random:x", "replay"] {
            let error = PlannerSource::parse(text).unwrap_err().to_string();
            assert!(error.contains("nearest:DATASET"), "{text}: {error}");
        }
    }

    #[test]
    fn options_of_networks_are_for_runs() {
        let load = LoadOptions {
            curiosity_weight: Some(1.0),
            ..LoadOptions::default()
        };
        let error = PlannerSource::Random.refuse_options(&load).unwrap_err();
        assert_eq!(
            error.to_string(),
            "planner `random` has no weight of curiosity"
        );
        let rounded = LoadOptions {
            precision: Precision::Bf16,
            ..LoadOptions::default()
        };
        let error = PlannerSource::Random.refuse_options(&rounded).unwrap_err();
        assert_eq!(error.to_string(), "planner `random` has no precision");
        let run = PlannerSource::Run("run".into());
        run.refuse_options(&load).unwrap();
    }
}
