//! Recorded actions once more.

use std::num::NonZeroUsize;
use std::path::Path;

use ksim_datasets::{OpenOptions, TransitionOptions, TransitionReader};
use ksim_envs::EnvironmentSpec;

use super::{EpisodeStart, Policy, PolicyError, mlp};

/// Plays the actions of a recorded dataset: episode k of a run plays the k-th episode of the recording.
///
/// Actions go in exactly as recorded, without clipping, so that control costs are those of the recording. The states
/// are not replayed: an episode starts where its seed says. It ends where the task ends, or, as truncated, where the
/// recorded episode does. A run with more episodes than were recorded is an error.
#[derive(Debug)]
pub struct Replay {
    name: String,
    action_dim: usize,
    /// Actions of all recorded episodes, row by row.
    actions: Vec<f64>,
    /// Row behind the last of each recorded episode.
    ends: Vec<usize>,
    /// The next row to play, for every slot.
    slots: Vec<usize>,
}

impl Replay {
    /// Reads a recording to be played in `environment`.
    ///
    /// # Errors
    /// A dataset that cannot be read, or with actions of another width.
    pub fn open(
        name: String,
        file: &Path,
        environment: &EnvironmentSpec,
    ) -> Result<Self, PolicyError> {
        let source = ksim_datasets::open(file, &OpenOptions::default())?;
        let reader = TransitionReader::new(source.as_ref(), &TransitionOptions::default())?;
        let action_dim = environment.action_dim();
        if reader.action_width() != action_dim {
            let found = reader.action_width();
            return Err(mlp::width(&name, "actions", found, environment, action_dim));
        }
        let mut replay = Self {
            name,
            action_dim,
            actions: Vec::new(),
            ends: Vec::new(),
            slots: Vec::new(),
        };
        let mut last = None;
        for batch in reader {
            let batch = batch?;
            let rows = batch.actions.chunks_exact(action_dim);
            for (episode, action) in batch.episode_index.into_iter().zip(rows) {
                if last != Some(episode) {
                    replay.ends.push(0);
                    last = Some(episode);
                }
                replay.actions.extend_from_slice(action);
                if let Some(end) = replay.ends.last_mut() {
                    *end = replay.actions.len() / action_dim;
                }
            }
        }
        Ok(replay)
    }
}

impl Policy for Replay {
    fn name(&self) -> &str {
        &self.name
    }

    fn start_episode(
        &mut self,
        slot: usize,
        start: &EpisodeStart,
    ) -> Result<Option<NonZeroUsize>, PolicyError> {
        let Some(&end) = self.ends.get(start.episode) else {
            return Err(PolicyError::NoEpisode {
                episode: start.episode,
                n_episodes: self.ends.len(),
            });
        };
        let first = match start.episode {
            0 => 0,
            episode => self.ends[episode - 1],
        };
        if self.slots.len() <= slot {
            self.slots.resize(slot + 1, 0);
        }
        self.slots[slot] = first;
        Ok(NonZeroUsize::new(end - first))
    }

    fn act(
        &mut self,
        slots: &[usize],
        _observations: &[f64],
        actions: &mut [f64],
    ) -> Result<(), Vec<(usize, PolicyError)>> {
        for (&slot, action) in slots.iter().zip(actions.chunks_exact_mut(self.action_dim)) {
            let row = self.slots[slot];
            action.copy_from_slice(&self.actions[row * self.action_dim..][..self.action_dim]);
            self.slots[slot] += 1;
        }
        Ok(())
    }
}
