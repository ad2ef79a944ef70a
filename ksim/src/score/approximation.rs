//! What an approximate search costs in accuracy.

use super::{KSim, Report, ScoreOptions};
use crate::error::ScoreError;
use crate::neighbors::{Neighbor, Neighbors};
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
        let mut truth: Vec<Vec<u32>> = Vec::with_capacity(rollouts.n_rows());
        exact.for_each_block(rollouts, &mut options(), &mut |_, neighbors| {
            truth.extend((0..neighbors.n_queries()).map(|query| sorted_rows(neighbors.of(query))));
            Ok(())
        })?;
        let mut shares = Vec::with_capacity(truth.len());
        approximate.for_each_block(rollouts, &mut options(), &mut |_, neighbors| {
            let queries = 0..neighbors.n_queries();
            let start = shares.len();
            shares.extend(
                queries.map(|query| share_found(neighbors.of(query), &truth[start + query])),
            );
            Ok(())
        })?;
        let own = approximate.score_with(rollouts, &mut options())?;
        Ok(Self::new(
            shares.into_iter(),
            &own,
            &exact.score_with(rollouts, &mut options())?,
        ))
    }

    /// From what both searches answered to the states of the same steps, and the scores that follow.
    ///
    /// # Panics
    /// If the exact search answered fewer queries than the approximate one.
    pub fn between(own: (&Neighbors, &Report), exact: (&Neighbors, &Report)) -> Self {
        let queries = 0..own.0.n_queries();
        let shares =
            queries.map(|query| share_found(own.0.of(query), &sorted_rows(exact.0.of(query))));
        Self::new(shares, own.1, exact.1)
    }

    /// From the share of the true nearest states that was found for every step, and both reports.
    fn new(shares: impl ExactSizeIterator<Item = f64>, own: &Report, exact: &Report) -> Self {
        let n = shares.len().max(1) as f64;
        let pairs = || own.steps.iter().zip(&exact.steps);
        let differs = pairs().filter(|(own, exact)| own.reference_row != exact.reference_row);
        let differences = || pairs().map(|(own, exact)| own.score - exact.score);
        Self {
            recall: shares.sum::<f64>() / n,
            match_differs_share: differs.count() as f64 / n,
            mean_score_difference: differences().sum::<f64>() / n,
            max_score_difference: differences().map(f64::abs).fold(0.0, f64::max),
        }
    }
}

fn share_found(found: &[Neighbor], truth: &[u32]) -> f64 {
    let hits = found
        .iter()
        .filter(|one| truth.binary_search(&one.row).is_ok());
    hits.count() as f64 / truth.len().max(1) as f64
}

fn sorted_rows(neighbors: &[Neighbor]) -> Vec<u32> {
    let mut rows: Vec<u32> = neighbors.iter().map(|neighbor| neighbor.row).collect();
    rows.sort_unstable();
    rows
}
