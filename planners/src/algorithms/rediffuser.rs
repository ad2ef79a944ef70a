//! ReDiffuser: reliable decision-making with confidence (He et al. 2024).
//!
//! Diffuser that does not execute the candidate of the highest value, but draws among the best few by the confidence
//! that random network distillation on clean plans has in them.

use std::path::Path;

use ksim_datasets::DatasetSource;

use super::loaded::Loaded;
use super::plan::{Choice, Chosen, DiffusionPlanner, SlotPlans};
use crate::config::{ConfidenceRule, Config};
use crate::data::Normalizer;
use crate::error::PlannerError;
use crate::family::{
    LoadOptions, PlannerFamily, Preset, TrainObserver, TrainRequest, TrainSummary,
};
use crate::model::network::{CONFIDENCE_PREDICTOR, CONFIDENCE_TARGET};
use crate::nets::Network;
use crate::planner::Planner;
use crate::presets::{self, PRESETS};
use crate::rng::Rng;
use crate::training::{TrainedFamily, train};

/// The family `rediffuser`.
#[derive(Debug, Clone, Copy, Default)]
pub struct ReDiffuser;

impl ReDiffuser {
    pub(crate) const ID: &'static str = "rediffuser";
}

/// Settings of a preset.
fn config(preset: &str) -> Option<Config> {
    let mut config = presets::base(preset)?;
    config.confidence = Some(presets::confidence(preset));
    Some(config)
}

impl PlannerFamily for ReDiffuser {
    fn id(&self) -> &'static str {
        Self::ID
    }

    fn summary(&self) -> &'static str {
        "Diffuser that draws among its best candidates by confidence (He et al. 2024)"
    }

    fn presets(&self) -> &[Preset] {
        PRESETS
    }

    fn train(
        &self,
        request: &TrainRequest,
        data: &dyn DatasetSource,
        run: &Path,
        observer: &mut dyn TrainObserver,
    ) -> Result<TrainSummary, PlannerError> {
        let family = TrainedFamily {
            id: Self::ID,
            config,
        };
        train(&family, request, data, run, observer)
    }

    fn load(&self, run: &Path, options: &LoadOptions) -> Result<Box<dyn Planner>, PlannerError> {
        let loaded = Loaded::open(run, Self::ID, options)?;
        loaded.refuse_curiosity(options)?;
        let guide = loaded.value_guide()?;
        let confidence = loaded.confidence()?;
        let choice = Confident {
            rule: confidence.rule,
            n_top: confidence.top_candidates,
            scaling: confidence.scaling,
            predictor: loaded.network(CONFIDENCE_PREDICTOR)?,
            target: loaded.network(CONFIDENCE_TARGET)?,
            normalizer: loaded.normalizer.clone(),
        };
        Ok(Box::new(DiffusionPlanner::new(
            loaded,
            guide,
            Box::new(choice),
            options,
        )?))
    }
}

/// Draws among the best candidates by confidence.
struct Confident {
    rule: ConfidenceRule,
    n_top: usize,
    scaling: f64,
    predictor: Box<dyn Network>,
    target: Box<dyn Network>,
    normalizer: Normalizer,
}

impl Confident {
    /// Uncertainty u of each candidate.
    fn uncertainties(&mut self, plans: &SlotPlans<'_>) -> Result<Vec<f64>, PlannerError> {
        let x = match self.rule {
            ConfidenceRule::Windows => plans.windows.to_vec(),
            ConfidenceRule::Plans => self.raw_states(plans),
        };
        let t = vec![0.0; plans.scores.len()];
        let out_dim = self.predictor.architecture().output_len();
        let (mut predicted, mut fixed) =
            (vec![0.0; t.len() * out_dim], vec![0.0; t.len() * out_dim]);
        self.predictor.forward(&x, &t, false, &mut predicted)?;
        self.target.forward(&x, &t, false, &mut fixed)?;
        Ok(confidence_uncertainties(
            self.rule, out_dim, &predicted, &fixed,
        ))
    }

    fn raw_states(&self, plans: &SlotPlans<'_>) -> Vec<f32> {
        let observation_dim = self.normalizer.width();
        let mut states = vec![0.0; plans.windows.len() / plans.width * observation_dim];
        let rows = plans.windows.chunks_exact(plans.width);
        for (row, state) in rows.zip(states.chunks_exact_mut(observation_dim)) {
            self.normalizer.denormalize(&row[..observation_dim], state);
        }
        states
    }
}

impl Choice for Confident {
    fn choose(&mut self, plans: &SlotPlans<'_>, mut rng: Rng) -> Result<Chosen, PlannerError> {
        let uncertainties = self.uncertainties(plans)?;
        let top = top_candidates(plans.scores, self.n_top);
        let among: Vec<f64> = top.iter().map(|&at| uncertainties[at]).collect();
        let probabilities = confidence_probabilities(&among, self.scaling);
        let drawn = rng.uniform();
        let mut sum = 0.0;
        let place = probabilities.iter().position(|probability| {
            sum += probability;
            drawn < sum
        });
        Ok(Chosen {
            index: top[place.unwrap_or(top.len() - 1)],
            novelties: Some(uncertainties),
        })
    }
}

/// Uncertainty u of each candidate from the outputs of predictor and target, of the shape `(n, out_dim)`: the mean of the
/// squared differences, or with [`ConfidenceRule::Plans`] the root of their sum.
pub fn confidence_uncertainties(
    rule: ConfidenceRule,
    out_dim: usize,
    predicted: &[f32],
    target: &[f32],
) -> Vec<f64> {
    let rows = predicted.chunks_exact(out_dim);
    let rows = rows.zip(target.chunks_exact(out_dim));
    let squares = rows.map(|(predicted, target)| -> f64 {
        let pairs = predicted.iter().zip(target);
        pairs
            .map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2))
            .sum()
    });
    match rule {
        ConfidenceRule::Windows => squares.map(|sum| sum / out_dim as f64).collect(),
        ConfidenceRule::Plans => squares.map(f64::sqrt).collect(),
    }
}

/// Indices of the `n` highest scores, the highest first; of equal ones the first.
pub fn top_candidates(scores: &[f64], n: usize) -> Vec<usize> {
    let mut order: Vec<usize> = (0..scores.len()).collect();
    order.sort_by(|&a, &b| scores[b].total_cmp(&scores[a]));
    order.truncate(n.max(1));
    order
}

/// softmax(−scaling·u): the probability with which each of the best candidates is executed.
pub fn confidence_probabilities(uncertainties: &[f64], scaling: f64) -> Vec<f64> {
    let logits: Vec<f64> = uncertainties.iter().map(|u| -scaling * u).collect();
    let greatest = logits.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let weights: Vec<f64> = logits
        .iter()
        .map(|logit| (logit - greatest).exp())
        .collect();
    let total: f64 = weights.iter().sum();
    weights.iter().map(|weight| weight / total).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn uncertainty_is_a_mean_of_squares_or_a_distance() {
        let (predicted, target) = ([1.0, 2.0, 0.0, 0.5], [1.0, -1.0, 4.0, 0.5]);
        let of = |rule| confidence_uncertainties(rule, 2, &predicted, &target);
        assert_eq!(of(ConfidenceRule::Windows), [4.5, 8.0]);
        assert_eq!(of(ConfidenceRule::Plans), [3.0, 4.0]);
    }
}
