//! One network under training with its optimizer.

use std::f64::consts::PI;

use crate::error::PlannerError;
use crate::nets::{Adam, Architecture, Backend, TrainableNetwork, TrainingState};

/// η_k = η_0/2·(1 + cos(π·k/K)): the rate of update `k`, from 0, of `n_updates`.
pub fn cosine_rate(first: f64, k: u64, n_updates: u64) -> f64 {
    0.5 * first * (1.0 + (PI * k as f64 / n_updates as f64).cos())
}

/// How the learning rate goes on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Rate {
    /// As [`cosine_rate`].
    Cosine {
        /// Rate of the first update.
        first: f64,
        /// Updates after which it is 0.
        n_updates: u64,
    },
    /// The same throughout.
    Constant(f64),
}

/// A network, its optimizer and its learning rate.
pub struct Learner {
    /// Name of the network, from [`crate::model::network`].
    pub name: &'static str,
    network: Box<dyn TrainableNetwork>,
    adam: Adam,
    rate: Rate,
    n_updates: u64,
}

/// What an update came to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Update {
    /// Loss before the update.
    pub loss: f64,
    /// L2 norm of the gradient by all weights.
    pub gradient_norm: f64,
    /// Learning rate of the update.
    pub learning_rate: f64,
}

/// PyTorch's defaults.
const ADAM: Adam = Adam {
    beta1: 0.9,
    beta2: 0.999,
    epsilon: 1e-8,
    weight_decay: 0.0,
    decoupled: false,
    ema_rate: 0.0,
};

impl Learner {
    /// A network with Adam, without decay and average.
    ///
    /// # Errors
    /// The backend does not have the network, or the state is not its.
    pub fn new(
        name: &'static str,
        backend: &dyn Backend,
        architecture: &Architecture,
        state: TrainingState,
        rate: Rate,
    ) -> Result<Self, PlannerError> {
        Ok(Self {
            name,
            n_updates: state.n_updates,
            network: backend.trainable(architecture, state)?,
            adam: ADAM,
            rate,
        })
    }

    /// AdamW's decay of the weights themselves.
    #[must_use]
    pub fn decoupled_decay(mut self, weight_decay: f64) -> Self {
        (self.adam.weight_decay, self.adam.decoupled) = (weight_decay, true);
        self
    }

    /// An L2 term in the gradient.
    #[must_use]
    pub fn l2_decay(mut self, weight_decay: f64) -> Self {
        (self.adam.weight_decay, self.adam.decoupled) = (weight_decay, false);
        self
    }

    /// A moving average of the weights.
    #[must_use]
    pub fn average(mut self, ema_rate: f64) -> Self {
        self.adam.ema_rate = ema_rate;
        self
    }

    /// One update on a batch. `loss` writes the gradient by the outputs and returns the loss.
    ///
    /// # Errors
    /// Lengths that do not go together, or a loss or gradient that is not finite; the weights then stay as they are.
    pub fn update(
        &mut self,
        x: &[f32],
        t: &[f32],
        loss: impl FnOnce(&[f32], &mut [f32]) -> f64,
    ) -> Result<Update, PlannerError> {
        let mut out = vec![0.0; t.len() * self.network.architecture().output_len()];
        let mut gradient = vec![0.0; out.len()];
        self.network.forward(x, t, true, &mut out)?;
        let loss = loss(&out, &mut gradient);
        if !loss.is_finite() {
            return Err(self.not_finite("loss"));
        }
        let gradient_norm = self.network.backward(&gradient)?;
        if !gradient_norm.is_finite() {
            return Err(self.not_finite("gradient"));
        }
        let learning_rate = match self.rate {
            Rate::Cosine { first, n_updates } => cosine_rate(first, self.n_updates, n_updates),
            Rate::Constant(rate) => rate,
        };
        self.network.update(&self.adam, learning_rate)?;
        self.n_updates += 1;
        Ok(Update {
            loss,
            gradient_norm,
            learning_rate,
        })
    }

    fn not_finite(&self, what: &str) -> PlannerError {
        PlannerError::NotFinite {
            what: format!("the {what} of network \"{}\"", self.name),
            place: format!("in its update {}", self.n_updates + 1),
            checkpoint: None,
        }
    }

    /// Everything to go on from.
    ///
    /// # Errors
    /// The device does not give it.
    pub fn state(&self) -> Result<TrainingState, PlannerError> {
        self.network.state()
    }

    /// Updates so far.
    pub fn n_updates(&self) -> u64 {
        self.n_updates
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rate_falls_on_a_cosine() {
        assert_eq!(cosine_rate(2e-4, 0, 20), 2e-4);
        assert!((cosine_rate(2e-4, 10, 20) - 1e-4).abs() < 1e-18);
        assert!(cosine_rate(2e-4, 20, 20).abs() < 1e-18);
    }
}
