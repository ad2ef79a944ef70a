//! Windows of episodes, with the value of each.

use serde::{Deserialize, Serialize};

use super::{Episodes, Normalizer};
use crate::config::{DataConfig, Mode, RewardRule};
use crate::error::PlannerError;

/// Which episodes windows come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Subset {
    /// All.
    All,
    /// With [`RewardRule::Goal`] those that end at the goal, with [`RewardRule::Locomotion`] those whose return is not
    /// below the median (`succ_only` of the reference).
    Successful,
}

/// An episode as training sees it.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Path {
    start: usize,
    length: usize,
    successful: bool,
}

/// All windows of a dataset. A window is `horizon` rows of normalized observation and raw action.
#[derive(Debug, Clone)]
pub struct Windows {
    /// Statistics of the observations.
    pub normalizer: Normalizer,
    /// Steps in a window.
    pub horizon: usize,
    observation_dim: usize,
    width: usize,
    /// Rows of the shape `(n_rows, width)`.
    rows: Vec<f32>,
    /// Rewards after the rule.
    rewards: Vec<f32>,
    /// Discounted return from each row to the end of its episode.
    values: Vec<f32>,
    paths: Vec<Path>,
    /// Path and first step of every window of every path.
    all: Vec<(u32, u32)>,
    /// Indices into `all` whose path is successful.
    successful: Vec<u32>,
    /// Paths that are shorter than a window.
    n_short: usize,
}

impl Windows {
    /// Cuts episodes into windows, by the reference's rules or by the corrected ones.
    ///
    /// # Errors
    /// The episodes do not fit the rules: none is long enough, or one is longer than the configuration says.
    pub fn new(episodes: &Episodes, config: &DataConfig, mode: Mode) -> Result<Self, PlannerError> {
        let width = episodes.observation_dim + episodes.action_dim;
        let normalizer = Normalizer::fit(&episodes.observations, episodes.observation_dim);
        let mut windows = Self {
            rows: rows(episodes, &normalizer),
            normalizer,
            horizon: config.horizon,
            observation_dim: episodes.observation_dim,
            width,
            rewards: episodes
                .rewards
                .iter()
                .map(|&reward| reward as f32)
                .collect(),
            values: vec![0.0; episodes.n_rows()],
            paths: Vec::new(),
            all: Vec::new(),
            successful: Vec::new(),
            n_short: 0,
        };
        windows.apply_rule(episodes, config, mode)?;
        windows.discount(config.discount);
        windows.index(config, mode)?;
        Ok(windows)
    }

    /// Rewards of the rule, and which paths there are.
    fn apply_rule(
        &mut self,
        episodes: &Episodes,
        config: &DataConfig,
        mode: Mode,
    ) -> Result<(), PlannerError> {
        let equal = episodes
            .spans
            .windows(2)
            .all(|pair| pair[0].length == pair[1].length);
        if mode == Mode::Reference && config.rule == RewardRule::Goal && !equal {
            return Err(PlannerError::DatasetFit {
                what: "the length of episodes",
                expected: "the same for all (mode reference)".to_owned(),
                found: "different".to_owned(),
            });
        }
        for span in &episodes.spans {
            let range = span.start..span.start + span.length;
            let successful = match config.rule {
                RewardRule::Locomotion => {
                    // A path without an end is dropped: what would have come is unknown.
                    if !(span.terminated || span.truncated) {
                        continue;
                    }
                    if span.terminated && !span.truncated {
                        self.rewards[range.end - 1] = config.terminal_penalty as f32;
                    }
                    false
                }
                RewardRule::Goal => {
                    let rewards = &mut self.rewards[range];
                    let offset = config.reward_offset as f32;
                    rewards.iter_mut().for_each(|reward| *reward += offset);
                    let last = rewards.len() - 1;
                    let at_goal = f64::from(rewards[last]) >= config.reward_offset + 0.05;
                    rewards[last] = if at_goal {
                        config.goal_bonus
                    } else {
                        config.terminal_penalty
                    } as f32;
                    at_goal
                }
            };
            self.paths.push(Path {
                start: span.start,
                length: span.length,
                successful,
            });
        }
        if config.rule == RewardRule::Locomotion {
            self.better_half();
        }
        Ok(())
    }

    /// Marks the paths whose return is not below the median.
    fn better_half(&mut self) {
        let total = |path: &Path| -> f64 {
            let rewards = &self.rewards[path.start..path.start + path.length];
            rewards.iter().map(|&reward| f64::from(reward)).sum()
        };
        let returns: Vec<f64> = self.paths.iter().map(total).collect();
        let mut sorted = returns.clone();
        sorted.sort_by(f64::total_cmp);
        let n = sorted.len();
        if n == 0 {
            return;
        }
        let median = f64::midpoint(sorted[(n - 1) / 2], sorted[n / 2]);
        for (path, total) in self.paths.iter_mut().zip(&returns) {
            path.successful = *total >= median;
        }
    }

    /// V(t) = r(t) + γ·V(t + 1), to the end of the episode.
    fn discount(&mut self, discount: f64) {
        for path in &self.paths {
            let mut value = 0.0;
            for row in (path.start..path.start + path.length).rev() {
                value = f64::from(self.rewards[row]) + discount * value;
                self.values[row] = value as f32;
            }
        }
    }

    /// Lists the windows: in mode reference every step from which `horizon` steps fit into the longest episode, in
    /// mode corrected every step from which they fit into its own.
    fn index(&mut self, config: &DataConfig, mode: Mode) -> Result<(), PlannerError> {
        let horizon = config.horizon;
        for (number, path) in self.paths.iter().enumerate() {
            if path.length > config.max_path_length {
                return Err(PlannerError::DatasetFit {
                    what: "the length of an episode",
                    expected: format!("at most {} (data.max_path_length)", config.max_path_length),
                    found: path.length.to_string(),
                });
            }
            let n_starts = match mode {
                Mode::Reference => path
                    .length
                    .min((config.max_path_length + 1).saturating_sub(horizon)),
                Mode::Corrected => (path.length + 1).saturating_sub(horizon),
            };
            self.n_short += usize::from(n_starts == 0);
            for start in 0..n_starts {
                if path.successful {
                    self.successful.push(self.all.len() as u32);
                }
                self.all.push((number as u32, start as u32));
            }
        }
        if self.all.is_empty() {
            let longest = self.paths.iter().map(|path| path.length).max().unwrap_or(0);
            return Err(PlannerError::DatasetFit {
                what: "the longest episode with an end",
                expected: format!("at least {horizon} steps (data.horizon)"),
                found: format!("{longest} steps"),
            });
        }
        Ok(())
    }

    /// Numbers in a row: observation and action.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Numbers in an observation.
    pub fn observation_dim(&self) -> usize {
        self.observation_dim
    }

    /// Number of windows of a subset.
    pub fn n_windows(&self, subset: Subset) -> usize {
        match subset {
            Subset::All => self.all.len(),
            Subset::Successful => self.successful.len(),
        }
    }

    /// Number of episodes of which windows are taken.
    pub fn n_episodes(&self) -> usize {
        self.paths.len()
    }

    /// Number of episodes that are shorter than a window and are left out.
    pub fn n_short(&self) -> usize {
        self.n_short
    }

    /// Episode (in the order of those with an end) and first step of a window of a subset.
    pub fn place(&self, subset: Subset, index: usize) -> (usize, usize) {
        let (path, start) = match subset {
            Subset::All => self.all[index],
            Subset::Successful => self.all[self.successful[index] as usize],
        };
        (path as usize, start as usize)
    }

    /// Writes a window of the shape `(horizon, width)`; what lies behind the end of its episode is zero.
    pub fn fill(&self, subset: Subset, index: usize, out: &mut [f32]) {
        let (path, start) = self.place(subset, index);
        let path = self.paths[path];
        let n_rows = self.horizon.min(path.length - start);
        let first = (path.start + start) * self.width;
        let (inside, behind) = out.split_at_mut(n_rows * self.width);
        inside.copy_from_slice(&self.rows[first..first + n_rows * self.width]);
        behind.fill(0.0);
    }

    /// Writes the rewards of a window, of the shape `(horizon,)`; what lies behind the end of its episode is zero.
    pub fn fill_rewards(&self, subset: Subset, index: usize, out: &mut [f32]) {
        let (path, start) = self.place(subset, index);
        let path = self.paths[path];
        let n_rows = self.horizon.min(path.length - start);
        let first = path.start + start;
        out.fill(0.0);
        out[..n_rows].copy_from_slice(&self.rewards[first..first + n_rows]);
    }

    /// Value of a window: the discounted return from its first step to the end of its episode.
    pub fn value(&self, subset: Subset, index: usize) -> f32 {
        let (path, start) = self.place(subset, index);
        self.values[self.paths[path].start + start]
    }

    /// Mean and deviation of the values of all windows; a deviation of 0 counts as 1.
    pub fn value_statistics(&self) -> (f64, f64) {
        let n = self.all.len() as f64;
        let values = || (0..self.all.len()).map(|index| f64::from(self.value(Subset::All, index)));
        let mean = values().sum::<f64>() / n;
        let variance = values().map(|value| (value - mean).powi(2)).sum::<f64>() / n;
        let std = variance.sqrt();
        (mean, if std > 0.0 { std } else { 1.0 })
    }

    /// The normalized observation with which an episode starts.
    pub fn first_observation(&self, episode: usize) -> &[f32] {
        let first = self.paths[episode].start * self.width;
        &self.rows[first..first + self.observation_dim]
    }
}

/// Normalized observations beside raw actions, of the shape `(n_rows, width)`.
fn rows(episodes: &Episodes, normalizer: &Normalizer) -> Vec<f32> {
    let (observation_dim, action_dim) = (episodes.observation_dim, episodes.action_dim);
    let width = observation_dim + action_dim;
    let mut rows = vec![0.0; episodes.n_rows() * width];
    let observations = episodes.observations.chunks_exact(observation_dim);
    let actions = episodes.actions.chunks_exact(action_dim);
    for ((row, observation), action) in rows.chunks_exact_mut(width).zip(observations).zip(actions)
    {
        let (normalized, raw) = row.split_at_mut(observation_dim);
        normalizer.normalize(observation, normalized);
        for (out, &value) in raw.iter_mut().zip(action) {
            *out = value as f32;
        }
    }
    rows
}
