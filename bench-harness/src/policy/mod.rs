//! What chooses actions.
//!
//! [`PolicySpec`] reads what a user writes, [`build`] makes the policy; the rest are the policies themselves. Whatever
//! is random in one comes from the seed of the episode, in a ChaCha8 stream of its own per purpose, so that an episode
//! is the same wherever and beside whatever it is played.

mod error;
mod mlp;
mod noise;
mod planned;
mod random;
mod replay;
mod spec;
mod waypoint;
mod zero;

use std::num::NonZeroUsize;

pub use error::PolicyError;
pub use mlp::{Mlp, MlpOptions};
pub use planned::{ANNOTATIONS, Planned};
pub use random::Random;
pub use replay::Replay;
pub use spec::{KINDS, PolicySpec};
pub use waypoint::Waypoint;
pub use zero::Zero;

use ksim_envs::EnvironmentSpec;

/// The start of an episode, as a policy is told of it.
#[derive(Debug, Clone, Copy)]
pub struct EpisodeStart {
    /// Number of the episode in its run, from 0.
    pub episode: usize,
    /// Seed of its reset; a policy that draws seeds its own stream with it.
    pub seed: u64,
}

/// A number that a policy tells of every step.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Annotation {
    /// Its name; the column of a recording is `info.` and this.
    pub name: &'static str,
}

/// One policy for a batch of environments. An environment keeps its slot for a whole episode; whatever a policy
/// remembers or draws belongs to a slot, so that results do not depend on what runs beside.
pub trait Policy: Send {
    /// Name for tables and files, such as `mlp:hopper-tqc`.
    fn name(&self) -> &str;

    /// An episode starts in a slot. Returns how many steps of it the policy can play, after which the episode counts
    /// as truncated; `None` if there is no limit.
    ///
    /// # Errors
    /// The policy cannot play this episode (a replay has no such episode).
    fn start_episode(
        &mut self,
        slot: usize,
        start: &EpisodeStart,
    ) -> Result<Option<NonZeroUsize>, PolicyError>;

    /// Writes the actions of the given slots, which are in ascending order and have all been started. `observations`
    /// has the shape `(slots.len(), observation_dim)`, `actions` `(slots.len(), action_dim)`, both row by row.
    ///
    /// # Errors
    /// The slots for which the policy has no action, and why; the actions of the others are written all the same.
    fn act(
        &mut self,
        slots: &[usize],
        observations: &[f64],
        actions: &mut [f64],
    ) -> Result<(), Vec<(usize, PolicyError)>>;

    /// What [`Policy::annotate`] tells, for the whole rollout the same.
    fn annotations(&self) -> &'static [Annotation] {
        &[]
    }

    /// Writes the numbers of the action that was given last in a slot, one per [`Policy::annotations`]; NaN where
    /// there is none.
    fn annotate(&self, slot: usize, out: &mut [f64]) {
        let _ = (slot, out);
    }
}

/// Makes the policy that a specification asks for, to act in `environment`.
///
/// # Errors
/// A file that cannot be read, or a policy of other widths than the environment's.
pub fn build(
    spec: &PolicySpec,
    environment: &EnvironmentSpec,
) -> Result<Box<dyn Policy>, PolicyError> {
    let name = spec.to_string();
    Ok(match spec {
        PolicySpec::Random => Box::new(Random::new(environment)),
        PolicySpec::Zero => Box::new(Zero),
        PolicySpec::Replay { file } => Box::new(Replay::open(name, file, environment)?),
        PolicySpec::Mlp {
            file,
            sample,
            noise,
        } => {
            let options = MlpOptions {
                sample: *sample,
                noise: *noise,
            };
            Box::new(Mlp::open(name, file, options, environment)?)
        }
        PolicySpec::Waypoint { far, near, noise } => {
            let near = near.as_deref().unwrap_or(far);
            Box::new(Waypoint::open(name, [far, near], *noise, environment)?)
        }
    })
}
