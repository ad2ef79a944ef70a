//! The one rollout loop of the workspace.

use ksim_envs::ResetOptions;
use ksim_envs::vector::VectorEnvironment;

use crate::error::HarnessError;
use crate::policy::Policy;
use crate::record::EpisodeTrace;

/// What is to be rolled out.
#[derive(Debug, Clone, PartialEq)]
pub struct RolloutConfig {
    /// Episodes of every run.
    pub n_episodes: usize,
    /// Number of runs, at least 1.
    pub n_runs: usize,
    /// Episode k, counted from 0 through all runs, resets with seed `seed + k`.
    pub seed: u64,
    /// Discount of the discounted return, in [0, 1].
    pub discount: f64,
    /// What every reset asks for.
    pub reset: ResetOptions,
    /// Returns that count as 0 and 1 in the normalized score.
    pub reference: Option<(f64, f64)>,
}

/// What the receiver of an episode wants.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Continue {
    /// The next one.
    Yes,
    /// No more.
    Stop,
}

/// Who watches a rollout.
pub trait Observer {
    /// A finished episode; they come in the order of their numbers, without gaps.
    ///
    /// # Errors
    /// It could not be kept: the rollout stops.
    fn episode(&mut self, trace: EpisodeTrace) -> Result<Continue, HarnessError>;

    /// So many steps have been taken in all environments together; asked after every round. `Stop` ends the rollout
    /// before the running episodes are complete.
    fn progress(&mut self, n_steps: u64) -> Continue {
        let _ = n_steps;
        Continue::Yes
    }
}

/// Plays all episodes, as many at once as there are environments. The episodes and their order do not depend on how
/// many that are, nor on the number of threads.
///
/// # Errors
/// The environment or the policy failed, with episode and step; or the observer did.
pub fn rollout(
    environments: &mut VectorEnvironment,
    policy: &mut dyn Policy,
    config: &RolloutConfig,
    observer: &mut dyn Observer,
) -> Result<(), HarnessError> {
    let _ = (environments, policy, config, observer);
    Ok(())
}
