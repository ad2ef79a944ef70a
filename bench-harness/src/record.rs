//! What a rollout leaves: one record per episode, and the steps.

mod comparison;
mod summary;

pub use comparison::Comparison;
pub use summary::{SuccessRates, Summary};

/// One episode, in numbers.
#[derive(Debug, Clone, PartialEq)]
pub struct EpisodeRecord {
    /// Number of the episode in this rollout, from 0, counted through all runs.
    pub episode: usize,
    /// Number of its run, from 0: runs are repetitions over which seeds vary.
    pub run: usize,
    /// Seed of its reset.
    pub seed: u64,
    /// Number of steps.
    pub length: usize,
    /// Undiscounted sum of its rewards, the last step's included.
    pub total_return: f64,
    /// Sum of discountᵗ · rewardₜ, t from 0.
    pub discounted_return: f64,
    /// Whether the task ended it.
    pub terminated: bool,
    /// Whether the time limit ended it; both may be true.
    pub truncated: bool,
    /// Whether any step was a success; `None` where the environment reports none.
    pub success: Option<bool>,
    /// Whether the last step was.
    pub success_at_end: Option<bool>,
    /// The first step that was, from 1: the number of steps taken until then (0: at the reset).
    pub first_success_step: Option<usize>,
    /// (return - min) / (max - min) with the reference returns of D4RL or Minari, where there are any; 1 is the
    /// reference expert. Papers print 100 times this.
    pub normalized_score: Option<f64>,
}

/// The steps of one finished episode of N steps, all row by row.
#[derive(Debug, Clone, PartialEq)]
pub struct EpisodeTrace {
    /// Its numbers.
    pub record: EpisodeRecord,
    /// `(N + 1, observation_dim)`: the observation before every step, and the one after the last.
    pub observations: Vec<f64>,
    /// `(N, action_dim)`, as they went into the environment.
    pub actions: Vec<f64>,
    /// `(N,)`.
    pub rewards: Vec<f64>,
    /// `(N + 1, info_dim)`: the simulator's state at every observation.
    pub infos: Vec<f64>,
    /// `(N + 1,)`, the reset's first; empty where the environment reports no success.
    pub successes: Vec<bool>,
    /// `(N, number of annotations)`: what the policy tells of every step, NaN where it tells nothing.
    pub annotations: Vec<f64>,
}

#[cfg(test)]
mod tests {
    use super::EpisodeRecord;

    /// An episode of ten steps.
    pub(super) fn record(
        run: usize,
        total_return: f64,
        first_success_step: Option<usize>,
    ) -> EpisodeRecord {
        EpisodeRecord {
            episode: 0,
            run,
            seed: 0,
            length: 10,
            total_return,
            discounted_return: total_return / 2.0,
            terminated: total_return > 3.0,
            truncated: true,
            success: Some(first_success_step.is_some()),
            success_at_end: Some(first_success_step == Some(10)),
            first_success_step,
            normalized_score: Some(total_return / 4.0),
        }
    }
}
