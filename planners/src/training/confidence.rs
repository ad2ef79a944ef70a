//! ReDiffuser's phase: random network distillation on clean plans.

use super::learner::{Learner, Rate};
use super::setting::{Done, Phase, Setting};
use crate::config::{ConfidenceConfig, ConfidenceRule};
use crate::data::{Batches, Subset};
use crate::diffusion::novelty_loss;
use crate::error::PlannerError;
use crate::family::TrainObserver;
use crate::model::network::{CONFIDENCE_PREDICTOR, CONFIDENCE_TARGET};
use crate::nets::Network;
use crate::rng::{Purpose, Rng};

mod plans;

/// A predictor that learns what a fixed random network says about plans that are to be trusted.
pub(crate) struct ConfidencePhase<'a> {
    config: &'a ConfidenceConfig,
    source: Source,
    predictor: Learner,
    target: Box<dyn Network>,
    x: Vec<f32>,
    values: Vec<f32>,
}

/// Where plans come from.
enum Source {
    /// Windows of the dataset, normalized observation and action.
    Windows(Batches),
    /// Raw states of plans that Diffuser generated, of the shape `(n_plans, horizon·observation_dim)`.
    Plans(Vec<f32>),
}

impl<'a> ConfidencePhase<'a> {
    /// `None` if the observer stops the generation of plans.
    pub(crate) fn new(
        setting: &mut Setting<'_>,
        config: &'a ConfidenceConfig,
        observer: &mut dyn TrainObserver,
    ) -> Result<Option<Self>, PlannerError> {
        let (horizon, width) = (setting.config.data.horizon, setting.windows.width());
        let [predictor, target] =
            config.networks(horizon, width, setting.windows.observation_dim());
        let in_dim = predictor.input_len();
        let predictor = setting.learner(
            CONFIDENCE_PREDICTOR,
            &predictor,
            Rate::Constant(config.learning_rate),
        )?;
        let target = setting.fixed(CONFIDENCE_TARGET, &target)?;
        let source = match config.rule {
            ConfidenceRule::Windows => Source::Windows(Self::batches(setting, config)?),
            ConfidenceRule::Plans => match plans::generate(setting, config, observer)? {
                Some(plans) => Source::Plans(plans),
                None => return Ok(None),
            },
        };
        Ok(Some(Self {
            config,
            source,
            predictor,
            target,
            x: vec![0.0; config.batch_size * in_dim],
            values: vec![0.0; config.batch_size],
        }))
    }

    /// The batches of [`ConfidenceRule::Windows`], which need enough windows.
    pub(crate) fn batches(
        setting: &Setting<'_>,
        config: &ConfidenceConfig,
    ) -> Result<Batches, PlannerError> {
        Batches::new(
            setting.windows,
            Subset::All,
            config.batch_size,
            setting.seed,
            Purpose::ConfidenceOrder,
        )
    }

    fn fill(&mut self, setting: &Setting<'_>, number: u64) {
        match &mut self.source {
            Source::Windows(batches) => {
                batches.fill(setting.windows, number, &mut self.x, &mut self.values);
            }
            Source::Plans(plans) => {
                let plan_len = self.x.len() / self.values.len();
                let n_plans = plans.len() / plan_len;
                let mut rng = Rng::new(setting.seed, Purpose::ConfidenceOrder, number);
                for x in self.x.chunks_exact_mut(plan_len) {
                    let first = rng.below(n_plans) * plan_len;
                    x.copy_from_slice(&plans[first..first + plan_len]);
                }
            }
        }
    }
}

impl Phase for ConfidencePhase<'_> {
    fn name(&self) -> &'static str {
        "confidence"
    }

    fn n_updates(&self, _: &Setting<'_>) -> u64 {
        self.config.n_updates
    }

    fn update(&mut self, setting: &Setting<'_>, number: u64) -> Result<Vec<Done>, PlannerError> {
        self.fill(setting, number);
        // These networks have no timestep.
        let t = vec![0.0; self.values.len()];
        let mut target = vec![0.0; t.len() * self.config.out_dim];
        self.target.forward(&self.x, &t, false, &mut target)?;
        let update = self.predictor.update(&self.x, &t, |out, gradient| {
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
