use std::num::NonZeroUsize;

use ksim_envs::Environment;
use ksim_envs::toy::{DT_S, GOAL, point_mass};
use proptest::prelude::*;

use super::*;
use crate::policy::{Random, Zero};

fn environments(n_slots: usize) -> VectorEnvironment {
    let one = || Box::new(point_mass(None)) as Box<dyn Environment>;
    VectorEnvironment::new((0..n_slots).map(|_| one()).collect()).unwrap()
}

fn config(n_episodes: usize) -> RolloutConfig {
    RolloutConfig {
        n_episodes,
        n_runs: 1,
        seed: 7,
        discount: 0.9,
        reset: ResetOptions::default(),
        reference: None,
    }
}

/// Keeps what it is given, and stops where it is told to.
#[derive(Default)]
struct Keep {
    traces: Vec<EpisodeTrace>,
    stop_after_episodes: Option<usize>,
    stop_after_steps: Option<u64>,
}

impl Observer for Keep {
    fn episode(&mut self, trace: EpisodeTrace) -> Result<Continue, HarnessError> {
        self.traces.push(trace);
        Ok(if self.stop_after_episodes == Some(self.traces.len()) {
            Continue::Stop
        } else {
            Continue::Yes
        })
    }

    fn progress(&mut self, n_steps: u64) -> Continue {
        match self.stop_after_steps {
            Some(limit) if n_steps >= limit => Continue::Stop,
            _ => Continue::Yes,
        }
    }
}

fn play(
    n_slots: usize,
    policy: &mut dyn Policy,
    config: &RolloutConfig,
) -> (Vec<EpisodeTrace>, Result<(), HarnessError>) {
    let mut keep = Keep::default();
    let result = rollout(&mut environments(n_slots), policy, config, &mut keep);
    (keep.traces, result)
}

/// Pushes with a constant force, but for one step (episode, step) with NaN and one without an action.
struct Push {
    force: f64,
    n_playable: Option<NonZeroUsize>,
    nan_at: Option<(usize, usize)>,
    none_at: Option<(usize, usize)>,
    slots: [(usize, usize); 8],
}

impl Push {
    fn new(force: f64) -> Self {
        Self {
            force,
            n_playable: None,
            nan_at: None,
            none_at: None,
            slots: Default::default(),
        }
    }
}

impl Policy for Push {
    fn name(&self) -> &str {
        "push"
    }

    fn start_episode(
        &mut self,
        slot: usize,
        start: &EpisodeStart,
    ) -> Result<Option<NonZeroUsize>, PolicyError> {
        self.slots[slot] = (start.episode, 0);
        Ok(self.n_playable)
    }

    fn act(
        &mut self,
        slots: &[usize],
        _observations: &[f64],
        actions: &mut [f64],
    ) -> Result<(), Vec<(usize, PolicyError)>> {
        let mut failures = Vec::new();
        for (&slot, action) in slots.iter().zip(actions) {
            if self.none_at == Some(self.slots[slot]) {
                let (episode, n_episodes) = (0, 0);
                let error = PolicyError::NoEpisode {
                    episode,
                    n_episodes,
                };
                failures.push((slot, error));
            }
            let is_nan = self.nan_at == Some(self.slots[slot]);
            *action = if is_nan { f64::NAN } else { self.force };
            self.slots[slot].1 += 1;
        }
        if failures.is_empty() {
            Ok(())
        } else {
            Err(failures)
        }
    }
}

#[test]
fn the_return_is_the_way_to_the_end_with_the_last_step() {
    let config = RolloutConfig {
        reference: Some((-1.0, 3.0)),
        ..config(20)
    };
    let (traces, result) = play(3, &mut Push::new(1.0), &config);
    result.unwrap();
    assert_eq!(traces.len(), 20);
    for (number, trace) in traces.iter().enumerate() {
        let record = &trace.record;
        let n = record.length;
        assert_eq!((record.episode, record.seed), (number, 7 + number as u64));
        let start = trace.observations[0];
        let way = |n: usize| DT_S * DT_S * (n * (n + 1)) as f64 / 2.0;
        assert!(start + way(n - 1) < GOAL && start + way(n) >= GOAL);
        assert!((record.total_return - way(n)).abs() < 1e-12);
        let discounted = (0..n).map(|t| 0.9f64.powi(t as i32) * DT_S * DT_S * (t + 1) as f64);
        assert!((record.discounted_return - discounted.sum::<f64>()).abs() < 1e-12);
        assert_eq!(
            (record.terminated, record.truncated, record.success_at_end),
            (true, false, Some(true))
        );
        assert_eq!(record.first_success_step, Some(n));
        let score = (record.total_return + 1.0) / 4.0;
        assert_eq!(record.normalized_score, Some(score));
        assert_eq!(trace.observations.len(), (n + 1) * 2);
        assert_eq!(trace.infos.len(), (n + 1) * 3);
        assert_eq!((trace.actions.len(), trace.rewards.len()), (n, n));
        assert_eq!(trace.successes.len(), n + 1);
        assert_eq!(trace.infos[n * 3], trace.observations[n * 2]);
    }
}

#[test]
fn actions_go_in_as_they_are_and_the_time_limit_truncates() {
    let (traces, _) = play(2, &mut Push::new(-7.5), &config(2));
    let record = &traces[1].record;
    assert!(traces[1].actions.iter().all(|&action| action == -7.5));
    assert_eq!((record.length, record.terminated), (50, false));
    assert!(record.truncated);
    assert_eq!(
        (record.success, record.first_success_step),
        (Some(false), None)
    );
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(12))]
    #[test]
    fn slots_and_threads_change_nothing(
        n_slots in 1usize..9, n_threads in 1usize..4, n_episodes in 0usize..12,
    ) {
        let spec = environments(1).spec().clone();
        let (expected, _) = play(1, &mut Random::new(&spec), &config(n_episodes));
        prop_assert_eq!(expected.len(), n_episodes);
        let pool = rayon::ThreadPoolBuilder::new().num_threads(n_threads).build().unwrap();
        let (found, _) =
            pool.install(|| play(n_slots, &mut Random::new(&spec), &config(n_episodes)));
        prop_assert_eq!(found, expected);
    }
}

#[test]
fn runs_go_on_with_the_seeds_and_count_episodes_anew() {
    let config = RolloutConfig {
        n_runs: 3,
        ..config(2)
    };
    let mut policy = Push::new(1.0);
    policy.nan_at = Some((1, 3));
    let (traces, error) = play(1, &mut policy, &config);
    assert_eq!(traces.len(), 1);
    assert!(matches!(
        error,
        Err(HarnessError::Policy { episode: 1, .. })
    ));
    let (traces, _) = play(4, &mut Zero, &config);
    let numbers: Vec<(usize, usize, u64)> = traces
        .iter()
        .map(|trace| (trace.record.episode, trace.record.run, trace.record.seed))
        .collect();
    let expected = [
        (0, 0, 7),
        (1, 0, 8),
        (2, 1, 9),
        (3, 1, 10),
        (4, 2, 11),
        (5, 2, 12),
    ];
    assert_eq!(numbers, expected);
}

#[test]
fn a_failed_episode_leaves_all_before_it() {
    let mut policy = Push::new(1.0);
    policy.nan_at = Some((5, 3));
    for n_slots in [1, 2, 8] {
        let (traces, result) = play(n_slots, &mut policy, &config(9));
        assert_eq!(traces.len(), 5, "{n_slots} slots");
        let Err(error) = result else {
            panic!("no error");
        };
        assert_eq!(error.to_string(), "episode 5, step 3: policy `push`");
        let source = std::error::Error::source(&error).unwrap().to_string();
        assert_eq!(source, "action 0 is NaN, expected a finite number");
    }
}

#[test]
fn of_several_failures_the_earliest_episode_counts() {
    let mut policy = Push::new(1.0);
    policy.nan_at = Some((4, 2));
    policy.none_at = Some((6, 0));
    for (none_at, n_kept) in [((6, 0), 4), ((3, 5), 3), ((4, 2), 4)] {
        policy.none_at = Some(none_at);
        for n_slots in [1, 3, 8] {
            let (traces, result) = play(n_slots, &mut policy, &config(9));
            assert_eq!(traces.len(), n_kept, "{n_slots} slots");
            assert!(
                matches!(result, Err(HarnessError::Policy { episode, .. }) if episode == n_kept)
            );
        }
    }
}

/// A point mass whose simulation diverges in its third step where the start is right of a place.
struct Diverging<E> {
    environment: E,
    n_steps: usize,
    limit: f64,
}

impl<E: Environment> Environment for Diverging<E> {
    fn spec(&self) -> &ksim_envs::EnvironmentSpec {
        self.environment.spec()
    }

    fn reset(
        &mut self,
        seed: Option<u64>,
        options: &ResetOptions,
        observation: &mut [f64],
    ) -> Result<ksim_envs::ResetOutcome, ksim_envs::EnvironmentError> {
        let outcome = self.environment.reset(seed, options, observation)?;
        self.n_steps = if observation[0] > self.limit { 0 } else { 99 };
        Ok(outcome)
    }

    fn step(
        &mut self,
        action: &[f64],
        observation: &mut [f64],
    ) -> Result<ksim_envs::StepOutcome, ksim_envs::EnvironmentError> {
        self.n_steps += 1;
        if self.n_steps == 3 {
            return Err(ksim_envs::EnvironmentError::Diverged {
                step: 2,
                message: "too fast".to_owned(),
            });
        }
        self.environment.step(action, observation)
    }

    fn read_info(&self, info: &mut [f64]) {
        self.environment.read_info(info);
    }
}

#[test]
fn a_simulation_that_diverges_leaves_all_episodes_before_it() {
    let (all, _) = play(1, &mut Push::new(1.0), &config(12));
    let starts: Vec<f64> = all.iter().map(|trace| trace.observations[0]).collect();
    // Only episodes that start right of the first three can fail.
    let limit = starts[..3].iter().copied().fold(f64::MIN, f64::max);
    let first = starts.iter().position(|start| *start > limit);
    let first = first.expect("a later episode starts farther right");
    for n_slots in [1, 2, 5] {
        let one = || Diverging {
            environment: point_mass(None),
            n_steps: 0,
            limit,
        };
        let slots = (0..n_slots).map(|_| Box::new(one()) as Box<dyn Environment>);
        let mut environments = VectorEnvironment::new(slots.collect()).unwrap();
        let mut keep = Keep::default();
        let mut policy = Push::new(1.0);
        let result = rollout(&mut environments, &mut policy, &config(12), &mut keep);
        assert_eq!(keep.traces, all[..first]);
        let Err(HarnessError::Environment { episode, step, .. }) = result else {
            panic!("{result:?}");
        };
        assert_eq!((episode, step), (first, 2));
    }
}

#[test]
fn an_environment_that_fails_is_named_with_its_episode() {
    let mut config = config(3);
    config.reset.goal_cell = Some((1, 1));
    let (traces, result) = play(2, &mut Zero, &config);
    assert!(traces.is_empty());
    assert!(matches!(
        result,
        Err(HarnessError::Environment {
            episode: 0,
            step: 0,
            ..
        })
    ));
}

#[test]
fn a_policy_that_runs_out_of_actions_truncates() {
    let mut policy = Push::new(0.0);
    policy.n_playable = NonZeroUsize::new(4);
    let (traces, result) = play(2, &mut policy, &config(3));
    result.unwrap();
    assert!(
        traces
            .iter()
            .all(|trace| trace.record.length == 4 && trace.record.truncated)
    );
}

#[test]
fn a_stopped_rollout_leaves_whole_episodes_from_the_first() {
    let spec = environments(1).spec().clone();
    let (all, _) = play(1, &mut Random::new(&spec), &config(12));
    for (stop_after_episodes, stop_after_steps) in [(Some(3), None), (None, Some(120))] {
        let mut keep = Keep {
            stop_after_episodes,
            stop_after_steps,
            ..Keep::default()
        };
        let mut policy = Random::new(&spec);
        rollout(&mut environments(4), &mut policy, &config(12), &mut keep).unwrap();
        assert!(keep.traces.len() < all.len());
        assert_eq!(keep.traces, all[..keep.traces.len()]);
        assert!(stop_after_episodes.is_none_or(|n| n == keep.traces.len()));
    }
}

#[test]
fn settings_that_make_no_sense_are_refused() {
    let cases = [
        RolloutConfig {
            discount: 1.5,
            ..config(1)
        },
        RolloutConfig {
            discount: f64::NAN,
            ..config(1)
        },
        RolloutConfig {
            n_runs: 0,
            ..config(1)
        },
        RolloutConfig {
            reference: Some((1.0, 1.0)),
            ..config(1)
        },
        RolloutConfig {
            seed: u64::MAX,
            ..config(1)
        },
        RolloutConfig {
            n_runs: usize::MAX,
            ..config(2)
        },
    ];
    for config in cases {
        let (_, result) = play(1, &mut Zero, &config);
        assert!(
            matches!(result, Err(HarnessError::Config { .. })),
            "{config:?}"
        );
    }
}
