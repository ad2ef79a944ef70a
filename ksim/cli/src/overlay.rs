//! Rollouts as they were recorded, with the score of every step and the step it was matched with as further columns.

use std::collections::HashMap;
use std::path::Path;
use std::sync::Arc;

use anyhow::{Context as _, Result};
use arrow::array::{
    Array as _, ArrayRef, AsArray as _, BooleanArray, FixedSizeListArray, Float64Array, Int64Array,
    RecordBatch,
};
use arrow::buffer::NullBuffer;
use arrow::datatypes::{DataType, Field, FieldRef, Int64Type, Schema, SchemaRef};
use ksim::StepScore;
use ksim_bench_harness::page::Scored;
use ksim_datasets::{
    DatasetSource, Format, Loss, McapEncoding, ObservationLayout, Scan, SinkInput, WriteOptions,
    schema,
};

use crate::load::PLANNER;
use crate::scoring::{ScoredRollouts, Session};

/// What is written of a step's score. Distances are those of `ksim score --per-step` by the root of the number of their
/// columns, so that they compare with γ and with each other.
const SCORES: [&str; 4] = [
    "score",
    "scaled_distance",
    "scaled_state_distance",
    "scaled_action_distance",
];

/// Writes an MCAP recording of the session's first file. Gives what the recording does not hold.
pub(crate) fn write(
    path: &Path,
    session: &Session,
    rollouts: &[ScoredRollouts],
    fps: Option<f64>,
) -> Result<Vec<Loss>> {
    let file = session.files().first().context("there are no rollouts")?;
    let source = &*file.source;
    let overlay = Overlay::new(session, rollouts, source);
    let episodes = source.episodes()?;
    let input = SinkInput {
        schema: &overlay.schema,
        info: source.info(),
        episodes: &episodes,
    };
    let options = WriteOptions {
        mcap_encoding: McapEncoding::Json,
        fps,
        ..WriteOptions::default()
    };
    let mut sink = ksim_datasets::create(path, Format::Mcap, &input, &options)?;
    let scan = Scan {
        columns: Some(overlay.recorded.clone()),
        ..Scan::default()
    };
    for batch in source.scan(&scan)? {
        sink.write(&overlay.with_scores(&batch?)?)?;
    }
    Ok(sink.finish()?.losses)
}

/// The further columns.
struct Overlay<'a> {
    session: &'a Session,
    rollouts: &'a [ScoredRollouts],
    /// Group and row of a step, by planner, episode and step number; looked up only.
    rows: HashMap<(Option<String>, i64, i64), (usize, usize)>,
    /// Columns of the file that are kept.
    recorded: Vec<String>,
    schema: SchemaRef,
    /// Parts of the state: the column of each, and places in the state.
    leaves: Vec<(FieldRef, Vec<usize>)>,
    action: FieldRef,
}

impl<'a> Overlay<'a> {
    fn new(
        session: &'a Session,
        rollouts: &'a [ScoredRollouts],
        source: &dyn DatasetSource,
    ) -> Self {
        let known = source.schema();
        let is_kept = |name: &str| {
            ![schema::INFO_K_SIM, schema::INFO_DEMONSTRATION]
                .iter()
                .any(|root| schema::belongs_to(name, root))
        };
        let kept: Vec<FieldRef> = known
            .fields()
            .iter()
            .filter(|field| is_kept(field.name()))
            .cloned()
            .collect();
        let added = |name: &str| format!("{}.{name}", schema::INFO_DEMONSTRATION);
        let vector = |name: &str, width: usize| -> FieldRef {
            let width = [width];
            Arc::new(schema::leaf_field(
                &added(name),
                DataType::Float64,
                &width,
                true,
            ))
        };
        let layout = ObservationLayout::new(&session.dataset().info().observation);
        // The column, not the short name: a part of the state may be called `action` or `step_index`.
        let column = |name: &str| {
            let leaf = layout.leaves().iter().find(|leaf| leaf.name == name);
            leaf.map_or_else(|| name.to_owned(), |leaf| leaf.column.clone())
        };
        let leaves: Vec<(FieldRef, Vec<usize>)> = leaves(session.state_names())
            .into_iter()
            .map(|(name, places)| (vector(&column(&name), places.len()), places))
            .collect();
        let action_dim = session.ksim().reference().actions().n_features();
        let action = vector(schema::ACTION, action_dim);
        let scalar =
            |name: String, data_type| -> FieldRef { Arc::new(Field::new(name, data_type, true)) };
        let score = |name: &str| format!("{}.{name}", schema::INFO_K_SIM);
        let mut fields = kept.clone();
        fields.extend(SCORES.map(|name| scalar(score(name), DataType::Float64)));
        fields.push(scalar(score("saturated"), DataType::Boolean));
        let numbers = [schema::EPISODE_INDEX, schema::STEP_INDEX];
        fields.extend(numbers.map(|name| scalar(added(name), DataType::Int64)));
        fields.extend(leaves.iter().map(|(field, _)| Arc::clone(field)));
        fields.push(Arc::clone(&action));
        Self {
            session,
            rollouts,
            rows: rows(rollouts),
            recorded: kept.iter().map(|field| field.name().clone()).collect(),
            schema: Arc::new(Schema::new_with_metadata(fields, known.metadata().clone())),
            leaves,
            action,
        }
    }

    /// A batch of the file with the further columns; null below the last step.
    fn with_scores(&self, batch: &RecordBatch) -> Result<RecordBatch> {
        let column = |name: &str| {
            let column = batch.column_by_name(name);
            column.with_context(|| format!("column \"{name}\" vanished"))
        };
        let episodes = column(schema::EPISODE_INDEX)?.as_primitive::<Int64Type>();
        let steps = column(schema::STEP_INDEX)?.as_primitive::<Int64Type>();
        let planners = match self.rollouts.iter().any(|one| one.steps.planner.is_some()) {
            true => Some(arrow::compute::cast(column(PLANNER)?, &DataType::Utf8)?),
            false => None,
        };
        let planner = |row: usize| {
            let names = planners.as_ref()?.as_string::<i32>();
            names.is_valid(row).then(|| names.value(row).to_owned())
        };
        let found: Vec<Option<(usize, usize)>> = (0..batch.num_rows())
            .map(|row| {
                let key = (planner(row), episodes.value(row), steps.value(row));
                self.rows.get(&key).copied()
            })
            .collect();
        let mut columns = self
            .recorded
            .iter()
            .map(|name| Ok(Arc::clone(column(name)?)))
            .collect::<Result<Vec<ArrayRef>>>()?;
        columns.extend(self.scores(&found));
        columns.extend(self.matches(&found)?);
        RecordBatch::try_new(Arc::clone(&self.schema), columns).context("cannot add the scores")
    }

    fn step(&self, (group, row): (usize, usize)) -> &StepScore {
        &self.rollouts[group].report.steps[row]
    }

    fn scores(&self, found: &[Option<(usize, usize)>]) -> Vec<ArrayRef> {
        let number = |of: &dyn Fn((usize, usize)) -> f64| -> ArrayRef {
            Arc::new(found.iter().map(|at| at.map(of)).collect::<Float64Array>())
        };
        let scaled = |part: usize| {
            number(&|at| {
                let one = &self.rollouts[at.0];
                Scored::scaled_by(&one.steps.trajectories, self.step(at))[part]
            })
        };
        let saturated = found.iter().map(|at| Some(self.step((*at)?).score == 1.0));
        vec![
            number(&|at| self.step(at).score),
            scaled(0),
            scaled(1),
            scaled(2),
            Arc::new(saturated.collect::<BooleanArray>()),
        ]
    }

    fn matches(&self, found: &[Option<(usize, usize)>]) -> Result<Vec<ArrayRef>> {
        let reference = self.session.ksim().reference();
        let (of_states, of_actions) = reference.normalizers();
        let matched: Vec<Option<u32>> = found
            .iter()
            .map(|at| Some(self.step((*at)?).reference_row))
            .collect();
        let place = |row: u32| {
            let (episode, position) = self.session.ksim().reference_step(row);
            let numbers = self.session.reference_numbers();
            [episode, numbers.number(row as usize, position)]
        };
        let number = |part: usize| -> ArrayRef {
            let numbers = matched.iter().map(|row| row.map(|row| place(row)[part]));
            Arc::new(numbers.collect::<Int64Array>())
        };
        let mut columns = vec![number(0), number(1)];
        let raw =
            |matrix: &ksim::Matrix, normalizer: &ksim::Normalizer, row: usize, column: usize| {
                normalizer.denormalize(column, matrix.value(row, column))
            };
        for (field, places) in &self.leaves {
            let value =
                |row: usize, place: usize| raw(reference.states(), of_states, row, places[place]);
            columns.push(vectors(field, &matched, &value)?);
        }
        let value = |row: usize, column: usize| raw(reference.actions(), of_actions, row, column);
        columns.push(vectors(&self.action, &matched, &value)?);
        Ok(columns)
    }
}

/// A column of vectors; null where no row is.
fn vectors(
    field: &Field,
    rows: &[Option<u32>],
    value: &dyn Fn(usize, usize) -> f64,
) -> Result<ArrayRef> {
    let DataType::FixedSizeList(item, width) = field.data_type() else {
        anyhow::bail!("column \"{}\" is no vector", field.name());
    };
    let width_of = usize::try_from(*width)?;
    let values: Float64Array = rows
        .iter()
        .flat_map(|row| {
            (0..width_of).map(move |place| row.map_or(0.0, |row| value(row as usize, place)))
        })
        .collect::<Vec<f64>>()
        .into();
    let valid: NullBuffer = rows.iter().map(Option::is_some).collect();
    let list = FixedSizeListArray::try_new(Arc::clone(item), *width, Arc::new(values), Some(valid));
    Ok(Arc::new(list.context("cannot lay out the demonstrations")?))
}

/// Where every step is.
fn rows(rollouts: &[ScoredRollouts]) -> HashMap<(Option<String>, i64, i64), (usize, usize)> {
    let mut rows = HashMap::new();
    for (group, one) in rollouts.iter().enumerate() {
        for episode in one.steps.trajectories.episodes() {
            for row in episode.rows.clone() {
                let number = one.steps.number(row, row - episode.rows.start);
                let key = (one.steps.planner.clone(), episode.episode_index, number);
                rows.insert(key, (group, row));
            }
        }
    }
    rows
}

/// The parts of the state by name, with the places of their columns, in the order of the first.
fn leaves(names: &[String]) -> Vec<(String, Vec<usize>)> {
    let mut leaves: Vec<(String, Vec<usize>)> = Vec::new();
    for (place, name) in names.iter().enumerate() {
        let leaf = name
            .rsplit_once('[')
            .map_or(name.as_str(), |(leaf, _)| leaf);
        match leaves.iter_mut().find(|(known, _)| known == leaf) {
            Some((_, places)) => places.push(place),
            None => leaves.push((leaf.to_owned(), vec![place])),
        }
    }
    leaves
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn columns_go_back_to_their_leaves() {
        let names = ["a[0]", "b[1]", "a[1]", "c[d][0]"].map(str::to_owned);
        let expected = [("a", vec![0, 2]), ("b", vec![1]), ("c[d]", vec![3])];
        assert_eq!(
            leaves(&names),
            expected.map(|(name, places)| (name.to_owned(), places))
        );
    }
}
