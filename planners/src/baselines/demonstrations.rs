//! The recorded episodes that the baselines draw on.

use std::ops::Range;

use ksim_datasets::{
    DatasetSource, ObservationLayout, TransitionOptions, TransitionReader, Transitions,
};

use super::error::BaselineError;
use crate::data::goal_order;

/// All episodes of a dataset, in memory.
#[derive(Debug, Clone, PartialEq)]
pub struct Demonstrations {
    name: String,
    pub(super) observation_dim: usize,
    pub(super) action_dim: usize,
    /// `(n_steps, observation_dim)`, raw.
    pub(super) observations: Vec<f64>,
    /// `(n_steps, action_dim)`, raw.
    pub(super) actions: Vec<f32>,
    /// `(n_steps,)`; empty where the dataset records none.
    pub(super) rewards: Vec<f64>,
    /// Rows of every episode; none is empty.
    pub(super) episodes: Vec<Range<usize>>,
}

impl Demonstrations {
    /// Reads a dataset. Observations of a goal-conditioned maze come in the order in which environments give them:
    /// achieved goal, observation, desired goal. What errors call the dataset is its id.
    ///
    /// # Errors
    /// It cannot be read, has no steps, or holds a number that is not finite.
    pub fn read(source: &dyn DatasetSource) -> Result<Self, BaselineError> {
        let layout = ObservationLayout::new(&source.info().observation);
        let options = TransitionOptions {
            state_columns: goal_order(&layout),
            rewards: true,
            ..TransitionOptions::default()
        };
        let reader = TransitionReader::new(source, &options)?;
        let mut reading = Reading {
            read: Self {
                name: source.info().id.clone(),
                observation_dim: reader.state_width(),
                action_dim: reader.action_width(),
                observations: Vec::new(),
                actions: Vec::new(),
                rewards: Vec::new(),
                episodes: Vec::new(),
            },
            numbers: Vec::new(),
        };
        for batch in reader {
            reading.push(&batch?)?;
        }
        let mut read = reading.read;
        if read.n_steps() == 0 {
            return Err(BaselineError::NoSteps { dataset: read.name });
        }
        if read.rewards.len() != read.n_steps() {
            read.rewards.clear();
        }
        Ok(read)
    }

    /// Id of the dataset.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Numbers in an observation.
    pub fn observation_dim(&self) -> usize {
        self.observation_dim
    }

    /// Numbers in an action.
    pub fn action_dim(&self) -> usize {
        self.action_dim
    }

    /// Steps of all episodes.
    pub fn n_steps(&self) -> usize {
        self.actions.len() / self.action_dim.max(1)
    }

    /// Episodes.
    pub fn n_episodes(&self) -> usize {
        self.episodes.len()
    }

    /// A hash of everything that planning sees.
    pub fn fingerprint(&self) -> String {
        let mut hasher = blake3::Hasher::new();
        for number in [self.observation_dim, self.action_dim, self.episodes.len()] {
            hasher.update(&(number as u64).to_le_bytes());
        }
        for rows in &self.episodes {
            hasher.update(&(rows.len() as u64).to_le_bytes());
        }
        for values in [&self.observations, &self.rewards] {
            for value in values {
                hasher.update(&value.to_le_bytes());
            }
        }
        for value in &self.actions {
            hasher.update(&value.to_le_bytes());
        }
        hasher.finalize().to_hex()[..32].to_owned()
    }

    /// Smallest and largest value of every action column.
    pub fn action_bounds(&self) -> (Vec<f32>, Vec<f32>) {
        let mut low = vec![f32::INFINITY; self.action_dim];
        let mut high = vec![f32::NEG_INFINITY; self.action_dim];
        for action in self.actions.chunks_exact(self.action_dim) {
            for ((value, low), high) in action.iter().zip(&mut low).zip(&mut high) {
                *low = low.min(*value);
                *high = high.max(*value);
            }
        }
        (low, high)
    }

    /// For every step the sum of the rewards from it to the end of its episode, undiscounted.
    pub(super) fn returns_to_go(&self) -> Result<Vec<f64>, BaselineError> {
        if self.rewards.is_empty() {
            return Err(BaselineError::NoRewards {
                dataset: self.name.clone(),
            });
        }
        let mut returns = self.rewards.clone();
        for rows in &self.episodes {
            for row in rows.clone().rev().skip(1) {
                returns[row] += returns[row + 1];
            }
        }
        Ok(returns)
    }

    /// Number of the episode that a row belongs to.
    pub(super) fn episode_of(&self, row: usize) -> usize {
        self.episodes.partition_point(|rows| rows.end <= row)
    }

    pub(super) fn action(&self, row: usize) -> &[f32] {
        &self.actions[row * self.action_dim..][..self.action_dim]
    }

    /// Episodes already in memory: observations of the shape `(n_steps, observation_dim)`, actions of the shape
    /// `(n_steps, action_dim)`, rewards of the shape `(n_steps,)` or none, and the length of every episode.
    pub fn from_parts(
        name: String,
        [observation_dim, action_dim]: [usize; 2],
        observations: Vec<f64>,
        actions: Vec<f32>,
        rewards: Vec<f64>,
        lengths: &[usize],
    ) -> Option<Self> {
        let mut episodes = Vec::with_capacity(lengths.len());
        let mut start = 0usize;
        for &length in lengths {
            let end = start.checked_add(length).filter(|&end| end > start)?;
            episodes.push(start..end);
            start = end;
        }
        let fits = observation_dim > 0
            && action_dim > 0
            && start > 0
            && start.checked_mul(observation_dim) == Some(observations.len())
            && start.checked_mul(action_dim) == Some(actions.len())
            && (rewards.is_empty() || rewards.len() == start)
            && observations
                .iter()
                .chain(&rewards)
                .all(|value| value.is_finite())
            && actions.iter().all(|value| value.is_finite());
        fits.then_some(Self {
            name,
            observation_dim,
            action_dim,
            observations,
            actions,
            rewards,
            episodes,
        })
    }
}

/// A dataset that is being read.
struct Reading {
    read: Demonstrations,
    /// The dataset's number of every episode.
    numbers: Vec<i64>,
}

impl Reading {
    fn push(&mut self, batch: &Transitions) -> Result<(), BaselineError> {
        self.check(batch, "observation", &batch.states, batch.state_width)?;
        self.check(batch, "action", &batch.actions, batch.action_width)?;
        if let Some(rewards) = &batch.rewards {
            self.check(batch, "reward", rewards, 1)?;
            self.read.rewards.extend(rewards);
        }
        for &number in &batch.episode_index {
            let row = self.read.episodes.last().map_or(0, |rows| rows.end);
            match self.read.episodes.last_mut() {
                Some(rows) if self.numbers.last() == Some(&number) => rows.end += 1,
                _ => {
                    if self.numbers.contains(&number) {
                        return Err(BaselineError::SplitEpisode {
                            dataset: self.read.name.clone(),
                            episode: number,
                        });
                    }
                    self.read.episodes.push(row..row + 1);
                    self.numbers.push(number);
                }
            }
        }
        self.read.observations.extend(&batch.states);
        self.read
            .actions
            .extend(batch.actions.iter().map(|&value| value as f32));
        Ok(())
    }

    fn check(
        &self,
        batch: &Transitions,
        part: &'static str,
        values: &[f64],
        width: usize,
    ) -> Result<(), BaselineError> {
        // What is finite as f64 only would be infinite as an action.
        let Some(at) = values.iter().position(|value| !(*value as f32).is_finite()) else {
            return Ok(());
        };
        let (row, column) = (at / width, at % width);
        Err(BaselineError::NotFinite {
            dataset: self.read.name.clone(),
            episode: batch.episode_index[row],
            step: batch.step_index[row],
            part,
            column,
            value: values[at],
        })
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// Walks through the plane. The only action column holds the number of the row, the reward is 1.
    pub(in crate::baselines) fn walks(lengths: &[usize]) -> Demonstrations {
        let n: usize = lengths.iter().sum();
        Demonstrations::from_parts(
            "walks".to_owned(),
            [2, 1],
            observations(n),
            (0..n).map(|row| row as f32).collect(),
            vec![1.0; n],
            lengths,
        )
        .unwrap()
    }

    /// `(n, 2)`, all different.
    pub(in crate::baselines) fn observations(n: usize) -> Vec<f64> {
        (0..2 * n).map(|i| (i as f64 * 0.7).sin() * 3.0).collect()
    }

    #[test]
    fn returns_are_those_to_the_end_of_the_episode() {
        let returns = walks(&[2, 3]).returns_to_go().unwrap();
        assert_eq!(returns, [2.0, 1.0, 3.0, 2.0, 1.0]);
    }

    #[test]
    fn rows_know_their_episode() {
        let walks = walks(&[2, 3, 1]);
        let episodes: Vec<usize> = (0..6).map(|row| walks.episode_of(row)).collect();
        assert_eq!(episodes, [0, 0, 1, 1, 1, 2]);
        assert_eq!(walks.action_bounds(), (vec![0.0], vec![5.0]));
    }

    #[test]
    fn parts_that_do_not_go_together_make_nothing() {
        let parts = |observations: Vec<f64>, n_actions: usize, lengths: &[usize]| {
            let actions = vec![0.0; n_actions];
            Demonstrations::from_parts(
                String::new(),
                [1, 1],
                observations,
                actions,
                vec![],
                lengths,
            )
        };
        assert!(parts(vec![0.0; 3], 3, &[1, 2]).is_some());
        assert!(parts(vec![0.0; 3], 2, &[1, 2]).is_none());
        assert!(parts(vec![0.0; 3], 3, &[3, 0]).is_none());
        assert!(parts(vec![f64::NAN; 3], 3, &[3]).is_none());
        assert!(parts(vec![0.0; 3], 3, &[usize::MAX, 4]).is_none());
        assert!(parts(vec![], 0, &[]).is_none());
    }
}
