//! Small datasets with one fault each, for the tests of the checks.

use std::collections::HashMap;
use std::path::PathBuf;
use std::sync::Arc;

use arrow::array::{
    ArrayRef, BooleanArray, FixedSizeListArray, Float64Array, Int64Array, RecordBatch,
    RecordBatchIterator, RecordBatchReader,
};
use arrow::datatypes::{DataType, Field, Schema, SchemaRef};
use serde_json::json;

use super::facts::Column;
use super::{Finding, validate};
use crate::episode::EpisodeRecord;
use crate::error::Result;
use crate::format::Format;
use crate::schema;
use crate::source::{DatasetInfo, DatasetSource, Scan};

const WIDTH: usize = 2;

/// A table of steps, kept as rows so that any of them can be spoiled.
#[derive(Debug, Clone)]
pub(super) struct Table {
    rows: Vec<Row>,
    info: DatasetInfo,
    metadata: HashMap<String, String>,
    has_flags: bool,
    has_next: bool,
    has_times: bool,
    has_goals: bool,
}

#[derive(Debug, Clone)]
struct Row {
    episode: i64,
    step: i64,
    time: i64,
    observation: Vec<f64>,
    action: Option<Vec<f64>>,
    reward: Option<f64>,
    flags: Option<(bool, bool)>,
    next: Vec<f64>,
    goal: Vec<f64>,
}

impl Table {
    /// Three episodes of 20 steps without any fault.
    pub(super) fn good() -> Self {
        Self::of_lengths(&[20, 20, 20])
    }

    /// Episodes of these lengths without another fault.
    pub(super) fn of_lengths(lengths: &[usize]) -> Self {
        let mut rows = Vec::new();
        for (episode, &length) in lengths.iter().enumerate() {
            for step in 0..length {
                let t = step as f64;
                rows.push(Row {
                    episode: episode as i64,
                    step: step as i64,
                    time: 0,
                    observation: vec![0.1 * t + episode as f64, (0.3 * t).sin()],
                    action: Some(vec![(1.1 * t).sin() * 0.9, (0.7 * t).cos() * 0.9]),
                    reward: Some(0.5 + 0.01 * t),
                    flags: Some((step + 1 == length, false)),
                    next: Vec::new(),
                    goal: Vec::new(),
                });
            }
        }
        let info = DatasetInfo::new("made".into(), Format::Parquet, PathBuf::from("made"));
        Self {
            rows,
            info,
            metadata: HashMap::new(),
            has_flags: true,
            has_next: false,
            has_times: false,
            has_goals: false,
        }
    }

    /// A description of a column, as the checks see it.
    pub(super) fn column(name: &str) -> Column {
        let facts_of = Table::good();
        let facts = super::facts::Facts::new(&facts_of);
        let mut column = facts.columns[facts.find("action").unwrap()].clone();
        column.name = name.to_owned();
        column
    }

    pub(super) fn d4rl(mut self, id: &str) -> Self {
        self.info.id = id.to_owned();
        self.info.format = Format::D4rlHdf5;
        self
    }

    pub(super) fn with_step_limit(mut self, limit: u64) -> Self {
        self.info.env_spec = Some(json!({ "max_episode_steps": limit }));
        self
    }

    pub(super) fn with_action_space(mut self, json: &str) -> Self {
        self.metadata
            .insert(schema::SPACE_ACTION.into(), json.into());
        self
    }

    pub(super) fn with_fps(mut self, fps: f64) -> Self {
        self.metadata.insert(schema::FPS.into(), fps.to_string());
        self
    }

    pub(super) fn with_observation(mut self, row: usize, index: usize, value: f64) -> Self {
        self.rows[row].observation[index] = value;
        self
    }

    pub(super) fn with_action(mut self, row: usize, index: usize, value: f64) -> Self {
        if let Some(action) = &mut self.rows[row].action {
            action[index] = value;
        }
        self
    }

    pub(super) fn with_rewards(mut self, rewards: Vec<f64>) -> Self {
        for (row, reward) in self.rows.iter_mut().zip(rewards) {
            row.reward = Some(reward);
        }
        self
    }

    pub(super) fn without_rewards(mut self) -> Self {
        self.rows.iter_mut().for_each(|row| row.reward = None);
        self
    }

    pub(super) fn with_flags(mut self, row: usize, terminated: bool, truncated: bool) -> Self {
        self.rows[row].flags = Some((terminated, truncated));
        self
    }

    pub(super) fn without_flags(mut self) -> Self {
        self.has_flags = false;
        self
    }

    pub(super) fn without_action(mut self, row: usize) -> Self {
        self.rows[row].action = None;
        self
    }

    /// Makes a row a final observation, wherever it is.
    pub(super) fn without_step(mut self, row: usize) -> Self {
        let row = &mut self.rows[row];
        (row.action, row.reward, row.flags) = (None, None, None);
        self
    }

    /// Leaves only a final observation of an episode of one step.
    pub(super) fn with_empty_episode(self, episode: i64) -> Self {
        let row = self
            .rows
            .iter()
            .position(|row| row.episode == episode)
            .unwrap();
        self.without_step(row)
    }

    /// Adds a final observation to these episodes.
    pub(super) fn with_final(mut self, episodes: &[i64]) -> Self {
        for episode in episodes {
            let last = self
                .rows
                .iter()
                .rposition(|row| row.episode == *episode)
                .unwrap();
            let mut row = self.rows[last].clone();
            row.step += 1;
            self.rows.insert(last + 1, row);
            self = self.without_step(last + 1);
        }
        self
    }

    pub(super) fn numbered(mut self, numbers: [i64; 3]) -> Self {
        for row in &mut self.rows {
            row.episode = numbers[usize::try_from(row.episode).unwrap()];
        }
        self
    }

    pub(super) fn skip_step(mut self, row: usize) -> Self {
        self.rows.remove(row);
        self
    }

    /// Adds next observations, one of them wrong.
    pub(super) fn with_next(mut self, wrong: Option<usize>) -> Self {
        self.has_next = true;
        for row in 0..self.rows.len() {
            let next = self.rows.get(row + 1).unwrap_or(&self.rows[row]);
            self.rows[row].next = next.observation.clone();
            if wrong == Some(row) {
                self.rows[row].next[0] += 0.5;
            }
        }
        self
    }

    pub(super) fn with_goals(mut self, goal: impl Fn(usize) -> Vec<f64>) -> Self {
        self.has_goals = true;
        self.rows
            .iter_mut()
            .enumerate()
            .for_each(|(i, row)| row.goal = goal(i));
        self
    }

    pub(super) fn with_times(mut self, time: impl Fn(usize, i64) -> i64) -> Self {
        self.has_times = true;
        self.rows
            .iter_mut()
            .enumerate()
            .for_each(|(i, row)| row.time = time(i, row.step));
        self
    }

    /// Gives an episode the observations and actions of another one of the same length.
    pub(super) fn with_copy(mut self, from: i64, to: i64) -> Self {
        let source: Vec<Row> = self
            .rows
            .iter()
            .filter(|row| row.episode == from)
            .cloned()
            .collect();
        let target = self.rows.iter_mut().filter(|row| row.episode == to);
        for (row, source) in target.zip(source) {
            (row.observation, row.action) = (source.observation, source.action);
        }
        self
    }

    fn columns(&self) -> Vec<(Field, ArrayRef)> {
        let scalar = |name: &str, array: ArrayRef| {
            (Field::new(name, array.data_type().clone(), true), array)
        };
        let ints = |of: fn(&Row) -> i64| -> ArrayRef {
            Arc::new(Int64Array::from_iter_values(self.rows.iter().map(of)))
        };
        let flags = |of: fn((bool, bool)) -> bool| -> ArrayRef {
            Arc::new(
                self.rows
                    .iter()
                    .map(|row| row.flags.map(of))
                    .collect::<BooleanArray>(),
            )
        };
        let lists = |name: &str, of: fn(&Row) -> Option<&Vec<f64>>| {
            let rows: Vec<_> = self.rows.iter().map(of).collect();
            (
                schema::leaf_field(name, DataType::Float64, &[WIDTH], true),
                list(&rows),
            )
        };
        let mut columns = vec![
            scalar(schema::EPISODE_INDEX, ints(|row| row.episode)),
            scalar(schema::STEP_INDEX, ints(|row| row.step)),
            lists(schema::OBSERVATION, |row| Some(&row.observation)),
            lists(schema::ACTION, |row| row.action.as_ref()),
        ];
        let rewards: Float64Array = self.rows.iter().map(|row| row.reward).collect();
        columns.push(scalar(schema::REWARD, Arc::new(rewards)));
        if self.has_times {
            columns.push(scalar(schema::T_NS, ints(|row| row.time)));
        }
        if self.has_flags {
            columns.push(scalar(
                schema::TERMINATED,
                flags(|(terminated, _)| terminated),
            ));
            columns.push(scalar(schema::TRUNCATED, flags(|(_, truncated)| truncated)));
        }
        if self.has_next {
            columns.push(lists(schema::NEXT_OBSERVATION, |row| Some(&row.next)));
        }
        if self.has_goals {
            columns.push(lists("info.goal", |row| Some(&row.goal)));
        }
        columns
    }

    fn batch(&self) -> RecordBatch {
        let arrays = self.columns().into_iter().map(|(_, array)| array).collect();
        RecordBatch::try_new(self.schema(), arrays).unwrap()
    }
}

fn list(rows: &[Option<&Vec<f64>>]) -> ArrayRef {
    let values = rows.iter().flat_map(|row| match row {
        Some(row) => row.to_vec(),
        None => vec![0.0; WIDTH],
    });
    let nulls = rows.iter().map(Option::is_some).collect::<Vec<_>>();
    Arc::new(FixedSizeListArray::new(
        schema::element(DataType::Float64),
        i32::try_from(WIDTH).unwrap(),
        Arc::new(Float64Array::from_iter_values(values)),
        Some(nulls.into()),
    ))
}

impl DatasetSource for Table {
    fn info(&self) -> &DatasetInfo {
        &self.info
    }

    fn schema(&self) -> SchemaRef {
        let fields: Vec<Field> = self.columns().into_iter().map(|(field, _)| field).collect();
        Arc::new(Schema::new_with_metadata(fields, self.metadata.clone()))
    }

    fn scan(&self, _scan: &Scan) -> Result<Box<dyn RecordBatchReader + Send + '_>> {
        // Batches that end inside episodes.
        let batch = self.batch();
        let starts = (0..batch.num_rows()).step_by(7);
        let parts: Vec<_> = starts
            .map(|start| Ok(batch.slice(start, 7.min(batch.num_rows() - start))))
            .collect();
        Ok(Box::new(RecordBatchIterator::new(parts, self.schema())))
    }

    fn episodes(&self) -> Result<Vec<EpisodeRecord>> {
        (self as &dyn DatasetSource).derived_episodes()
    }
}

/// The codes that belong to a check.
fn codes_of(check: &str) -> &'static [&'static str] {
    match check {
        "lengths" => &[
            "null-inside-episode",
            "incomplete-step",
            "empty-episodes",
            "mixed-final-observations",
            "one-step-episodes",
            "longer-than-limit",
        ],
        "numbers" => &[
            "episode-number-twice",
            "step-gap",
            "late-start",
            "episode-number-gap",
            "episode-order",
        ],
        "values" => &["not-finite", "huge-values", "all-null", "constant-values"],
        "actions" => &["action-out-of-range", "actions-at-bound"],
        "flags" => &[
            "terminated-inside-episode",
            "truncated-inside-episode",
            "both-flags",
            "no-end-flag",
            "reward-without-terminal",
            "terminal-without-reward",
        ],
        "next-observations" => &["next-observation-differs"],
        "jumps" => &["position-jump", "outlier-step"],
        "goals" => &["goal-change", "reward-off-by-one"],
        "duplicates" => &["duplicate-episode", "frozen-observation"],
        "times" => &[
            "time-not-increasing",
            "negative-time",
            "time-gap",
            "uneven-time",
            "fps-mismatch",
        ],
        other => panic!("no check {other}"),
    }
}

/// What a check finds in a table.
pub(super) fn findings(table: &Table, check: &str) -> Vec<Finding> {
    let report = validate(table);
    assert!(report.coverage.complete, "{report:?}");
    let known = codes_of(check);
    let findings = report.findings.into_iter();
    findings
        .filter(|finding| known.contains(&finding.code))
        .collect()
}

/// The codes of what a check finds in a table.
pub(super) fn codes(table: &Table, check: &str) -> Vec<&'static str> {
    findings(table, check)
        .iter()
        .map(|finding| finding.code)
        .collect()
}

#[test]
fn a_good_table_has_no_findings_at_all() {
    assert_eq!(validate(&Table::good()).findings, []);
    assert_eq!(validate(&Table::good().with_final(&[0, 1, 2])).findings, []);
}
