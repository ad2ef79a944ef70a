//! Keeps the steps of one running episode.

use std::num::NonZeroUsize;

use ksim_envs::vector::VectorEnvironment;

use super::RolloutConfig;
use crate::policy::Policy;
use crate::record::{EpisodeRecord, EpisodeTrace};

/// One episode under way.
pub(super) struct Recorder {
    /// Its number through all runs.
    pub(super) episode: usize,
    /// How many steps the policy can play, if it cannot go on forever.
    n_playable: Option<NonZeroUsize>,
    discount: f64,
    /// discountᵗ of the next step.
    weight: f64,
    reference: Option<(f64, f64)>,
    trace: EpisodeTrace,
}

impl Recorder {
    pub(super) fn new(
        config: &RolloutConfig,
        episode: usize,
        n_playable: Option<NonZeroUsize>,
    ) -> Self {
        let record = EpisodeRecord {
            episode,
            run: episode / config.n_episodes,
            seed: config.seed + episode as u64,
            length: 0,
            total_return: 0.0,
            discounted_return: 0.0,
            terminated: false,
            truncated: false,
            success: None,
            success_at_end: None,
            first_success_step: None,
            normalized_score: None,
        };
        Self {
            episode,
            n_playable,
            discount: config.discount,
            weight: 1.0,
            reference: config.reference,
            trace: EpisodeTrace {
                record,
                observations: Vec::new(),
                actions: Vec::new(),
                rewards: Vec::new(),
                infos: Vec::new(),
                successes: Vec::new(),
                annotations: Vec::new(),
            },
        }
    }

    pub(super) fn length(&self) -> usize {
        self.trace.record.length
    }

    /// Takes what the policy tells of its last action.
    pub(super) fn annotate(&mut self, policy: &dyn Policy, slot: usize) {
        let annotations = &mut self.trace.annotations;
        let start = annotations.len();
        annotations.resize(start + policy.annotations().len(), f64::NAN);
        policy.annotate(slot, &mut annotations[start..]);
    }

    /// Takes what stands in a slot after a step with this action.
    pub(super) fn step(&mut self, environments: &VectorEnvironment, slot: usize, action: &[f64]) {
        let outcome = &environments.outcomes()[slot];
        self.trace.actions.extend_from_slice(action);
        self.trace.rewards.push(outcome.reward);
        let record = &mut self.trace.record;
        record.length += 1;
        record.total_return += outcome.reward;
        record.discounted_return += self.weight * outcome.reward;
        record.terminated = outcome.terminated;
        let is_played_out = self.n_playable.is_some_and(|n| n.get() == record.length);
        record.truncated = outcome.truncated || is_played_out;
        self.weight *= self.discount;
        self.observe(environments, slot, outcome.success);
    }

    /// Takes what stands in a slot, after its reset or a step.
    pub(super) fn observe(
        &mut self,
        environments: &VectorEnvironment,
        slot: usize,
        success: Option<bool>,
    ) {
        let trace = &mut self.trace;
        trace
            .observations
            .extend_from_slice(environments.observation(slot));
        let n_infos = trace.infos.len();
        trace
            .infos
            .resize(n_infos + environments.spec().info_dim(), 0.0);
        environments.read_info(slot, &mut trace.infos[n_infos..]);
        trace.successes.extend(success);
        let record = &mut trace.record;
        if let Some(now) = success {
            record.success = Some(record.success.unwrap_or(false) || now);
            record.success_at_end = Some(now);
            if now && record.first_success_step.is_none() {
                record.first_success_step = Some(record.length);
            }
        }
    }

    pub(super) fn is_over(&self) -> bool {
        self.trace.record.terminated || self.trace.record.truncated
    }

    pub(super) fn finish(self) -> EpisodeTrace {
        let mut trace = self.trace;
        let total_return = trace.record.total_return;
        trace.record.normalized_score = self
            .reference
            .map(|(min, max)| (total_return - min) / (max - min));
        trace
    }
}
