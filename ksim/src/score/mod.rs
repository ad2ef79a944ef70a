//! K-Sim itself: fit on the reference, score rollouts.

mod approximation;
mod bootstrap;
mod cost;
mod params;
mod reference;
mod report;

pub use approximation::ApproximationError;
pub use params::{KSimParams, Prepared, Search};
pub use reference::Reference;
pub use report::{Aggregate, EpisodeScore, Report, StepScore};

use std::ops::Range;

use rayon::prelude::*;

use crate::error::{DataError, ScoreError};
use crate::matrix::MatrixView;
use crate::neighbors::{Neighbor, NeighborIndex, Neighbors, SearchRequest};
use crate::normalizer::Normalizer;
use crate::trajectories::{EpisodeRows, Trajectories};

/// Steps scored between two calls of the progress function, at most: enough queries to share the
/// work of passing over the reference.
const BLOCK_STEPS: usize = 8192;

/// Neighbors found between two calls, at most, while a step alone has fewer: they take 64 MB.
const BLOCK_NEIGHBORS: usize = 1 << 22;

/// The smallest distance a score divides by.
const SMALLEST_DISTANCE: f64 = 1e-12;

/// The reference data in normalized units, with a search over its states.
///
/// ```
/// use ksim::{KSim, Trajectories};
///
/// let mut reference = Trajectories::new(2, 1)?;
/// reference.push(0, &[0.0, 0.0, 1.0, 0.0, 2.0, 0.0, 3.0, 1.0], &[1.0, 1.0, 1.0, -1.0])?;
/// let mut rollouts = Trajectories::new(2, 1)?;
/// rollouts.push(0, &[0.1, 0.0, 1.1, 0.0], &[1.0, 1.0])?;
///
/// let report = KSim::params().fit(reference)?.score(&rollouts)?;
/// assert_eq!(report.state_action.pooled, 1.0); // both steps lie beside the data
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Debug)]
pub struct KSim {
    reference: Reference,
    index: Box<dyn NeighborIndex>,
    params: KSimParams,
}

/// What to do while scoring.
#[derive(Default)]
pub struct ScoreOptions<'a> {
    /// Match no step with a step of the reference episode of the same number: for scoring a
    /// dataset against itself, where every score would otherwise be 1.
    pub exclude_same_episode: bool,
    /// Called with the number of steps done so far.
    pub progress: Option<&'a mut dyn FnMut(usize)>,
}

impl KSim {
    /// Parameters with their defaults: see [`KSimParams`].
    pub fn params() -> KSimParams {
        KSimParams::default()
    }

    /// The search in use.
    pub fn index(&self) -> &dyn NeighborIndex {
        &*self.index
    }

    /// The reference, normalized.
    pub fn reference(&self) -> &Reference {
        &self.reference
    }

    /// Scale of the score: a step scores 1 up to this distance by the root of the number of columns.
    pub fn gamma(&self) -> f64 {
        self.params.gamma
    }

    /// Number of reference steps.
    pub fn n_reference_steps(&self) -> usize {
        self.reference.states.n_rows()
    }

    /// Normalization of states and of actions, from the reference.
    pub fn normalizers(&self) -> (&Normalizer, &Normalizer) {
        (
            &self.reference.state_normalizer,
            &self.reference.action_normalizer,
        )
    }

    /// The same reference under another search; the data are shared, not copied.
    ///
    /// # Errors
    /// What k-means or the search object to.
    pub fn with_search(&self, search: Search) -> Result<Self, ScoreError> {
        self.with_prepared(search, Prepared::default())
    }

    /// The same from what was prepared for the states: see [`KSimParams::fit_prepared`].
    ///
    /// # Errors
    /// As [`KSimParams::fit_prepared`].
    pub fn with_prepared(&self, search: Search, prepared: Prepared) -> Result<Self, ScoreError> {
        let params = self.params.clone().search(search);
        params.fit_prepared(self.reference.clone(), prepared)
    }

    /// The same reference under other parameters; the data are shared, not copied.
    ///
    /// # Errors
    /// As [`KSimParams::fit`].
    pub fn with_params(&self, params: KSimParams) -> Result<Self, ScoreError> {
        params.fit_prepared(self.reference.clone(), Prepared::default())
    }

    /// Episode number and step of a reference row.
    ///
    /// # Panics
    /// If `row` is out of range.
    pub fn reference_step(&self, row: u32) -> (i64, usize) {
        let row = row as usize;
        let episodes = &self.reference.episodes;
        let episode = &episodes[episodes.partition_point(|episode| episode.rows.end <= row)];
        (episode.episode_index, row - episode.rows.start)
    }

    /// Scores every step of the rollouts, which are in raw units.
    ///
    /// # Errors
    /// [`ScoreError::EmptyRollouts`], [`ScoreError::WidthMismatch`], and what the search objects
    /// to.
    pub fn score(&self, rollouts: &Trajectories) -> Result<Report, ScoreError> {
        self.score_with(rollouts, &mut ScoreOptions::default())
    }

    /// [`score`](Self::score) with options.
    ///
    /// # Errors
    /// As `score`; [`ScoreError::NotSelf`] and [`ScoreError::NoCandidate`] under
    /// [`exclude_same_episode`](ScoreOptions::exclude_same_episode).
    pub fn score_with(
        &self,
        rollouts: &Trajectories,
        options: &mut ScoreOptions<'_>,
    ) -> Result<Report, ScoreError> {
        let mut steps = Vec::with_capacity(rollouts.n_rows());
        self.for_each_block(rollouts, options, &mut |block, neighbors| {
            let scored: Result<Vec<StepScore>, ScoreError> = (0..neighbors.n_queries())
                .into_par_iter()
                .map(|query| {
                    self.step(block, query, neighbors)
                        .ok_or_else(|| no_candidate(rollouts, block.start + query))
                })
                .collect();
            steps.extend(scored?);
            Ok(())
        })?;
        Ok(Report::new(rollouts, steps, &self.params))
    }

    /// Runs the search over the rollouts block by block.
    fn for_each_block(
        &self,
        rollouts: &Trajectories,
        options: &mut ScoreOptions<'_>,
        visit: &mut dyn FnMut(&Block, &Neighbors) -> Result<(), ScoreError>,
    ) -> Result<(), ScoreError> {
        self.check(rollouts)?;
        let reference = &self.reference;
        let excluded = match options.exclude_same_episode {
            true => Some(self.same_episode_rows(rollouts)?),
            false => None,
        };
        let n_neighbors = self.params.n_neighbors.clamp(1, reference.states.n_rows());
        let block_steps = (BLOCK_NEIGHBORS / n_neighbors).clamp(1, BLOCK_STEPS);
        for start in (0..rollouts.n_rows()).step_by(block_steps) {
            let rows = start..(start + block_steps).min(rollouts.n_rows());
            let block = Block {
                start,
                states: reference
                    .state_normalizer
                    .normalized_rows(&rollouts.states, rows.clone()),
                actions: reference
                    .action_normalizer
                    .normalized_rows(&rollouts.actions, rows.clone()),
                state_dim: rollouts.state_dim(),
                action_dim: rollouts.action_dim(),
            };
            let neighbors = self.index.search(&SearchRequest {
                queries: MatrixView::new(&block.states, block.state_dim)
                    .map_err(|error| at_step(rollouts, start, error))?,
                n_neighbors: self.params.n_neighbors,
                excluded: excluded.as_deref().map(|excluded| &excluded[rows.clone()]),
            })?;
            visit(&block, &neighbors)?;
            if let Some(progress) = &mut options.progress {
                progress(rows.end);
            }
        }
        Ok(())
    }

    fn check(&self, rollouts: &Trajectories) -> Result<(), ScoreError> {
        if rollouts.n_rows() == 0 {
            return Err(ScoreError::EmptyRollouts);
        }
        let reference = &self.reference;
        for (part, expected, found) in [
            ("state", reference.states.n_features(), rollouts.state_dim()),
            (
                "action",
                reference.actions.n_features(),
                rollouts.action_dim(),
            ),
        ] {
            if expected != found {
                return Err(ScoreError::WidthMismatch {
                    part,
                    expected,
                    found,
                });
            }
        }
        Ok(())
    }

    /// For every rollout step the reference rows of the episode with the same number.
    fn same_episode_rows(&self, rollouts: &Trajectories) -> Result<Vec<Range<usize>>, ScoreError> {
        let mut excluded = Vec::with_capacity(rollouts.n_rows());
        for episode in rollouts.episodes() {
            let twin = self
                .reference
                .episodes
                .iter()
                .find(|reference| reference.episode_index == episode.episode_index)
                .filter(|twin| self.is_same(rollouts, episode, twin))
                .ok_or(ScoreError::NotSelf {
                    episode_index: episode.episode_index,
                })?;
            excluded.extend(std::iter::repeat_n(twin.rows.clone(), episode.rows.len()));
        }
        Ok(excluded)
    }

    /// Whether two episodes have the same length and states, up to the rounding of storage.
    fn is_same(&self, rollouts: &Trajectories, episode: &EpisodeRows, twin: &EpisodeRows) -> bool {
        let reference = &self.reference;
        let normalizer = &reference.state_normalizer;
        episode.rows.len() == twin.rows.len()
            && episode
                .rows
                .clone()
                .zip(twin.rows.clone())
                .all(|(row, twin)| {
                    (0..rollouts.state_dim()).all(|column| {
                        let value =
                            normalizer.normalize(column, rollouts.states.value(row, column));
                        (value - reference.states.value(twin, column)).abs()
                            <= 1e-9 * (1.0 + value.abs())
                    })
                })
    }

    /// The matched pair of one query and its distances (Similarity Measurement, steps 3 and 4):
    /// among the nearest states the one with the nearest action, ties to the nearer state, then
    /// to the smaller row. `None` if there is no neighbor.
    fn step(&self, block: &Block, query: usize, neighbors: &Neighbors) -> Option<StepScore> {
        let (matched, squared_action) = self.matched(block, query, neighbors.of(query))?;
        let squared_state = self
            .reference
            .states
            .squared_distance(matched.row as usize, block.state(query));
        let distance = (squared_state + squared_action).sqrt();
        let dim = (block.state_dim + block.action_dim) as f64;
        Some(StepScore {
            score: step_score(self.params.gamma, dim, distance),
            distance,
            state_distance: squared_state.sqrt(),
            action_distance: squared_action.sqrt(),
            cluster: neighbors.cluster(query),
            reference_row: matched.row,
        })
    }

    fn matched(
        &self,
        block: &Block,
        query: usize,
        candidates: &[Neighbor],
    ) -> Option<(Neighbor, f64)> {
        let action = block.action(query);
        let mut best: Option<(Neighbor, f64)> = None;
        let rows = candidates.iter().map(|candidate| candidate.row);
        let actions = &self.reference.actions;
        // Candidates come by ascending state distance, then row: the first of equals stays.
        actions.each_squared_distance(rows, action, |at, squared| {
            if best.is_none_or(|(_, least)| squared < least) {
                best = Some((candidates[at], squared));
            }
        });
        best
    }
}

/// `min(1, γ√dim / d)`.
fn step_score(gamma: f64, dim: f64, distance: f64) -> f64 {
    (gamma * dim.sqrt() / distance.max(SMALLEST_DISTANCE)).min(1.0)
}

fn no_candidate(rollouts: &Trajectories, row: usize) -> ScoreError {
    let (episode_index, step_index) = step_of(rollouts, row);
    ScoreError::NoCandidate {
        episode_index,
        step_index,
    }
}

/// Where a normalized state left the range of the engine: the matrix that refused it knows only
/// its own rows, from `start` of the rollouts.
fn at_step(rollouts: &Trajectories, start: usize, error: DataError) -> ScoreError {
    let DataError::NonFinite { row, column, value } = error else {
        return error.into();
    };
    let (episode_index, step_index) = step_of(rollouts, start + row);
    let part = "normalized state";
    ScoreError::Data(DataError::NonFiniteStep {
        episode_index,
        step_index,
        part,
        column,
        value,
    })
}

/// Episode number and step of a row.
fn step_of(rollouts: &Trajectories, row: usize) -> (i64, usize) {
    let episodes = rollouts.episodes();
    let episode = &episodes[episodes.partition_point(|episode| episode.rows.end <= row)];
    (episode.episode_index, row - episode.rows.start)
}

/// Consecutive rollout steps in normalized units.
struct Block {
    /// Row of the first step.
    start: usize,
    states: Vec<f64>,
    actions: Vec<f64>,
    state_dim: usize,
    action_dim: usize,
}

impl Block {
    fn state(&self, query: usize) -> &[f64] {
        &self.states[query * self.state_dim..][..self.state_dim]
    }

    fn action(&self, query: usize) -> &[f64] {
        &self.actions[query * self.action_dim..][..self.action_dim]
    }
}

#[cfg(test)]
mod tests;
