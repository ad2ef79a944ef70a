//! A whole recorded episode once more.

use std::collections::BTreeMap;
use std::sync::Arc;

use ksim::{Linear, Matrix, MatrixView, NeighborIndex as _, Normalizer, SearchRequest};
use serde::{Deserialize, Serialize};

use super::demonstrations::Demonstrations;
use super::error::BaselineError;
use crate::error::PlannerError;
use crate::planner::{Candidates, PlanRequest, Planner, PlannerSpec};

/// How an episode is replayed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ReplayOptions {
    /// Actions in a plan.
    pub horizon: usize,
    /// Actions that are executed between two plans: how far the replay moves on.
    pub stride: usize,
}

impl Default for ReplayOptions {
    fn default() -> Self {
        Self {
            horizon: 32,
            stride: 1,
        }
    }
}

/// Replays the recorded episode whose first state is nearest to the one it is first asked about, without looking
/// again: what is gained over it is gained by feedback.
///
/// Distances are L2 between states normalized by the dataset's mean and deviation; ties go to the earlier episode.
/// After the end of the episode its last action is held. The novelty of a plan is the distance of the two first
/// states per √column.
#[derive(Debug)]
pub struct Replay {
    spec: PlannerSpec,
    options: ReplayOptions,
    demonstrations: Arc<Demonstrations>,
    normalizer: Normalizer,
    /// The first states.
    index: Linear,
    slots: BTreeMap<usize, Option<Place>>,
}

/// Where the replay of a slot is.
#[derive(Debug, Clone, Copy)]
struct Place {
    episode: usize,
    step: usize,
    distance: f64,
}

impl Replay {
    /// Id of the family.
    pub const FAMILY: &'static str = "replay";

    /// Prepares to replay demonstrations.
    ///
    /// # Errors
    /// An option of 0.
    pub fn new(
        demonstrations: Arc<Demonstrations>,
        options: ReplayOptions,
    ) -> Result<Self, PlannerError> {
        super::check_count("horizon", options.horizon)?;
        super::check_count("stride", options.stride)?;
        let width = demonstrations.observation_dim;
        let all =
            Matrix::from_f64(&demonstrations.observations, width).map_err(BaselineError::from)?;
        let normalizer = Normalizer::fit(&all);
        let mut firsts = Vec::with_capacity(demonstrations.n_episodes() * width);
        for rows in &demonstrations.episodes {
            let first = &demonstrations.observations[rows.start * width..][..width];
            firsts.extend(normalized(&normalizer, first));
        }
        let firsts = Matrix::from_f64(&firsts, width).map_err(BaselineError::from)?;
        Ok(Self {
            spec: PlannerSpec {
                family: Self::FAMILY.to_owned(),
                observation_dim: width,
                action_dim: demonstrations.action_dim,
                horizon: options.horizon,
            },
            options,
            demonstrations,
            normalizer,
            index: Linear::new(Arc::new(firsts)),
            slots: BTreeMap::new(),
        })
    }

    /// The episode that begins nearest to an observation.
    fn begin(&self, observation: &[f64]) -> Result<Place, BaselineError> {
        let query: Vec<f64> = normalized(&self.normalizer, observation).collect();
        let queries = MatrixView::new(&query, self.spec.observation_dim)?;
        let found = self.index.search(&SearchRequest::new(queries, 1))?;
        let nearest = found.of(0)[0]; // there is at least one episode
        Ok(Place {
            episode: nearest.row as usize,
            step: 0,
            distance: nearest.distance,
        })
    }
}

fn normalized<'a>(
    normalizer: &'a Normalizer,
    observation: &'a [f64],
) -> impl Iterator<Item = f64> + 'a {
    let columns = observation.iter().enumerate();
    columns.map(|(column, value)| normalizer.normalize(column, *value))
}

impl Planner for Replay {
    fn spec(&self) -> &PlannerSpec {
        &self.spec
    }

    /// Nothing is drawn: the seed does not matter.
    fn reset(&mut self, slot: usize, _seed: u64) -> Result<(), PlannerError> {
        self.slots.insert(slot, None);
        Ok(())
    }

    fn plan(&mut self, request: &PlanRequest<'_>) -> Result<Candidates, PlannerError> {
        request.check(&self.spec, |slot| self.slots.contains_key(&slot))?;
        let mut out = Candidates {
            n_candidates: 1,
            horizon: self.options.horizon,
            actions: Vec::new(),
            scores: Vec::new(),
            novelties: Vec::new(),
            chosen: vec![0; request.slots.len()],
        };
        let scale = (self.spec.observation_dim as f64).sqrt();
        let observations = request.observations.chunks_exact(self.spec.observation_dim);
        for (&slot, observation) in request.slots.iter().zip(observations) {
            let place = match self.slots.get(&slot).copied().flatten() {
                Some(place) => place,
                None => self.begin(observation)?,
            };
            let rows = &self.demonstrations.episodes[place.episode];
            for step in place.step..place.step.saturating_add(self.options.horizon) {
                let row = rows.start.saturating_add(step).min(rows.end - 1);
                out.actions
                    .extend_from_slice(self.demonstrations.action(row));
            }
            out.novelties.push(place.distance / scale);
            let step = place.step.saturating_add(self.options.stride);
            self.slots.insert(slot, Some(Place { step, ..place }));
        }
        Ok(out)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::baselines::demonstrations::tests::{observations, walks};
    use crate::conformance;

    #[test]
    fn it_keeps_to_the_contract() {
        let make = || -> Box<dyn Planner> {
            let options = ReplayOptions {
                horizon: 4,
                stride: 2,
            };
            Box::new(Replay::new(Arc::new(walks(&[5, 9, 2])), options).unwrap())
        };
        conformance::check(&make, &observations(12));
    }

    #[test]
    fn the_episode_that_began_nearest_is_played_to_its_end_and_held() {
        let demonstrations = walks(&[4, 3]);
        let options = ReplayOptions {
            horizon: 3,
            stride: 2,
        };
        let mut replay = Replay::new(Arc::new(demonstrations.clone()), options).unwrap();
        replay.reset(7, 0).unwrap();
        let mut play = |observation: &[f64]| {
            let request = PlanRequest {
                slots: &[7],
                observations: observation,
            };
            replay.plan(&request).unwrap()
        };
        // The first state of the second walk, rows 4 to 6; where it is later does not matter.
        let first = play(&demonstrations.observations[8..10]);
        assert_eq!(first.actions, [4.0, 5.0, 6.0]);
        // The state itself, up to the rounding of its normalization.
        assert!(first.novelties[0] < 1e-12, "{:?}", first.novelties);
        assert_eq!(play(&[0.0, 0.0]).actions, [6.0, 6.0, 6.0]);
    }
}
