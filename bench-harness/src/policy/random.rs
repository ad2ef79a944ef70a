//! The policy that a normalized score counts as 0.

use std::num::NonZeroUsize;

use ksim_envs::EnvironmentSpec;

use super::{EpisodeStart, Policy, PolicyError};
use crate::rng::{Purpose, SlotRngs};

/// Actions drawn uniformly from the action space.
#[derive(Debug)]
pub struct Random {
    low: Vec<f64>,
    high: Vec<f64>,
    rngs: SlotRngs,
}

impl Random {
    /// Draws from the action space of `environment`.
    pub fn new(environment: &EnvironmentSpec) -> Self {
        Self {
            low: environment.action_low.clone(),
            high: environment.action_high.clone(),
            rngs: SlotRngs::new(Purpose::RandomAction),
        }
    }
}

impl Policy for Random {
    fn name(&self) -> &str {
        "random"
    }

    fn start_episode(
        &mut self,
        slot: usize,
        start: &EpisodeStart,
    ) -> Result<Option<NonZeroUsize>, PolicyError> {
        self.rngs.start(slot, start.seed);
        Ok(None)
    }

    fn act(
        &mut self,
        slots: &[usize],
        _observations: &[f64],
        actions: &mut [f64],
    ) -> Result<(), Vec<(usize, PolicyError)>> {
        for (&slot, action) in slots.iter().zip(actions.chunks_exact_mut(self.low.len())) {
            let rng = self.rngs.slot(slot);
            for ((value, low), high) in action.iter_mut().zip(&self.low).zip(&self.high) {
                *value = low + (high - low) * rng.uniform();
            }
        }
        Ok(())
    }
}
