//! What every environment must pass.

use crate::environment::{Environment, ResetOptions, StepOutcome};
use crate::error::EnvironmentError;
use crate::numpy_rng::Generator;

/// Makes an environment, always the same one.
pub type Make<'a> = &'a dyn Fn() -> Box<dyn Environment>;

/// Checks what [`Environment`] promises. Environments should be made with a time limit of some dozen steps: one
/// episode is stepped to its end.
///
/// # Panics
/// Where a promise is broken.
pub fn check_environment(make: Make<'_>) {
    specification_is_usable(make);
    steps_outside_an_episode_are_refused(make);
    bad_slices_are_refused_and_change_nothing(make);
    a_seed_decides_a_trajectory(make);
    a_reset_without_seed_continues_the_stream(make);
    environments_share_nothing(make);
    the_time_limit_truncates(make);
}

/// What an episode's start or step showed: observation, info and outcome.
type Record = (Vec<f64>, Vec<f64>, Option<StepOutcome>);

/// An environment with its buffers.
struct Driver {
    environment: Box<dyn Environment>,
    observation: Vec<f64>,
    actions: Generator,
}

impl Driver {
    fn new(make: Make<'_>) -> Self {
        let environment = make();
        Self {
            observation: vec![0.0; environment.spec().observation_dim()],
            actions: Generator::new(9),
            environment,
        }
    }

    fn record(&self, outcome: Option<StepOutcome>) -> Record {
        let mut info = vec![0.0; self.environment.spec().info_dim()];
        self.environment.read_info(&mut info);
        (self.observation.clone(), info, outcome)
    }

    fn reset(&mut self, seed: Option<u64>) -> Record {
        self.environment
            .reset(seed, &ResetOptions::default(), &mut self.observation)
            .expect("a reset without options works");
        self.record(None)
    }

    /// Steps with the next random action.
    fn step(&mut self) -> Record {
        let spec = self.environment.spec();
        let limits = spec.action_low.iter().zip(&spec.action_high);
        let action: Vec<f64> = limits
            .map(|(&low, &high)| self.actions.uniform(low, high))
            .collect();
        let outcome = self.environment.step(&action, &mut self.observation);
        self.record(Some(outcome.expect("a step inside an episode works")))
    }

    /// Resets with a seed and takes some steps, fewer if the episode ends.
    fn trajectory(&mut self, seed: u64) -> Vec<Record> {
        self.actions = Generator::new(9);
        let mut records = vec![self.reset(Some(seed))];
        for _ in 0..10 {
            records.push(self.step());
            if Self::is_over(&records) {
                break;
            }
        }
        records
    }

    fn is_over(records: &[Record]) -> bool {
        records
            .last()
            .and_then(|(_, _, outcome)| outcome.as_ref())
            .is_some_and(StepOutcome::is_last)
    }

    fn step_error(&mut self, action: &[f64]) -> EnvironmentError {
        self.environment
            .step(action, &mut self.observation)
            .expect_err("the step is to be refused")
    }

    fn rest(&self) -> Vec<f64> {
        vec![0.0; self.environment.spec().action_dim()]
    }
}

fn specification_is_usable(make: Make<'_>) {
    let environment = make();
    let spec = environment.spec();
    assert!(!spec.id.is_empty());
    assert!(spec.observation_dim() > 0 && spec.action_dim() > 0);
    assert!(spec.max_episode_steps > 0 && spec.dt_s > 0.0);
    assert_eq!(spec.action_low.len(), spec.action_high.len());
    let mut limits = spec.action_low.iter().zip(&spec.action_high);
    assert!(limits.all(|(low, high)| low < high));
    assert_eq!(spec, make().spec());
}

fn steps_outside_an_episode_are_refused(make: Make<'_>) {
    let mut driver = Driver::new(make);
    let rest = driver.rest();
    assert_eq!(driver.step_error(&rest), EnvironmentError::NotReset);
    driver.reset(Some(0));
    let mut n_steps = 1;
    while !Driver::is_over(&[driver.step()]) {
        n_steps += 1;
    }
    let over = EnvironmentError::EpisodeOver { step: n_steps };
    assert_eq!(driver.step_error(&rest), over);
    driver.reset(None);
    driver.step();
}

fn bad_slices_are_refused_and_change_nothing(make: Make<'_>) {
    let mut driver = Driver::new(make);
    let start = driver.reset(Some(1));
    let mut action = driver.rest();
    action.push(0.0);
    assert!(matches!(
        driver.step_error(&action),
        EnvironmentError::Width { what: "action", .. }
    ));
    action.pop();
    for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        action[0] = bad;
        assert!(matches!(
            driver.step_error(&action),
            EnvironmentError::ActionNotFinite { index: 0, .. }
        ));
    }
    let mut narrow = vec![0.0; driver.observation.len() - 1];
    let narrow_step = driver.environment.step(&driver.rest(), &mut narrow);
    assert!(matches!(narrow_step, Err(EnvironmentError::Width { .. })));
    assert_eq!(driver.record(None), start);
    let narrow_reset = driver
        .environment
        .reset(None, &ResetOptions::default(), &mut narrow);
    assert!(matches!(narrow_reset, Err(EnvironmentError::Width { .. })));
}

fn a_seed_decides_a_trajectory(make: Make<'_>) {
    let (mut first, mut second) = (Driver::new(make), Driver::new(make));
    let expected = first.trajectory(5);
    second.trajectory(6);
    assert_eq!(second.trajectory(5), expected, "after another episode");
    assert_ne!(
        first.trajectory(6)[0].1,
        expected[0].1,
        "another seed starts elsewhere"
    );
    let observations = expected.iter().flat_map(|(observation, _, _)| observation);
    assert!(observations.into_iter().all(|value| value.is_finite()));
}

fn a_reset_without_seed_continues_the_stream(make: Make<'_>) {
    let (mut seeded, mut fresh) = (Driver::new(make), Driver::new(make));
    let first = seeded.reset(Some(0));
    let second = seeded.reset(None);
    assert_ne!(first.1, second.1, "the second episode starts elsewhere");
    assert_eq!(fresh.reset(None), first, "a fresh stream is that of seed 0");
    assert_eq!(fresh.reset(None), second);
}

fn environments_share_nothing(make: Make<'_>) {
    let (mut left, mut right) = (Driver::new(make), Driver::new(make));
    let expected = left.trajectory(3);
    left.actions = Generator::new(9);
    right.actions = Generator::new(4);
    let mut records = vec![left.reset(Some(3))];
    right.reset(Some(8));
    let mut is_right_over = false;
    while records.len() < expected.len() {
        records.push(left.step());
        if !is_right_over {
            is_right_over = Driver::is_over(&[right.step()]);
        }
    }
    assert_eq!(records, expected);
}

fn the_time_limit_truncates(make: Make<'_>) {
    let mut driver = Driver::new(make);
    driver.reset(Some(2));
    let limit = driver.environment.spec().max_episode_steps;
    for step in 1..=limit {
        let outcome = driver.step().2.expect("a step has an outcome");
        assert_eq!(outcome.truncated, step == limit, "step {step} of {limit}");
        let reports = driver.environment.spec().reports_success;
        assert_eq!(outcome.success.is_some(), reports);
        if outcome.terminated {
            break;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::toy::point_mass;

    #[test]
    fn the_point_mass_passes() {
        check_environment(&|| Box::new(point_mass(Some(20))));
    }
}
