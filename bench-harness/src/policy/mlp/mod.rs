//! Networks from safetensors files.
//!
//! A file holds the actor alone. Weights are `(out, in)`: `layers.N.weight` and `.bias` from N = 0, then `mean`; for
//! policies with a distribution `log_std.weight` and `.bias`, or a vector `log_std`; for policies that normalize
//! observations `obs_mean` and `obs_var`. The header says `kind` (`tanh_gaussian`, `gaussian`, `linear`), `activation`
//! (`relu`, `tanh`), and `obs_eps` and `obs_clip` where observations are normalized.

mod network;
mod read;

use std::num::NonZeroUsize;
use std::path::Path;

use ksim_envs::EnvironmentSpec;
use rayon::prelude::*;

pub(super) use self::network::{Network, Pass};
pub(super) use self::read::read;
use super::noise::ActionNoise;
use super::{EpisodeStart, Policy, PolicyError};
use crate::rng::{Purpose, SlotRngs};

/// How a network is to act.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct MlpOptions {
    /// Whether actions are drawn from the policy's distribution; otherwise they are its mode.
    pub sample: bool,
    /// Standard deviation of Gaussian noise that is added to actions before they are clipped.
    pub noise: f64,
}

/// A network that maps observations to actions. Clips to the action space.
///
/// Ant policies of the years when observations had 84 contact forces take 111 numbers. In Ant-v4 and Ant-v5 they get
/// the first 27 of the observation and 84 zeros, which is what their simulator gave them; Ant policies of width 27 get
/// the first 27.
#[derive(Debug)]
pub struct Mlp {
    name: String,
    network: Network,
    /// Numbers of the observation that the network sees.
    n_seen: usize,
    observation_dim: usize,
    /// Draws of the policy's distribution.
    samples: Option<SlotRngs>,
    noise: ActionNoise,
    passes: Vec<Pass>,
}

/// Numbers of an Ant's observation without contact forces.
const ANT_DIM: usize = 27;
/// Positions and velocities of the ant.
const ANT_STATE: [usize; 2] = [15, 14];
/// Numbers of the Ant's observation with the contact forces of version 3.
const ANT_CONTACT_DIM: usize = 111;

impl Mlp {
    /// Reads a network to act in `environment`.
    ///
    /// # Errors
    /// A file that is no network, or one of other widths; `sample` for a network without a distribution.
    pub fn open(
        name: String,
        file: &Path,
        options: MlpOptions,
        environment: &EnvironmentSpec,
    ) -> Result<Self, PolicyError> {
        let network = read(file)?;
        if options.sample && !network.has_distribution() {
            return Err(PolicyError::Option {
                kind: "mlp",
                option: "sample=true".to_owned(),
                expected: "a network with `log_std`".to_owned(),
            });
        }
        let n_seen = n_seen(&network, environment).ok_or_else(|| {
            let observation_dim = environment.observation_dim();
            width(
                &name,
                "observations",
                network.observation_dim(),
                environment,
                observation_dim,
            )
        })?;
        if network.action_dim() != environment.action_dim() {
            let action_dim = environment.action_dim();
            return Err(width(
                &name,
                "actions",
                network.action_dim(),
                environment,
                action_dim,
            ));
        }
        Ok(Self {
            name,
            network,
            n_seen,
            observation_dim: environment.observation_dim(),
            samples: options.sample.then(|| SlotRngs::new(Purpose::PolicySample)),
            noise: ActionNoise::new(options.noise, environment),
            passes: Vec::new(),
        })
    }
}

/// How many numbers of the observation the network sees, if it can act in this environment.
fn n_seen(network: &Network, environment: &EnvironmentSpec) -> Option<usize> {
    let (wanted, given) = (network.observation_dim(), environment.observation_dim());
    if wanted == given {
        Some(given)
    } else {
        let is_ants = [ANT_DIM, ANT_CONTACT_DIM].contains(&wanted);
        (is_ants && begins_as_ant(environment)).then_some(ANT_DIM)
    }
}

/// Whether an observation begins with the ant's 27 numbers: not for another robot in Ant's task, and not where the
/// horizontal position comes first.
fn begins_as_ant(environment: &EnvironmentSpec) -> bool {
    let state = environment.info.iter().map(|part| part.width);
    environment.id.starts_with("Ant-")
        && state.eq(ANT_STATE)
        && !environment
            .kwargs
            .contains_key("exclude_current_positions_from_observation")
}

pub(super) fn width(
    policy: &str,
    what: &'static str,
    policy_dim: usize,
    environment: &EnvironmentSpec,
    environment_dim: usize,
) -> PolicyError {
    PolicyError::Width {
        policy: policy.to_owned(),
        what,
        policy_dim,
        environment: environment.id.clone(),
        environment_dim,
    }
}

impl Policy for Mlp {
    fn name(&self) -> &str {
        &self.name
    }

    fn start_episode(
        &mut self,
        slot: usize,
        start: &EpisodeStart,
    ) -> Result<Option<NonZeroUsize>, PolicyError> {
        if let Some(samples) = &mut self.samples {
            samples.start(slot, start.seed);
        }
        self.noise.start(slot, start.seed);
        Ok(None)
    }

    fn act(
        &mut self,
        slots: &[usize],
        observations: &[f64],
        actions: &mut [f64],
    ) -> Result<(), Vec<(usize, PolicyError)>> {
        if self.passes.len() < slots.len() {
            self.passes.resize_with(slots.len(), Pass::default);
        }
        let (network, n_seen) = (&self.network, self.n_seen);
        self.passes
            .par_iter_mut()
            .zip(observations.par_chunks_exact(self.observation_dim))
            .for_each(|(pass, observation)| network.forward(&observation[..n_seen], pass));
        let rows = actions.chunks_exact_mut(network.action_dim());
        for ((&slot, pass), action) in slots.iter().zip(&self.passes).zip(rows) {
            match &mut self.samples {
                None => network.mean_action(pass, action),
                Some(samples) => {
                    let rng = samples.slot(slot);
                    network.sampled_action(pass, || rng.normal(), action);
                }
            }
            self.noise.apply(slot, action);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
