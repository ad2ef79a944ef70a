//! Which columns of the rollouts go with which of the dataset.

use anyhow::{Result, bail};
use ksim_datasets::{
    DatasetInfo, DatasetSource, Format, LayoutLeaf, LeafSpec, ObservationLayout, OpenOptions,
};

use crate::load::Columns;

/// Names of a single leaf that say nothing of what is in it: such a leaf is the whole vector.
const GENERIC: [&str; 4] = ["observation", "state", "obs", "action"];

/// How both sides were opened: columns listed for each of them go together as listed.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Listed {
    observation: bool,
    action: bool,
}

/// One of the two vectors of a step, on both sides.
struct Pair<'a> {
    what: &'static str,
    rollouts: (&'a DatasetInfo, ObservationLayout),
    dataset: (&'a DatasetInfo, ObservationLayout),
    listed: bool,
}

impl Listed {
    /// Whether the command line lists columns for the rollouts, and others for the dataset.
    pub(crate) fn new(rollouts: &OpenOptions, dataset: &OpenOptions) -> Self {
        let differ =
            |own: &[String], other: &[String]| !own.is_empty() && !other.is_empty() && own != other;
        let (own, other) = (&rollouts.columns, &dataset.columns);
        Self {
            observation: differ(&own.observation, &other.observation),
            action: differ(&own.action, &other.action),
        }
    }
}

/// The rollouts' columns for the chosen ones of the dataset. Leaves go together by name; by position only
/// where one side is a single vector, or where the command line lists the columns of both sides.
///
/// # Errors
/// Columns that have no counterpart, or one of another width.
pub(crate) fn columns_of(
    rollouts: &dyn DatasetSource,
    dataset: &dyn DatasetSource,
    chosen: &Columns,
    listed: Listed,
) -> Result<Columns> {
    let (found, expected) = (rollouts.info(), dataset.info());
    // No other format has columns to list.
    let lists = found.format == Format::Parquet && expected.format == Format::Parquet;
    let pair = |what, own: &[LeafSpec], other: &[LeafSpec], listed: bool| Pair {
        what,
        rollouts: (found, ObservationLayout::new(own)),
        dataset: (expected, ObservationLayout::new(other)),
        listed: listed && lists,
    };
    let states = pair(
        "observations",
        &found.observation,
        &expected.observation,
        listed.observation,
    );
    let actions = pair("actions", &found.action, &expected.action, listed.action);
    let every: Vec<usize> = (0..actions.dataset.1.width()).collect();
    // Unlike a state, an action is taken whole.
    actions.check_width()?;
    let in_order = actions.map(&every)?;
    Ok(Columns {
        indices: states.map(&chosen.indices)?,
        names: chosen.names.clone(),
        actions: (in_order != every).then_some(in_order),
    })
}

impl Pair<'_> {
    /// Places in the rollouts' vector of places in the dataset's.
    fn map(&self, chosen: &[usize]) -> Result<Vec<usize>> {
        if self.is_positional() {
            self.check_width()?;
            return Ok(chosen.to_vec());
        }
        chosen.iter().map(|&column| self.place(column)).collect()
    }

    fn is_positional(&self) -> bool {
        match (self.rollouts.1.leaves(), self.dataset.1.leaves()) {
            ([own], [other]) if own.column == other.column => true,
            ([own], _) if is_generic(own) => true,
            (_, [other]) if is_generic(other) => true,
            _ => false,
        }
    }

    fn check_width(&self) -> Result<()> {
        let (found, expected) = (self.rollouts.1.width(), self.dataset.1.width());
        if found != expected {
            bail!(
                "{}: {} have {found} columns, expected {expected} as in dataset {} ({})",
                self.rollouts.0.path.display(),
                self.what,
                self.dataset.0.id,
                self.dataset.0.path.display()
            );
        }
        Ok(())
    }

    /// Place of one column, through the leaf it belongs to.
    fn place(&self, column: usize) -> Result<usize> {
        let leaves = self.dataset.1.leaves();
        let holds = |leaf: &LayoutLeaf| (leaf.offset..leaf.offset + leaf.width).contains(&column);
        let Some(at) = leaves.iter().position(holds) else {
            bail!("column {column} lies outside the {}", self.what);
        };
        let leaf = &leaves[at];
        let own = self.rollouts.1.leaves();
        let counterpart = if self.listed {
            own.get(at).filter(|_| own.len() == leaves.len())
        } else {
            own.iter().find(|own| own.column == leaf.column)
        };
        match counterpart {
            Some(own) if own.width == leaf.width => Ok(own.offset + column - leaf.offset),
            Some(own) => bail!(self.mismatch(&format!(
                "{} has {} columns, expected {}",
                own.column, own.width, leaf.width
            ))),
            None => bail!(self.mismatch(&format!("nothing goes with {}", leaf.column))),
        }
    }

    fn mismatch(&self, what: &str) -> String {
        format!(
            "{}: {what}; the {} are {} here, and {} in dataset {} ({})",
            self.rollouts.0.path.display(),
            self.what,
            described(&self.rollouts.1),
            described(&self.dataset.1),
            self.dataset.0.id,
            self.dataset.0.path.display()
        )
    }
}

fn is_generic(leaf: &LayoutLeaf) -> bool {
    let name = leaf
        .column
        .rsplit_once('.')
        .map_or(&*leaf.column, |(_, name)| name);
    GENERIC.contains(&name)
}

/// `observation.a (2), observation.b (27)`.
fn described(layout: &ObservationLayout) -> String {
    let leaves = layout.leaves().iter();
    let leaves: Vec<String> = leaves
        .map(|leaf| format!("{} ({})", leaf.column, leaf.width))
        .collect();
    leaves.join(", ")
}
