//! The course of a training: from a dataset and a preset to a run folder.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use ksim_datasets::DatasetSource;

use super::checkpoint::{CHECKPOINT_FILE, Checkpoint};
use super::confidence::ConfidencePhase;
use super::curiosity::CuriosityPhase;
use super::diffusion::DiffusionPhase;
use super::learner::{Learner, Rate, Update};
use super::manifest::{DatasetEntry, MANIFEST_FILE, Manifest};
use crate::backend::{self, BackendOptions};
use crate::config::{ConfidenceRule, Config, Mode, RewardRule};
use crate::data::{Episodes, Windows};
use crate::diffusion::Schedule;
use crate::error::PlannerError;
use crate::family::{TrainControl, TrainObserver, TrainProgress, TrainRequest, TrainSummary};
use crate::model::{PLANNER_FILE, PlannerFile, PlannerMeta, network};
use crate::nets::{Architecture, Backend, Network, TrainingState, Weights, initial_weights};
use crate::presets::{PRESETS, default_preset};
use crate::rng::{Purpose, Rng};

/// Which family is trained, and the settings of its presets.
pub(crate) struct TrainedFamily {
    pub(crate) id: &'static str,
    pub(crate) config: fn(&str) -> Option<Config>,
}

/// What every phase works with.
pub(crate) struct Setting<'a> {
    pub(crate) config: &'a Config,
    pub(crate) windows: &'a Windows,
    pub(crate) seed: u64,
    pub(crate) schedule: Schedule,
    pub(crate) value_mean: f32,
    pub(crate) value_std: f32,
    backend: &'a dyn Backend,
    checkpoint: Checkpoint,
}

/// One update of one network.
pub(crate) struct Done {
    network: &'static str,
    n_updates: u64,
    last: bool,
    update: Update,
}

impl Done {
    pub(crate) fn new(learner: &Learner, update: Update, last: bool) -> Self {
        Self {
            network: learner.name,
            n_updates: learner.n_updates(),
            last,
            update,
        }
    }
}

/// A part of a training that trains some of the networks.
pub(crate) trait Phase {
    fn name(&self) -> &'static str;

    fn n_updates(&self, setting: &Setting<'_>) -> u64;

    /// Update `number`, from 0, of all networks of the phase; the first one leads.
    fn update(&mut self, setting: &Setting<'_>, number: u64) -> Result<Vec<Done>, PlannerError>;

    fn learners(&self) -> Vec<&Learner>;
}

impl Setting<'_> {
    /// A network under training, from the checkpoint or from its initial weights.
    pub(crate) fn learner(
        &self,
        name: &'static str,
        architecture: &Architecture,
        learning_rate: f64,
        rate: Rate,
    ) -> Result<Learner, PlannerError> {
        let state = match self.checkpoint.learning.get(name) {
            Some(state) => state.clone(),
            None => TrainingState::new(self.initial(name, architecture)?),
        };
        Learner::new(name, self.backend, architecture, state, learning_rate, rate)
    }

    /// A network that stays as it was drawn, and is kept.
    pub(crate) fn fixed(
        &mut self,
        name: &'static str,
        architecture: &Architecture,
    ) -> Result<Box<dyn Network>, PlannerError> {
        if !self.checkpoint.finished.contains_key(name) {
            let weights = self.initial(name, architecture)?;
            self.checkpoint.finished.insert(name.to_owned(), weights);
        }
        self.trained(name, architecture)
    }

    /// A network of a phase before.
    pub(crate) fn trained(
        &self,
        name: &str,
        architecture: &Architecture,
    ) -> Result<Box<dyn Network>, PlannerError> {
        match self.checkpoint.finished.get(name) {
            Some(weights) => self.backend.network(architecture, weights),
            None => Err(PlannerError::MissingTensor {
                name: format!("{name}.*"),
            }),
        }
    }

    /// Initial weights, from a stream of the network's own.
    fn initial(&self, name: &str, architecture: &Architecture) -> Result<Weights, PlannerError> {
        const ORDER: [&str; 6] = [
            network::DIFFUSION,
            network::REWARD,
            network::CURIOSITY_PREDICTOR,
            network::CURIOSITY_TARGET,
            network::CONFIDENCE_PREDICTOR,
            network::CONFIDENCE_TARGET,
        ];
        let number = ORDER
            .iter()
            .position(|known| *known == name)
            .unwrap_or(ORDER.len());
        let seed = Rng::new(self.seed, Purpose::Weights, number as u64).seed();
        initial_weights(architecture, seed)
    }
}

/// Trains a family. See [`crate::family::PlannerFamily::train`].
pub(crate) fn train(
    family: &TrainedFamily,
    request: &TrainRequest,
    data: &dyn DatasetSource,
    run: &Path,
    observer: &mut dyn TrainObserver,
) -> Result<TrainSummary, PlannerError> {
    let episodes = Episodes::read(data)?;
    let preset = request
        .preset
        .as_deref()
        .unwrap_or_else(|| default_preset(episodes.has_goal));
    let Some(config) = (family.config)(preset) else {
        return Err(PlannerError::UnknownPreset {
            family: family.id,
            name: preset.to_owned(),
            known: PRESETS.iter().map(|preset| preset.name).collect(),
        });
    };
    let config = config.with_overrides(&request.overrides)?;
    check_rewards(&episodes, &config)?;
    let windows = Windows::new(&episodes, &config.data, config.mode)?;
    if windows.n_short() > 0 {
        observer.notice(&format!(
            "{} episodes are shorter than the horizon of {} steps and are left out",
            windows.n_short(),
            config.data.horizon
        ));
    }
    let dataset = DatasetEntry::new(data.info(), &episodes, &windows);
    let mut manifest = Manifest::new(family.id, preset, &config, request.seed, dataset);
    let backend = backend::open(&BackendOptions::of_training(request))?;
    manifest.backend = backend.name().to_owned();
    let (value_mean, value_std) = value_unit(&windows, &config);
    let mut session = Session {
        meta: meta(
            family.id,
            &config,
            &episodes,
            &manifest,
            (value_mean, value_std),
        ),
        setting: Setting {
            config: &config,
            windows: &windows,
            seed: request.seed,
            schedule: Schedule::cosine(config.diffusion.n_timesteps),
            value_mean,
            value_std,
            backend: backend.as_ref(),
            checkpoint: Checkpoint::default(),
        },
        kinds: kinds(&config),
        interval: request
            .checkpoint_interval
            .unwrap_or(config.checkpoint_interval)
            .max(1),
        run,
        manifest,
    };
    session.check()?;
    session.begin(request)?;
    session.train(observer)
}

/// The phases of a configuration.
fn kinds(config: &Config) -> Vec<Kind> {
    let mut kinds = vec![Kind::Diffusion];
    kinds.extend(config.curiosity.as_ref().map(|_| Kind::Curiosity));
    kinds.extend(config.confidence.as_ref().map(|_| Kind::Confidence));
    kinds
}

/// Mean and unit of the values the reward network learns. Mode reference has it learn raw values.
fn value_unit(windows: &Windows, config: &Config) -> (f32, f32) {
    match config.mode {
        Mode::Reference => (0.0, 1.0),
        Mode::Corrected => {
            let (mean, std) = windows.value_statistics();
            (mean as f32, std as f32)
        }
    }
}

/// Mazes have rewards of 0 and 1 only; another reward means another preset.
fn check_rewards(episodes: &Episodes, config: &Config) -> Result<(), PlannerError> {
    let sparse = |reward: &f64| *reward == 0.0 || *reward == 1.0;
    match (
        config.data.rule,
        episodes.rewards.iter().find(|reward| !sparse(reward)),
    ) {
        (RewardRule::Goal, Some(reward)) => Err(PlannerError::DatasetFit {
            what: "a reward",
            expected: "0 or 1 (data.rule \"goal\")".to_owned(),
            found: reward.to_string(),
        }),
        (RewardRule::Locomotion, None) => Err(PlannerError::DatasetFit {
            what: "every reward",
            expected: "dense (data.rule \"locomotion\")".to_owned(),
            found: "0 or 1: choose a preset for mazes, such as \"cpu-antmaze\"".to_owned(),
        }),
        _ => Ok(()),
    }
}

fn meta(
    family: &str,
    config: &Config,
    episodes: &Episodes,
    manifest: &Manifest,
    (value_mean, value_std): (f32, f32),
) -> PlannerMeta {
    let (action_low, action_high) = episodes.action_bounds();
    PlannerMeta {
        format: PlannerMeta::FORMAT,
        family: family.to_owned(),
        config: config.clone(),
        observation_dim: episodes.observation_dim,
        action_dim: episodes.action_dim,
        observation_order: episodes.observation_order.clone(),
        action_low,
        action_high,
        value_mean,
        value_std,
        n_updates: BTreeMap::new(),
        finished: false,
        dataset: Some(manifest.dataset.fingerprint.clone()),
    }
}

/// Which phase.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Diffusion,
    Curiosity,
    Confidence,
}

/// A training under way.
struct Session<'a> {
    setting: Setting<'a>,
    meta: PlannerMeta,
    kinds: Vec<Kind>,
    interval: u64,
    run: &'a Path,
    manifest: Manifest,
}

impl<'a> Session<'a> {
    /// What must hold before anything is written.
    fn check(&self) -> Result<(), PlannerError> {
        DiffusionPhase::batches(&self.setting)?;
        if let Some(curiosity) = &self.setting.config.curiosity {
            CuriosityPhase::batches(&self.setting, curiosity)?;
        }
        if let Some(confidence) = &self.setting.config.confidence
            && confidence.rule == ConfidenceRule::Windows
        {
            ConfidencePhase::batches(&self.setting, confidence)?;
        }
        for architecture in self.meta.architectures().values() {
            architecture.validate()?;
        }
        Ok(())
    }

    /// Begins a run in an empty folder, or goes on with the one that is there.
    fn begin(&mut self, request: &TrainRequest) -> Result<(), PlannerError> {
        let path = self.run.join(MANIFEST_FILE);
        if !path.exists() {
            if request.resume {
                return Err(PlannerError::Mismatch {
                    path,
                    what: "the run to go on with".to_owned(),
                    expected: "a manifest".to_owned(),
                    found: "missing".to_owned(),
                });
            }
            return self.begin_new(request, &path);
        }
        if !request.resume {
            return Err(PlannerError::Mismatch {
                path: self.run.to_owned(),
                what: "the run folder".to_owned(),
                expected: "empty, or a run to go on with (resume)".to_owned(),
                found: "the folder of another training".to_owned(),
            });
        }
        let begun = Manifest::read(&path)?;
        begun.check_same(&self.manifest, &path)?;
        self.manifest = begun;
        let checkpoint = self.run.join(CHECKPOINT_FILE);
        if checkpoint.exists() {
            self.setting.checkpoint = Checkpoint::read(&checkpoint, &self.manifest.run)?;
        }
        Ok(())
    }

    fn begin_new(&mut self, request: &TrainRequest, path: &Path) -> Result<(), PlannerError> {
        fs::create_dir_all(self.run).map_err(|source| PlannerError::File {
            path: self.run.to_owned(),
            action: "make the folder",
            source,
        })?;
        if let Some(base) = &request.base {
            self.manifest.base = Some(self.take_over(base)?);
        }
        self.manifest.identify();
        if self.manifest.base.is_some() {
            // The networks taken over must be there to go on from, whenever the training stops.
            self.write_checkpoint()?;
        }
        self.manifest.write(path)
    }

    /// Takes the networks of the first phase from a finished Diffuser; returns the hash of its file.
    fn take_over(&mut self, base: &Path) -> Result<String, PlannerError> {
        let path = PlannerFile::path(base);
        let planner = PlannerFile::read(&path, "diffuser")?;
        let (found, asked) = (&planner.meta, &self.meta);
        let dims = |meta: &PlannerMeta| {
            let (value_mean, value_std) = (meta.value_mean, meta.value_std);
            format!("{:?} {value_mean} {value_std}", meta.observation_order)
        };
        let pairs = [
            ("finished", found.finished.to_string(), "true".to_owned()),
            (
                "mode",
                format!("{:?}", found.config.mode),
                format!("{:?}", asked.config.mode),
            ),
            (
                "data",
                format!("{:?}", found.config.data),
                format!("{:?}", asked.config.data),
            ),
            (
                "networks",
                format!("{:?}", found.config.networks),
                format!("{:?}", asked.config.networks),
            ),
            (
                "dataset",
                format!("{:?}", found.dataset),
                format!("{:?}", asked.dataset),
            ),
            ("observations and values", dims(found), dims(asked)),
        ];
        if let Some((what, found, expected)) = pairs.into_iter().find(|(_, a, b)| a != b) {
            return Err(PlannerError::Mismatch {
                path,
                what: format!("\"{what}\" of the base"),
                expected,
                found,
            });
        }
        let bytes = fs::read(&path).map_err(|source| PlannerError::File {
            path: path.clone(),
            action: "read",
            source,
        })?;
        let checkpoint = &mut self.setting.checkpoint;
        checkpoint.finished = planner.networks;
        checkpoint.n_updates = planner.meta.n_updates;
        checkpoint.n_phases = 1;
        Ok(blake3::hash(&bytes).to_hex().to_string())
    }

    fn open(&mut self, kind: Kind) -> Result<Box<dyn Phase + 'a>, PlannerError> {
        let config = self.setting.config;
        Ok(match (kind, &config.curiosity, &config.confidence) {
            (Kind::Curiosity, Some(curiosity), _) => {
                Box::new(CuriosityPhase::new(&mut self.setting, curiosity)?)
            }
            (Kind::Confidence, _, Some(confidence)) => {
                Box::new(ConfidencePhase::new(&mut self.setting, confidence)?)
            }
            _ => Box::new(DiffusionPhase::new(&mut self.setting)?),
        })
    }

    /// Updates of each phase in all.
    fn lengths(&self) -> Vec<u64> {
        let config = self.setting.config;
        let length = |kind: &Kind| match kind {
            Kind::Diffusion => config.diffusion.n_updates,
            Kind::Curiosity => config
                .curiosity
                .as_ref()
                .map_or(0, |config| config.n_updates),
            Kind::Confidence => config
                .confidence
                .as_ref()
                .map_or(0, |config| config.n_updates),
        };
        self.kinds.iter().map(length).collect()
    }

    fn train(mut self, observer: &mut dyn TrainObserver) -> Result<TrainSummary, PlannerError> {
        while self.setting.checkpoint.n_phases < self.kinds.len() {
            let mut phase = self.open(self.kinds[self.setting.checkpoint.n_phases])?;
            if !self.train_phase(phase.as_mut(), observer)? {
                return Ok(self.summary());
            }
            self.close(phase.as_ref());
            self.save(&[], observer)?;
        }
        Ok(self.summary())
    }

    /// Trains a phase to its end; `false` if the observer stopped it.
    fn train_phase(
        &mut self,
        phase: &mut dyn Phase,
        observer: &mut dyn TrainObserver,
    ) -> Result<bool, PlannerError> {
        let n_updates = phase.n_updates(&self.setting);
        while self.setting.checkpoint.update < n_updates {
            let number = self.setting.checkpoint.update;
            let done = phase
                .update(&self.setting, number)
                .map_err(|error| self.keep(error))?;
            self.setting.checkpoint.update += 1;
            for done in &done {
                let history = &mut self.setting.checkpoint.history;
                history.push(
                    phase.name(),
                    done.network,
                    (done.n_updates, done.last),
                    &done.update,
                );
            }
            let control = observer.progress(&TrainProgress {
                phase: phase.name(),
                update: number + 1,
                n_updates,
                loss: done.first().map_or(f64::NAN, |done| done.update.loss),
                total_update: self.total_update(),
                total_updates: self.lengths().iter().sum(),
            });
            let stop = control == TrainControl::Stop && number + 1 < n_updates;
            let due = (number + 1) % self.interval == 0 && number + 1 < n_updates;
            if stop || due {
                self.save(&phase.learners(), observer)?;
            }
            if stop {
                return Ok(false);
            }
        }
        Ok(true)
    }

    /// Moves the networks of a phase to those that are done.
    fn close(&mut self, phase: &dyn Phase) {
        let checkpoint = &mut self.setting.checkpoint;
        for learner in phase.learners() {
            let state = learner.state();
            checkpoint
                .finished
                .insert(learner.name.to_owned(), state.ema);
            checkpoint
                .n_updates
                .insert(learner.name.to_owned(), state.n_updates);
        }
        checkpoint.learning.clear();
        checkpoint.n_phases += 1;
        checkpoint.update = 0;
    }

    /// Writes planner, losses and checkpoint, the checkpoint last.
    fn save(
        &mut self,
        learners: &[&Learner],
        observer: &mut dyn TrainObserver,
    ) -> Result<(), PlannerError> {
        let states = learners
            .iter()
            .map(|learner| (learner.name.to_owned(), learner.state()));
        self.setting.checkpoint.learning = states.collect();
        self.write_planner()?;
        self.setting.checkpoint.history.write(self.run)?;
        let path = self.write_checkpoint()?;
        observer.checkpoint(&path, self.total_update());
        Ok(())
    }

    fn write_checkpoint(&self) -> Result<PathBuf, PlannerError> {
        let path = self.run.join(CHECKPOINT_FILE);
        self.setting
            .checkpoint
            .write(&path, &self.manifest.run, self.setting.seed)?;
        Ok(path)
    }

    /// Writes the planner, as soon as there is something of all its networks.
    fn write_planner(&self) -> Result<(), PlannerError> {
        let checkpoint = &self.setting.checkpoint;
        let mut file = PlannerFile {
            meta: self.meta.clone(),
            normalizer: self.setting.windows.normalizer.clone(),
            networks: BTreeMap::new(),
        };
        for name in self.meta.architectures().into_keys() {
            let (weights, n_updates) = match checkpoint.learning.get(name) {
                Some(state) => (&state.ema, state.n_updates),
                None => match checkpoint.finished.get(name) {
                    Some(weights) => (
                        weights,
                        checkpoint.n_updates.get(name).copied().unwrap_or(0),
                    ),
                    None => return Ok(()),
                },
            };
            file.networks.insert(name.to_owned(), weights.clone());
            file.meta.n_updates.insert(name.to_owned(), n_updates);
        }
        file.meta.finished = checkpoint.n_phases == self.kinds.len();
        file.write(&self.run.join(PLANNER_FILE))
    }

    /// Adds the last checkpoint to an error that ends the training.
    fn keep(&self, error: PlannerError) -> PlannerError {
        let path = self.run.join(CHECKPOINT_FILE);
        match error {
            PlannerError::NotFinite { what, place, .. } => PlannerError::NotFinite {
                what,
                place,
                checkpoint: path.exists().then_some(path),
            },
            other => other,
        }
    }

    /// Updates done in all phases.
    fn total_update(&self) -> u64 {
        let checkpoint = &self.setting.checkpoint;
        let done: u64 = self.lengths()[..checkpoint.n_phases].iter().sum();
        done + checkpoint.update
    }

    fn summary(&self) -> TrainSummary {
        TrainSummary {
            finished: self.setting.checkpoint.n_phases == self.kinds.len(),
            total_update: self.total_update(),
            total_updates: self.lengths().iter().sum(),
            final_losses: self.setting.checkpoint.history.last_losses(),
        }
    }
}
