//! What an approximate search costs in accuracy.

use super::{KSim, ScoreOptions};
use crate::error::ScoreError;
use crate::neighbors::Neighbors;
use crate::trajectories::Trajectories;

/// How far one search departs from an exact one, over the steps of some rollouts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ApproximationError {
    /// Mean share of the true K nearest states that the approximate search found.
    pub recall: f64,
    /// Share of steps matched with another reference row.
    pub match_differs_share: f64,
    /// Mean of (approximate − exact) step score.
    pub mean_score_difference: f64,
    /// Largest |approximate − exact| step score.
    pub max_score_difference: f64,
}

impl ApproximationError {
    /// Scores the rollouts under both searches.
    ///
    /// # Errors
    /// As [`KSim::score_with`].
    pub fn measure(
        approximate: &KSim,
        exact: &KSim,
        rollouts: &Trajectories,
        exclude_same_episode: bool,
    ) -> Result<Self, ScoreError> {
        let options = || ScoreOptions {
            exclude_same_episode,
            progress: None,
        };
        let rows = |ksim: &KSim| {
            let mut lists: Vec<Vec<u32>> = Vec::with_capacity(rollouts.n_rows());
            ksim.for_each_block(rollouts, &mut options(), &mut |_, neighbors| {
                lists.extend((0..neighbors.n_queries()).map(|query| sorted_rows(neighbors, query)));
                Ok(())
            })?;
            Ok::<_, ScoreError>(lists)
        };
        let truth = rows(exact)?;
        let recall = rows(approximate)?
            .iter()
            .zip(&truth)
            .map(|(found, truth)| {
                let hits = found
                    .iter()
                    .filter(|row| truth.binary_search(row).is_ok())
                    .count();
                hits as f64 / truth.len().max(1) as f64
            })
            .sum::<f64>()
            / truth.len() as f64;
        let a = approximate.score_with(rollouts, &mut options())?;
        let b = exact.score_with(rollouts, &mut options())?;
        let n = a.steps.len() as f64;
        let pairs = || a.steps.iter().zip(&b.steps);
        let differs = pairs()
            .filter(|(a, b)| a.reference_row != b.reference_row)
            .count();
        let differences = || pairs().map(|(a, b)| a.score - b.score);
        Ok(Self {
            recall,
            match_differs_share: differs as f64 / n,
            mean_score_difference: differences().sum::<f64>() / n,
            max_score_difference: differences().map(f64::abs).fold(0.0, f64::max),
        })
    }
}

fn sorted_rows(neighbors: &Neighbors, query: usize) -> Vec<u32> {
    let mut rows: Vec<u32> = neighbors
        .of(query)
        .iter()
        .map(|neighbor| neighbor.row)
        .collect();
    rows.sort_unstable();
    rows
}
