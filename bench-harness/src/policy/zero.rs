//! The policy that does nothing.

use std::num::NonZeroUsize;

use super::{EpisodeStart, Policy, PolicyError};

/// Every action is zero, whatever the action space.
#[derive(Debug, Clone, Copy)]
pub struct Zero;

impl Policy for Zero {
    fn name(&self) -> &str {
        "zero"
    }

    fn start_episode(
        &mut self,
        _slot: usize,
        _start: &EpisodeStart,
    ) -> Result<Option<NonZeroUsize>, PolicyError> {
        Ok(None)
    }

    fn act(
        &mut self,
        _slots: &[usize],
        _observations: &[f64],
        actions: &mut [f64],
    ) -> Result<(), Vec<(usize, PolicyError)>> {
        actions.fill(0.0);
        Ok(())
    }
}
