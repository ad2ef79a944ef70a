//! Where OGBench's trajectories end, and their columns.

use std::collections::HashMap;
use std::sync::Arc;

use arrow::datatypes::DataType;

use crate::episode::EpisodeEnd;
use crate::error::{DatasetError, Result};
use crate::formats::d4rl::cut::Cut;
use crate::formats::d4rl::flat::{
    ACTIONS, FlatArrays, NEXT_OBSERVATIONS, OBSERVATIONS, TERMINALS, info_name,
};
use crate::formats::d4rl::plan::Column;
use crate::formats::steps::{ArrayInfo, ColumnSource, Element, RowRule, StepColumn};
use crate::schema;

/// 0 on the last row of a trajectory, in compact archives.
pub(super) const VALIDS: &str = "valids";
/// Rows of flags read at a time.
const ROWS_AT_ONCE: u64 = 65_536;

/// The trajectories: all with a final observation but what is left at the end. Also how many were without a step.
///
/// # Errors
/// The flags cannot be read, or do not fit each other.
pub(super) fn cut(file: &dyn FlatArrays) -> Result<(Vec<Cut>, u64)> {
    let is_compact = file.infos().iter().any(|array| array.key == VALIDS);
    let mut terminals = Column::new(file, TERMINALS)?;
    let mut valids = is_compact.then(|| Column::new(file, VALIDS)).transpose()?;
    let mut cutter = Cutter::default();
    let mut start = 0;
    while start < file.n_rows() {
        let n = usize::try_from(ROWS_AT_ONCE.min(file.n_rows() - start)).unwrap_or(1);
        let terminal = terminals.flags(start, n)?;
        let valid = valids
            .as_mut()
            .map(|valids| valids.flags(start, n))
            .transpose()?;
        for row in 0..n {
            let valid = valid.as_ref().map(|valid| valid.value(row));
            cutter.push(terminal.value(row), valid)?;
        }
        start += n as u64;
    }
    Ok(cutter.finish())
}

#[derive(Default)]
struct Cutter {
    cuts: Vec<Cut>,
    n_empty: u64,
    start: u64,
    row: u64,
    /// Whether the row before said that this one is the last.
    announced: bool,
}

impl Cutter {
    fn push(&mut self, is_terminal: bool, valid: Option<bool>) -> Result<()> {
        let is_last = match valid {
            None => is_terminal,
            Some(valid) => {
                if (!valid && !is_terminal) || (valid && self.announced) {
                    let row = self.row;
                    return Err(DatasetError::corrupt(format!(
                        "row {row} of \"{VALIDS}\" and \"{TERMINALS}\" do not fit each other"
                    )));
                }
                self.announced = valid && is_terminal;
                !valid
            }
        };
        self.row += 1;
        if is_last {
            self.end(true);
        }
        Ok(())
    }

    fn end(&mut self, is_marked: bool) {
        let n_rows = self.row - self.start;
        let n_steps = n_rows.saturating_sub(u64::from(is_marked));
        if n_steps > 0 {
            self.cuts.push(Cut {
                start: self.start,
                n_steps,
                has_final_obs: is_marked,
                end: if is_marked {
                    EpisodeEnd::Truncated
                } else {
                    EpisodeEnd::Cut
                },
            });
        } else {
            self.n_empty += u64::from(n_rows > 0);
        }
        self.start = self.row;
    }

    fn finish(mut self) -> (Vec<Cut>, u64) {
        self.end(false);
        (self.cuts, self.n_empty)
    }
}

/// The columns of the step table, canonical order.
pub(super) fn columns(arrays: &[ArrayInfo]) -> Vec<StepColumn> {
    let known = [OBSERVATIONS, ACTIONS, TERMINALS, NEXT_OBSERVATIONS];
    let find = |key: &str| arrays.iter().find(|array| array.key == key);
    let named = |key: &str, name: &str, rule| find(key).map(|array| column(array, name, rule));
    let mut columns = Vec::new();
    columns.extend(named(
        OBSERVATIONS,
        schema::OBSERVATION,
        RowRule::Observation,
    ));
    columns.extend(named(ACTIONS, schema::ACTION, RowRule::Step));
    columns.extend(find(TERMINALS).map(truncated));
    columns.extend(named(
        NEXT_OBSERVATIONS,
        schema::NEXT_OBSERVATION,
        RowRule::Step,
    ));
    let is_other = |array: &&ArrayInfo| !known.contains(&array.key.as_str()) && array.key != VALIDS;
    let others = arrays.iter().filter(is_other);
    // State of the simulator is recorded for the last row as well.
    columns.extend(others.map(|array| column(array, &info_name(&array.key), RowRule::Info)));
    columns
}

fn column(array: &ArrayInfo, name: &str, rule: RowRule) -> StepColumn {
    let nullable = rule != RowRule::Observation;
    let field = schema::leaf_field(name, array.element.data_type(), &array.row_shape, nullable);
    StepColumn {
        field: Arc::new(field),
        source: ColumnSource {
            key: array.key.clone(),
            element: array.element,
            width: array.width(),
            rule,
        },
    }
}

/// Made of the ends of the trajectories, not of the rows of `terminals`.
fn truncated(terminals: &ArrayInfo) -> StepColumn {
    let dtype = terminals.element.numpy_name().to_owned();
    let field = schema::leaf_field(schema::TRUNCATED, DataType::Boolean, &[], true)
        .with_metadata(HashMap::from([(schema::SOURCE_DTYPE.to_owned(), dtype)]));
    StepColumn {
        field: Arc::new(field),
        source: ColumnSource {
            key: TERMINALS.to_owned(),
            element: Element::Bool,
            width: 1,
            rule: RowRule::Step,
        },
    }
}
