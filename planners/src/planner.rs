//! What every planner is.

use crate::error::PlannerError;

/// What is fixed about a planner.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PlannerSpec {
    /// Stable id of its family, such as `diffuser`.
    pub family: String,
    /// Numbers in an observation, in the order of the dataset it was made from.
    pub observation_dim: usize,
    /// Numbers in an action.
    pub action_dim: usize,
    /// Actions in a plan, at least 1.
    pub horizon: usize,
}

/// Several environments that want a plan. An environment keeps its slot for a whole episode.
#[derive(Debug, Clone, Copy)]
pub struct PlanRequest<'a> {
    /// The slots, in ascending order; all have been reset.
    pub slots: &'a [usize],
    /// Current observations, raw, of the shape `(slots.len(), observation_dim)`.
    pub observations: &'a [f64],
}

/// Proposed action sequences for every slot of a request.
#[derive(Debug, Clone, PartialEq)]
pub struct Candidates {
    /// Candidates per slot, at least 1.
    pub n_candidates: usize,
    /// Actions per candidate, at least 1.
    pub horizon: usize,
    /// Raw actions of the shape `(n_slots, n_candidates, horizon, action_dim)`, in the order of generation.
    pub actions: Vec<f32>,
    /// The planner's own score of each candidate, of the shape `(n_slots, n_candidates)`, higher is better; empty if
    /// it has none.
    pub scores: Vec<f64>,
    /// Novelty of each candidate (the curiosity that guidance lowers), of the same shape; empty if it has none.
    pub novelties: Vec<f64>,
    /// Index of the candidate to execute, one per slot.
    pub chosen: Vec<usize>,
}

impl PlanRequest<'_> {
    /// Checks a request as every planner must: widths, ascending slots that have been reset, finite observations.
    ///
    /// # Errors
    /// What is wrong, with its place.
    pub fn check(
        &self,
        spec: &PlannerSpec,
        is_reset: impl Fn(usize) -> bool,
    ) -> Result<(), PlannerError> {
        let expected = self.slots.len().saturating_mul(spec.observation_dim);
        if self.observations.len() != expected {
            return Err(PlannerError::Length {
                what: "observations",
                expected,
                found: self.observations.len(),
            });
        }
        let refuse = |what, expected: &str, found: String| {
            let expected = expected.to_owned();
            Err(PlannerError::Request {
                what,
                expected,
                found,
            })
        };
        if let Some(pair) = self.slots.windows(2).find(|pair| pair[0] >= pair[1]) {
            let found = format!("{} after {}", pair[1], pair[0]);
            return refuse("slot", "slots in ascending order", found);
        }
        if let Some(slot) = self.slots.iter().find(|&&slot| !is_reset(slot)) {
            return refuse("slot", "one that has been reset", slot.to_string());
        }
        // What is finite as f64 only would be infinite in a network.
        let is_wrong = |value: &f64| !(*value as f32).is_finite();
        if let Some(at) = self.observations.iter().position(is_wrong) {
            let slot = self.slots[at / spec.observation_dim];
            let (column, value) = (at % spec.observation_dim, self.observations[at]);
            let found = format!("{value:?} in column {column} of slot {slot}");
            return refuse("observation", "finite numbers", found);
        }
        Ok(())
    }
}

impl Candidates {
    /// Checks that a plan for `n_slots` slots is what the specification says: shapes, finite numbers, choices among
    /// the candidates.
    ///
    /// # Errors
    /// What is wrong, with its place.
    pub fn check(&self, spec: &PlannerSpec, n_slots: usize) -> Result<(), PlannerError> {
        let refuse = |what, expected, found| {
            Err(PlannerError::Plan {
                what,
                expected,
                found,
            })
        };
        for (what, found) in [
            ("n_candidates", self.n_candidates),
            ("horizon", self.horizon),
        ] {
            if found == 0 {
                return refuse(what, "at least 1".to_owned(), found.to_string());
            }
        }
        let length = |what, expected: usize, found: usize| match expected == found {
            true => Ok(()),
            false => Err(PlannerError::Length {
                what,
                expected,
                found,
            }),
        };
        let n_plans = n_slots.saturating_mul(self.n_candidates);
        let per_plan = self.horizon.saturating_mul(spec.action_dim);
        length(
            "actions",
            n_plans.saturating_mul(per_plan),
            self.actions.len(),
        )?;
        length("chosen", n_slots, self.chosen.len())?;
        for (what, values) in [("scores", &self.scores), ("novelties", &self.novelties)] {
            if !values.is_empty() {
                length(what, n_plans, values.len())?;
            }
        }
        if let Some(&found) = self
            .chosen
            .iter()
            .find(|&&found| found >= self.n_candidates)
        {
            let expected = format!("one of the {} candidates", self.n_candidates);
            return refuse("chosen", expected, found.to_string());
        }
        let wrong = self.actions.iter().find(|value| !value.is_finite());
        if let Some(value) = wrong {
            return refuse("actions", "finite numbers".to_owned(), format!("{value:?}"));
        }
        let mut scores = self.scores.iter().chain(&self.novelties);
        match scores.find(|value| !value.is_finite()) {
            None => Ok(()),
            Some(value) => refuse("scores", "finite numbers".to_owned(), format!("{value:?}")),
        }
    }
}

/// Proposes action sequences.
///
/// Whatever a planner remembers or draws belongs to a slot and comes from the seed of its episode, so that a plan does
/// not depend on what is planned beside it.
pub trait Planner: Send {
    /// What is fixed.
    fn spec(&self) -> &PlannerSpec;

    /// An episode starts in a slot. The same seed and the same observations give the same candidates.
    ///
    /// # Errors
    /// The planner cannot plan for this episode.
    fn reset(&mut self, slot: usize, seed: u64) -> Result<(), PlannerError>;

    /// Plans for all slots of the request.
    ///
    /// # Errors
    /// The request does not fit [`Planner::spec`], or planning failed.
    fn plan(&mut self, request: &PlanRequest<'_>) -> Result<Candidates, PlannerError>;
}
