//! An episode as rows of a table.

use std::sync::Arc;

use arrow::array::{
    ArrayRef, BooleanArray, FixedSizeListArray, Float32Array, Float64Array, Int64Array,
};
use arrow::buffer::NullBuffer;
use arrow::datatypes::{DataType, Field};
use arrow::error::ArrowError;
use ksim_datasets::{EpisodeEnd, EpisodeRecord as DatasetEpisode, schema};
use ksim_envs::{EnvironmentSpec, Part};
use serde_json::{Map, Value, json};

use super::table::column_name;
use crate::policy::Annotation;
use crate::record::EpisodeTrace;

/// An episode as rows: one for every step, and one for the observation after the last.
pub(super) struct Rows<'a> {
    trace: &'a EpisodeTrace,
    annotations: &'static [Annotation],
    n_steps: usize,
}

impl<'a> Rows<'a> {
    pub(super) fn new(trace: &'a EpisodeTrace, annotations: &'static [Annotation]) -> Self {
        Self {
            trace,
            annotations,
            n_steps: trace.rewards.len(),
        }
    }

    /// The values of a column.
    ///
    /// # Errors
    /// The trace does not have the environment's widths.
    pub(super) fn column(
        &self,
        field: &Field,
        environment: &EnvironmentSpec,
    ) -> Result<ArrayRef, ArrowError> {
        let Self { trace, n_steps, .. } = *self;
        let record = &trace.record;
        let at_end = |value: bool| -> ArrayRef {
            let flags = (0..n_steps).map(|step| Some(value && step + 1 == n_steps));
            Arc::new(BooleanArray::from_iter(flags.chain([None])))
        };
        let index = |number: usize| i64::try_from(number).unwrap_or(i64::MAX);
        Ok(match field.name().as_str() {
            schema::EPISODE_INDEX => {
                Arc::new(Int64Array::from(vec![index(record.episode); n_steps + 1]))
            }
            schema::STEP_INDEX => Arc::new((0..=index(n_steps)).collect::<Int64Array>()),
            schema::ACTION => return self.actions(field),
            schema::REWARD => {
                let rewards = trace.rewards.iter().copied().map(Some);
                Arc::new(rewards.chain([None]).collect::<Float64Array>())
            }
            schema::TERMINATED => at_end(record.terminated),
            schema::TRUNCATED => at_end(record.truncated),
            schema::INFO_SUCCESS => Arc::new(BooleanArray::from(trace.successes.clone())),
            name if self.annotation(name).is_some() => {
                let place = self.annotation(name).unwrap_or(0);
                let rows = trace.annotations.chunks_exact(self.annotations.len());
                let told = rows.map(|row| Some(row[place]).filter(|value| !value.is_nan()));
                Arc::new(told.chain([None]).collect::<Float64Array>())
            }
            name if schema::belongs_to(name, schema::INFO) => {
                return part_of(field, &trace.infos, &environment.info, schema::INFO);
            }
            _ => {
                return part_of(
                    field,
                    &trace.observations,
                    &environment.observation,
                    schema::OBSERVATION,
                );
            }
        })
    }

    /// Place of the annotation whose column this is.
    fn annotation(&self, column: &str) -> Option<usize> {
        let is_it =
            |annotation: &Annotation| schema::join_key(schema::INFO, annotation.name) == column;
        self.annotations.iter().position(is_it)
    }

    /// The actions, and a null below them.
    fn actions(&self, field: &Field) -> Result<ArrayRef, ArrowError> {
        let actions = &self.trace.actions;
        let width = actions.len() / self.n_steps.max(1);
        let padded = actions
            .iter()
            .copied()
            .chain(std::iter::repeat_n(0.0, width));
        let is_single = schema::row_shape(field).is_some_and(|(to, _)| to == DataType::Float32);
        let values: ArrayRef = match is_single {
            true => Arc::new(padded.map(|value| value as f32).collect::<Float32Array>()),
            false => Arc::new(padded.collect::<Float64Array>()),
        };
        let is_step = (0..=self.n_steps).map(|step| step < self.n_steps);
        list(field, values, Some(is_step.collect()))
    }

    /// What a dataset records of the episode.
    pub(super) fn describe(&self, first_row: u64, n_rows: u64) -> DatasetEpisode {
        let record = &self.trace.record;
        DatasetEpisode {
            episode_index: i64::try_from(record.episode).unwrap_or(i64::MAX),
            length: self.n_steps as u64,
            first_row,
            n_rows,
            end: match (record.terminated, record.truncated) {
                (true, _) => EpisodeEnd::Terminated,
                (_, true) => EpisodeEnd::Truncated,
                _ => EpisodeEnd::Cut,
            },
            has_final_obs: true,
            seed: Some(record.seed),
            success: record.success,
            total_return: Some(record.total_return),
            attributes: self.attributes(),
        }
    }

    /// What is recorded of the episode besides its rows: the rewards' statistics as Minari has them by default, and
    /// the numbers of the rollout.
    fn attributes(&self) -> Map<String, Value> {
        let (record, rewards) = (&self.trace.record, &self.trace.rewards);
        let n_steps = self.n_steps.max(1) as f64;
        let mean = record.total_return / n_steps;
        let variance = rewards.iter().map(|r| (r - mean).powi(2)).sum::<f64>() / n_steps;
        let numbers = [
            ("rewards_sum", Some(json!(record.total_return))),
            ("rewards_mean", Some(json!(mean))),
            ("rewards_std", Some(json!(variance.sqrt()))),
            (
                "rewards_max",
                rewards.iter().copied().reduce(f64::max).map(Value::from),
            ),
            (
                "rewards_min",
                rewards.iter().copied().reduce(f64::min).map(Value::from),
            ),
            ("run", Some(record.run.into())),
            ("discounted_return", Some(json!(record.discounted_return))),
            ("success", record.success.map(Value::from)),
            ("success_at_end", record.success_at_end.map(Value::from)),
            (
                "first_success_step",
                record.first_success_step.map(Value::from),
            ),
            ("normalized_score", record.normalized_score.map(Value::from)),
        ];
        let known = numbers
            .into_iter()
            .filter_map(|(key, value)| Some((key.to_owned(), value?)));
        known.collect()
    }
}

/// The part of flat rows whose column the field is.
fn part_of(
    field: &Field,
    rows: &[f64],
    parts: &[Part],
    root: &str,
) -> Result<ArrayRef, ArrowError> {
    let width: usize = parts.iter().map(|part| part.width).sum();
    let is_other = |part: &&Part| column_name(root, part) != *field.name();
    let before = parts.iter().take_while(is_other).map(|part| part.width);
    let start: usize = before.sum();
    let own = parts
        .iter()
        .find(|part| !is_other(part))
        .map_or(0, |part| part.width);
    let values = rows
        .chunks_exact(width.max(1))
        .flat_map(|row| row.iter().skip(start).take(own).copied());
    list(field, Arc::new(values.collect::<Float64Array>()), None)
}

/// Values as rows of the field's width.
fn list(
    field: &Field,
    values: ArrayRef,
    is_valid: Option<NullBuffer>,
) -> Result<ArrayRef, ArrowError> {
    let DataType::FixedSizeList(child, width) = field.data_type() else {
        return Ok(values);
    };
    let list = FixedSizeListArray::try_new(Arc::clone(child), *width, values, is_valid)?;
    Ok(Arc::new(list))
}
