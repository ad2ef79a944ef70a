//! What chooses actions.

/// Why a policy could not be made or asked.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PolicyError {}

/// The start of an episode, as a policy is told of it.
#[derive(Debug, Clone, Copy)]
pub struct EpisodeStart {
    /// Number of the episode in this run, from 0.
    pub episode: usize,
    /// Seed of its reset; a policy that draws seeds its own stream with it.
    pub seed: u64,
}

/// One policy for a batch of environments. An environment keeps its slot for a whole episode; whatever a policy
/// remembers or draws belongs to a slot, so that results do not depend on what runs beside.
pub trait Policy: Send {
    /// Name for tables and files, such as `mlp:hopper-tqc`.
    fn name(&self) -> &str;

    /// An episode starts in a slot.
    ///
    /// # Errors
    /// The policy cannot play this episode (a replay has no such episode).
    fn start_episode(&mut self, slot: usize, start: &EpisodeStart) -> Result<(), PolicyError>;

    /// Writes the actions of the given slots. `observations` has the shape `(slots.len(), observation_dim)`,
    /// `actions` `(slots.len(), action_dim)`, both row by row.
    ///
    /// # Errors
    /// The policy has no action for a slot: the first slot that failed, and why.
    fn act(
        &mut self,
        slots: &[usize],
        observations: &[f64],
        actions: &mut [f64],
    ) -> Result<(), (usize, PolicyError)>;
}
