//! Cutting the rows of a file into episodes.

use arrow::array::{ArrayRef, AsArray, BooleanArray};
use arrow::datatypes::{DataType, Field, Float64Type};

use super::cut::{Cut, Cutter, RowFlags};
use super::policy::EpisodePolicy;
use super::walk::{GOAL, OBSERVATIONS, TERMINALS, TIMEOUTS, Walked};
use crate::error::{DatasetError, Result};
use crate::format::OpenOptions;
use crate::formats::hdf5::{Array, LeafBuilder};
use crate::source::Warning;

/// Rows of flags read at a time.
const ROWS_AT_ONCE: u64 = 65_536;
/// A position that moves further than this in one step is a reset (the antmaze ant moves by at most 0.5).
const JUMP: f64 = 1.0;

/// The episodes and how they came about.
pub(super) struct Plan {
    pub(super) policy: EpisodePolicy,
    pub(super) cuts: Vec<Cut>,
    pub(super) rule: String,
    pub(super) inferred: bool,
    pub(super) warnings: Vec<Warning>,
}

/// Reads the flags once, in parts, and cuts.
///
/// # Errors
/// What the policy needs is not there, a NaN flag, or a failed read.
pub(super) fn plan(walked: &Walked, file_name: &str, options: &OpenOptions) -> Result<Plan> {
    let (by_name, warning) = EpisodePolicy::default_for(file_name);
    let (policy, mut warnings) = match options.episode_policy {
        Some(policy) => (policy, Vec::new()),
        None => (by_name, warning.into_iter().collect()),
    };
    let timeouts = walked.find(TIMEOUTS);
    let uses_timeouts = !matches!(
        policy,
        EpisodePolicy::GoalChange | EpisodePolicy::PositionJump
    );
    if by_name == EpisodePolicy::PositionJump && uses_timeouts && timeouts.is_some() {
        warnings.push(Warning::UnreliableTimeouts);
    }
    let limit = options.max_episode_steps;
    if timeouts.is_none() && policy == EpisodePolicy::Clean {
        let instead = match limit {
            Some(_) => "episodes are cut at terminals and after max_episode_steps",
            None => "episodes are cut at terminals only (max_episode_steps is not given)",
        };
        warnings.push(Warning::NoEpisodeEnds { instead });
    }
    let mut cutter = Cutter::new(policy, timeouts.is_some(), limit, options.terminate_on_end)?;
    let mover = Mover::new(walked, policy)?;
    read_flags(walked, timeouts, mover, &mut cutter)?;
    let by_counter = timeouts.is_none() && limit.is_some() && uses_timeouts;
    Ok(Plan {
        policy,
        cuts: cutter.finish(),
        rule: rule(policy, by_counter),
        inferred: by_counter || !uses_timeouts,
        warnings,
    })
}

fn rule(policy: EpisodePolicy, by_counter: bool) -> String {
    let counter = if by_counter {
        ", with a step limit in place of time-outs"
    } else {
        ""
    };
    format!("policy `{policy}`{counter}")
}

fn read_flags(
    walked: &Walked,
    timeouts: Option<&Array>,
    mut mover: Option<Mover<'_>>,
    cutter: &mut Cutter,
) -> Result<()> {
    let terminals = walked.required(TERMINALS)?;
    let mut start = 0;
    while start < walked.n_rows {
        let n = usize::try_from(ROWS_AT_ONCE.min(walked.n_rows - start)).unwrap_or(0);
        let terminal = flags(terminals, start, n)?;
        let timeout = timeouts.map(|array| flags(array, start, n)).transpose()?;
        let moved = mover
            .as_mut()
            .map(|mover| mover.read(start, n))
            .transpose()?;
        for row in 0..n {
            cutter.push(RowFlags {
                terminal: terminal.value(row),
                timeout: timeout.as_ref().map(|flags| flags.value(row)),
                moved: moved.as_ref().is_some_and(|moved| moved[row]),
            });
        }
        start += n as u64;
    }
    Ok(())
}

fn read(array: &Array, field: &Field, start: u64, n: usize) -> Result<ArrayRef> {
    let mut builder = LeafBuilder::new(array.element(), array.width(), n);
    builder.append(array, start, n)?;
    builder.finish(field).map_err(|error| match error {
        DatasetError::NanFlag { column, row } => DatasetError::NanFlag {
            column,
            row: row + start,
        },
        other => other,
    })
}

fn flags(array: &Array, start: u64, n: usize) -> Result<BooleanArray> {
    let field = Field::new(array.key(), DataType::Boolean, true);
    Ok(read(array, &field, start, n)?.as_boolean().clone())
}

/// Sees where the goal or the position moved.
struct Mover<'a> {
    array: &'a Array,
    jump: bool,
    before: Vec<f64>,
}

impl<'a> Mover<'a> {
    fn new(walked: &'a Walked, policy: EpisodePolicy) -> Result<Option<Self>> {
        let needs = |needs| DatasetError::PolicyNeeds {
            policy: policy.name(),
            needs,
        };
        let (array, jump) = match policy {
            EpisodePolicy::GoalChange => (
                walked
                    .find(GOAL)
                    .ok_or_else(|| needs("the key \"infos/goal\""))?,
                false,
            ),
            EpisodePolicy::PositionJump => (walked.required(OBSERVATIONS)?, true),
            _ => return Ok(None),
        };
        if jump && array.width() < 2 {
            return Err(needs("observations that start with x and y"));
        }
        Ok(Some(Self {
            array,
            jump,
            before: Vec::new(),
        }))
    }

    fn read(&mut self, start: u64, n: usize) -> Result<Vec<bool>> {
        let width = self.array.width();
        let flat = Field::new(self.array.key(), self.array.element().data_type(), false);
        let values = read(self.array, &flat, start, n)?;
        let values = arrow::compute::cast(&values, &DataType::Float64)
            .map_err(DatasetError::arrow("compare positions"))?;
        let values = values.as_primitive::<Float64Type>();
        if values.len() != n * width {
            return Err(DatasetError::corrupt("positions of the wrong length"));
        }
        let mut moved = Vec::with_capacity(n);
        for row in values.values().chunks_exact(width) {
            moved.push(!self.before.is_empty() && self.has_moved(row));
            self.before.clear();
            self.before.extend_from_slice(row);
        }
        Ok(moved)
    }

    fn has_moved(&self, row: &[f64]) -> bool {
        if self.jump {
            return (row[0] - self.before[0]).hypot(row[1] - self.before[1]) > JUMP;
        }
        // By bits, so that a NaN goal is a goal and does not end an episode at every row.
        row.iter()
            .zip(&self.before)
            .any(|(a, b)| a.to_bits() != b.to_bits())
    }
}
