//! Writing the rows of a table as D4RL's flat arrays.

use std::path::{Path, PathBuf};

use arrow::array::{
    Array, ArrayRef, AsArray, BooleanArray, Float32Array, RecordBatch, UInt64Array,
};
use arrow::datatypes::DataType;
use hdf5_metno as hdf5;

use super::flat::{ACTIONS, NEXT_OBSERVATIONS, OBSERVATIONS, REWARDS, TERMINALS, TIMEOUTS};
use super::write_about::{describe, note_episodes};
use super::write_plan::{Concat, Info, Next, Plan, Scalar};
use crate::error::{DatasetError, Result};
use crate::formats::episode_rows::{EpisodeCursor, EpisodePiece, flat_values, refuse_nulls};
use crate::formats::fill::{concat, without_nulls};
use crate::formats::hdf5::{ArrayPlan, ArrayWriter, close_file, create_file};
use crate::schema;
use crate::sink::{
    DatasetSink, Loss, LossEffect, LossTally, SinkInput, WriteOptions, Written, publish,
};
use crate::staging::Staged;

/// D4RL's own level of deflate.
const DEFLATE: u8 = 4;

/// A D4RL file that is being written.
struct D4rlSink {
    path: PathBuf,
    staged: Staged,
    file: hdf5::File,
    cursor: EpisodeCursor,
    plan: Plan,
    arrays: Arrays,
    /// The source's last episode may end without a flag, as in D4RL's own files.
    keeps_tail: bool,
    losses: Vec<Loss>,
    tally: LossTally,
    /// The episode that is being written has a flag before its last step.
    flag_inside: bool,
}

/// The arrays of the file.
struct Arrays {
    observations: ArrayWriter,
    actions: ArrayWriter,
    rewards: ArrayWriter,
    terminals: ArrayWriter,
    timeouts: Option<ArrayWriter>,
    next_observations: Option<ArrayWriter>,
    infos: Vec<ArrayWriter>,
}

/// Starts a D4RL file.
///
/// # Errors
/// No numeric observation or action, or the file cannot be made.
pub(crate) fn create(
    path: &Path,
    input: &SinkInput<'_>,
    options: &WriteOptions,
) -> Result<Box<dyn DatasetSink>> {
    let mut losses = Vec::new();
    let plan = Plan::new(input, &mut losses)?;
    let is_d4rl = super::write_about::is_d4rl(input);
    note_episodes(input, options, &plan, &mut losses);
    let staged = Staged::file(path)?;
    let file = create_file(staged.path())?;
    describe(&file, input, &plan, &mut losses)?;
    let n_rows = input.episodes.iter().map(|episode| episode.length).sum();
    let maker = Maker {
        file: &file,
        n_rows,
    };
    let arrays = maker.arrays(&plan, super::write_about::needs_timeouts(input, &plan))?;
    Ok(Box::new(D4rlSink {
        path: path.to_owned(),
        staged,
        file,
        cursor: EpisodeCursor::new(input),
        plan,
        arrays,
        keeps_tail: is_d4rl,
        losses,
        tally: LossTally::default(),
        flag_inside: false,
    }))
}

/// Makes the arrays of a file.
struct Maker<'f> {
    file: &'f hdf5::File,
    n_rows: u64,
}

impl Maker<'_> {
    fn arrays(&self, plan: &Plan, timeouts: bool) -> Result<Arrays> {
        let made = |scalar: &Option<Scalar>, key, otherwise| match scalar {
            Some(scalar) => self.array(key, &scalar.value_type, &scalar.row_shape),
            None => self.array(key, &otherwise, &[]),
        };
        let observed = &plan.observation;
        let next = (plan.next != Next::Absent).then_some(NEXT_OBSERVATIONS);
        let infos = plan.infos.iter();
        Ok(Arrays {
            observations: self.concat(OBSERVATIONS, observed)?,
            actions: self.concat(ACTIONS, &plan.action)?,
            rewards: made(&plan.reward, REWARDS, DataType::Float32)?,
            terminals: made(&plan.terminated, TERMINALS, DataType::Boolean)?,
            timeouts: match timeouts {
                true => Some(made(&plan.truncated, TIMEOUTS, DataType::Boolean)?),
                false => None,
            },
            next_observations: next.map(|key| self.concat(key, observed)).transpose()?,
            infos: infos
                .map(|info| self.array(&info.key, &info.value_type, &info.row_shape))
                .collect::<Result<_>>()?,
        })
    }

    fn concat(&self, key: &str, concat: &Concat) -> Result<ArrayWriter> {
        self.array(key, &concat.value_type, &concat.row_shape)
    }

    fn array(&self, key: &str, value_type: &DataType, row_shape: &[usize]) -> Result<ArrayWriter> {
        let plan = ArrayPlan {
            value_type: value_type.clone(),
            row_shape: row_shape.to_vec(),
            n_rows: self.n_rows,
            deflate: Some(DEFLATE),
        };
        ArrayWriter::create(self.file, key, key, &plan)
    }
}

impl D4rlSink {
    fn write_rows(&mut self, batch: &RecordBatch) -> Result<()> {
        for piece in self.cursor.cut(batch)? {
            self.write_piece(&piece)?;
        }
        Ok(())
    }

    fn write_piece(&mut self, piece: &EpisodePiece) -> Result<()> {
        let Some(episode) = self.cursor.episodes().get(piece.place) else {
            return Ok(());
        };
        let (length, has_final) = (episode.length, episode.has_final_obs);
        let is_last = piece.place + 1 == self.cursor.episodes().len();
        let n_rows = piece.rows.num_rows();
        let n_steps = usize::try_from(length.saturating_sub(piece.first_row))
            .unwrap_or(usize::MAX)
            .min(n_rows);
        let steps = Steps {
            rows: &piece.rows,
            first_row: piece.first_row,
            n_steps,
            ends: n_steps > 0 && piece.first_row + n_steps as u64 == length,
        };
        let observed = steps.joined(&self.plan.observation, 0..n_rows)?;
        self.arrays
            .observations
            .append(&observed.slice(0, n_steps))?;
        let acted = steps.joined(&self.plan.action, 0..n_steps)?;
        self.arrays.actions.append(&acted)?;
        let rewards = steps.scalar(self.plan.reward.as_ref(), schema::REWARD)?;
        self.arrays.rewards.append(&rewards)?;
        self.write_next(&steps, &observed, has_final)?;
        self.write_flags(&steps, is_last)?;
        self.write_infos(&steps)
    }

    fn write_next(
        &mut self,
        steps: &Steps<'_>,
        observed: &ArrayRef,
        has_final: bool,
    ) -> Result<()> {
        let Some(array) = &mut self.arrays.next_observations else {
            return Ok(());
        };
        if let Next::Recorded(next) = &self.plan.next {
            return array.append(&steps.joined(next, 0..steps.n_steps)?);
        }
        // Every observation of an episode but the first is the next one of some step.
        let skipped = usize::from(steps.first_row == 0);
        array.append(&observed.slice(skipped, observed.len() - skipped))?;
        if steps.ends && !has_final {
            array.append(&observed.slice(observed.len() - 1, 1))?;
            let detail = "the last observation stands for the one after the last step as well";
            let item = "final observations";
            self.tally.add(item, LossEffect::Invented, detail, 1);
        }
        Ok(())
    }

    fn write_flags(&mut self, steps: &Steps<'_>, is_last: bool) -> Result<()> {
        let terminals = steps.flags(self.plan.terminated.as_ref(), schema::TERMINATED)?;
        let mut timeouts = steps.flags(self.plan.truncated.as_ref(), schema::TRUNCATED)?;
        let inside = steps.n_steps - usize::from(steps.ends);
        self.flag_inside |= terminals
            .iter()
            .zip(&timeouts)
            .take(inside)
            .any(|(&terminal, &timeout)| terminal || timeout);
        if steps.ends {
            let detail = "D4RL's rules cut at every flag, and some are set before the last step";
            let n = u64::from(std::mem::take(&mut self.flag_inside));
            self.tally
                .add("episode borders", LossEffect::Changed, detail, n);
            let last = steps.n_steps - 1;
            let has_end = terminals[last] || timeouts[last] || (is_last && self.keeps_tail);
            if !has_end {
                timeouts[last] = true;
                let detail = "an episode that ends without a flag gets a time-out at its last step";
                self.tally.add(TIMEOUTS, LossEffect::Invented, detail, 1);
            }
        }
        self.arrays
            .terminals
            .append(&stored_flags(terminals, self.plan.terminated.as_ref())?)?;
        match &mut self.arrays.timeouts {
            Some(array) => array.append(&stored_flags(timeouts, self.plan.truncated.as_ref())?),
            None => Ok(()),
        }
    }

    fn write_infos(&mut self, steps: &Steps<'_>) -> Result<()> {
        for (array, info) in self.arrays.infos.iter_mut().zip(&self.plan.infos) {
            let column = steps.rows.column(info.index);
            let (filled, n_filled) = without_nulls(&column.slice(0, steps.n_steps))?;
            note_info(info, column, (steps.n_steps, n_filled), &mut self.tally);
            array.append(&filled)?;
        }
        Ok(())
    }

    fn place(self) -> Result<Written> {
        let Self {
            staged,
            file,
            cursor,
            arrays,
            mut losses,
            tally,
            ..
        } = self;
        cursor.finish()?;
        drop(arrays);
        close_file(file, staged.path())?;
        losses.extend(tally.into_losses());
        publish(staged, losses)
    }
}

/// Values that steps lack, and values at final observations, of which D4RL has no rows.
fn note_info(
    info: &Info,
    column: &ArrayRef,
    (n_steps, n_filled): (usize, u64),
    tally: &mut LossTally,
) {
    let detail = "steps without a value got NaN, 0 or empty text";
    tally.add(&info.column, LossEffect::Invented, detail, n_filled);
    let after = column.slice(n_steps, column.len() - n_steps);
    let n_dropped = (after.len() - after.null_count()) as u64;
    let detail = "D4RL has no rows after the last step";
    tally.add(&info.column, LossEffect::Dropped, detail, n_dropped);
}

/// The steps of an episode among the rows of a batch.
struct Steps<'r> {
    rows: &'r RecordBatch,
    /// Place of the first row in the episode.
    first_row: u64,
    n_steps: usize,
    /// The last step of the episode is among them.
    ends: bool,
}

impl Steps<'_> {
    /// Leaves side by side in one type.
    fn joined(&self, leaves: &Concat, rows: std::ops::Range<usize>) -> Result<ArrayRef> {
        let n_rows = rows.len();
        let mut flat = Vec::with_capacity(leaves.leaves.len());
        for leaf in &leaves.leaves {
            let column = self.rows.column(leaf.index).slice(rows.start, n_rows);
            refuse_nulls(&column, &leaf.column, self.first_row)?;
            if let [_] = leaves.leaves.as_slice() {
                return Ok(column);
            }
            let values = flat_values(&column);
            let width = leaf.width();
            let place = (leaf.column.as_str(), width);
            flat.push((
                cast(&values, &leaves.value_type, place, self.first_row)?,
                width,
            ));
        }
        let width: usize = flat.iter().map(|(_, width)| width).sum();
        let columns: Vec<&ArrayRef> = flat.iter().map(|(values, _)| values).collect();
        let all = concat(&columns)?;
        let mut order = Vec::with_capacity(n_rows * width);
        for row in 0..n_rows {
            let mut start = 0;
            for (values, width) in &flat {
                let first = start + row * width;
                order.extend((first..first + width).map(|place| place as u64));
                start += values.len();
            }
        }
        let values = arrow::compute::take(&all, &UInt64Array::from(order), None)
            .map_err(DatasetError::arrow("put leaves side by side"))?;
        rows_of(values, width)
    }

    fn scalar(&self, scalar: Option<&Scalar>, name: &str) -> Result<ArrayRef> {
        let Some(scalar) = scalar else {
            return Ok(std::sync::Arc::new(Float32Array::from(vec![
                0.0;
                self.n_steps
            ])));
        };
        let values = self.rows.column(scalar.index).slice(0, self.n_steps);
        refuse_nulls(&values, name, self.first_row)?;
        Ok(values)
    }

    fn flags(&self, scalar: Option<&Scalar>, name: &str) -> Result<Vec<bool>> {
        if scalar.is_none() {
            return Ok(vec![false; self.n_steps]);
        }
        let flags = self.scalar(scalar, name)?;
        Ok(flags.as_boolean().values().iter().collect())
    }
}

/// Values as rows of `width`.
fn rows_of(values: ArrayRef, width: usize) -> Result<ArrayRef> {
    let size = i32::try_from(width).unwrap_or(i32::MAX);
    let child = schema::element(values.data_type().clone());
    let list = arrow::array::FixedSizeListArray::try_new(child, size, values, None);
    Ok(std::sync::Arc::new(
        list.map_err(DatasetError::arrow("put leaves side by side"))?,
    ))
}

/// The values in another type that holds each of them.
fn cast(
    values: &ArrayRef,
    to: &DataType,
    (column, width): (&str, usize),
    first_row: u64,
) -> Result<ArrayRef> {
    let converted =
        arrow::compute::cast(values, to).map_err(DatasetError::arrow("put leaves side by side"))?;
    if values.data_type().is_integer() && to.is_floating() {
        let back = arrow::compute::cast(&converted, values.data_type())
            .map_err(DatasetError::arrow("put leaves side by side"))?;
        let differs = |place: &usize| back.slice(*place, 1) != values.slice(*place, 1);
        if back.as_ref() != values.as_ref()
            && let Some(place) = (0..values.len()).find(differs)
        {
            return Err(DatasetError::InexactInteger {
                column: column.to_owned(),
                row: first_row + (place / width.max(1)) as u64,
            });
        }
    }
    Ok(converted)
}

/// Flags in the type they had in the source.
fn stored_flags(flags: Vec<bool>, scalar: Option<&Scalar>) -> Result<ArrayRef> {
    let flags: ArrayRef = std::sync::Arc::new(BooleanArray::from(flags));
    match scalar {
        Some(scalar) if scalar.value_type != DataType::Boolean => {
            arrow::compute::cast(&flags, &scalar.value_type)
                .map_err(DatasetError::arrow("write flags"))
        }
        _ => Ok(flags),
    }
}

impl DatasetSink for D4rlSink {
    fn write(&mut self, batch: &RecordBatch) -> Result<()> {
        self.write_rows(batch)
            .map_err(|error| error.in_file(&self.path))
    }

    fn finish(self: Box<Self>) -> Result<Written> {
        let path = self.path.clone();
        self.place().map_err(|error| error.in_file(&path))
    }
}
