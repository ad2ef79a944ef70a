//! Which environment is played, by whom and how often: options that `rollout` and `dataset collect` share.

use std::num::NonZero;

use anyhow::{Context as _, Result, bail};
use clap::error::ErrorKind;
use clap::{Args, CommandFactory as _};
use ksim_bench_harness::planner_source::PlannerSource;
use ksim_bench_harness::policy::{self, Policy, PolicySpec};
use ksim_bench_harness::rollout::RolloutConfig;
use ksim_datasets::{DatasetError, OpenOptions, SearchRoots};
use ksim_envs::EnvironmentSpec;
use ksim_envs::ResetOptions;
use ksim_envs::registry::{self, DatasetEnvironment, EnvironmentRequest};
use serde_json::Value;

use crate::context::Context;
use crate::data_args;
use crate::planner_args::{Chosen, PlannerArgs};

/// Which environment.
#[derive(Debug, Clone, Args)]
#[command(next_help_heading = "Environment")]
pub(crate) struct EnvironmentArgs {
    /// Id of the environment, such as Hopper-v5 (see `ksim env list`)
    #[arg(long, value_name = "ID", required_unless_present = "dataset")]
    env: Option<String>,
    /// The environment, time limit and reference scores of this dataset; with --env only what K-Sim compares with
    #[arg(long, value_name = "NAME|PATH")]
    dataset: Option<String>,
    /// A keyword argument of Gymnasium's constructor; what is no JSON is taken as text
    #[arg(long = "env-arg", value_name = "NAME=JSON", value_parser = env_arg)]
    env_args: Vec<(String, Value)>,
    /// Time limit of an episode in steps [default: the environment's]
    #[arg(long, value_name = "N")]
    max_steps: Option<NonZero<u32>>,
    /// Cell of the goal in the maze, from 0 at the top left [default: drawn]
    #[arg(long, value_name = "ROW,COLUMN", value_parser = cell)]
    goal_cell: Option<(usize, usize)>,
    /// Cell of the start in the maze [default: drawn]
    #[arg(long, value_name = "ROW,COLUMN", value_parser = cell)]
    reset_cell: Option<(usize, usize)>,
}

/// By whom and how often.
#[derive(Debug, Clone, Args)]
#[command(next_help_heading = "Rollout")]
pub(crate) struct PlayArgs {
    /// random, zero, replay:FILE, mlp:FILE.safetensors or waypoint:FILE.safetensors, with options after commas
    #[arg(
        long,
        value_name = "SPEC",
        required_unless_present = "planner",
        conflicts_with = "planner"
    )]
    policy: Option<String>,
    /// Episodes to play
    #[arg(long, value_name = "N")]
    pub(crate) episodes: NonZero<u32>,
    /// Seed: episode k resets with seed + k, and what the policy draws follows from the same
    #[arg(long, value_name = "S", default_value_t = 0)]
    pub(crate) seed: u64,
    /// Environments that are stepped together; results do not depend on it, except with planners by libtorch [default: 8 per thread]
    #[arg(long, value_name = "N")]
    pub(crate) parallel: Option<NonZero<u16>>,
    /// Discount of the discounted return
    #[arg(long, value_name = "FACTOR", default_value_t = 0.99)]
    pub(crate) discount: f64,
    #[command(flatten)]
    planner: PlannerArgs,
}

/// Who plays, read but not made.
#[derive(Debug)]
pub(crate) enum Player {
    /// A policy, and as it was written.
    Policy(PolicySpec, String),
    /// A planner.
    Planner(Box<Chosen>),
}

fn env_arg(text: &str) -> Result<(String, Value)> {
    let (name, value) = text.split_once('=').context("expected NAME=JSON")?;
    let value = serde_json::from_str(value).unwrap_or_else(|_| Value::from(value));
    Ok((name.to_owned(), value))
}

fn cell(text: &str) -> Result<(usize, usize)> {
    let (row, column) = text.split_once(',').context("expected ROW,COLUMN")?;
    Ok((row.trim().parse()?, column.trim().parse()?))
}

/// The environment that was asked for.
#[derive(Debug)]
pub(crate) struct Setup {
    /// What to play in.
    pub(crate) request: EnvironmentRequest,
    /// What policies are judged in; another one for some datasets.
    pub(crate) evaluation: EnvironmentRequest,
    /// Returns that count as 0 and 1.
    pub(crate) reference: Option<(f64, f64)>,
    /// What to know before numbers are compared.
    pub(crate) note: Option<&'static str>,
    /// What every reset asks for.
    pub(crate) reset: ResetOptions,
    /// The dataset it is the environment of.
    pub(crate) dataset: Option<String>,
}

impl EnvironmentArgs {
    /// Finds the environment; of a dataset, the one it was collected in or the one policies are judged in.
    pub(crate) fn setup(&self, collection: bool) -> Result<Setup> {
        let mut found = match (&self.env, &self.dataset) {
            (Some(id), None) => of_id(id)?,
            (Some(id), Some(name)) => {
                // It must be there, and may know returns that the environment does not.
                let (_, source) = data_args::open(name, &OpenOptions::default())?;
                let info = source.info();
                let found = of_id(id)?;
                DatasetEnvironment {
                    reference: info
                        .ref_min_score
                        .zip(info.ref_max_score)
                        .or(found.reference),
                    ..found
                }
            }
            (None, Some(name)) => of_dataset(name)?,
            (None, None) => bail!("neither --env nor --dataset is given"),
        };
        for request in [&mut found.request, &mut found.evaluation] {
            request.kwargs.extend(self.env_args.iter().cloned());
            if let Some(limit) = self.max_steps {
                request.max_episode_steps = usize::try_from(limit.get()).ok();
            }
        }
        Ok(Setup {
            request: match collection {
                true => found.request,
                false => found.evaluation.clone(),
            },
            evaluation: found.evaluation,
            reference: found.reference,
            note: found.note,
            reset: ResetOptions {
                goal_cell: self.goal_cell,
                reset_cell: self.reset_cell,
            },
            dataset: self.dataset.clone(),
        })
    }
}

fn of_id(id: &str) -> Result<DatasetEnvironment> {
    let info = registry::find(id)?;
    let request = EnvironmentRequest::of_id(&info.id);
    Ok(DatasetEnvironment {
        evaluation: request.clone(),
        request,
        reference: info.family.reference_scores(),
        note: None,
    })
}

/// The environment of a dataset on this machine, or of a published name that tells it.
pub(crate) fn of_dataset(name: &str) -> Result<DatasetEnvironment> {
    match ksim_datasets::resolve(name, &SearchRoots::from_env()) {
        Ok(resolved) => {
            let source = ksim_datasets::open(&resolved.path, &OpenOptions::default())?;
            Ok(registry::for_dataset(source.info())?)
        }
        Err(error @ DatasetError::NotFound { .. }) => match registry::for_d4rl(name) {
            Ok(found) => Ok(found),
            // D4RL's mazes are known and not offered; any other name is just not there.
            Err(reason) if ksim_datasets::registry::find(name).is_some_and(is_d4rl) => {
                Err(reason.into())
            }
            Err(_) => Err(error.into()),
        },
        Err(error) => Err(error.into()),
    }
}

fn is_d4rl(known: &ksim_datasets::registry::Known) -> bool {
    known.store == ksim_datasets::registry::Store::D4rl
}

impl Player {
    /// Makes the policy.
    pub(crate) fn make(&self, environment: &EnvironmentSpec) -> Result<Box<dyn Policy>> {
        Ok(match self {
            Self::Policy(spec, _) => policy::build(spec, environment)?,
            Self::Planner(chosen) => Box::new(chosen.open(environment)?),
        })
    }

    /// As it was written.
    pub(crate) fn text(&self) -> &str {
        match self {
            Self::Policy(_, text) => text,
            Self::Planner(chosen) => &chosen.text,
        }
    }

    /// What to know about it before it plays.
    pub(crate) fn warning(&self) -> Option<String> {
        match self {
            Self::Policy(..) => None,
            Self::Planner(chosen) => chosen.warning(),
        }
    }

    /// How a planner plans.
    pub(crate) fn planner(&self) -> Option<Value> {
        match self {
            Self::Policy(..) => None,
            Self::Planner(chosen) => Some(chosen.describe()),
        }
    }
}

impl PlayArgs {
    /// Who plays.
    pub(crate) fn player(&self, context: &Context) -> Result<Player> {
        match (&self.planner.planner, &self.policy) {
            (Some(text), _) => Ok(Player::Planner(Box::new(Chosen {
                text: text.clone(),
                source: PlannerSource::parse(text)?,
                options: self.planner.planning.open_options(context.threads()),
            }))),
            (None, Some(_)) if self.planner.planning.first_given().is_some() => {
                let flag = self.planner.planning.first_given().unwrap_or_default();
                let message = format!("{flag} is for --planner, not for --policy");
                Err(crate::cli::Cli::command()
                    .error(ErrorKind::ArgumentConflict, message)
                    .into())
            }
            (None, Some(text)) => Ok(Player::Policy(PolicySpec::parse(text)?, text.clone())),
            (None, None) => bail!("neither --policy nor --planner is given"),
        }
    }

    /// Whether a planner plays.
    pub(crate) fn is_planned(&self) -> bool {
        self.planner.planner.is_some()
    }

    /// What is to be rolled out.
    pub(crate) fn config(&self, setup: &Setup, n_runs: usize) -> RolloutConfig {
        RolloutConfig {
            n_episodes: usize::try_from(self.episodes.get()).unwrap_or(usize::MAX),
            n_runs,
            seed: self.seed,
            discount: self.discount,
            reset: setup.reset.clone(),
            reference: setup.reference,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arguments_are_json_or_text() {
        let value = |text: &str| env_arg(text).unwrap().1;
        assert_eq!(value("a=false"), Value::Bool(false));
        assert_eq!(value("a=[1, 2]"), serde_json::json!([1, 2]));
        assert_eq!(value("xml_file=a=b.xml"), Value::from("a=b.xml"));
        assert!(env_arg("a").is_err());
    }

    #[test]
    fn cells_are_two_numbers() {
        assert_eq!(cell("1, 12").unwrap(), (1, 12));
        for wrong in ["1", "1,", "-1,2", "1,2,3"] {
            assert!(cell(wrong).is_err(), "{wrong}");
        }
    }
}
