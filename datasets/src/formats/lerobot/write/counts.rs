//! Things that are counted while rows go by, and what they come to.

use std::collections::BTreeMap;

use super::plan::loss;
use crate::schema;
use crate::sink::{Loss, LossEffect};

/// The counts.
#[derive(Default)]
pub(super) struct Counts {
    /// Rows that are no step.
    pub(super) final_rows: u64,
    /// Steps with another number than their place.
    pub(super) renumbered_steps: u64,
    /// Steps whose time is not step / fps.
    pub(super) off_grid: u64,
    /// Rows with a null, by column.
    pub(super) filled: BTreeMap<String, u64>,
}

impl Counts {
    /// What was lost or changed; `keeps_time` if `t_ns` is a feature.
    pub(super) fn losses(&self, fps: f64, keeps_time: bool) -> Vec<Loss> {
        let kept = match keeps_time {
            true => "`timestamp` is step / fps; the feature `t_ns` keeps the recorded time",
            false => "`timestamp` keeps the recorded time, to the precision of float32",
        };
        let off_grid = format!("over 0.1 ms off the grid of {fps} steps per second: {kept}");
        let mut losses = Vec::new();
        for (item, effect, count, detail) in [
            (
                "final observations",
                LossEffect::Dropped,
                self.final_rows,
                "LeRobot has no observation after the last step",
            ),
            (
                schema::STEP_INDEX,
                LossEffect::Changed,
                self.renumbered_steps,
                "steps are numbered from 0 without gaps",
            ),
            (
                schema::T_NS,
                LossEffect::Changed,
                self.off_grid,
                off_grid.as_str(),
            ),
        ] {
            if count > 0 {
                losses.push(counted(item, effect, count, detail));
            }
        }
        let detail = "LeRobot has no nulls: NaN, 0, false or no text stand in for them";
        let filled = self.filled.iter();
        losses.extend(filled.map(|(column, n)| counted(column, LossEffect::Changed, *n, detail)));
        losses
    }
}

/// A loss of so many rows.
pub(super) fn counted(item: &str, effect: LossEffect, count: u64, detail: &str) -> Loss {
    Loss {
        count: Some(count),
        ..loss(item, effect, detail)
    }
}
