//! Where an agent was and where it was to go, as files record it.

use std::collections::BTreeMap;

use anyhow::{Context as _, Result, bail};
use arrow::array::{Array as _, AsArray as _, RecordBatch};
use arrow::datatypes::{DataType, Float64Type};
use ksim_datasets::{DatasetSource, ObservationLayout, Scan, schema};

use crate::load::{self, Columns, PLANNER};
use crate::pairing::{self, Listed};

/// Where positions are looked for: the first that is there. Of a simulator's state, the first two are x and y.
const POSITIONS: [&str; 2] = ["observation.achieved_goal", "info.qpos"];
/// Where goals are.
const GOALS: [&str; 2] = ["observation.desired_goal", "info.goal"];

/// Positions of the steps of a planner, or of a whole file, in their order.
#[derive(Debug, Default)]
pub(crate) struct Track {
    /// x and y; NaN where they are null.
    pub(crate) positions: Vec<[f64; 2]>,
    /// The same of goals; empty if there is no such column.
    pub(crate) goals: Vec<[f64; 2]>,
}

/// Two numbers in every row of a column of lists.
#[derive(Debug, Clone)]
pub(crate) struct Pair {
    pub(crate) column: String,
    places: [usize; 2],
}

/// The first of some columns that holds two numbers or more in every row.
fn find(source: &dyn DatasetSource, names: &[&str]) -> Option<Pair> {
    let pair = |name: &&str| Pair::new(source, (*name).to_owned(), [0, 1]);
    names.iter().find_map(pair)
}

/// Whether positions have a column of their own.
pub(crate) fn has_own(source: &dyn DatasetSource) -> bool {
    find(source, &POSITIONS).is_some()
}

/// Positions of a file and, where they are recorded, goals: in columns of their own, or where those of a dataset are.
///
/// # Errors
/// What was expected, and what is there.
pub(crate) fn of(
    source: &dyn DatasetSource,
    paired: Option<(&dyn DatasetSource, Listed)>,
) -> Result<(Pair, Option<Pair>), String> {
    let of = |names: &[&str], part: &str| {
        let own = find(source, names);
        own.or_else(|| find_paired(source, paired?, part))
    };
    let Some(position) = of(&POSITIONS, "achieved_goal") else {
        let schema = source.schema();
        let names = schema.fields().iter().map(|field| field.name().as_str());
        let found: Vec<&str> = names.collect();
        return Err(format!(
            "no positions: expected column {}, found {}",
            POSITIONS.join(" or "),
            found.join(", ")
        ));
    };
    Ok((position, of(&GOALS, "desired_goal")))
}

/// What goes with a part of the dataset's state, such as two places of a state that is a single vector.
fn find_paired(
    source: &dyn DatasetSource,
    (dataset, listed): (&dyn DatasetSource, Listed),
    part: &str,
) -> Option<Pair> {
    let columns = Columns::select(dataset, Some(part)).ok()?;
    let own = pairing::columns_of(source, dataset, &columns, listed).ok()?;
    let layout = ObservationLayout::new(&source.info().observation);
    let place = |index: usize| {
        let mut leaves = layout.leaves().iter();
        let leaf = leaves.find(|leaf| (leaf.offset..leaf.offset + leaf.width).contains(&index))?;
        Some((leaf.column.clone(), index - leaf.offset))
    };
    let [x, y] = *own.indices else { return None };
    let ((column, x), (other, y)) = (place(x)?, place(y)?);
    (column == other).then(|| Pair::new(source, column, [x, y]))?
}

impl Pair {
    fn new(source: &dyn DatasetSource, column: String, places: [usize; 2]) -> Option<Self> {
        let schema = source.schema();
        let is_fit = match schema.field_with_name(&column).ok()?.data_type() {
            DataType::FixedSizeList(item, width) => {
                let width = usize::try_from(*width).unwrap_or(0);
                item.data_type().is_numeric() && places.iter().all(|place| *place < width)
            }
            _ => false,
        };
        is_fit.then_some(Self { column, places })
    }
}

/// Reads positions and goals of all steps, by planner if the file names planners: in the order in which
/// [`load::rollouts`] and [`load::dataset`] read states.
///
/// # Errors
/// Those of the reader.
pub(crate) fn read(
    source: &dyn DatasetSource,
    (position, goal): (&Pair, Option<&Pair>),
    by_planner: bool,
) -> Result<BTreeMap<Option<String>, Track>> {
    let by_planner = by_planner && load::names_planners(source);
    let actions = ObservationLayout::new(&source.info().action);
    let mut actions = actions.leaves().iter().filter(|leaf| leaf.width > 0);
    // Null below the last step, where there is an observation only.
    let action = actions
        .next()
        .context("there are no actions")?
        .column
        .clone();
    let wanted = [
        Some(schema::EPISODE_INDEX),
        by_planner.then_some(PLANNER),
        Some(&*position.column),
        goal.map(|goal| &*goal.column),
        Some(&*action),
    ];
    let scan = Scan {
        columns: Some(each_once(wanted.into_iter().flatten())),
        ..Scan::default()
    };
    let mut found = BTreeMap::<Option<String>, Track>::new();
    for batch in source.scan(&scan)? {
        let batch = batch?;
        let column = |name: &str| {
            let column = batch.column_by_name(name);
            column.with_context(|| format!("column \"{name}\" vanished"))
        };
        let planners = match by_planner {
            true => Some(arrow::compute::cast(column(PLANNER)?, &DataType::Utf8)?),
            false => None,
        };
        let planner = |row: usize| {
            let names = planners.as_ref()?.as_string::<i32>();
            names.is_valid(row).then(|| names.value(row).to_owned())
        };
        let positions = pairs(&batch, position)?;
        let goals = goal.map(|goal| pairs(&batch, goal)).transpose()?;
        let action = column(&action)?;
        for row in (0..batch.num_rows()).filter(|row| action.is_valid(*row)) {
            let track = found.entry(planner(row)).or_default();
            track.positions.push(positions[row]);
            track.goals.extend(goals.as_ref().map(|goals| goals[row]));
        }
    }
    Ok(found)
}

/// Columns to read: positions and goals may lie in one vector.
pub(crate) fn each_once<'a>(names: impl IntoIterator<Item = &'a str>) -> Vec<String> {
    let mut columns: Vec<String> = Vec::new();
    for name in names {
        if !columns.iter().any(|known| known == name) {
            columns.push(name.to_owned());
        }
    }
    columns
}

/// The two numbers of every row; what is null is NaN.
pub(crate) fn pairs(batch: &RecordBatch, pair: &Pair) -> Result<Vec<[f64; 2]>> {
    let name = &pair.column;
    let column = batch.column_by_name(name).context("a column vanished")?;
    let list = column.as_fixed_size_list_opt();
    let Some(list) = list.filter(|list| list.value_length() >= 2) else {
        bail!(
            "column \"{name}\" holds {}, expected lists of two numbers or more",
            column.data_type()
        );
    };
    let values = arrow::compute::cast(list.values(), &DataType::Float64)?;
    let values = values.as_primitive::<Float64Type>();
    let at = |place: usize| match values.is_valid(place) {
        true => values.value(place),
        false => f64::NAN,
    };
    let one = |row: usize| {
        let start = usize::try_from(list.value_offset(row)).unwrap_or(0);
        match list.is_valid(row) {
            true => pair.places.map(|place| at(start + place)),
            false => [f64::NAN; 2],
        }
    };
    Ok((0..list.len()).map(one).collect())
}
