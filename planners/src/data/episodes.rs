//! Episodes in memory.

use blake3::Hasher;
use ksim_datasets::{
    DatasetInfo, DatasetSource, ObservationLayout, TransitionOptions, TransitionReader, Transitions,
};

use crate::error::PlannerError;

/// Where an episode stands, and how it ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct EpisodeSpan {
    /// Its first row.
    pub start: usize,
    /// Its steps.
    pub length: usize,
    /// Whether its last step is terminal.
    pub terminated: bool,
    /// Whether its last step is the last of a time limit.
    pub truncated: bool,
}

/// All complete transitions of a dataset, one episode after the other.
#[derive(Debug, Clone, PartialEq)]
pub struct Episodes {
    /// Numbers in an observation.
    pub observation_dim: usize,
    /// Numbers in an action.
    pub action_dim: usize,
    /// Raw observations of the shape `(n_rows, observation_dim)`.
    pub observations: Vec<f64>,
    /// Raw actions of the shape `(n_rows, action_dim)`.
    pub actions: Vec<f64>,
    /// Rewards of the shape `(n_rows,)`.
    pub rewards: Vec<f64>,
    /// The episodes, which cover the rows in order.
    pub spans: Vec<EpisodeSpan>,
    /// Column of the dataset's observation for each number of an observation here.
    pub observation_order: Vec<usize>,
    /// Whether observations contain a goal, as a maze's do.
    pub has_goal: bool,
}

impl Episodes {
    /// Reads a dataset. Observations of a goal-conditioned maze come in the reference's order: achieved goal,
    /// observation, desired goal.
    ///
    /// # Errors
    /// The dataset cannot be read, is empty, or records no rewards.
    pub fn read(source: &dyn DatasetSource) -> Result<Self, PlannerError> {
        let layout = ObservationLayout::new(&source.info().observation);
        let goal_order = goal_order(&layout);
        let has_goal = goal_order.is_some();
        let observation_order = goal_order.unwrap_or_else(|| (0..layout.width()).collect());
        let options = TransitionOptions {
            state_columns: Some(observation_order.clone()),
            rewards: true,
            flags: true,
            ..TransitionOptions::default()
        };
        let reader = TransitionReader::new(source, &options)?;
        let mut episodes = Self {
            observation_dim: reader.state_width(),
            action_dim: reader.action_width(),
            observations: Vec::new(),
            actions: Vec::new(),
            rewards: Vec::new(),
            spans: Vec::new(),
            observation_order,
            has_goal,
        };
        let mut current = None;
        for batch in reader {
            episodes.append(batch?, &mut current)?;
        }
        if episodes.spans.is_empty() {
            return Err(PlannerError::DatasetFit {
                what: "the number of steps",
                expected: "at least 1".to_owned(),
                found: "0".to_owned(),
            });
        }
        Ok(episodes)
    }

    fn append(
        &mut self,
        batch: Transitions,
        current: &mut Option<i64>,
    ) -> Result<(), PlannerError> {
        let Some(rewards) = batch.rewards else {
            return Err(PlannerError::DatasetFit {
                what: "the reward column",
                expected: "a number for every step".to_owned(),
                found: "missing".to_owned(),
            });
        };
        let flag =
            |flags: &Option<Vec<bool>>, row: usize| flags.as_ref().is_some_and(|flags| flags[row]);
        for (row, &episode) in batch.episode_index.iter().enumerate() {
            if *current != Some(episode) {
                *current = Some(episode);
                self.spans.push(EpisodeSpan {
                    start: self.rewards.len() + row,
                    length: 0,
                    terminated: false,
                    truncated: false,
                });
            }
            if let Some(span) = self.spans.last_mut() {
                span.length += 1;
                span.terminated = flag(&batch.terminated, row);
                span.truncated = flag(&batch.truncated, row);
            }
        }
        // What is finite as f64 only would be infinite in training.
        let is_wrong = |value: &f64| !(*value as f32).is_finite();
        for (what, values) in [
            ("an observation", &batch.states),
            ("an action", &batch.actions),
            ("a reward", &rewards),
        ] {
            if let Some(at) = values.iter().position(is_wrong) {
                let row = at / (values.len() / rewards.len());
                return Err(PlannerError::DatasetFit {
                    what,
                    expected: "finite numbers".to_owned(),
                    found: format!(
                        "{:?} in episode {}, step {}",
                        values[at], batch.episode_index[row], batch.step_index[row]
                    ),
                });
            }
        }
        self.observations.extend(batch.states);
        self.actions.extend(batch.actions);
        self.rewards.extend(rewards);
        Ok(())
    }

    /// Number of steps.
    pub fn n_rows(&self) -> usize {
        self.rewards.len()
    }

    /// Least and greatest number of each action: −1 and 1, or what the dataset has where it goes beyond.
    pub fn action_bounds(&self) -> (Vec<f32>, Vec<f32>) {
        let (mut low, mut high) = (vec![-1.0; self.action_dim], vec![1.0; self.action_dim]);
        for action in self.actions.chunks_exact(self.action_dim) {
            for ((low, high), &value) in low.iter_mut().zip(&mut high).zip(action) {
                *low = f32::min(*low, value as f32);
                *high = f32::max(*high, value as f32);
            }
        }
        (low, high)
    }

    /// A hash of everything that training sees, the same however the dataset is stored.
    pub fn fingerprint(&self) -> String {
        let mut hasher = Hasher::new();
        for size in [self.observation_dim, self.action_dim, self.spans.len()] {
            hasher.update(&(size as u64).to_le_bytes());
        }
        for span in &self.spans {
            hasher.update(&(span.length as u64).to_le_bytes());
            hasher.update(&[u8::from(span.terminated), u8::from(span.truncated)]);
        }
        let mut bytes = Vec::new();
        for values in [&self.observations, &self.actions, &self.rewards] {
            for part in values.chunks(8192) {
                bytes.clear();
                bytes.extend(part.iter().flat_map(|value| value.to_le_bytes()));
                hasher.update(&bytes);
            }
        }
        hasher.finalize().to_hex().to_string()
    }
}

/// Whether observations of a dataset contain a goal, as a maze's do.
pub(crate) fn has_goal(info: &DatasetInfo) -> bool {
    goal_order(&ObservationLayout::new(&info.observation)).is_some()
}

/// Columns of a goal-conditioned maze's state in the reference's order; `None` for other observations.
pub(crate) fn goal_order(layout: &ObservationLayout) -> Option<Vec<usize>> {
    const LEAVES: [&str; 3] = ["achieved_goal", "observation", "desired_goal"];
    let mut order = Vec::with_capacity(layout.width());
    for name in LEAVES {
        let leaf = layout.leaves().iter().find(|leaf| leaf.name == name)?;
        order.extend(leaf.offset..leaf.offset + leaf.width);
    }
    (layout.leaves().len() == LEAVES.len()).then_some(order)
}
