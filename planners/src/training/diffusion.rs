//! First phase: the diffusion model and the reward network on the same windows.

use super::learner::{Learner, Rate};
use super::setting::{Done, Phase, Setting};
use crate::data::{Batches, Subset};
use crate::diffusion::{DiffusionLoss, value_loss};
use crate::error::PlannerError;
use crate::model::network::{DIFFUSION, REWARD};
use crate::rng::Purpose;

/// Diffusion model and reward network.
pub(crate) struct DiffusionPhase {
    batches: Batches,
    diffusion: Learner,
    reward: Learner,
    x0: Vec<f32>,
    values: Vec<f32>,
}

impl DiffusionPhase {
    pub(crate) fn new(setting: &mut Setting<'_>) -> Result<Self, PlannerError> {
        let config = setting.config;
        let batch_size = config.diffusion.batch_size;
        let width = setting.windows.width();
        let n_updates = config.diffusion.n_updates;
        let diffusion = setting.learner(
            DIFFUSION,
            &config.diffusion_network(width),
            Rate::Cosine {
                first: config.diffusion.learning_rate,
                n_updates,
            },
        )?;
        let reward = setting.learner(
            REWARD,
            &config.classifier_network(width, 1),
            Rate::Cosine {
                first: config.reward.learning_rate,
                n_updates: n_updates.div_ceil(config.reward.interval),
            },
        )?;
        Ok(Self {
            batches: Self::batches(setting)?,
            diffusion: diffusion
                .decoupled_decay(config.diffusion.weight_decay)
                .average(config.diffusion.ema_rate),
            reward: reward
                .l2_decay(config.reward.weight_decay)
                .average(config.reward.ema_rate),
            x0: vec![0.0; batch_size * config.data.horizon * width],
            values: vec![0.0; batch_size],
        })
    }

    /// The batches, which need enough windows.
    pub(crate) fn batches(setting: &Setting<'_>) -> Result<Batches, PlannerError> {
        let batch_size = setting.config.diffusion.batch_size;
        Batches::new(
            setting.windows,
            Subset::All,
            batch_size,
            setting.seed,
            Purpose::DiffusionOrder,
        )
    }

    fn update_diffusion(
        &mut self,
        setting: &Setting<'_>,
        number: u64,
    ) -> Result<Done, PlannerError> {
        let noised = setting.noise(&self.x0, self.values.len(), Purpose::DiffusionNoise, number)?;
        let windows = setting.windows;
        let loss = DiffusionLoss {
            window_len: windows.horizon * windows.width(),
            observation_dim: windows.observation_dim(),
            width: windows.width(),
            action_weight: setting.config.diffusion.action_loss_weight,
        };
        let x0 = &self.x0;
        let update = self
            .diffusion
            .update(&noised.x, &noised.t, |out, gradient| {
                loss.loss(out, x0, gradient)
            })?;
        Ok(Done::new(
            &self.diffusion,
            update,
            number + 1 == self.n_updates(setting),
        ))
    }

    fn update_reward(&mut self, setting: &Setting<'_>, number: u64) -> Result<Done, PlannerError> {
        let config = setting.config;
        let noised = setting.noise(&self.x0, self.values.len(), Purpose::RewardNoise, number)?;
        let values = &self.values;
        let update = self.reward.update(&noised.x, &noised.t, |out, gradient| {
            value_loss(out, values, config.broadcasts_values(), gradient)
        })?;
        let last = number + config.reward.interval >= config.diffusion.n_updates;
        Ok(Done::new(&self.reward, update, last))
    }
}

impl Phase for DiffusionPhase {
    fn name(&self) -> &'static str {
        DIFFUSION
    }

    fn n_updates(&self, setting: &Setting<'_>) -> u64 {
        setting.config.diffusion.n_updates
    }

    fn update(&mut self, setting: &Setting<'_>, number: u64) -> Result<Vec<Done>, PlannerError> {
        self.batches
            .fill(setting.windows, number, &mut self.x0, &mut self.values);
        for value in &mut self.values {
            *value = (*value - setting.value_mean) / setting.value_std;
        }
        let mut done = vec![self.update_diffusion(setting, number)?];
        if number.is_multiple_of(setting.config.reward.interval) {
            done.push(self.update_reward(setting, number)?);
        }
        Ok(done)
    }

    fn learners(&self) -> Vec<&Learner> {
        vec![&self.diffusion, &self.reward]
    }
}
