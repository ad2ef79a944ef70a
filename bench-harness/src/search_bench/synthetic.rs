//! Trajectories made from a seed, shaped like those of a walking robot: a few driven oscillators, seen through many
//! sensors.

use ksim::{DataError, Trajectories};
use rayon::prelude::*;

use super::QueryKind;
use crate::rng::{Purpose, Rng};

/// Oscillators behind all sensors: what makes 31 columns of a robot fewer than 31 free directions.
const LATENT_DIM: usize = 12;
/// Width of an action.
pub(super) const ACTION_DIM: usize = 8;
/// Steps of an episode.
const EPISODE_STEPS: usize = 1000;
/// Seconds of a step.
const STEP_S: f64 = 0.1;
/// Episodes made at a time, in parallel.
const CHUNK_EPISODES: usize = 64;

/// A seeded source of episodes. The first columns of wide states are the states of narrow ones, and the first
/// episodes of many the episodes of few.
#[derive(Debug, Clone)]
pub(super) struct Synthetic {
    seed: u64,
    /// Per sensor: weights of the oscillators, then the one it sees bent.
    sensors: Vec<([f64; LATENT_DIM], usize)>,
    /// Per action: weights of the oscillators.
    policy: Vec<[f64; LATENT_DIM]>,
    /// Per oscillator: stiffness.
    stiffness: [f64; LATENT_DIM],
}

impl Synthetic {
    /// A robot with so many sensors.
    pub(super) fn new(seed: u64, state_dim: usize) -> Self {
        let mut rng = Rng::new(seed, Purpose::Synthetic);
        let weights =
            |rng: &mut Rng| std::array::from_fn(|_| rng.normal() / (LATENT_DIM as f64).sqrt());
        let policy = (0..ACTION_DIM).map(|_| weights(&mut rng)).collect();
        let stiffness = std::array::from_fn(|_| 0.2 + 1.8 * rng.uniform());
        let sensors = (0..state_dim)
            .map(|_| (weights(&mut rng), rng.below(LATENT_DIM)))
            .collect();
        Self {
            seed,
            sensors,
            policy,
            stiffness,
        }
    }

    /// At least `n_rows` steps of a kind of behavior, cut to as many. Reference data are of the kind
    /// [`QueryKind::InDistribution`]; `stream` tells them from queries of that kind.
    pub(super) fn trajectories(
        &self,
        kind: QueryKind,
        stream: u64,
        n_rows: usize,
    ) -> Result<Trajectories, DataError> {
        let mut data = Trajectories::new(self.sensors.len(), ACTION_DIM)?;
        let n_episodes = n_rows.div_ceil(EPISODE_STEPS);
        for start in (0..n_episodes).step_by(CHUNK_EPISODES) {
            let end = (start + CHUNK_EPISODES).min(n_episodes);
            let made: Vec<_> = (start..end)
                .into_par_iter()
                .map(|episode| self.episode(kind, stream, episode))
                .collect();
            for (episode, (states, actions)) in (start..).zip(made) {
                let n = EPISODE_STEPS.min(n_rows - data.n_rows());
                let (states, actions) = (
                    &states[..n * self.sensors.len()],
                    &actions[..n * ACTION_DIM],
                );
                data.push(episode as i64, states, actions)?;
            }
        }
        Ok(data)
    }

    fn episode(&self, kind: QueryKind, stream: u64, episode: usize) -> (Vec<f64>, Vec<f64>) {
        // One stream per episode, whatever thread makes it.
        let mut seeds = Rng::new(self.seed ^ (stream << 32), Purpose::Synthetic);
        let seed = seeds.seed() ^ (episode as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        let mut rng = Rng::new(seed, Purpose::Synthetic);
        let mut position: [f64; LATENT_DIM] = std::array::from_fn(|_| rng.normal());
        let mut velocity = [0.0; LATENT_DIM];
        let mut states = Vec::with_capacity(EPISODE_STEPS * self.sensors.len());
        let mut actions = Vec::with_capacity(EPISODE_STEPS * ACTION_DIM);
        for _ in 0..EPISODE_STEPS {
            for (weights, bent) in &self.sensors {
                let noise = 0.05 * (rng.uniform() - 0.5);
                states.push(dot(weights, &position) + 0.3 * (2.0 * position[*bent]).sin() + noise);
            }
            let action = self.action(kind, &position, &mut rng);
            for (i, (x, v)) in position.iter_mut().zip(&mut velocity).enumerate() {
                let force = 1.5 * action[i % ACTION_DIM] - self.stiffness[i] * *x - 0.3 * *v;
                *v += STEP_S * force;
                *x += STEP_S * *v;
            }
            actions.extend(action);
        }
        (states, actions)
    }

    fn action(
        &self,
        kind: QueryKind,
        position: &[f64; LATENT_DIM],
        rng: &mut Rng,
    ) -> [f64; ACTION_DIM] {
        let noise = match kind {
            QueryKind::InDistribution => 0.2,
            QueryKind::Noisy => 0.8,
            QueryKind::Random => return std::array::from_fn(|_| 2.0 * rng.uniform() - 1.0),
        };
        std::array::from_fn(|i| (dot(&self.policy[i], position) + noise * rng.normal()).tanh())
    }
}

fn dot(a: &[f64; LATENT_DIM], b: &[f64; LATENT_DIM]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(data: &Trajectories, row: usize) -> (Vec<f64>, Vec<f64>) {
        let (mut state, mut action) = (vec![0.0; data.state_dim()], vec![0.0; data.action_dim()]);
        data.read_step(row, &mut state, &mut action);
        (state, action)
    }

    #[test]
    fn the_same_seed_gives_the_same_steps_and_a_smaller_set_is_the_start_of_a_larger() {
        let make = |seed, n| {
            Synthetic::new(seed, 5)
                .trajectories(QueryKind::InDistribution, 0, n)
                .unwrap()
        };
        let (small, large) = (make(1, 1500), make(1, 3000));
        assert_eq!(small.n_rows(), 1500);
        assert_eq!(row(&small, 1499), row(&large, 1499));
        assert_ne!(row(&small, 3), row(&make(2, 10), 3));
    }

    #[test]
    fn steps_follow_each_other_and_random_behavior_acts_at_random() {
        let robot = Synthetic::new(0, 3);
        let calm = robot
            .trajectories(QueryKind::InDistribution, 0, 1000)
            .unwrap();
        for at in 1..1000 {
            let (before, now) = (row(&calm, at - 1).0, row(&calm, at).0);
            assert!(before.iter().zip(&now).all(|(a, b)| (a - b).abs() < 1.0));
        }
        let random = robot.trajectories(QueryKind::Random, 1, 1000).unwrap();
        let mean: f64 = (0..1000).map(|at| row(&random, at).1[0]).sum::<f64>() / 1000.0;
        assert!(mean.abs() < 0.1, "{mean}");
    }
}
