//! A point mass on a line, whose motion and return are known in closed form.
//!
//! `PointMass-v0`: a unit mass at `x`, pushed with a force `a` clamped to [−1, 1], Euler steps of [`DT_S`] seconds:
//! `v ← v + a·dt`, then `x ← x + v·dt`. An episode starts at rest at `x ~ U(−0.5, 0.5)`, earns `x′ − x` each step and
//! ends with success once `x ≥ 1`. Hence the return of an episode is the way it went, `x_T − x_0`, and a constant
//! force `a` puts the mass after `n` steps at `x_0 + a·dt²·n(n + 1)/2`.

use crate::environment::{Environment, EnvironmentSpec, Part, ResetOptions, RewardTerms};
use crate::error::EnvironmentError;
use crate::numpy_rng::Generator;
use crate::simulation::{Judgement, Physics, SimEnvironment, Task};

/// The point mass's id.
pub const POINT_MASS_ID: &str = "PointMass-v0";

/// Control step, in seconds: a power of two, so that sums of steps are exact.
pub const DT_S: f64 = 0.125;

/// Where an episode ends with success.
pub const GOAL: f64 = 1.0;

/// The time limit of `PointMass-v0` in steps; a full push needs 14 steps at most.
pub const MAX_EPISODE_STEPS: usize = 50;

/// Makes a `PointMass-v0`, of [`MAX_EPISODE_STEPS`] if no other limit is given.
pub fn point_mass(max_episode_steps: Option<usize>) -> impl Environment {
    let part = |name, width| Part { name, width };
    let spec = EnvironmentSpec {
        id: POINT_MASS_ID.to_owned(),
        observation: vec![part("", 2)],
        action_low: vec![-1.0],
        action_high: vec![1.0],
        info: vec![part("qpos", 1), part("qvel", 1), part("goal", 1)],
        max_episode_steps: max_episode_steps.unwrap_or(MAX_EPISODE_STEPS),
        dt_s: DT_S,
        reports_success: true,
        kwargs: serde_json::Map::new(),
    };
    SimEnvironment::new(spec, PointMass::default(), Reach::default())
}

/// A unit mass on a line.
#[derive(Debug, Clone, Copy, Default)]
struct PointMass {
    position: f64,
    velocity: f64,
}

impl Physics for PointMass {
    fn step(&mut self, control: &[f64]) -> Result<(), String> {
        self.velocity += control[0].clamp(-1.0, 1.0) * DT_S;
        self.position += self.velocity * DT_S;
        Ok(())
    }
}

/// To get past [`GOAL`].
#[derive(Debug, Clone, Copy, Default)]
struct Reach {
    position_before: f64,
}

impl Task<PointMass> for Reach {
    fn initialize(
        &mut self,
        physics: &mut PointMass,
        generator: &mut Generator,
        options: &ResetOptions,
    ) -> Result<Option<bool>, EnvironmentError> {
        options.refuse_cells(POINT_MASS_ID)?;
        *physics = PointMass {
            position: generator.uniform(-0.5, 0.5),
            velocity: 0.0,
        };
        Ok(Some(false))
    }

    fn before_step(&mut self, physics: &PointMass) {
        self.position_before = physics.position;
    }

    fn observe(&self, physics: &PointMass, observation: &mut [f64]) {
        observation.copy_from_slice(&[physics.position, physics.velocity]);
    }

    fn judge(&mut self, physics: &PointMass, _action: &[f64], _: &mut Generator) -> Judgement {
        let forward = physics.position - self.position_before;
        let success = physics.position >= GOAL;
        Judgement {
            reward: forward,
            terminated: success,
            success: Some(success),
            terms: RewardTerms {
                forward,
                ..RewardTerms::default()
            },
        }
    }

    fn read_info(&self, physics: &PointMass, info: &mut [f64]) {
        info.copy_from_slice(&[physics.position, physics.velocity, GOAL]);
    }

    fn restore(&mut self, physics: &mut PointMass, info: &[f64]) {
        *physics = PointMass {
            position: info[0],
            velocity: info[1],
        };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_full_push_goes_and_earns_what_the_formula_says() {
        let mut environment = point_mass(None);
        let mut observation = [0.0; 2];
        environment
            .reset(Some(3), &ResetOptions::default(), &mut observation)
            .unwrap();
        let start = observation[0];
        let mut total_return = 0.0;
        let mut n_steps = 0;
        loop {
            let outcome = environment.step(&[1.0], &mut observation).unwrap();
            n_steps += 1;
            total_return += outcome.reward;
            let formula = start + DT_S * DT_S * f64::from(n_steps * (n_steps + 1)) / 2.0;
            assert!((observation[0] - formula).abs() < 1e-12);
            assert_eq!(outcome.terminated, formula >= GOAL);
            assert_eq!(outcome.success, Some(outcome.terminated));
            if outcome.is_last() {
                break;
            }
        }
        assert!(n_steps <= 14);
        assert!((total_return - (observation[0] - start)).abs() < 1e-12);
    }

    #[test]
    fn a_force_outside_the_limits_is_clamped_and_rest_earns_nothing() {
        let mut environment = point_mass(Some(2));
        let mut observation = [0.0; 2];
        environment
            .reset(Some(0), &ResetOptions::default(), &mut observation)
            .unwrap();
        let outcome = environment.step(&[0.0], &mut observation).unwrap();
        assert_eq!(outcome.reward, 0.0);
        let outcome = environment.step(&[7.0], &mut observation).unwrap();
        assert_eq!(observation[1], DT_S);
        assert!(outcome.truncated && !outcome.terminated);
    }

    #[test]
    fn the_documentation_says_what_it_is() {
        let documentation = include_str!("../../../docs/environments.md");
        let row =
            format!("| `{POINT_MASS_ID}` | 2 | 1 | {DT_S} s | {MAX_EPISODE_STEPS} | at the goal |");
        assert!(documentation.contains(&row), "{row}");
    }

    #[test]
    fn a_maze_cell_is_refused() {
        let options = ResetOptions {
            reset_cell: Some((1, 2)),
            ..ResetOptions::default()
        };
        let error = point_mass(None).reset(None, &options, &mut [0.0; 2]);
        let message = error.unwrap_err().to_string();
        assert!(message.contains("`reset_cell`: expected none"), "{message}");
    }
}
