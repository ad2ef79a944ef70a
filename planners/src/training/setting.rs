//! What the phases of a training work with, and what a phase is.

use super::checkpoint::Checkpoint;
use super::learner::{Learner, Rate, Update};
use crate::config::Config;
use crate::data::Windows;
use crate::diffusion::{Noised, Schedule};
use crate::error::PlannerError;
use crate::model::network;
use crate::nets::{Architecture, Backend, Network, TrainingState, Weights, initial_weights};
use crate::rng::{Purpose, Rng};

/// What every phase works with.
pub(crate) struct Setting<'a> {
    pub(crate) config: &'a Config,
    pub(crate) windows: &'a Windows,
    pub(crate) seed: u64,
    pub(crate) schedule: Schedule,
    pub(crate) value_mean: f32,
    pub(crate) value_std: f32,
    pub(super) backend: &'a dyn Backend,
    pub(super) checkpoint: Checkpoint,
}

/// One update of one network.
pub(crate) struct Done {
    pub(super) network: &'static str,
    /// Updates of the network so far.
    pub(super) n_updates: u64,
    /// Whether it is the network's last.
    pub(super) last: bool,
    pub(super) update: Update,
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
        rate: Rate,
    ) -> Result<Learner, PlannerError> {
        let state = match self.checkpoint.learning.get(name) {
            Some(state) => state.clone(),
            None => TrainingState::new(self.initial(name, architecture)?),
        };
        Learner::new(name, self.backend, architecture, state, rate)
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

    /// Windows noised to uniform timesteps, from the stream of a purpose and an update.
    pub(crate) fn noise(
        &self,
        x0: &[f32],
        n: usize,
        purpose: Purpose,
        number: u64,
    ) -> Result<Noised, PlannerError> {
        let mut rng = Rng::new(self.seed, purpose, number);
        let n_timesteps = self.schedule.n_timesteps();
        let t: Vec<usize> = (0..n).map(|_| rng.below(n_timesteps)).collect();
        let mut epsilon = vec![0.0; x0.len()];
        rng.fill_normal(&mut epsilon);
        Noised::new(
            &self.schedule,
            x0,
            &t,
            &epsilon,
            self.windows.observation_dim(),
        )
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
