//! Recorded actions once more.

use std::num::NonZeroUsize;
use std::path::Path;

use ksim_datasets::{OpenOptions, TransitionOptions, TransitionReader};
use ksim_envs::EnvironmentSpec;

use super::{EpisodeStart, Policy, PolicyError, mlp};

/// Plays the actions of a recorded dataset: episode k of a run plays the k-th episode of the recording that has a step.
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

#[cfg(test)]
mod tests {
    use std::fs::File;
    use std::sync::Arc;

    use arrow::array::{ArrayRef, FixedSizeListArray, Int64Array, RecordBatch};
    use arrow::datatypes::Float64Type;
    use ksim_envs::Environment as _;
    use ksim_envs::toy::point_mass;
    use parquet::arrow::ArrowWriter;
    use tempfile::TempDir;

    use super::*;

    /// Two episodes, numbered 4 and 9: actions 0.5, -3 and 0.25.
    fn recording(action_dim: i32) -> (TempDir, std::path::PathBuf) {
        let list = |values: &[f64], width: i32| -> ArrayRef {
            let rows = values
                .iter()
                .map(|value| Some(vec![Some(*value); width as usize]));
            Arc::new(FixedSizeListArray::from_iter_primitive::<Float64Type, _, _>(rows, width))
        };
        let integers = |values: &[i64]| -> ArrayRef { Arc::new(Int64Array::from(values.to_vec())) };
        let batch = RecordBatch::try_from_iter([
            ("episode_index", integers(&[4, 4, 9])),
            ("step_index", integers(&[0, 1, 0])),
            ("observation", list(&[0.0, 0.0, 0.0], 2)),
            ("action", list(&[0.5, -3.0, 0.25], action_dim)),
        ])
        .unwrap();
        let folder = TempDir::new().unwrap();
        let file = folder.path().join("recorded.parquet");
        let mut writer =
            ArrowWriter::try_new(File::create(&file).unwrap(), batch.schema(), None).unwrap();
        writer.write(&batch).unwrap();
        writer.close().unwrap();
        (folder, file)
    }

    #[test]
    fn actions_are_played_as_recorded_episode_by_episode() {
        let (_folder, file) = recording(1);
        let environment = point_mass(None);
        let mut replay = Replay::open("replay:r".to_owned(), &file, environment.spec()).unwrap();
        let start = |episode| EpisodeStart { episode, seed: 0 };
        assert_eq!(
            replay.start_episode(3, &start(0)).unwrap(),
            NonZeroUsize::new(2)
        );
        assert_eq!(
            replay.start_episode(0, &start(1)).unwrap(),
            NonZeroUsize::new(1)
        );
        let mut actions = [0.0; 2];
        replay.act(&[0, 3], &[0.0; 4], &mut actions).unwrap();
        assert_eq!(actions, [0.25, 0.5]);
        replay.act(&[3], &[0.0; 2], &mut actions[..1]).unwrap();
        assert_eq!(actions[0], -3.0);
        let error = replay.start_episode(0, &start(2)).unwrap_err().to_string();
        assert_eq!(
            error,
            "the recording has 2 episodes, none with number 2 (from 0)"
        );
    }

    #[test]
    fn actions_of_another_width_are_refused() {
        let (_folder, file) = recording(3);
        let environment = point_mass(None);
        let error = Replay::open("replay:r".to_owned(), &file, environment.spec()).unwrap_err();
        assert_eq!(
            error.to_string(),
            "policy `replay:r` has 3 actions, environment `PointMass-v0` has 1"
        );
    }
}
