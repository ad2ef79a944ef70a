//! A training under way: phase after phase, with checkpoints.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::checkpoint::CHECKPOINT_FILE;
use super::confidence::ConfidencePhase;
use super::curiosity::CuriosityPhase;
use super::diffusion::DiffusionPhase;
use super::learner::Learner;
use super::manifest::Manifest;
use super::setting::{Phase, Setting};
use crate::config::Config;
use crate::error::PlannerError;
use crate::family::{TrainControl, TrainObserver, TrainProgress, TrainSummary};
use crate::model::{PLANNER_FILE, PlannerFile, PlannerMeta, network};
use crate::nets::TrainingState;

/// Which phase.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    Diffusion,
    Curiosity,
    Confidence,
}

/// A training under way.
pub(super) struct Session<'a> {
    pub(super) setting: Setting<'a>,
    pub(super) meta: PlannerMeta,
    pub(super) kinds: Vec<Kind>,
    /// Updates between two checkpoints.
    pub(super) interval: u64,
    pub(super) run: &'a Path,
    pub(super) manifest: Manifest,
}

impl Kind {
    /// Names of the networks that a phase trains, and of those that it draws.
    pub(super) fn networks(self) -> (&'static [&'static str], &'static [&'static str]) {
        match self {
            Self::Diffusion => (&[network::DIFFUSION, network::REWARD], &[]),
            Self::Curiosity => (
                &[network::CURIOSITY_PREDICTOR],
                &[network::CURIOSITY_TARGET],
            ),
            Self::Confidence => (
                &[network::CONFIDENCE_PREDICTOR],
                &[network::CONFIDENCE_TARGET],
            ),
        }
    }
}

impl<'a> Session<'a> {
    /// The phase; `None` if the observer stops what it prepares.
    fn open(
        &mut self,
        kind: Kind,
        observer: &mut dyn TrainObserver,
    ) -> Result<Option<Box<dyn Phase + 'a>>, PlannerError> {
        let config = self.setting.config;
        Ok(Some(match (kind, &config.curiosity, &config.confidence) {
            (Kind::Curiosity, Some(curiosity), _) => {
                Box::new(CuriosityPhase::new(&mut self.setting, curiosity)?)
            }
            (Kind::Confidence, _, Some(confidence)) => {
                match ConfidencePhase::new(&mut self.setting, confidence, observer)? {
                    Some(phase) => Box::new(phase),
                    None => return Ok(None),
                }
            }
            _ => Box::new(DiffusionPhase::new(&mut self.setting)?),
        }))
    }

    /// Updates of each phase in all.
    pub(super) fn lengths(&self) -> Vec<u64> {
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

    /// Trains what is left, or until the observer stops it.
    pub(super) fn train(
        mut self,
        observer: &mut dyn TrainObserver,
    ) -> Result<TrainSummary, PlannerError> {
        while self.setting.checkpoint.n_phases < self.kinds.len() {
            let kind = self.kinds[self.setting.checkpoint.n_phases];
            let Some(mut phase) = self.open(kind, observer)? else {
                break;
            };
            let control = self.train_phase(phase.as_mut(), observer)?;
            if self.setting.checkpoint.update == phase.n_updates(&self.setting) {
                self.close(phase.as_ref())?;
                self.save(&[], observer)?;
            }
            if control == TrainControl::Stop {
                break;
            }
        }
        Ok(self.summary())
    }

    /// Trains a phase to its end, or until the observer stops it.
    fn train_phase(
        &mut self,
        phase: &mut dyn Phase,
        observer: &mut dyn TrainObserver,
    ) -> Result<TrainControl, PlannerError> {
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
            let stop = control == TrainControl::Stop;
            // The end of a phase is saved by whoever closes it.
            if number + 1 < n_updates && (stop || (number + 1).is_multiple_of(self.interval)) {
                self.save(&phase.learners(), observer)?;
            }
            if stop {
                return Ok(TrainControl::Stop);
            }
        }
        Ok(TrainControl::Continue)
    }

    /// Moves the networks of a phase to those that are done.
    fn close(&mut self, phase: &dyn Phase) -> Result<(), PlannerError> {
        let states = self.states(&phase.learners())?;
        let checkpoint = &mut self.setting.checkpoint;
        for (name, state) in states {
            checkpoint.n_updates.insert(name.clone(), state.n_updates);
            checkpoint.finished.insert(name, state.ema);
        }
        checkpoint.learning.clear();
        checkpoint.n_phases += 1;
        checkpoint.update = 0;
        Ok(())
    }

    /// The states of networks by name, which must be finite: a last good checkpoint is not replaced by another.
    fn states(
        &self,
        learners: &[&Learner],
    ) -> Result<BTreeMap<String, TrainingState>, PlannerError> {
        let mut states = BTreeMap::new();
        for learner in learners {
            let state = learner.state()?;
            if let Some(what) = state.not_finite() {
                return Err(self.keep(PlannerError::NotFinite {
                    what: format!("{what} of network \"{}\"", learner.name),
                    place: format!("after its update {}", state.n_updates),
                    checkpoint: None,
                }));
            }
            states.insert(learner.name.to_owned(), state);
        }
        Ok(states)
    }

    /// Writes planner, losses and checkpoint, the checkpoint last.
    fn save(
        &mut self,
        learners: &[&Learner],
        observer: &mut dyn TrainObserver,
    ) -> Result<(), PlannerError> {
        self.setting.checkpoint.learning = self.states(learners)?;
        self.write_planner()?;
        self.setting.checkpoint.history.write(self.run)?;
        let path = self.write_checkpoint()?;
        observer.checkpoint(&path, self.total_update());
        Ok(())
    }

    pub(super) fn write_checkpoint(&self) -> Result<PathBuf, PlannerError> {
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

/// The phases of a configuration.
pub(super) fn kinds(config: &Config) -> Vec<Kind> {
    let mut kinds = vec![Kind::Diffusion];
    kinds.extend(config.curiosity.as_ref().map(|_| Kind::Curiosity));
    kinds.extend(config.confidence.as_ref().map(|_| Kind::Confidence));
    kinds
}
