//! What policies of ours do to their actions last: noise, and the limits of the action space.

use ksim_envs::EnvironmentSpec;

use crate::rng::{Purpose, SlotRngs};

/// Adds Gaussian noise, then clips to the action space.
#[derive(Debug)]
pub(super) struct ActionNoise {
    std: f64,
    low: Vec<f64>,
    high: Vec<f64>,
    rngs: SlotRngs,
}

impl ActionNoise {
    pub(super) fn new(std: f64, environment: &EnvironmentSpec) -> Self {
        Self {
            std,
            low: environment.action_low.clone(),
            high: environment.action_high.clone(),
            rngs: SlotRngs::new(Purpose::ActionNoise),
        }
    }

    pub(super) fn start(&mut self, slot: usize, seed: u64) {
        self.rngs.start(slot, seed);
    }

    pub(super) fn apply(&mut self, slot: usize, action: &mut [f64]) {
        if self.std > 0.0 {
            let rng = self.rngs.slot(slot);
            action
                .iter_mut()
                .for_each(|value| *value += self.std * rng.normal());
        }
        for ((value, low), high) in action.iter_mut().zip(&self.low).zip(&self.high) {
            // Not `clamp`, which panics where limits are NaN; NaN actions stay what they are.
            if *value < *low {
                *value = *low;
            } else if *value > *high {
                *value = *high;
            }
        }
    }
}
