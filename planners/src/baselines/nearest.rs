//! The continuation of the most similar demonstrations.

use std::collections::BTreeSet;
use std::sync::Arc;

use ksim::{
    Blocked, KdTree, Matrix, MatrixView, Neighbor, NeighborIndex, Normalizer, SearchRequest,
};
use serde::{Deserialize, Serialize};

use super::demonstrations::Demonstrations;
use super::error::BaselineError;
use crate::error::PlannerError;
use crate::planner::{Candidates, PlanRequest, Planner, PlannerSpec};

/// Neighbors of an episode's last state among which a way on is looked for.
const WAYS_ON: usize = 16;

/// Which candidate is executed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Choice {
    /// The demonstration that is nearest.
    #[default]
    Nearest,
    /// The one with the highest recorded return from there on, undiscounted; of equals the nearest.
    Return,
}

/// How demonstrations become plans.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NearestOptions {
    /// Actions in a plan.
    pub horizon: usize,
    /// Nearest states, each of which gives a candidate.
    pub n_candidates: usize,
    /// Which of them is executed.
    pub choice: Choice,
}

impl Default for NearestOptions {
    fn default() -> Self {
        Self {
            horizon: 32,
            n_candidates: 1,
            choice: Choice::Nearest,
        }
    }
}

/// Finds the recorded states nearest to the current one and proposes what was done from there on.
///
/// Distances are K-Sim's: L2 between states normalized by the dataset's mean and deviation, found by exact search,
/// ties by the smaller row. The score of a candidate is minus the distance of its state (with [`Choice::Return`] its
/// return from there on), its novelty that distance per √column.
///
/// **Ends of episodes**: a demonstration that ends before the plan does goes on in another one. After its last step
/// comes the successor of the recorded state nearest to its last state, in another episode, so that no plan is padded
/// and no state is left out of the search. Only where no other episode leads on, the last action is held.
#[derive(Debug)]
pub struct Nearest {
    spec: PlannerSpec,
    options: NearestOptions,
    demonstrations: Arc<Demonstrations>,
    normalizer: Normalizer,
    index: Box<dyn NeighborIndex>,
    /// For the last row of every episode, the row whose action comes next.
    next: Vec<Option<u32>>,
    /// For every row, with [`Choice::Return`].
    returns: Vec<f64>,
    started: BTreeSet<usize>,
}

impl Nearest {
    /// Id of the family.
    pub const FAMILY: &'static str = "nearest";

    /// Indexes demonstrations.
    ///
    /// # Errors
    /// An option of 0, more candidates than there are states, or returns of a dataset without rewards.
    pub fn new(
        demonstrations: Arc<Demonstrations>,
        options: NearestOptions,
    ) -> Result<Self, PlannerError> {
        super::check_count("horizon", options.horizon)?;
        super::check_count("n_candidates", options.n_candidates)?;
        if options.n_candidates > demonstrations.n_steps() {
            return Err(BaselineError::Setting {
                name: "n_candidates",
                expected: format!(
                    "at most the {} states of the dataset",
                    demonstrations.n_steps()
                ),
                found: options.n_candidates.to_string(),
            }
            .into());
        }
        let returns = match options.choice {
            Choice::Nearest => Vec::new(),
            Choice::Return => demonstrations.returns_to_go()?,
        };
        let (normalizer, index) = index(&demonstrations)?;
        let mut nearest = Self {
            spec: PlannerSpec {
                family: Self::FAMILY.to_owned(),
                observation_dim: demonstrations.observation_dim,
                action_dim: demonstrations.action_dim,
                horizon: options.horizon,
            },
            options,
            normalizer,
            index,
            next: Vec::new(),
            returns,
            started: BTreeSet::new(),
            demonstrations,
        };
        nearest.next = nearest.ways_on()?;
        Ok(nearest)
    }

    /// Where the plan goes on after the end of every episode.
    fn ways_on(&self) -> Result<Vec<Option<u32>>, BaselineError> {
        let demonstrations = &*self.demonstrations;
        let width = demonstrations.observation_dim;
        let mut queries = Vec::with_capacity(demonstrations.episodes.len() * width);
        for rows in &demonstrations.episodes {
            let last = &demonstrations.observations[(rows.end - 1) * width..rows.end * width];
            queries.extend(self.normalized(last));
        }
        let request = SearchRequest {
            queries: MatrixView::new(&queries, width)?,
            n_neighbors: WAYS_ON,
            excluded: Some(&demonstrations.episodes),
        };
        let found = self.index.search(&request)?;
        let way_on = |episode: usize| {
            let rows = found.of(episode).iter().map(|neighbor| neighbor.row);
            let mut leading_on = rows.filter(|&row| !self.is_last(row as usize));
            leading_on.next().map(|row| row + 1)
        };
        Ok((0..demonstrations.episodes.len()).map(way_on).collect())
    }

    fn is_last(&self, row: usize) -> bool {
        let demonstrations = &self.demonstrations;
        demonstrations.episodes[demonstrations.episode_of(row)].end == row + 1
    }

    fn normalized<'a>(&'a self, observation: &'a [f64]) -> impl Iterator<Item = f64> + 'a {
        let columns = observation.iter().enumerate();
        columns.map(|(column, value)| self.normalizer.normalize(column, *value))
    }

    /// Appends the actions that follow from a row on.
    fn follow(&self, row: u32, actions: &mut Vec<f32>) {
        let demonstrations = &*self.demonstrations;
        let mut row = row as usize;
        let mut end = demonstrations.episodes[demonstrations.episode_of(row)].end;
        for _ in 0..self.options.horizon {
            actions.extend_from_slice(demonstrations.action(row));
            if row + 1 < end {
                row += 1;
            } else if let Some(next) = self.next[demonstrations.episode_of(row)] {
                row = next as usize;
                end = demonstrations.episodes[demonstrations.episode_of(row)].end;
            }
        }
    }

    /// Appends a slot's candidates.
    fn propose(&self, neighbors: &[Neighbor], out: &mut Candidates) {
        let scale = (self.spec.observation_dim as f64).sqrt();
        let mut best = 0;
        let first = out.scores.len();
        for (candidate, neighbor) in neighbors.iter().enumerate() {
            self.follow(neighbor.row, &mut out.actions);
            out.novelties.push(neighbor.distance / scale);
            out.scores.push(match self.options.choice {
                Choice::Nearest => -neighbor.distance,
                Choice::Return => self.returns[neighbor.row as usize],
            });
            if out.scores[first + candidate] > out.scores[first + best] {
                best = candidate;
            }
        }
        out.chosen.push(best);
    }
}

fn index(
    demonstrations: &Demonstrations,
) -> Result<(Normalizer, Box<dyn NeighborIndex>), BaselineError> {
    let width = demonstrations.observation_dim;
    let normalizer = Normalizer::fit(&Matrix::from_f64(&demonstrations.observations, width)?);
    let mut states = Matrix::new(width)?;
    let mut row = Vec::with_capacity(width);
    for observation in demonstrations.observations.chunks_exact(width) {
        row.clear();
        let columns = observation.iter().enumerate();
        row.extend(columns.map(|(column, value)| normalizer.normalize(column, *value)));
        states.push_rows(&row)?;
    }
    let states = Arc::new(states);
    let index: Box<dyn NeighborIndex> = match width <= KdTree::MAX_FEATURES {
        true => Box::new(KdTree::new(states)?),
        false => Box::new(Blocked::new(states)),
    };
    Ok((normalizer, index))
}

impl Planner for Nearest {
    fn spec(&self) -> &PlannerSpec {
        &self.spec
    }

    /// Nothing is drawn: the seed does not matter.
    fn reset(&mut self, slot: usize, _seed: u64) -> Result<(), PlannerError> {
        self.started.insert(slot);
        Ok(())
    }

    fn plan(&mut self, request: &PlanRequest<'_>) -> Result<Candidates, PlannerError> {
        request.check(&self.spec, |slot| self.started.contains(&slot))?;
        let width = self.spec.observation_dim;
        let rows = request.observations.chunks_exact(width);
        let queries: Vec<f64> = rows.flat_map(|row| self.normalized(row)).collect();
        let queries = MatrixView::new(&queries, width).map_err(BaselineError::from)?;
        let n_candidates = self.options.n_candidates;
        let found = self
            .index
            .search(&SearchRequest::new(queries, n_candidates))
            .map_err(BaselineError::from)?;
        let mut out = Candidates {
            n_candidates,
            horizon: self.options.horizon,
            actions: Vec::new(),
            scores: Vec::new(),
            novelties: Vec::new(),
            chosen: Vec::new(),
        };
        for slot in 0..request.slots.len() {
            self.propose(found.of(slot), &mut out);
        }
        Ok(out)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::baselines::demonstrations::tests::{observations, walks};
    use crate::conformance;

    fn nearest(lengths: &[usize], options: NearestOptions) -> Nearest {
        Nearest::new(Arc::new(walks(lengths)), options).unwrap()
    }

    fn plan(planner: &mut Nearest, observation: &[f64]) -> Candidates {
        planner.reset(0, 0).unwrap();
        let request = PlanRequest {
            slots: &[0],
            observations: observation,
        };
        planner.plan(&request).unwrap()
    }

    #[test]
    fn it_keeps_to_the_contract() {
        for choice in [Choice::Nearest, Choice::Return] {
            let make = || -> Box<dyn Planner> {
                let options = NearestOptions {
                    horizon: 6,
                    n_candidates: 3,
                    choice,
                };
                Box::new(nearest(&[5, 9, 2], options))
            };
            conformance::check(&make, &observations(12));
        }
    }

    #[test]
    fn a_recorded_state_gives_what_was_done_there() {
        let mut planner = nearest(
            &[4, 3],
            NearestOptions {
                horizon: 3,
                ..Default::default()
            },
        );
        let demonstrations = walks(&[4, 3]);
        let plan = plan(&mut planner, &demonstrations.observations[2..4]);
        // Row 1 of the first walk, whose actions are the numbers of their rows.
        assert_eq!(plan.actions, [1.0, 2.0, 3.0]);
        assert_eq!((plan.novelties[0], plan.scores[0]), (0.0, 0.0));
    }

    /// Two walks on a line; the second passes where the first ends.
    fn crossing() -> Demonstrations {
        let states = [0.0, 1.0, 2.0, /**/ 10.0, 2.1, 5.0, 6.0];
        let actions = [0.0, 1.0, 2.0, /**/ 3.0, 4.0, 5.0, 6.0];
        let rewards = [0.0, 0.0, 1.0, /**/ 5.0, 5.0, 5.0, 5.0];
        Demonstrations::from_parts(
            "crossing".to_owned(),
            [1, 1],
            states.to_vec(),
            actions.map(|value| value as f32).to_vec(),
            rewards.to_vec(),
            &[3, 4],
        )
        .unwrap()
    }

    #[test]
    fn a_plan_goes_on_in_the_demonstration_that_passes_where_its_own_ends() {
        let options = NearestOptions {
            horizon: 6,
            ..Default::default()
        };
        let mut planner = Nearest::new(Arc::new(crossing()), options).unwrap();
        // From row 1: 1, 2, then on from row 4 (state 2.1), whose action is 4: its successor is row 5. Row 6 ends the
        // second walk at 6; nearest to it, in the first walk, is its last row, which leads nowhere, so row 1 does.
        assert_eq!(
            plan(&mut planner, &[1.0]).actions,
            [1.0, 2.0, 5.0, 6.0, 2.0, 5.0]
        );
    }

    #[test]
    fn the_only_demonstration_holds_its_last_action() {
        let mut planner = nearest(
            &[3],
            NearestOptions {
                horizon: 5,
                ..Default::default()
            },
        );
        let demonstrations = walks(&[3]);
        let plan = plan(&mut planner, &demonstrations.observations[2..4]);
        assert_eq!(plan.actions, [1.0, 2.0, 2.0, 2.0, 2.0]);
    }

    #[test]
    fn the_best_return_may_win_over_the_nearest() {
        for (choice, first) in [(Choice::Nearest, 2.0), (Choice::Return, 4.0)] {
            let options = NearestOptions {
                horizon: 1,
                n_candidates: 2,
                choice,
            };
            let mut planner = Nearest::new(Arc::new(crossing()), options).unwrap();
            let plan = plan(&mut planner, &[2.01]);
            assert_eq!(plan.actions[plan.chosen[0]], first);
            assert!(plan.novelties[0] < plan.novelties[1]);
            if choice == Choice::Return {
                assert_eq!(plan.scores, [1.0, 15.0]);
            }
        }
    }

    #[test]
    fn settings_that_cannot_be_are_refused() {
        let refused = |demonstrations: Demonstrations, options| {
            Nearest::new(Arc::new(demonstrations), options)
                .unwrap_err()
                .to_string()
        };
        let few = NearestOptions {
            n_candidates: 8,
            ..Default::default()
        };
        assert_eq!(
            refused(crossing(), few),
            "n_candidates is 8, expected at most the 7 states of the dataset"
        );
        let none = NearestOptions {
            horizon: 0,
            ..Default::default()
        };
        assert_eq!(
            refused(crossing(), none),
            "horizon is 0, expected 1 to 65536"
        );
        let mut silent = crossing();
        silent.rewards.clear();
        let best = NearestOptions {
            choice: Choice::Return,
            ..Default::default()
        };
        assert!(refused(silent, best).contains("records no rewards"));
    }
}
