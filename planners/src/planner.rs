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
