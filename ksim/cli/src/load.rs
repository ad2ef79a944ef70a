//! From files to the engine's matrices, in batches.

use std::borrow::Cow;
use std::collections::HashMap;
use std::fmt;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, anyhow, bail};
use arrow::datatypes::DataType;
use ksim::{DataError, EpisodeRows, Trajectories};
use ksim_datasets::{
    DatasetSource, ObservationLayout, TransitionOptions, TransitionReader, Transitions,
};
use ksim_index::{IndexError, StagedSteps};

use crate::context::Context;

/// Column that tells whose rollouts a row belongs to.
pub(crate) const PLANNER: &str = "info.planner";

/// A file of rollouts without steps, or without any yet.
#[derive(Debug)]
pub(crate) struct NoSteps(PathBuf);

impl fmt::Display for NoSteps {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: no steps", self.0.display())
    }
}

/// The steps of one planner, or of a whole file.
#[derive(Debug)]
pub(crate) struct Steps {
    /// The planner, where the file names planners.
    pub(crate) planner: Option<String>,
    /// States and actions.
    pub(crate) trajectories: Trajectories,
    /// Recorded step numbers, kept only if they are not 0, 1, 2, ... in every episode.
    numbers: Option<Vec<i64>>,
}

impl Steps {
    fn new(planner: Option<String>, state_dim: usize, action_dim: usize) -> Result<Self> {
        let trajectories = Trajectories::new(state_dim, action_dim)?;
        Ok(Self {
            planner,
            trajectories,
            numbers: None,
        })
    }

    /// Number the dataset gives to the step that is `position` steps after its episode's first.
    pub(crate) fn number(&self, row: usize, position: usize) -> i64 {
        match &self.numbers {
            Some(numbers) => numbers[row],
            None => position as i64,
        }
    }

    /// The recorded numbers, without the matrices.
    pub(crate) fn into_parts(self) -> (Trajectories, StepNumbers) {
        (self.trajectories, StepNumbers(self.numbers))
    }

    fn push_run(&mut self, run: &Run<'_>, columns: &Columns) -> Result<()> {
        push_run(&mut self.trajectories, &mut self.numbers, run, columns)
    }
}

/// Where steps are kept.
trait StepStore {
    /// The episodes so far.
    fn episodes(&self) -> &[EpisodeRows];
    /// Appends consecutive steps of one episode.
    fn push(&mut self, episode: i64, states: &[f64], actions: &[f64]) -> Result<(), IndexError>;
}

impl StepStore for Trajectories {
    fn episodes(&self) -> &[EpisodeRows] {
        self.episodes()
    }

    fn push(&mut self, episode: i64, states: &[f64], actions: &[f64]) -> Result<(), IndexError> {
        Ok(self.push(episode, states, actions)?)
    }
}

impl StepStore for StagedSteps {
    fn episodes(&self) -> &[EpisodeRows] {
        self.episodes()
    }

    fn push(&mut self, episode: i64, states: &[f64], actions: &[f64]) -> Result<(), IndexError> {
        self.push(episode, states, actions)
    }
}

/// Appends a run, and its numbers from the first on that does not count on.
fn push_run(
    store: &mut impl StepStore,
    numbers: &mut Option<Vec<i64>>,
    run: &Run<'_>,
    columns: &Columns,
) -> Result<()> {
    let known = match store.episodes().last() {
        Some(last) if last.episode_index == run.episode => last.rows.len(),
        _ => 0,
    };
    let counted = (known as i64..).take(run.numbers.len());
    if numbers.is_none() && !run.numbers.iter().copied().eq(counted) {
        let episodes = store.episodes().iter();
        *numbers = Some(
            episodes
                .flat_map(|episode| 0..episode.rows.len() as i64)
                .collect(),
        );
    }
    let pushed = store.push(run.episode, run.states, run.actions);
    pushed.map_err(|error| match error {
        IndexError::Data(error) => columns.placed(error, run, known),
        other => other.into(),
    })?;
    if let Some(numbers) = numbers {
        numbers.extend(run.numbers);
    }
    Ok(())
}

/// Recorded step numbers of a dataset, by row.
#[derive(Debug)]
pub(crate) struct StepNumbers(Option<Vec<i64>>);

impl StepNumbers {
    /// Numbers as an index has them.
    pub(crate) fn new(numbers: Option<Vec<i64>>) -> Self {
        Self(numbers)
    }

    /// The numbers, where they do not count from 0 in every episode.
    pub(crate) fn values(&self) -> Option<&[i64]> {
        self.0.as_deref()
    }

    /// As [`Steps::number`].
    pub(crate) fn number(&self, row: usize, position: usize) -> i64 {
        self.0
            .as_ref()
            .map_or(position as i64, |numbers| numbers[row])
    }
}

/// The chosen state columns and their names.
#[derive(Debug, Clone)]
pub(crate) struct Columns {
    /// Places in the observation, in the order wanted.
    pub(crate) indices: Vec<usize>,
    /// A name for each.
    pub(crate) names: Vec<String>,
    /// Places in the action, where they are not taken as they stand.
    pub(crate) actions: Option<Vec<usize>>,
}

impl Columns {
    /// Resolves a selection on the layout of the dataset; `None` takes all columns.
    pub(crate) fn select(source: &dyn DatasetSource, selection: Option<&str>) -> Result<Self> {
        let layout = ObservationLayout::new(&source.info().observation);
        let indices = match selection {
            Some(selection) => layout.select(selection)?,
            None => (0..layout.width()).collect(),
        };
        let names = indices
            .iter()
            .map(|&index| layout.column_name(index))
            .collect();
        Ok(Self {
            indices,
            names,
            actions: None,
        })
    }

    /// An engine's error with the place as the file has it.
    fn placed(&self, error: DataError, run: &Run<'_>, known: usize) -> anyhow::Error {
        let DataError::NonFiniteStep {
            episode_index,
            step_index,
            part,
            column,
            value,
        } = error
        else {
            return error.into();
        };
        let step = run.numbers.get(step_index.wrapping_sub(known)).copied();
        let step = step.unwrap_or(step_index as i64);
        let column = match (part, self.indices.get(column)) {
            ("state", Some(index)) => {
                format!("observation column {index} ({})", self.names[column])
            }
            _ => {
                let actions = self.actions.as_ref();
                let index = actions.and_then(|actions| actions.get(column));
                format!("{part} column {}", index.unwrap_or(&column))
            }
        };
        anyhow!(
            "episode {episode_index}, step {step}: {column} holds {value:?}, \
             expected a finite number within ±3.4e38"
        )
    }
}

/// Consecutive rows of one episode and planner.
struct Run<'a> {
    episode: i64,
    numbers: &'a [i64],
    states: &'a [f64],
    actions: &'a [f64],
}

/// Reads a whole dataset as one group.
pub(crate) fn dataset(
    source: &dyn DatasetSource,
    columns: &Columns,
    context: &Context,
) -> Result<Steps> {
    let mut groups = load(source, columns, None, context)?;
    match groups.pop() {
        Some(steps) if groups.is_empty() => Ok(steps),
        _ => bail!("{}: no steps", source.info().path.display()),
    }
}

/// Reads a whole dataset into temporary files in `folder`: for one that may not fit into memory.
pub(crate) fn staged(
    source: &dyn DatasetSource,
    columns: &Columns,
    folder: &Path,
    context: &Context,
) -> Result<(StagedSteps, StepNumbers)> {
    let mut staged = None;
    let mut numbers = None;
    each_batch(source, columns, None, context, &mut |batch| {
        each_run(
            batch,
            columns,
            &mut |_, run, [state_width, action_width]| {
                let steps = match &mut staged {
                    Some(steps) => steps,
                    none => none.insert(StagedSteps::new(folder, state_width, action_width)?),
                };
                push_run(steps, &mut numbers, run, columns)
            },
        )
    })?;
    match staged {
        Some(steps) => Ok((steps, StepNumbers(numbers))),
        None => bail!("{}: no steps", source.info().path.display()),
    }
}

/// Reads rollouts, one group per planner if the file names planners, in order of appearance.
pub(crate) fn rollouts(
    source: &dyn DatasetSource,
    columns: &Columns,
    context: &Context,
) -> Result<Vec<Steps>> {
    let groups = load(
        source,
        columns,
        names_planners(source).then_some(PLANNER),
        context,
    )?;
    if groups.is_empty() {
        return Err(anyhow::Error::msg(NoSteps(source.info().path.clone())));
    }
    Ok(groups)
}

/// Whether the rows say which planner they come from.
pub(crate) fn names_planners(source: &dyn DatasetSource) -> bool {
    let schema = source.schema();
    schema
        .field_with_name(PLANNER)
        .is_ok_and(|field| is_text(field.data_type()))
}

/// What to say of a planner column that names none.
pub(crate) fn ignored_planners(source: &dyn DatasetSource) -> Option<String> {
    let schema = source.schema();
    let field = schema.field_with_name(PLANNER).ok()?;
    (!is_text(field.data_type())).then(|| {
        format!(
            "column \"planner\" is ignored: it holds {}, expected text",
            field.data_type()
        )
    })
}

/// The types of text a [`TransitionReader`] reads.
fn is_text(data_type: &DataType) -> bool {
    match data_type {
        DataType::Utf8 | DataType::LargeUtf8 | DataType::Utf8View => true,
        DataType::Dictionary(_, value) => is_text(value),
        _ => false,
    }
}

fn load(
    source: &dyn DatasetSource,
    columns: &Columns,
    text_column: Option<&str>,
    context: &Context,
) -> Result<Vec<Steps>> {
    let mut groups = Groups {
        columns,
        groups: Vec::new(),
        by_planner: HashMap::new(),
    };
    each_batch(source, columns, text_column, context, &mut |batch| {
        groups.push(batch)
    })?;
    Ok(groups.groups)
}

/// Reads a source batch by batch.
fn each_batch(
    source: &dyn DatasetSource,
    columns: &Columns,
    text_column: Option<&str>,
    context: &Context,
    visit: &mut dyn FnMut(&Transitions) -> Result<()>,
) -> Result<()> {
    let info = source.info();
    let what = format!("reading {}", info.id);
    let progress = match info.n_steps {
        Some(n_steps) => context.bar(what, n_steps, "steps"),
        None => context.spinner(what),
    };
    let options = TransitionOptions {
        state_columns: Some(columns.indices.clone()),
        text_column: text_column.map(str::to_owned),
        ..TransitionOptions::default()
    };
    let mut done = 0;
    for batch in TransitionReader::new(source, &options)? {
        let batch = batch.map_err(|error| error.in_file(&info.path))?;
        visit(&batch).with_context(|| info.path.display().to_string())?;
        done += batch.n_rows() as u64;
        progress.set(done);
    }
    Ok(())
}

/// Takes a run with its planner and the widths of states and actions.
type VisitRun<'a> = dyn FnMut(Option<&str>, &Run<'_>, [usize; 2]) -> Result<()> + 'a;

/// Visits the runs of a batch.
fn each_run(batch: &Transitions, columns: &Columns, visit: &mut VisitRun<'_>) -> Result<()> {
    let planner = |row: usize| batch.text.as_ref().and_then(|text| text[row].as_deref());
    let key = |row: usize| (batch.episode_index[row], planner(row));
    let (actions, action_width) = match &columns.actions {
        Some(places) => (Cow::Owned(picked(batch, places)), places.len()),
        None => (Cow::Borrowed(&*batch.actions), batch.action_width),
    };
    let mut start = 0;
    while start < batch.n_rows() {
        let same = (start..batch.n_rows())
            .take_while(|&row| key(row) == key(start))
            .count();
        let rows = start..start + same;
        let run = Run {
            episode: batch.episode_index[start],
            numbers: &batch.step_index[rows.clone()],
            states: &batch.states[rows.start * batch.state_width..rows.end * batch.state_width],
            actions: &actions[rows.start * action_width..rows.end * action_width],
        };
        visit(planner(start), &run, [batch.state_width, action_width])?;
        start = rows.end;
    }
    Ok(())
}

/// Rows sorted by planner.
struct Groups<'a> {
    columns: &'a Columns,
    groups: Vec<Steps>,
    by_planner: HashMap<Option<String>, usize>,
}

impl Groups<'_> {
    fn push(&mut self, batch: &Transitions) -> Result<()> {
        let columns = self.columns;
        each_run(batch, columns, &mut |planner, run, widths| {
            let group = self.group(planner, widths)?;
            self.groups[group].push_run(run, columns)
        })
    }

    fn group(
        &mut self,
        planner: Option<&str>,
        [state_width, action_width]: [usize; 2],
    ) -> Result<usize> {
        let planner = planner.map(str::to_owned);
        if let Some(&group) = self.by_planner.get(&planner) {
            return Ok(group);
        }
        self.groups
            .push(Steps::new(planner.clone(), state_width, action_width)?);
        self.by_planner.insert(planner, self.groups.len() - 1);
        Ok(self.groups.len() - 1)
    }
}

/// The action columns at `places` of every row.
fn picked(batch: &Transitions, places: &[usize]) -> Vec<f64> {
    let rows = batch.actions.chunks_exact(batch.action_width.max(1));
    rows.flat_map(|row| places.iter().map(|&place| row[place]))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn batch(episodes: &[i64], steps: &[i64], planners: Option<&[&str]>) -> Transitions {
        Transitions {
            episode_index: episodes.to_vec(),
            step_index: steps.to_vec(),
            state_width: 1,
            states: steps.iter().map(|&step| step as f64).collect(),
            action_width: 1,
            actions: vec![0.0; steps.len()],
            text: planners.map(|names| names.iter().map(|name| Some((*name).to_owned())).collect()),
            ..Transitions::default()
        }
    }

    fn groups(batches: &[Transitions]) -> Result<Vec<Steps>> {
        let columns = Columns {
            indices: vec![3],
            names: vec!["x[1]".to_owned()],
            actions: None,
        };
        let mut groups = Groups {
            columns: &columns,
            groups: Vec::new(),
            by_planner: HashMap::new(),
        };
        batches.iter().try_for_each(|batch| groups.push(batch))?;
        Ok(groups.groups)
    }

    #[test]
    fn planners_are_told_apart_in_order_of_appearance() {
        let batches = [
            batch(&[0, 0, 1], &[0, 1, 0], Some(&["b", "b", "a"])),
            batch(&[2], &[0], Some(&["b"])),
        ];
        let groups = groups(&batches).unwrap();
        let seen: Vec<_> = groups
            .iter()
            .map(|g| (g.planner.as_deref().unwrap(), g.trajectories.n_rows()))
            .collect();
        assert_eq!(seen, [("b", 3), ("a", 1)]);
    }

    #[test]
    fn step_numbers_are_kept_only_where_they_do_not_count_from_zero() {
        let plain =
            &groups(&[batch(&[0, 0], &[0, 1], None), batch(&[0, 1], &[2, 0], None)]).unwrap()[0];
        assert!(plain.numbers.is_none());
        let gaps =
            &groups(&[batch(&[0, 0], &[0, 1], None), batch(&[0, 1], &[5, 7], None)]).unwrap()[0];
        assert_eq!(gaps.numbers.as_deref(), Some(&[0, 1, 5, 7][..]));
        assert_eq!(gaps.number(2, 2), 5);
    }

    #[test]
    fn a_bad_value_is_placed_as_the_file_has_it() {
        let mut bad = batch(&[4, 4], &[7, 9], None);
        bad.states[1] = f64::NAN;
        let error = groups(&[bad]).unwrap_err().to_string();
        assert!(
            error.starts_with("episode 4, step 9: observation column 3 (x[1]) holds NaN"),
            "{error}"
        );
    }
}
