//! Texts of tasks, numbered as they appear.

use std::collections::BTreeMap;
use std::sync::Arc;

use arrow::array::{AsArray, RecordBatch, StringArray};
use arrow::datatypes::DataType;

use super::super::columns::INFO_TASK;
use super::counts::counted;
use crate::sink::{Loss, LossEffect};

/// Text of the task where nothing else says it.
const UNNAMED_TASK: &str = "unspecified task";

/// The tasks that were met.
pub(super) struct Tasks {
    numbers: BTreeMap<String, i64>,
    /// Their texts, by number.
    pub(super) texts: Vec<String>,
    of_episodes: BTreeMap<i64, String>,
    default: String,
    is_default_invented: bool,
    /// Rows that got the default.
    n_default: u64,
}

impl Tasks {
    /// `default` is the text of steps that have none; `of_episodes` are those of whole episodes, by number.
    pub(super) fn new(default: Option<&String>, of_episodes: BTreeMap<i64, String>) -> Self {
        Self {
            numbers: BTreeMap::new(),
            texts: Vec::new(),
            of_episodes,
            default: default.map_or_else(|| UNNAMED_TASK.to_owned(), Clone::clone),
            is_default_invented: default.is_none(),
            n_default: 0,
        }
    }

    /// Numbers of the rows' tasks, by `info.task`, else by what the episode records, else the default. New ones
    /// are added to those of the episode.
    pub(super) fn of_rows(
        &mut self,
        batch: &RecordBatch,
        episode: i64,
        met: &mut Vec<String>,
    ) -> Vec<i64> {
        let texts = match batch.column_by_name(INFO_TASK) {
            Some(column) if *column.data_type() == DataType::Utf8 => Arc::clone(column),
            _ => Arc::new(StringArray::new_null(batch.num_rows())),
        };
        let of_episode = self.of_episodes.get(&episode).cloned();
        let default = self.default.clone();
        let mut numbers = Vec::with_capacity(batch.num_rows());
        for text in texts.as_string::<i32>() {
            let text = text.or(of_episode.as_deref()).unwrap_or_else(|| {
                self.n_default += 1;
                &default
            });
            numbers.push(self.number(text));
            if !met.iter().any(|task| task == text) {
                met.push(text.to_owned());
            }
        }
        numbers
    }

    fn number(&mut self, text: &str) -> i64 {
        if let Some(number) = self.numbers.get(text) {
            return *number;
        }
        let number = i64::try_from(self.texts.len()).unwrap_or(i64::MAX);
        self.numbers.insert(text.to_owned(), number);
        self.texts.push(text.to_owned());
        number
    }

    /// A task that was made up, for how many steps.
    pub(super) fn loss(&self) -> Option<Loss> {
        (self.is_default_invented && self.n_default > 0).then(|| {
            let task = &self.default;
            let detail = format!("steps need a task: it is \"{task}\" where none is recorded");
            counted("task", LossEffect::Invented, self.n_default, &detail)
        })
    }
}
