//! A rollout from the environments to the file: what `rollout` and `dataset collect` share.

use std::num::NonZeroUsize;
use std::path::Path;
use std::time::{Duration, Instant};

use anyhow::{Result, bail};
use ksim_bench_harness::HarnessError;
use ksim_bench_harness::k_sim::{EpisodeKSim, Reference};
use ksim_bench_harness::policy::{Annotation, EpisodeStart, Policy, PolicyError};
use ksim_bench_harness::record::{EpisodeRecord, EpisodeTrace};
use ksim_bench_harness::recording::{About, ActionPrecision, Recording};
use ksim_bench_harness::rollout::{Continue, Observer, RolloutConfig, rollout};
use ksim_datasets::convert::check_target;
use ksim_datasets::{Format, OpenOptions, WriteOptions};
use ksim_envs::EnvironmentSpec;
use ksim_envs::registry::{self, EnvironmentRequest};
use ksim_envs::vector::VectorEnvironment;
use serde_json::{Map, Value, json};

use crate::atomic;
use crate::context::{Context, Progress};
use crate::data_args;
use crate::rollout_args::{PlayArgs, Player, Setup};

/// Environments of a thread, so that a slow episode holds nobody up.
const ENVIRONMENTS_PER_THREAD: usize = 8;

/// A rollout that is ready to start.
pub(crate) struct Ready {
    environments: VectorEnvironment,
    policy: Box<dyn Policy>,
    /// What will be played.
    pub(crate) config: RolloutConfig,
    player: Player,
    dataset: Option<String>,
    reference: Option<Reference>,
}

/// Where the episodes go.
pub(crate) struct Destination<'a> {
    /// File or folder.
    pub(crate) path: &'a Path,
    /// What it will be.
    pub(crate) format: Format,
    /// Id and whether something is replaced.
    pub(crate) options: WriteOptions,
    /// How actions are stored.
    pub(crate) precision: ActionPrecision,
}

impl Destination<'_> {
    /// Refuses a place that cannot be written in the end, before anything is played.
    pub(crate) fn check(&self) -> Result<()> {
        check_target(self.path, self.format, self.options.overwrite)?;
        if !self.format.is_folder() {
            atomic::check_target(self.path)?;
        }
        Ok(())
    }

    /// The nearest folder that is there: what waits for the end waits in it.
    fn folder(&self) -> &Path {
        let around = self.path.ancestors().skip(1);
        let mut folders = around.filter(|folder| folder.is_dir());
        folders.next().unwrap_or(Path::new("."))
    }
}

/// What was played.
pub(crate) struct Played {
    /// One record per episode.
    pub(crate) records: Vec<EpisodeRecord>,
    /// Episodes asked for.
    pub(crate) n_requested: usize,
    /// How it was made.
    pub(crate) rollout: Map<String, Value>,
    /// K-Sim of every episode, where there is a dataset to compare with.
    pub(crate) k_sim: Option<Vec<EpisodeKSim>>,
}

impl Played {
    /// Whether Ctrl-C came before the last episode was over.
    pub(crate) fn is_interrupted(&self) -> bool {
        self.records.len() < self.n_requested
    }
}

impl Ready {
    /// Makes environments and policy.
    pub(crate) fn new(
        setup: &Setup,
        args: &PlayArgs,
        n_runs: usize,
        context: &Context,
    ) -> Result<Self> {
        let player = args.player(context)?;
        let config = args.config(setup, n_runs);
        let n_episodes = config.n_episodes.saturating_mul(n_runs).max(1);
        let n_slots = args
            .parallel
            .map_or(context.threads() * ENVIRONMENTS_PER_THREAD, |n| {
                usize::from(n.get())
            });
        let make = |_| registry::make(&setup.request);
        let environments = (0..n_slots.min(n_episodes))
            .map(make)
            .collect::<Result<Vec<_>, _>>()?;
        let environments = VectorEnvironment::new(environments)?;
        if let Some(warning) = player.warning() {
            context.warn(&warning);
        }
        if let Some(note) = setup.note {
            context.warn(&format!("{}: {note}", environments.spec().id));
        }
        Ok(Self {
            policy: player.make(environments.spec())?,
            environments,
            config,
            player,
            dataset: setup.dataset.clone(),
            reference: None,
        })
    }

    /// Scores every episode against the dataset of the setup.
    pub(crate) fn with_k_sim(mut self, context: &Context) -> Result<Self> {
        let Some(name) = &self.dataset else {
            bail!("K-Sim needs the dataset that it compares with: --dataset");
        };
        let (_, source) = data_args::open(name, &OpenOptions::default())?;
        let progress = context.spinner(format!("reading {name}"));
        self.reference = Some(Reference::fit(&*source, self.environments.spec())?);
        drop(progress);
        Ok(self)
    }

    /// What is fixed about the environment.
    pub(crate) fn spec(&self) -> &EnvironmentSpec {
        self.environments.spec()
    }

    /// Name of the policy.
    pub(crate) fn policy_name(&self) -> &str {
        self.policy.name()
    }

    /// Rounds what the policy does to f32, as Gymnasium's action spaces declare it.
    pub(crate) fn with_single_precision(self) -> Self {
        Self {
            policy: Box::new(SinglePrecision(self.policy)),
            ..self
        }
    }

    /// Plays, and writes the episodes if there is a destination. An interrupt ends it after the last episode that is
    /// complete.
    pub(crate) fn play(
        mut self,
        destination: Option<&Destination<'_>>,
        about: About,
        context: &Context,
    ) -> Result<Played> {
        let n_requested = self.config.n_episodes.saturating_mul(self.config.n_runs);
        let what = format!("{} with {}", self.spec().id, self.policy.name());
        let recording = match destination {
            Some(to) => Some(Recording::start(
                self.spec(),
                self.policy.annotations(),
                to.precision,
                to.folder(),
            )?),
            None => None,
        };
        let mut watcher = Watcher {
            progress: context.bar(what.clone(), n_requested as u64, "episodes"),
            what,
            started: Instant::now(),
            told: Duration::ZERO,
            n_steps: 0,
            n_successes: 0,
            records: Vec::new(),
            recording,
            reference: self.reference.take(),
            k_sim: Vec::new(),
        };
        // On a thread of the pool, which needs not be woken for every step.
        rayon::scope(|_| {
            let (environments, policy) = (&mut self.environments, &mut *self.policy);
            rollout(environments, policy, &self.config, &mut watcher)
        })?;
        let mut rollout = self.describe();
        let Watcher {
            progress,
            started,
            n_steps,
            records,
            recording,
            reference,
            k_sim,
            ..
        } = watcher;
        drop(progress);
        let elapsed_s = started.elapsed().as_secs_f64();
        context.note(&format!(
            "{n_steps} steps in {elapsed_s:.2} s: {:.0} steps/s, {} environments on {} threads",
            n_steps as f64 / elapsed_s,
            self.environments.len(),
            context.threads(),
        ));
        rollout.insert("n_episodes".to_owned(), records.len().into());
        rollout.insert(
            "interrupted".to_owned(),
            (records.len() < n_requested).into(),
        );
        let played = Played {
            records,
            n_requested,
            rollout,
            k_sim: reference.is_some().then_some(k_sim),
        };
        if let (Some(recording), Some(to)) = (recording, destination) {
            let about = About {
                rollout: played.rollout.clone(),
                ..about
            };
            let written = recording.finish(to.path, to.format, &about, &to.options)?;
            for loss in written.iter().flat_map(|written| &written.losses) {
                context.warn(&format!("{}: {loss}", to.path.display()));
            }
        }
        played.tell(destination.map(|to| to.path), context);
        Ok(played)
    }

    /// How the rollout is made.
    fn describe(&self) -> Map<String, Value> {
        let (spec, config) = (self.spec(), &self.config);
        let cell = |cell: Option<(usize, usize)>| cell.map(|(row, column)| json!([row, column]));
        let entries = [
            (
                "environment",
                json!({
                    "id": spec.id,
                    "kwargs": spec.kwargs,
                    "max_episode_steps": spec.max_episode_steps,
                    "dt_s": spec.dt_s,
                }),
            ),
            ("dataset", json!(self.dataset)),
            ("policy", json!(self.policy.name())),
            ("policy_spec", json!(self.player.text())),
            ("planner", json!(self.player.planner())),
            ("seed", json!(config.seed)),
            ("n_runs", json!(config.n_runs)),
            (
                "n_episodes_requested",
                json!(config.n_episodes * config.n_runs),
            ),
            ("discount", json!(config.discount)),
            ("goal_cell", json!(cell(config.reset.goal_cell))),
            ("reset_cell", json!(cell(config.reset.reset_cell))),
            ("ksim_version", json!(env!("CARGO_PKG_VERSION"))),
        ];
        entries
            .map(|(key, value)| (key.to_owned(), value))
            .into_iter()
            .collect()
    }
}

impl Played {
    /// After an interrupt, says what there is.
    fn tell(&self, output: Option<&Path>, context: &Context) {
        if !self.is_interrupted() {
            return;
        }
        let (n, of) = (self.records.len(), self.n_requested);
        context.note(&match (n, output) {
            (0, _) => "interrupted before an episode was complete; nothing was written".to_owned(),
            (_, None) => format!("interrupted after {n} of {of} episodes"),
            (_, Some(path)) => format!(
                "interrupted after {n} of {of} episodes; {} holds these {n}",
                path.display()
            ),
        });
    }
}

/// Keeps what is finished and shows how far it is.
struct Watcher {
    progress: Progress,
    what: String,
    started: Instant,
    /// When the line was last written anew, since the start.
    told: Duration,
    n_steps: u64,
    n_successes: usize,
    records: Vec<EpisodeRecord>,
    recording: Option<Recording>,
    reference: Option<Reference>,
    k_sim: Vec<EpisodeKSim>,
}

impl Observer for Watcher {
    fn episode(&mut self, trace: EpisodeTrace) -> Result<Continue, HarnessError> {
        if let Some(recording) = &mut self.recording {
            recording.add(&trace)?;
        }
        if let Some(reference) = &self.reference {
            self.k_sim.push(reference.score(&trace)?.0);
        }
        self.n_successes += usize::from(trace.record.success == Some(true));
        self.records.push(trace.record);
        self.progress.set(self.records.len() as u64);
        Ok(Continue::Yes)
    }

    fn progress(&mut self, n_steps: u64) -> Continue {
        self.n_steps = n_steps;
        let elapsed = self.started.elapsed();
        if elapsed - self.told > Duration::from_millis(200) {
            self.told = elapsed;
            let rate = n_steps as f64 / elapsed.as_secs_f64();
            let success = match self.records.iter().any(|record| record.success.is_some()) {
                true => format!(
                    ", success in {} of {}",
                    self.n_successes,
                    self.records.len()
                ),
                false => String::new(),
            };
            self.progress
                .say(format!("{}: {rate:.0} steps/s{success}", self.what));
        }
        match atomic::is_interrupted() {
            true => Continue::Stop,
            false => Continue::Yes,
        }
    }
}

/// A policy whose actions are rounded to f32.
struct SinglePrecision(Box<dyn Policy>);

impl Policy for SinglePrecision {
    fn name(&self) -> &str {
        self.0.name()
    }

    fn start_episode(
        &mut self,
        slot: usize,
        start: &EpisodeStart,
    ) -> Result<Option<NonZeroUsize>, PolicyError> {
        self.0.start_episode(slot, start)
    }

    fn act(
        &mut self,
        slots: &[usize],
        observations: &[f64],
        actions: &mut [f64],
    ) -> Result<(), Vec<(usize, PolicyError)>> {
        let result = self.0.act(slots, observations, actions);
        for action in actions {
            *action = f64::from(*action as f32);
        }
        result
    }

    fn annotations(&self) -> &'static [Annotation] {
        self.0.annotations()
    }

    fn annotate(&self, slot: usize, out: &mut [f64]) {
        self.0.annotate(slot, out);
    }
}

/// What Gymnasium calls the environment of a request, where it has it.
pub(crate) fn env_spec(request: &EnvironmentRequest) -> Result<Option<Value>> {
    Ok(registry::env_spec(registry::make(request)?.spec()))
}
