//! What training lowers, and the gradients of it by the outputs of the networks.

use super::Schedule;
use crate::error::PlannerError;

/// Noised windows of a batch.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Noised {
    /// x_t = α_t·x_0 + σ_t·ε, with the clean observation in the first row.
    pub x: Vec<f32>,
    /// Timestep of each window, as the networks take it.
    pub t: Vec<f32>,
}

impl Noised {
    /// Noises `x0` of the shape `(n, horizon, width)` to the timesteps `t` with `epsilon` of the same shape. The first
    /// `observation_dim` numbers of each window stay clean.
    ///
    /// # Errors
    /// Lengths that do not go together, or a timestep that the schedule does not have.
    pub fn new(
        schedule: &Schedule,
        x0: &[f32],
        t: &[usize],
        epsilon: &[f32],
        observation_dim: usize,
    ) -> Result<Self, PlannerError> {
        if epsilon.len() != x0.len() {
            return Err(PlannerError::Length {
                what: "the noise",
                expected: x0.len(),
                found: epsilon.len(),
            });
        }
        if let Some(t) = t.iter().find(|t| **t >= schedule.n_timesteps()) {
            return Err(PlannerError::Request {
                what: "the timestep",
                expected: format!("below {}", schedule.n_timesteps()),
                found: t.to_string(),
            });
        }
        let window_len = x0.len() / t.len().max(1);
        let mut x = vec![0.0; x0.len()];
        for (window, &t) in t.iter().enumerate() {
            let range = window * window_len..(window + 1) * window_len;
            let (x0, epsilon) = (&x0[range.clone()], &epsilon[range.clone()]);
            let out = &mut x[range];
            schedule.noise(t, x0, epsilon, out);
            out[..observation_dim].copy_from_slice(&x0[..observation_dim]);
        }
        Ok(Self {
            x,
            t: t.iter().map(|&t| t as f32).collect(),
        })
    }
}

/// The loss of the diffusion model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DiffusionLoss {
    /// Numbers in a window.
    pub window_len: usize,
    /// Numbers in an observation.
    pub observation_dim: usize,
    /// Numbers in a row.
    pub width: usize,
    /// Weight of the action of the first row.
    pub action_weight: f64,
}

impl DiffusionLoss {
    /// Mean over all numbers of W·(1 − M)·(prediction − x_0)²: the given observation of the first row (M = 1) does
    /// not count but is in the denominator, the action of the first row counts `action_weight` times. Writes the
    /// gradient by the prediction.
    pub fn loss(&self, prediction: &[f32], x0: &[f32], gradient: &mut [f32]) -> f64 {
        let n = prediction.len() as f64;
        let mut loss = 0.0;
        let pairs = prediction.iter().zip(x0).zip(gradient);
        for (at, ((prediction, x0), gradient)) in pairs.enumerate() {
            let weight = match at % self.window_len {
                place if place < self.observation_dim => 0.0,
                place if place < self.width => self.action_weight,
                _ => 1.0,
            };
            let difference = f64::from(*prediction) - f64::from(*x0);
            loss += weight * difference * difference;
            *gradient = (2.0 * weight * difference / n) as f32;
        }
        loss / n
    }
}

/// Mean of (prediction − value)². Writes the gradient by the prediction.
pub fn paired_loss(prediction: &[f32], values: &[f32], gradient: &mut [f32]) -> f64 {
    let n = prediction.len() as f64;
    let mut loss = 0.0;
    for ((prediction, value), gradient) in prediction.iter().zip(values).zip(gradient) {
        let difference = f64::from(*prediction) - f64::from(*value);
        loss += difference * difference;
        *gradient = (2.0 * difference / n) as f32;
    }
    loss / n
}

/// The loss of the reward network: [`paired_loss`], or with `broadcast` the reference's on AntMaze, where shapes (B, 1)
/// and (B,) meet: the mean over all B·B pairs of (prediction_i − value_j)², which draws every prediction to the mean of
/// the values.
pub fn value_loss(
    prediction: &[f32],
    values: &[f32],
    broadcast: bool,
    gradient: &mut [f32],
) -> f64 {
    if !broadcast {
        return paired_loss(prediction, values, gradient);
    }
    let n = values.len() as f64;
    let mean = values.iter().map(|&value| f64::from(value)).sum::<f64>() / n;
    let spread = values
        .iter()
        .map(|&value| (f64::from(value) - mean).powi(2));
    let variance = spread.sum::<f64>() / n;
    let same = vec![mean as f32; prediction.len()];
    paired_loss(prediction, &same, gradient) + variance
}

/// Mean over all outputs of (predictor − target)². Writes the gradient by the predictor's output.
pub fn novelty_loss(predictor: &[f32], target: &[f32], gradient: &mut [f32]) -> f64 {
    paired_loss(predictor, target, gradient)
}
