//! Curiosity-Diffuser's phase: random network distillation on noised windows (Burda et al. 2019).

use super::learner::{Learner, Rate};
use super::setting::{Done, Phase, Setting};
use crate::config::CuriosityConfig;
use crate::data::Batches;
use crate::diffusion::novelty_loss;
use crate::error::PlannerError;
use crate::model::network::{CURIOSITY_PREDICTOR, CURIOSITY_TARGET};
use crate::nets::Network;
use crate::rng::Purpose;

/// A predictor that learns what a fixed random network says about windows of the data, at every timestep.
pub(crate) struct CuriosityPhase<'a> {
    config: &'a CuriosityConfig,
    batches: Batches,
    predictor: Learner,
    target: Box<dyn Network>,
    x0: Vec<f32>,
    values: Vec<f32>,
}

impl<'a> CuriosityPhase<'a> {
    pub(crate) fn new(
        setting: &mut Setting<'_>,
        config: &'a CuriosityConfig,
    ) -> Result<Self, PlannerError> {
        let width = setting.windows.width();
        let predictor = setting.learner(
            CURIOSITY_PREDICTOR,
            &setting.config.classifier_network(width, config.out_dim),
            Rate::Cosine {
                first: config.learning_rate,
                n_updates: config.n_updates,
            },
        )?;
        let target = setting.config.target_network(width, config.out_dim);
        Ok(Self {
            config,
            batches: Self::batches(setting, config)?,
            predictor: predictor.average(config.ema_rate),
            target: setting.fixed(CURIOSITY_TARGET, &target)?,
            x0: vec![0.0; config.batch_size * setting.config.data.horizon * width],
            values: vec![0.0; config.batch_size],
        })
    }

    /// The batches, which need enough windows.
    pub(crate) fn batches(
        setting: &Setting<'_>,
        config: &CuriosityConfig,
    ) -> Result<Batches, PlannerError> {
        Batches::new(
            setting.windows,
            config.subset,
            config.batch_size,
            setting.seed,
            Purpose::CuriosityOrder,
        )
    }
}

impl Phase for CuriosityPhase<'_> {
    fn name(&self) -> &'static str {
        "curiosity"
    }

    fn n_updates(&self, _: &Setting<'_>) -> u64 {
        self.config.n_updates
    }

    fn update(&mut self, setting: &Setting<'_>, number: u64) -> Result<Vec<Done>, PlannerError> {
        self.batches
            .fill(setting.windows, number, &mut self.x0, &mut self.values);
        let n = self.values.len();
        let noised = setting.noise(&self.x0, n, Purpose::CuriosityNoise, number)?;
        let mut target = vec![0.0; n * self.config.out_dim];
        self.target
            .forward(&noised.x, &noised.t, false, &mut target)?;
        let update = self
            .predictor
            .update(&noised.x, &noised.t, |out, gradient| {
                novelty_loss(out, &target, gradient)
            })?;
        Ok(vec![Done::new(
            &self.predictor,
            update,
            number + 1 == self.config.n_updates,
        )])
    }

    fn learners(&self) -> Vec<&Learner> {
        vec![&self.predictor]
    }
}
