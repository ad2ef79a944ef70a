//! The one rollout loop of the workspace.
//!
//! **Actions** reach the environment as the policy gives them; the loop changes none. The environments do not clip
//! either: a simulator clamps controls outside their range, while the control cost takes the raw action. The policies
//! of this crate therefore clip to the action space themselves, all but [`crate::policy::Replay`], which repeats what
//! was recorded. A number that is not finite is an error with policy, episode and step.
//!
//! **Ends**: the step that ends an episode counts, reward and success included; nothing after it does.
//!
//! **Order**: a slot whose episode is over takes the next number. Finished episodes wait for those with smaller
//! numbers, so that what was handed on is a prefix without gaps at any moment. Where an episode fails, those before
//! it are still played to their ends and handed on, those after it are not: also the prefix of a failed rollout is the
//! same for any number of slots.

mod recorder;

use std::collections::BTreeMap;

use ksim_envs::ResetOptions;
use ksim_envs::vector::{VectorEnvironment, VectorError};

use self::recorder::Recorder;
use crate::error::HarnessError;
use crate::policy::{EpisodeStart, Policy, PolicyError};
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

/// Plays all episodes, as many at once as there are environments, on the current rayon pool. The episodes and their
/// order do not depend on how many that are, nor on the number of threads.
///
/// Ends early, without an error, where the observer stops it. Finished episodes that wait for a slower one are held
/// in memory. Called inside the pool (`pool.install`), a step allocates nothing but the room for what is recorded.
///
/// # Errors
/// A configuration that makes no sense, before any step; the environment or the policy failed, with episode and step,
/// after all episodes before that one were handed on; or the observer did, at once.
pub fn rollout(
    environments: &mut VectorEnvironment,
    policy: &mut dyn Policy,
    config: &RolloutConfig,
    observer: &mut dyn Observer,
) -> Result<(), HarnessError> {
    let n_episodes = config.check()?;
    let mut round = Rollout::new(environments, policy, config, n_episodes);
    while round.play()? {
        if round.hand_on(observer)? == Continue::Stop
            || observer.progress(round.n_steps) == Continue::Stop
        {
            return Ok(());
        }
    }
    round.failure.map_or(Ok(()), Err)
}

impl RolloutConfig {
    /// Checks the numbers and returns how many episodes there are in all runs together.
    fn check(&self) -> Result<usize, HarnessError> {
        let refuse = |name, expected, found: String| {
            Err(HarnessError::Config {
                name,
                expected,
                found,
            })
        };
        if !(0.0..=1.0).contains(&self.discount) {
            return refuse("discount", "a number in [0, 1]", self.discount.to_string());
        }
        if self.n_runs == 0 {
            return refuse("n_runs", "at least 1", "0".to_owned());
        }
        if let Some((min, max)) = self.reference
            && (!min.is_finite() || !max.is_finite() || min >= max)
        {
            let expected = "finite returns, the second above the first";
            return refuse("reference", expected, format!("{min} and {max}"));
        }
        match self.n_episodes.checked_mul(self.n_runs) {
            Some(n) if self.seed.checked_add(n as u64).is_some() => Ok(n),
            _ => {
                let found = format!(
                    "{} episodes of {} runs from seed {}",
                    self.n_episodes, self.n_runs, self.seed
                );
                refuse("n_episodes", "seeds that fit 64 bits", found)
            }
        }
    }
}

/// A rollout under way.
struct Rollout<'a> {
    environments: &'a mut VectorEnvironment,
    policy: &'a mut dyn Policy,
    config: &'a RolloutConfig,
    /// The running episode of every slot.
    slots: Vec<Option<Recorder>>,
    /// Number of the next episode to start.
    next: usize,
    /// Episodes from here on are not played: all are done, or this one failed.
    end: usize,
    failure: Option<HarnessError>,
    /// Finished episodes that wait for an earlier one.
    finished: BTreeMap<usize, EpisodeTrace>,
    n_handed_on: usize,
    n_steps: u64,
    /// The slots of this round, their observations and actions row by row.
    active: Vec<usize>,
    observations: Vec<f64>,
    actions: Vec<f64>,
}

impl<'a> Rollout<'a> {
    fn new(
        environments: &'a mut VectorEnvironment,
        policy: &'a mut dyn Policy,
        config: &'a RolloutConfig,
        n_episodes: usize,
    ) -> Self {
        Self {
            slots: (0..environments.len()).map(|_| None).collect(),
            environments,
            policy,
            config,
            next: 0,
            end: n_episodes,
            failure: None,
            finished: BTreeMap::new(),
            n_handed_on: 0,
            n_steps: 0,
            active: Vec::new(),
            observations: Vec::new(),
            actions: Vec::new(),
        }
    }

    /// One step of every running episode. `false` if none is left.
    fn play(&mut self) -> Result<bool, HarnessError> {
        for slot in 0..self.slots.len() {
            while self.slots[slot].is_none() && self.next < self.end {
                self.start(slot)?;
            }
        }
        self.active.clear();
        self.active
            .extend((0..self.slots.len()).filter(|&slot| self.slots[slot].is_some()));
        if self.active.is_empty() {
            return Ok(false);
        }
        self.act();
        self.step()?;
        Ok(true)
    }

    /// Starts the next episode in a free slot; the slot stays free if that fails.
    fn start(&mut self, slot: usize) -> Result<(), HarnessError> {
        let episode = self.next;
        self.next += 1;
        let start = EpisodeStart {
            episode: episode % self.config.n_episodes,
            seed: self.config.seed + episode as u64,
        };
        let n_playable = match self.policy.start_episode(slot, &start) {
            Ok(n_playable) => n_playable,
            Err(error) => {
                self.fail_policy(episode, 0, error);
                return Ok(());
            }
        };
        match self
            .environments
            .reset(slot, Some(start.seed), &self.config.reset)
        {
            Ok(outcome) => {
                let mut recorder = Recorder::new(self.config, episode, n_playable);
                recorder.observe(self.environments, slot, outcome.success);
                self.slots[slot] = Some(recorder);
                Ok(())
            }
            Err(error) => self.fail_environment(episode, 0, error),
        }
    }

    /// Asks the policy for the actions of this round.
    fn act(&mut self) {
        let action_dim = self.environments.spec().action_dim();
        self.observations.clear();
        for &slot in &self.active {
            self.observations
                .extend_from_slice(self.environments.observation(slot));
        }
        self.actions.clear();
        self.actions.resize(self.active.len() * action_dim, 0.0);
        if let Err(failures) = self
            .policy
            .act(&self.active, &self.observations, &mut self.actions)
        {
            for (slot, error) in failures {
                self.fail_slot(slot, error);
            }
        }
        for row in 0..self.active.len() {
            let action = &self.actions[row * action_dim..][..action_dim];
            if let Some(index) = action.iter().position(|value| !value.is_finite()) {
                let value = action[index];
                self.fail_slot(self.active[row], PolicyError::NotFinite { index, value });
            }
        }
        if self.failure.is_some() {
            self.drop_failed_rows(action_dim);
        }
    }

    /// Leaves the slots that were emptied since the round began out of it.
    fn drop_failed_rows(&mut self, action_dim: usize) {
        let mut kept = 0;
        for row in 0..self.active.len() {
            if self.slots[self.active[row]].is_some() {
                self.active[kept] = self.active[row];
                self.actions
                    .copy_within(row * action_dim..(row + 1) * action_dim, kept * action_dim);
                kept += 1;
            }
        }
        self.active.truncate(kept);
        self.actions.truncate(kept * action_dim);
    }

    /// Takes the step, records it, and puts finished episodes aside.
    fn step(&mut self) -> Result<(), HarnessError> {
        let action_dim = self.environments.spec().action_dim();
        if let Err(error) = self.environments.step(&self.active, &self.actions) {
            let failed: Vec<VectorError> = self.environments.errors().collect();
            if failed.is_empty() {
                return Err(error.into());
            }
            for error in failed {
                let VectorError::Slot { slot, .. } = error else {
                    return Err(error.into());
                };
                if let Some(recorder) = self.slots[slot].take() {
                    self.fail_environment(recorder.episode, recorder.length(), error)?;
                }
            }
        }
        for (row, &slot) in self.active.iter().enumerate() {
            let Some(recorder) = &mut self.slots[slot] else {
                continue;
            };
            self.n_steps += 1;
            let action = &self.actions[row * action_dim..][..action_dim];
            recorder.annotate(self.policy, slot);
            recorder.step(self.environments, slot, action);
            if recorder.is_over() {
                let trace = self.slots[slot].take().map(Recorder::finish);
                self.finished
                    .extend(trace.map(|trace| (trace.record.episode, trace)));
            }
        }
        Ok(())
    }

    fn hand_on(&mut self, observer: &mut dyn Observer) -> Result<Continue, HarnessError> {
        while let Some(trace) = self.finished.remove(&self.n_handed_on) {
            self.n_handed_on += 1;
            if observer.episode(trace)? == Continue::Stop {
                return Ok(Continue::Stop);
            }
        }
        Ok(Continue::Yes)
    }

    fn fail_slot(&mut self, slot: usize, error: PolicyError) {
        if let Some(Some(recorder)) = self.slots.get(slot) {
            self.fail_policy(recorder.episode, recorder.length(), error);
        }
    }

    fn fail_policy(&mut self, episode: usize, step: usize, source: PolicyError) {
        let policy = self.policy.name().to_owned();
        self.fail(
            episode,
            HarnessError::Policy {
                policy,
                episode,
                step,
                source: Box::new(source),
            },
        );
    }

    fn fail_environment(
        &mut self,
        episode: usize,
        step: usize,
        error: VectorError,
    ) -> Result<(), HarnessError> {
        let VectorError::Slot { source, .. } = error else {
            return Err(error.into());
        };
        self.fail(
            episode,
            HarnessError::Environment {
                episode,
                step,
                source,
            },
        );
        Ok(())
    }

    /// Gives up an episode and all after it; those before it go on, and may fail themselves.
    fn fail(&mut self, episode: usize, error: HarnessError) {
        if episode >= self.end {
            return;
        }
        self.end = episode;
        self.failure = Some(error);
        for slot in &mut self.slots {
            if slot
                .as_ref()
                .is_some_and(|recorder| recorder.episode >= episode)
            {
                *slot = None;
            }
        }
    }
}

#[cfg(test)]
mod tests;
