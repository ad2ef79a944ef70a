//! Cutting the rows of a file into episodes.

use arrow::array::{ArrayRef, AsArray, BooleanArray};
use arrow::datatypes::{DataType, Field, Float64Type};

use super::cut::{Cut, Cutter, RowFlags};
use super::flat::{FlatArrays, FlatRows, GOAL, OBSERVATIONS, TERMINALS, TIMEOUTS, missing};
use super::policy::EpisodePolicy;
use crate::error::{DatasetError, Result};
use crate::format::OpenOptions;
use crate::formats::steps::{ArrayInfo, LeafBuilder};
use crate::source::Warning;

/// Rows of flags read at a time.
const ROWS_AT_ONCE: u64 = 65_536;
/// A position that moves further than this in one step is a reset (the antmaze ant moves by at most 0.5).
const JUMP: f64 = 1.0;

/// The episodes and how they came about.
pub(crate) struct Plan {
    pub(crate) policy: EpisodePolicy,
    pub(crate) cuts: Vec<Cut>,
    pub(crate) rule: String,
    pub(crate) inferred: bool,
    pub(crate) warnings: Vec<Warning>,
}

/// Reads the flags once, in parts, and cuts.
///
/// # Errors
/// What the policy needs is not there, a NaN flag, or a failed read.
pub(crate) fn plan(file: &dyn FlatArrays, file_name: &str, options: &OpenOptions) -> Result<Plan> {
    let infos = file.infos();
    let (by_name, warning) = EpisodePolicy::default_for(file_name);
    let (policy, mut warnings) = match options.episode_policy {
        Some(policy) => (policy, Vec::new()),
        None => (by_name, warning.into_iter().collect()),
    };
    let timeouts = infos.iter().find(|array| array.key == TIMEOUTS);
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
    let mover = Mover::new(file, policy)?;
    read_flags(file, timeouts.is_some(), mover, &mut cutter)?;
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
    file: &dyn FlatArrays,
    has_timeouts: bool,
    mut mover: Option<Mover<'_>>,
    cutter: &mut Cutter,
) -> Result<()> {
    let mut terminals = Column::new(file, TERMINALS)?;
    let mut timeouts = has_timeouts
        .then(|| Column::new(file, TIMEOUTS))
        .transpose()?;
    let mut start = 0;
    while start < file.n_rows() {
        let n = usize::try_from(ROWS_AT_ONCE.min(file.n_rows() - start)).unwrap_or(0);
        let terminal = terminals.flags(start, n)?;
        let timeout = timeouts
            .as_mut()
            .map(|timeouts| timeouts.flags(start, n))
            .transpose()?;
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

/// An array that is read in parts.
pub(crate) struct Column<'a> {
    info: ArrayInfo,
    rows: Box<dyn FlatRows + 'a>,
}

impl<'a> Column<'a> {
    /// Starts to read an array.
    ///
    /// # Errors
    /// It is not there.
    pub(crate) fn new(file: &'a dyn FlatArrays, key: &str) -> Result<Self> {
        let infos = file.infos();
        let info = infos.iter().find(|array| array.key == key);
        let missing = || missing(key, infos.iter().map(|array| array.key.as_str()));
        Ok(Self {
            info: info.cloned().ok_or_else(missing)?,
            rows: file.rows(key)?,
        })
    }

    fn read(&mut self, field: &Field, start: u64, n: usize) -> Result<ArrayRef> {
        let mut builder = LeafBuilder::new(self.info.element, self.info.width(), n);
        self.rows.append(start, n, &mut builder)?;
        builder.finish(field).map_err(|error| match error {
            DatasetError::NanFlag { column, row } => DatasetError::NanFlag {
                column,
                row: row + start,
            },
            other => other,
        })
    }

    /// Rows `start..start + n` as flags.
    ///
    /// # Errors
    /// They cannot be read, or one is NaN.
    pub(crate) fn flags(&mut self, start: u64, n: usize) -> Result<BooleanArray> {
        let field = Field::new(&self.info.key, DataType::Boolean, true);
        Ok(self.read(&field, start, n)?.as_boolean().clone())
    }
}

/// Sees where the goal or the position moved.
struct Mover<'a> {
    column: Column<'a>,
    jump: bool,
    before: Vec<f64>,
}

impl<'a> Mover<'a> {
    fn new(file: &'a dyn FlatArrays, policy: EpisodePolicy) -> Result<Option<Self>> {
        let needs = |needs| DatasetError::PolicyNeeds {
            policy: policy.name(),
            needs,
        };
        let (column, jump) = match policy {
            EpisodePolicy::GoalChange => {
                let goal = Column::new(file, GOAL);
                (goal.map_err(|_| needs("the key \"infos/goal\""))?, false)
            }
            EpisodePolicy::PositionJump => (Column::new(file, OBSERVATIONS)?, true),
            _ => return Ok(None),
        };
        if jump && column.info.width() < 2 {
            return Err(needs("observations that start with x and y"));
        }
        Ok(Some(Self {
            column,
            jump,
            before: Vec::new(),
        }))
    }

    fn read(&mut self, start: u64, n: usize) -> Result<Vec<bool>> {
        let width = self.column.info.width();
        let info = &self.column.info;
        let flat = Field::new(&info.key, info.element.data_type(), false);
        let values = self.column.read(&flat, start, n)?;
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
