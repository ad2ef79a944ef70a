//! What becomes of an episode: its number, and where its last observation comes from.

use std::sync::Arc;

use arrow::array::{
    Array, ArrayRef, AsArray, BooleanArray, Float64Array, RecordBatch, new_null_array,
};
use arrow::datatypes::DataType;
use serde_json::Value;

use super::columns::{Columns, Group};
use super::{Episode, Rows};
use crate::episode::EpisodeRecord;
use crate::error::{DatasetError, Result};
use crate::formats::episode_rows::{EpisodePiece, refuse_nulls};
use crate::formats::fill::concat;
use crate::schema;
use crate::sink::{FinalObservation, Loss, LossEffect, LossTally};

/// Where the observation after the last step comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Last {
    /// The episode has it.
    Own,
    /// The last step's `next_observation`.
    Next,
    /// The last observation once more.
    Repeated,
    /// The last step is given up for its observation.
    GivenUp,
}

/// What becomes of an episode.
#[derive(Debug, Clone, Copy)]
pub(super) struct Fate {
    /// Its number in the dataset.
    number: u64,
    /// Its steps in the dataset, at least 1.
    n_steps: u64,
    last: Last,
}

/// What becomes of all episodes.
pub(super) struct Fates {
    /// `None` for an episode that is left out.
    fates: Vec<Option<Fate>>,
    /// Episodes that get another number.
    n_renumbered: u64,
}

impl Fates {
    /// Decides by what the episodes have and what is asked for.
    pub(super) fn new(
        episodes: &[EpisodeRecord],
        columns: &Columns,
        wish: FinalObservation,
    ) -> Self {
        let (mut number, mut n_renumbered) = (0, 0);
        let mut fates = Vec::with_capacity(episodes.len());
        for episode in episodes {
            let last = match wish {
                _ if episode.has_final_obs => Last::Own,
                FinalObservation::Duplicate => Last::Repeated,
                FinalObservation::Recorded if columns.next_observation.is_some() => Last::Next,
                FinalObservation::Recorded | FinalObservation::DropStep => Last::GivenUp,
            };
            let n_steps = episode
                .length
                .saturating_sub(u64::from(last == Last::GivenUp));
            let is_kept = n_steps > 0;
            fates.push(is_kept.then_some(Fate {
                number,
                n_steps,
                last,
            }));
            if is_kept {
                n_renumbered += u64::from(u64::try_from(episode.episode_index) != Ok(number));
                number += 1;
            }
        }
        Self {
            fates,
            n_renumbered,
        }
    }

    /// What becomes of an episode by its place; `None` if it is left out.
    pub(super) fn of(&self, place: usize) -> Option<Fate> {
        self.fates.get(place).copied().flatten()
    }

    /// Episodes in the dataset.
    pub(super) fn n_episodes(&self) -> u64 {
        self.fates.iter().flatten().count() as u64
    }

    /// Steps in the dataset.
    pub(super) fn n_steps(&self) -> u64 {
        self.fates.iter().flatten().map(|fate| fate.n_steps).sum()
    }

    /// Everything this changes about the episodes.
    pub(super) fn losses(&self) -> Vec<Loss> {
        let mut tally = LossTally::default();
        let count = |last: Last| {
            let fates = self.fates.iter().flatten();
            fates.filter(|fate| fate.last == last).count() as u64
        };
        let item = "final observations";
        let next = "the observation after the last step is that step's next_observation";
        tally.add(item, LossEffect::Changed, next, count(Last::Next));
        let repeated = "the last observation stands for the one after the last step as well";
        tally.add(item, LossEffect::Invented, repeated, count(Last::Repeated));
        let given_up = "the last step of an episode was given up for its observation, \
             and the step before it counts as truncated";
        tally.add("steps", LossEffect::Dropped, given_up, count(Last::GivenUp));
        let left_out = "episodes of one step have none left once the last one is given up";
        let n_left_out = self.fates.len() as u64 - self.n_episodes();
        tally.add("episodes", LossEffect::Dropped, left_out, n_left_out);
        let renumbered = "Minari counts episodes from 0 without a gap";
        tally.add(
            "episode numbers",
            LossEffect::Changed,
            renumbered,
            self.n_renumbered,
        );
        tally.into_losses().collect()
    }
}

impl Fate {
    /// The episode as it will be stored.
    pub(super) fn episode(&self, record: &EpisodeRecord, tally: &mut LossTally) -> Episode {
        let mut attributes = record.attributes.clone();
        if self.n_steps != record.length {
            for statistic in ["sum", "mean", "std", "max", "min"] {
                if attributes.remove(&format!("rewards_{statistic}")).is_some() {
                    let detail = "it no longer holds once a step is given up";
                    tally.add("attribute rewards_*", LossEffect::Dropped, detail, 1);
                }
            }
        }
        attributes.insert("id".to_owned(), Value::from(self.number));
        attributes.insert("total_steps".to_owned(), Value::from(self.n_steps));
        if let Some(seed) = record.seed {
            attributes.insert("seed".to_owned(), Value::from(seed));
        }
        Episode {
            number: self.number,
            n_steps: self.n_steps,
            attributes,
        }
    }
}

/// The rows of a piece of an episode as they are stored.
///
/// # Errors
/// A null where Minari has none.
pub(super) fn rows(
    piece: &EpisodePiece,
    is_end: bool,
    fate: Fate,
    columns: &Columns,
) -> Result<Rows> {
    let n_steps = fate.n_steps.saturating_sub(piece.first_row);
    let n_steps = usize::try_from(n_steps)
        .unwrap_or(usize::MAX)
        .min(piece.rows.num_rows());
    let cut = Cut {
        piece,
        n_steps,
        extra: if is_end { fate.last } else { Last::Own },
        last_step: n_steps
            .checked_sub(1)
            .filter(|&row| piece.first_row + row as u64 + 1 == fate.n_steps),
    };
    let (terminations, truncations) = cut.flags(columns, fate.last == Last::GivenUp)?;
    Ok(Rows {
        observations: cut.observations(columns)?,
        actions: cut.steps(&columns.action)?,
        rewards: cut.rewards(columns)?,
        terminations,
        truncations,
        infos: cut.infos(columns)?,
        is_end,
    })
}

/// A piece of an episode, and how much of it are steps.
struct Cut<'a> {
    piece: &'a EpisodePiece,
    n_steps: usize,
    /// What comes after the piece.
    extra: Last,
    /// The row of the episode's last step, if it is here.
    last_step: Option<usize>,
}

impl Cut<'_> {
    fn batch(&self) -> &RecordBatch {
        &self.piece.rows
    }

    fn observations(&self, columns: &Columns) -> Result<Vec<ArrayRef>> {
        let mut arrays = Vec::with_capacity(columns.observation.leaves.len());
        for (place, leaf) in columns.observation.leaves.iter().enumerate() {
            let array = self.batch().column(leaf.index);
            let last_row = array.len().saturating_sub(1);
            let array = match self.extra {
                Last::Own | Last::GivenUp => array.clone(),
                Last::Repeated => concat(&[array, &array.slice(last_row, 1)])?,
                Last::Next => {
                    let next = columns.next_observation.as_ref();
                    let next = next.and_then(|columns| columns.get(place)).copied();
                    let next = next.unwrap_or(leaf.index);
                    concat(&[array, &self.batch().column(next).slice(last_row, 1)])?
                }
            };
            refuse_nulls(&array, &leaf.column, self.piece.first_row)?;
            arrays.push(array);
        }
        Ok(arrays)
    }

    fn steps(&self, group: &Group) -> Result<Vec<ArrayRef>> {
        let steps = group.leaves.iter().map(|leaf| {
            let array = self.batch().column(leaf.index).slice(0, self.n_steps);
            refuse_nulls(&array, &leaf.column, self.piece.first_row)?;
            Ok(array)
        });
        steps.collect()
    }

    fn infos(&self, columns: &Columns) -> Result<Vec<ArrayRef>> {
        let has_extra = matches!(self.extra, Last::Repeated | Last::Next);
        let infos = columns.infos.leaves.iter().map(|leaf| {
            let array = self.batch().column(leaf.index);
            match has_extra {
                true => concat(&[array, &new_null_array(array.data_type(), 1)]),
                false => Ok(array.clone()),
            }
        });
        infos.collect()
    }

    fn rewards(&self, columns: &Columns) -> Result<ArrayRef> {
        let Some(index) = columns.reward else {
            return Ok(Arc::new(Float64Array::from(vec![0.0; self.n_steps])));
        };
        let rewards = self.batch().column(index).slice(0, self.n_steps);
        refuse_nulls(&rewards, schema::REWARD, self.piece.first_row)?;
        arrow::compute::cast(&rewards, &DataType::Float64)
            .map_err(DatasetError::arrow("convert rewards"))
    }

    /// Terminations and truncations. `cut` episodes lost their last step.
    fn flags(&self, columns: &Columns, cut: bool) -> Result<(ArrayRef, ArrayRef)> {
        let recorded = |index: Option<usize>, name: &str| -> Result<Vec<bool>> {
            let Some(index) = index else {
                return Ok(vec![false; self.n_steps]);
            };
            let flags = self.batch().column(index).slice(0, self.n_steps);
            refuse_nulls(&flags, name, self.piece.first_row)?;
            Ok(flags.as_boolean().values().iter().collect())
        };
        let terminated = recorded(columns.terminated, schema::TERMINATED)?;
        let mut truncated = recorded(columns.truncated, schema::TRUNCATED)?;
        if let Some(row) = self.last_step
            && (cut || columns.truncated.is_none())
            && !terminated[row]
        {
            truncated[row] = true;
        }
        Ok((
            Arc::new(BooleanArray::from(terminated)),
            Arc::new(BooleanArray::from(truncated)),
        ))
    }
}
