//! Positions and goals of episodes.

use anyhow::{Context as _, Result, anyhow};
use arrow::array::{AsArray, RecordBatch};
use arrow::datatypes::{DataType, Int64Type};
use ksim_bench_harness::figure::paths::EpisodePath;
use ksim_datasets::{DatasetSource, EpisodeRecord, Scan, schema};

use crate::pairing::Listed;
use crate::positions::{self, Pair, each_once, pairs};

/// Reads the paths of some episodes; a dataset says where positions lie in a state that is a single vector.
///
/// # Errors
/// The columns are missing or no positions.
pub(super) fn read(
    source: &dyn DatasetSource,
    chosen: &[EpisodeRecord],
    paired: Option<(&dyn DatasetSource, Listed)>,
) -> Result<Vec<EpisodePath>> {
    let (position, goal) = positions::of(source, paired)
        .map_err(|what| anyhow!("{}: {what}", source.info().path.display()))?;
    let has_success = source
        .schema()
        .field_with_name(schema::INFO_SUCCESS)
        .is_ok();
    let wanted = [
        Some(schema::EPISODE_INDEX),
        Some(&*position.column),
        goal.as_ref().map(|goal| &*goal.column),
        has_success.then_some(schema::INFO_SUCCESS),
    ];
    let scan = Scan {
        columns: Some(each_once(wanted.into_iter().flatten())),
        episodes: Some(chosen.iter().map(|episode| episode.episode_index).collect()),
        ..Scan::default()
    };
    let mut open: Vec<Open> = chosen.iter().map(Open::new).collect();
    let mut place = 0;
    for batch in source.scan(&scan)? {
        let batch = batch?;
        let rows = Rows::of(&batch, &position, goal.as_ref(), has_success)?;
        let numbers = batch
            .column_by_name(schema::EPISODE_INDEX)
            .context("a batch without episode numbers")?
            .as_primitive::<Int64Type>();
        for row in 0..batch.num_rows() {
            while open
                .get(place)
                .is_some_and(|open| open.number != numbers.value(row))
            {
                place += 1;
            }
            let episode = open.get_mut(place).context("episodes out of their order")?;
            episode.add(&rows, row);
        }
    }
    Ok(open
        .into_iter()
        .zip(chosen)
        .map(|(open, record)| open.close(record))
        .collect())
}

/// The columns of a batch.
struct Rows {
    positions: Vec<[f64; 2]>,
    goals: Option<Vec<[f64; 2]>>,
    successes: Option<Vec<bool>>,
}

impl Rows {
    fn of(
        batch: &RecordBatch,
        position: &Pair,
        goal: Option<&Pair>,
        has_success: bool,
    ) -> Result<Self> {
        let flags = || -> Result<Vec<bool>> {
            let column = batch.column_by_name(schema::INFO_SUCCESS);
            let column = column.context("a column vanished")?;
            let flat = match column.as_fixed_size_list_opt() {
                Some(list) => list.values(),
                None => column,
            };
            let flags = arrow::compute::cast(flat, &DataType::Boolean)?;
            Ok(flags
                .as_boolean()
                .iter()
                .map(|flag| flag == Some(true))
                .collect())
        };
        Ok(Self {
            positions: pairs(batch, position)?,
            goals: goal.map(|goal| pairs(batch, goal)).transpose()?,
            successes: has_success.then(flags).transpose()?,
        })
    }
}

/// An episode that is being read.
struct Open {
    number: i64,
    path: EpisodePath,
    n_rows: usize,
    first_success: Option<usize>,
}

impl Open {
    fn new(record: &EpisodeRecord) -> Self {
        Self {
            number: record.episode_index,
            path: EpisodePath {
                title: format!("episode {}", record.episode_index),
                note: String::new(),
                positions_m: Vec::new(),
                goals_m: Vec::new(),
                scores: None,
            },
            n_rows: 0,
            first_success: None,
        }
    }

    fn add(&mut self, rows: &Rows, row: usize) {
        self.path.positions_m.extend(rows.positions.get(row));
        let goal = rows.goals.as_ref().and_then(|goals| goals.get(row));
        if let Some(goal) = goal
            && self.path.goals_m.last() != Some(goal)
        {
            self.path.goals_m.push(*goal);
        }
        let successes = rows.successes.as_ref().and_then(|flags| flags.get(row));
        if successes == Some(&true) && self.first_success.is_none() {
            self.first_success = Some(self.n_rows);
        }
        self.n_rows += 1;
    }

    fn close(mut self, record: &EpisodeRecord) -> EpisodePath {
        let total = record
            .total_return
            .map(|total| format!("return {}", crate::table::number(total)));
        // A row's flag says what the step before it led to, where the reset has a flag of its own.
        let success = match (record.success, self.first_success) {
            (Some(true), Some(step)) => Some(format!("success at step {step}")),
            (Some(false), _) => Some("no success".to_owned()),
            _ => None,
        };
        let notes: Vec<String> = [total, success].into_iter().flatten().collect();
        self.path.note = notes.join(", ");
        self.path
    }
}
