//! log p of a window: its value, less the curiosity it raises.

use crate::error::PlannerError;
use crate::nets::Network;

/// Scores windows and knows the gradient of the score.
///
/// log p(x, t) = R(x, t) − λ·Σ_o (predictor(x, t)_o − target(x, t)_o)², with the value R in the unit of the rewards.
/// The gradient flows through all three networks. Without curiosity it is Diffuser's guide.
pub struct Guide {
    reward: Box<dyn Network>,
    value_mean: f32,
    value_std: f32,
    curiosity: Option<Curiosity>,
}

/// The two networks of random network distillation, and their weight.
struct Curiosity {
    predictor: Box<dyn Network>,
    target: Box<dyn Network>,
    weight: f32,
}

/// Scores of a batch of windows.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct GuideScore {
    /// log p of each window.
    pub log_p: Vec<f32>,
    /// Novelty Σ_o (predictor_o − target_o)² of each window; empty without curiosity.
    pub novelty: Vec<f32>,
}

impl Guide {
    /// A guide by value alone. The reward network's output times `value_std` plus `value_mean` is the value.
    pub fn new(reward: Box<dyn Network>, value_mean: f32, value_std: f32) -> Self {
        Self {
            reward,
            value_mean,
            value_std,
            curiosity: None,
        }
    }

    /// Lowers curiosity with the weight λ. A weight of 0 leaves the guide as it is: the networks are not even asked.
    #[must_use]
    pub fn with_curiosity(
        mut self,
        predictor: Box<dyn Network>,
        target: Box<dyn Network>,
        weight: f64,
    ) -> Self {
        self.curiosity = (weight != 0.0).then_some(Curiosity {
            predictor,
            target,
            weight: weight as f32,
        });
        self
    }

    /// Scores windows `x` of the shape `(n, horizon, width)` at timesteps `t`, and writes the gradient of log p by `x`
    /// if it is wanted.
    ///
    /// # Errors
    /// Lengths that do not go together.
    pub fn score(
        &mut self,
        x: &[f32],
        t: &[f32],
        mut gradient: Option<&mut [f32]>,
    ) -> Result<GuideScore, PlannerError> {
        let on_rayon = self.on_rayon();
        let mut by_curiosity = match (&gradient, &self.curiosity) {
            (Some(gradient), Some(_)) => Some(vec![0.0; gradient.len()]),
            _ => None,
        };
        let curiosity = self.curiosity.as_mut();
        let (value, novelty) = both(
            on_rayon,
            || {
                value(
                    self.reward.as_mut(),
                    self.value_std,
                    x,
                    t,
                    gradient.as_deref_mut(),
                )
            },
            || match curiosity {
                None => Ok(Vec::new()),
                Some(curiosity) => curiosity.novelty(x, t, by_curiosity.as_deref_mut()),
            },
        );
        let (mut log_p, novelty) = (value?, novelty?);
        for value in &mut log_p {
            *value = *value * self.value_std + self.value_mean;
        }
        if let Some(curiosity) = &self.curiosity {
            for (log_p, novelty) in log_p.iter_mut().zip(&novelty) {
                *log_p -= curiosity.weight * novelty;
            }
        }
        if let (Some(gradient), Some(part)) = (gradient, &by_curiosity) {
            add(gradient, part);
        }
        Ok(GuideScore { log_p, novelty })
    }

    /// Windows come in groups, see [`Network::in_groups_of`].
    pub fn in_groups_of(&mut self, n: usize) {
        self.reward.in_groups_of(n);
        if let Some(curiosity) = &mut self.curiosity {
            curiosity.predictor.in_groups_of(n);
            curiosity.target.in_groups_of(n);
        }
    }

    /// Whether all its networks compute on rayon's threads.
    pub(super) fn on_rayon(&self) -> bool {
        let curiosity = self.curiosity.as_ref();
        let curiosity = curiosity.is_none_or(|c| c.predictor.on_rayon() && c.target.on_rayon());
        self.reward.on_rayon() && curiosity
    }
}

/// The results of two computations, at a time if they are `on_rayon`.
pub(super) fn both<A: Send, B: Send>(
    on_rayon: bool,
    a: impl FnOnce() -> A + Send,
    b: impl FnOnce() -> B + Send,
) -> (A, B) {
    if on_rayon {
        rayon::join(a, b)
    } else {
        (a(), b())
    }
}

/// The network's outputs, and the gradient of `scale` times them.
fn value(
    reward: &mut dyn Network,
    scale: f32,
    x: &[f32],
    t: &[f32],
    gradient: Option<&mut [f32]>,
) -> Result<Vec<f32>, PlannerError> {
    let mut out = vec![0.0; t.len()];
    reward.forward(x, t, gradient.is_some(), &mut out)?;
    if let Some(gradient) = gradient {
        reward.input_gradient(&vec![scale; t.len()], gradient)?;
    }
    Ok(out)
}

impl Curiosity {
    /// Novelty of each window, and the gradient of what lowers it.
    fn novelty(
        &mut self,
        x: &[f32],
        t: &[f32],
        gradient: Option<&mut [f32]>,
    ) -> Result<Vec<f32>, PlannerError> {
        let keep = gradient.is_some();
        let out_dim = self.predictor.architecture().output_len();
        let mut difference = vec![0.0; t.len() * out_dim];
        let mut fixed = vec![0.0; t.len() * out_dim];
        self.predictor.forward(x, t, keep, &mut difference)?;
        self.target.forward(x, t, keep, &mut fixed)?;
        for (difference, fixed) in difference.iter_mut().zip(&fixed) {
            *difference -= fixed;
        }
        let novelty = difference.chunks_exact(out_dim);
        let novelty = novelty
            .map(|row| row.iter().map(|value| value * value).sum())
            .collect();
        if let Some(gradient) = gradient {
            // d(−λ Σ d²) = −2λ Σ d·(d predictor − d target)
            let mut cotangent = difference;
            cotangent
                .iter_mut()
                .for_each(|value| *value *= -2.0 * self.weight);
            self.predictor.input_gradient(&cotangent, gradient)?;
            let mut part = vec![0.0; x.len()];
            cotangent.iter_mut().for_each(|value| *value = -*value);
            self.target.input_gradient(&cotangent, &mut part)?;
            add(gradient, &part);
        }
        Ok(novelty)
    }
}

fn add(sum: &mut [f32], part: &[f32]) {
    for (sum, part) in sum.iter_mut().zip(part) {
        *sum += part;
    }
}
