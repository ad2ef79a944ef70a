//! Whether the steps of numbered rows have what makes a step.

use std::collections::VecDeque;

use arrow::array::{Array, ArrayRef, RecordBatch};

use super::mapping::{Column, From, Mapping};
use super::numbered::{is_step, no_sample};
use super::plan::Episode;
use crate::error::{DatasetError, Result};

/// Looks for nulls that stand where a step needs a value.
pub(super) struct StepCheck<'a> {
    mapping: &'a Mapping,
    /// Those not passed yet.
    episodes: VecDeque<&'a Episode>,
    /// Row in the first of them.
    row: usize,
}

impl<'a> StepCheck<'a> {
    pub(super) fn new(mapping: &'a Mapping, episodes: VecDeque<&'a Episode>) -> Self {
        Self {
            mapping,
            episodes,
            row: 0,
        }
    }

    /// Checks the next batch.
    ///
    /// # Errors
    /// A row that is no final observation and lacks an action, reward or flag.
    pub(super) fn check(&mut self, batch: &RecordBatch) -> Result<()> {
        let columns = self.mapping.columns.iter().filter(|column| is_step(column));
        let columns: Vec<(&Column, &ArrayRef)> = columns
            .filter_map(|column| Some((column, batch.column_by_name(&column.name)?)))
            .collect();
        for row in 0..batch.num_rows() {
            while let Some(episode) = self.episodes.front()
                && self.row >= episode.rows.len()
            {
                self.episodes.pop_front();
                self.row = 0;
            }
            let Some(episode) = self.episodes.front() else {
                return Err(DatasetError::corrupt("more rows than were counted"));
            };
            let is_last = self.row + 1 == episode.rows.len();
            let mut nulls = columns.iter().filter(|(_, array)| array.is_null(row));
            if let Some((column, _)) = nulls.next()
                && !(is_last && nulls.count() + 1 == columns.len())
            {
                let topic = match &column.from {
                    From::Topic(fields) => fields.topic.clone(),
                    From::NextOf(_) => String::new(),
                };
                let time = episode.rows.get(self.row).copied().unwrap_or_default();
                return Err(no_sample(topic, column.name.clone(), time));
            }
            self.row += 1;
        }
        Ok(())
    }
}
