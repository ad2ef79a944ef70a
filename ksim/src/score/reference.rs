//! The reference data in normalized units.

use std::sync::Arc;

use crate::error::{DataError, ScoreError};
use crate::matrix::Matrix;
use crate::normalizer::Normalizer;
use crate::trajectories::{EpisodeRows, Trajectories};

/// Normalized states and actions of the reference, how they were normalized, and where its episodes
/// lie. Shared, never copied, between searches.
#[derive(Debug, Clone)]
pub struct Reference {
    pub(super) states: Arc<Matrix>,
    pub(super) actions: Arc<Matrix>,
    pub(super) state_normalizer: Normalizer,
    pub(super) action_normalizer: Normalizer,
    pub(super) episodes: Arc<[EpisodeRows]>,
}

impl Reference {
    /// Normalizes data in raw units by their own statistics, in place.
    ///
    /// # Errors
    /// [`ScoreError::EmptyReference`].
    pub fn new(mut data: Trajectories) -> Result<Self, ScoreError> {
        if data.n_rows() == 0 {
            return Err(ScoreError::EmptyReference);
        }
        data.states.shrink_to_fit();
        data.actions.shrink_to_fit();
        let state_normalizer = Normalizer::fit(&data.states);
        let action_normalizer = Normalizer::fit(&data.actions);
        state_normalizer.normalize_in_place(&mut data.states);
        action_normalizer.normalize_in_place(&mut data.actions);
        Ok(Self {
            episodes: data.episodes().into(),
            states: Arc::new(data.states),
            actions: Arc::new(data.actions),
            state_normalizer,
            action_normalizer,
        })
    }

    /// Takes what was normalized before: `normalized` in units of standard deviations, by the
    /// normalizers of its states and of its actions.
    ///
    /// # Errors
    /// [`ScoreError::EmptyReference`], [`DataError::Parts`] for normalizers of another width.
    pub fn from_normalized(
        normalized: Trajectories,
        (state_normalizer, action_normalizer): (Normalizer, Normalizer),
    ) -> Result<Self, ScoreError> {
        if normalized.n_rows() == 0 {
            return Err(ScoreError::EmptyReference);
        }
        for (what, normalizer, width) in [
            (
                "columns of the state normalizer",
                &state_normalizer,
                normalized.state_dim(),
            ),
            (
                "columns of the action normalizer",
                &action_normalizer,
                normalized.action_dim(),
            ),
        ] {
            if normalizer.mean().len() != width {
                return Err(ScoreError::Data(DataError::Parts {
                    what,
                    expected: width,
                    found: normalizer.mean().len(),
                }));
            }
        }
        Ok(Self {
            episodes: normalized.episodes().into(),
            states: Arc::new(normalized.states),
            actions: Arc::new(normalized.actions),
            state_normalizer,
            action_normalizer,
        })
    }

    /// The normalized states, one row per step.
    pub fn states(&self) -> &Arc<Matrix> {
        &self.states
    }

    /// The normalized actions, one row per step.
    pub fn actions(&self) -> &Matrix {
        &self.actions
    }

    /// Normalization of states and of actions.
    pub fn normalizers(&self) -> (&Normalizer, &Normalizer) {
        (&self.state_normalizer, &self.action_normalizer)
    }

    /// The episodes, in the order of their rows.
    pub fn episodes(&self) -> &[EpisodeRows] {
        &self.episodes
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{KMeans, KSim, Prepared, Search};

    fn walk(n: usize) -> Trajectories {
        let mut data = Trajectories::new(2, 1).unwrap();
        for episode in 0..4 {
            let states: Vec<f64> = (0..2 * n)
                .map(|i| ((i + 7 * episode) as f64 * 0.37).sin())
                .collect();
            let actions: Vec<f64> = (0..n).map(|i| (i as f64 * 0.7).cos()).collect();
            data.push(episode as i64, &states, &actions).unwrap();
        }
        data
    }

    #[test]
    fn a_reference_put_together_again_scores_the_same_bits() {
        let reference = Reference::new(walk(50)).unwrap();
        let copy = |matrix: &Matrix| {
            let (high, low) = matrix.planes();
            Matrix::from_planes(
                high.to_vec().into(),
                low.to_vec().into(),
                matrix.n_features(),
            )
            .unwrap()
        };
        let normalized = Trajectories::from_parts(
            copy(reference.states()),
            copy(reference.actions()),
            reference.episodes().to_vec(),
        );
        let normalizers = reference.normalizers();
        let normalizers = (normalizers.0.clone(), normalizers.1.clone());
        let again = Reference::from_normalized(normalized.unwrap(), normalizers.clone()).unwrap();
        let params = KSim::params()
            .search(Search::Clusters)
            .kmeans(KMeans::params(5))
            .n_neighbors(7);
        let own = params.clone().fit(walk(50)).unwrap();
        let kmeans = own.index().kmeans().unwrap().clone();
        let prepared = params
            .fit_prepared(
                again,
                Prepared {
                    clusters: Some(kmeans),
                    rounded: None,
                },
            )
            .unwrap();
        let rollouts = walk(20);
        assert_eq!(
            own.score(&rollouts).unwrap(),
            prepared.score(&rollouts).unwrap()
        );

        let narrow = Trajectories::new(1, 1).unwrap();
        assert!(Reference::from_normalized(narrow, normalizers.clone()).is_err());
        let mut narrow = Trajectories::new(1, 1).unwrap();
        narrow.push(0, &[0.0], &[0.0]).unwrap();
        assert!(matches!(
            Reference::from_normalized(narrow, normalizers),
            Err(ScoreError::Data(DataError::Parts {
                expected: 1,
                found: 2,
                ..
            }))
        ));
    }

    #[expect(
        clippy::single_range_in_vec_init,
        reason = "the rows of a single episode"
    )]
    #[test]
    fn episodes_must_cover_the_rows() {
        let matrix = |n: usize| Matrix::from_f32(vec![0.0; n], 1).unwrap();
        let rows = |ranges: &[std::ops::Range<usize>]| {
            let episodes = ranges.iter().cloned().zip(0..);
            episodes
                .map(|(rows, episode_index)| EpisodeRows {
                    episode_index,
                    rows,
                })
                .collect()
        };
        let of = |ranges| Trajectories::from_parts(matrix(4), matrix(4), rows(ranges));
        assert!(of(&[0..1, 1..4]).is_ok());
        for wrong in [&[0..1, 2..4][..], &[0..1], &[0..5], &[]] {
            assert!(
                matches!(of(wrong), Err(DataError::Parts { .. })),
                "{wrong:?}"
            );
        }
        let unequal = Trajectories::from_parts(matrix(4), matrix(3), rows(&[0..4]));
        assert!(matches!(unequal, Err(DataError::UnequalRows { .. })));
    }
}
