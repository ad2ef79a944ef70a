//! States and actions of whole episodes: the reference data and the rollouts alike.

use std::collections::HashSet;
use std::ops::Range;

use crate::error::DataError;
use crate::matrix::Matrix;

/// One episode's place in the rows.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EpisodeRows {
    /// The episode's own number in its dataset.
    pub episode_index: i64,
    /// Its rows, one per step, in step order.
    pub rows: Range<usize>,
}

/// State-action pairs in raw units, one row per step, grouped by episode.
///
/// ```
/// let mut data = ksim::Trajectories::new(2, 1)?;
/// data.push(0, &[0.0, 0.0, 0.1, 0.0], &[1.0, 0.5])?; // episode 0: two steps
/// data.push(1, &[5.0, 5.0], &[0.0])?; // episode 1: one step
/// assert_eq!((data.n_rows(), data.episodes().len()), (3, 2));
/// # Ok::<(), ksim::DataError>(())
/// ```
#[derive(Debug, Clone)]
pub struct Trajectories {
    pub(crate) states: Matrix,
    pub(crate) actions: Matrix,
    episodes: Vec<EpisodeRows>,
    seen: HashSet<i64>,
}

impl Trajectories {
    /// No steps yet, of the given widths.
    ///
    /// # Errors
    /// [`DataError::NoColumns`] if a width is 0.
    pub fn new(state_dim: usize, action_dim: usize) -> Result<Self, DataError> {
        Ok(Self {
            states: Matrix::new(state_dim)?,
            actions: Matrix::new(action_dim)?,
            episodes: Vec::new(),
            seen: HashSet::new(),
        })
    }

    /// Takes whole matrices, one row per step, and the episodes that their rows belong to, which must
    /// follow each other without a gap.
    ///
    /// # Errors
    /// [`DataError::UnequalRows`], [`DataError::SplitEpisode`]; [`DataError::Parts`] if the episodes do
    /// not cover the rows in order.
    pub fn from_parts(
        states: Matrix,
        actions: Matrix,
        episodes: Vec<EpisodeRows>,
    ) -> Result<Self, DataError> {
        if states.n_rows() != actions.n_rows() {
            return Err(DataError::UnequalRows {
                states: states.n_rows(),
                actions: actions.n_rows(),
            });
        }
        let mut seen = HashSet::with_capacity(episodes.len());
        let mut next = 0;
        for episode in &episodes {
            let episode_index = episode.episode_index;
            if !seen.insert(episode_index) {
                return Err(DataError::SplitEpisode { episode_index });
            }
            if episode.rows.start != next || episode.rows.end < next {
                return Err(DataError::Parts {
                    what: "first row of an episode",
                    expected: next,
                    found: episode.rows.start,
                });
            }
            next = episode.rows.end;
        }
        if next != states.n_rows() {
            return Err(DataError::Parts {
                what: "rows of all episodes",
                expected: states.n_rows(),
                found: next,
            });
        }
        Ok(Self {
            states,
            actions,
            episodes,
            seen,
        })
    }

    /// The states, raw units.
    pub fn states(&self) -> &Matrix {
        &self.states
    }

    /// The actions, raw units.
    pub fn actions(&self) -> &Matrix {
        &self.actions
    }

    /// Appends consecutive steps of one episode: `states` of shape `(n, state_dim)`, `actions` of
    /// shape `(n, action_dim)`, row-major, raw units. An episode may come in several pushes, one
    /// after the other.
    ///
    /// # Errors
    /// [`DataError::NonFiniteStep`] with the place, [`DataError::SplitEpisode`],
    /// [`DataError::UnequalRows`], [`DataError::RaggedRows`], [`DataError::TooManyRows`].
    pub fn push(
        &mut self,
        episode_index: i64,
        states: &[f64],
        actions: &[f64],
    ) -> Result<(), DataError> {
        let start = self.n_rows();
        let (n, n_actions) = (
            states.len() / self.state_dim(),
            actions.len() / self.action_dim(),
        );
        if n != n_actions {
            return Err(DataError::UnequalRows {
                states: n,
                actions: n_actions,
            });
        }
        let continues = self
            .episodes
            .last()
            .is_some_and(|e| e.episode_index == episode_index);
        if !continues && self.seen.contains(&episode_index) {
            return Err(DataError::SplitEpisode { episode_index });
        }
        let first_step = match self.episodes.last() {
            Some(last) if continues => last.rows.len(),
            _ => 0,
        };
        let at_step = |part: &'static str| {
            move |error| match error {
                DataError::NonFinite { row, column, value } => DataError::NonFiniteStep {
                    episode_index,
                    step_index: first_step + row,
                    part,
                    column,
                    value,
                },
                other => other,
            }
        };
        // Actions are checked before states are stored, so that a failed push leaves both equal.
        Matrix::from_f64(actions, self.action_dim()).map_err(at_step("action"))?;
        self.states.push_rows(states).map_err(at_step("state"))?;
        self.actions.push_rows(actions).map_err(at_step("action"))?;
        match self.episodes.last_mut() {
            Some(last) if continues => last.rows.end += n,
            _ => {
                self.seen.insert(episode_index);
                self.episodes.push(EpisodeRows {
                    episode_index,
                    rows: start..start + n,
                });
            }
        }
        Ok(())
    }

    /// Number of steps.
    pub fn n_rows(&self) -> usize {
        self.states.n_rows()
    }

    /// Width of a state.
    pub fn state_dim(&self) -> usize {
        self.states.n_features()
    }

    /// Width of an action.
    pub fn action_dim(&self) -> usize {
        self.actions.n_features()
    }

    /// Writes state and action of one step, in raw units and to 48 bits of significand.
    ///
    /// # Panics
    /// If `row` is out of range or one of the outputs has another length than its width.
    pub fn read_step(&self, row: usize, state: &mut [f64], action: &mut [f64]) {
        self.states.read_row(row, state);
        self.actions.read_row(row, action);
    }

    /// The episodes in the order they came.
    pub fn episodes(&self) -> &[EpisodeRows] {
        &self.episodes
    }

    /// A hash of everything a score can depend on: widths, values and episode borders, but not
    /// the format they were read from. 16 hexadecimal digits of BLAKE3.
    pub fn fingerprint(&self) -> String {
        let mut hasher = blake3::Hasher::new();
        let mut number = |n: u64| {
            hasher.update(&n.to_le_bytes());
        };
        number(self.state_dim() as u64);
        number(self.action_dim() as u64);
        for episode in &self.episodes {
            number(episode.episode_index as u64);
            number(episode.rows.len() as u64);
        }
        hash_matrix(&mut hasher, &self.states);
        hash_matrix(&mut hasher, &self.actions);
        hasher.finalize().to_hex()[..16].to_owned()
    }
}

fn hash_matrix(hasher: &mut blake3::Hasher, matrix: &Matrix) {
    let mut row = vec![0.0; matrix.n_features()];
    let mut bytes = Vec::with_capacity(row.len() * 8 * 1024);
    for r in 0..matrix.n_rows() {
        matrix.read_row(r, &mut row);
        // Zero has two signs and one meaning.
        bytes.extend(row.iter().flat_map(|v| (v + 0.0).to_le_bytes()));
        if bytes.len() >= row.len() * 8 * 1024 {
            hasher.update(&bytes);
            bytes.clear();
        }
    }
    hasher.update(&bytes);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_episode_may_come_in_parts_but_not_return() {
        let mut data = Trajectories::new(1, 1).unwrap();
        data.push(3, &[0.0], &[0.0]).unwrap();
        data.push(3, &[1.0, 2.0], &[0.0, 0.0]).unwrap();
        data.push(1, &[9.0], &[0.0]).unwrap();
        assert_eq!(data.episodes()[0].rows, 0..3);
        assert_eq!(
            data.push(3, &[9.0], &[0.0]),
            Err(DataError::SplitEpisode { episode_index: 3 })
        );
        assert_eq!(data.n_rows(), 4);
    }

    #[test]
    fn a_bad_value_is_placed_and_nothing_is_stored() {
        let mut data = Trajectories::new(2, 1).unwrap();
        data.push(0, &[0.0, 0.0], &[0.0]).unwrap();
        let error = data
            .push(0, &[0.0, 1.0, 2.0, 3.0], &[0.0, f64::INFINITY])
            .unwrap_err();
        assert!(matches!(
            error,
            DataError::NonFiniteStep {
                episode_index: 0,
                step_index: 2,
                part: "action",
                column: 0,
                ..
            }
        ));
        assert_eq!((data.n_rows(), data.actions.n_rows()), (1, 1));
    }

    #[test]
    fn the_fingerprint_knows_values_and_borders() {
        let make = |split: bool, value: f64| {
            let mut data = Trajectories::new(1, 1).unwrap();
            data.push(0, &[value], &[0.0]).unwrap();
            data.push(i64::from(split), &[2.0], &[0.0]).unwrap();
            data.fingerprint()
        };
        assert_eq!(make(false, 1.0), make(false, 1.0));
        assert_ne!(make(false, 1.0), make(true, 1.0));
        assert_ne!(make(false, 1.0), make(false, 1.0 + 1e-12));
        assert_eq!(make(false, 0.0), make(false, -0.0));
    }
}
