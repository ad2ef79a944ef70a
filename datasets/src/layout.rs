//! How observation leaves line up in a state vector, and how columns of it are named.

use std::ops::Range;

use crate::error::{DatasetError, Result};
use crate::schema;
use crate::spec::LeafSpec;

/// One leaf's place in the state vector.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LayoutLeaf {
    /// Short name: the column without `observation.`.
    pub name: String,
    /// Column in the dataset.
    pub column: String,
    /// First column of the state vector.
    pub offset: usize,
    /// Number of columns.
    pub width: usize,
}

/// The numeric observation leaves, concatenated in schema order.
///
/// For AntMaze in Minari: `achieved_goal` (2), `observation` (27), `desired_goal` (2), so 31 columns.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ObservationLayout {
    leaves: Vec<LayoutLeaf>,
}

impl ObservationLayout {
    /// Lays out the numeric leaves; text and pictures take no part.
    pub fn new(leaves: &[LeafSpec]) -> Self {
        let mut offset = 0;
        let mut laid_out = Vec::new();
        for leaf in leaves.iter().filter(|leaf| leaf.is_numeric()) {
            let root = format!("{}.", schema::OBSERVATION);
            let name = leaf
                .column
                .strip_prefix(&root)
                .unwrap_or(&leaf.column)
                .to_owned();
            let width = leaf.width();
            laid_out.push(LayoutLeaf {
                name,
                column: leaf.column.clone(),
                offset,
                width,
            });
            offset += width;
        }
        Self { leaves: laid_out }
    }

    /// Number of columns of the state vector.
    pub fn width(&self) -> usize {
        self.leaves
            .last()
            .map_or(0, |leaf| leaf.offset + leaf.width)
    }

    /// The leaves in order.
    pub fn leaves(&self) -> &[LayoutLeaf] {
        &self.leaves
    }

    /// Name of a column, such as `achieved_goal[0]`; its number if it lies outside.
    pub fn column_name(&self, index: usize) -> String {
        match self
            .leaves
            .iter()
            .find(|leaf| (leaf.offset..leaf.offset + leaf.width).contains(&index))
        {
            Some(leaf) => format!("{}[{}]", leaf.name, index - leaf.offset),
            None => index.to_string(),
        }
    }

    /// The columns a selection names, in the order given.
    ///
    /// A selection is a comma-separated list of column numbers (`3`), half-open ranges (`0..2`), leaf names
    /// (`achieved_goal`, or in full `observation.achieved_goal`) and parts of a leaf (`achieved_goal[0]`,
    /// `observation[3..7]`). The name of a whole leaf wins over a part of another one.
    ///
    /// # Errors
    /// [`DatasetError::BadSelection`] for an empty selection, an unknown name, a range outside the leaf or
    /// the state, or a column named twice.
    pub fn select(&self, selection: &str) -> Result<Vec<usize>> {
        let mut columns = Vec::new();
        for item in selection.split(',').map(str::trim) {
            for column in self.select_item(item)? {
                if columns.contains(&column) {
                    return Err(self.bad(item, "names a column twice"));
                }
                columns.push(column);
            }
        }
        Ok(columns)
    }

    fn select_item(&self, item: &str) -> Result<Range<usize>> {
        if item.is_empty() {
            return Err(self.bad(item, "is empty"));
        }
        if let Some(leaf) = self.leaf(item) {
            return Ok(leaf.offset..leaf.offset + leaf.width);
        }
        if item.starts_with(|c: char| c.is_ascii_digit()) {
            return self.range(item, item, 0, self.width());
        }
        let part = item
            .strip_suffix(']')
            .and_then(|open| open.rsplit_once('['));
        let Some((name, numbers)) = part else {
            return Err(self.bad(item, "is not there"));
        };
        let Some(leaf) = self.leaf(name) else {
            return Err(self.bad(item, "is not there"));
        };
        self.range(item, numbers, leaf.offset, leaf.width)
    }

    fn leaf(&self, name: &str) -> Option<&LayoutLeaf> {
        let full = self.leaves.iter().find(|leaf| leaf.column == name);
        full.or_else(|| self.leaves.iter().find(|leaf| leaf.name == name))
    }

    fn range(
        &self,
        item: &str,
        numbers: &str,
        offset: usize,
        width: usize,
    ) -> Result<Range<usize>> {
        let parse = |text: &str| text.trim().parse::<usize>().ok();
        let range = match numbers.split_once("..") {
            Some((start, end)) => parse(start).zip(parse(end)),
            None => parse(numbers).and_then(|n| Some((n, n.checked_add(1)?))),
        };
        match range {
            None => Err(self.bad(item, "is neither a number nor a range such as 0..2")),
            Some((start, end)) if start >= end => Err(self.bad(item, "is an empty range")),
            Some((_, end)) if end > width => Err(self.bad(item, "reaches past the end")),
            Some((start, end)) => Ok(offset + start..offset + end),
        }
    }

    fn bad(&self, item: &str, reason: &'static str) -> DatasetError {
        let all = self.leaves.iter().map(|leaf| {
            format!(
                "{} ({}..{})",
                leaf.name,
                leaf.offset,
                leaf.offset + leaf.width
            )
        });
        let available = all.collect::<Vec<_>>().join(", ");
        DatasetError::BadSelection {
            item: item.to_owned(),
            reason,
            available,
        }
    }
}

#[cfg(test)]
mod tests {
    use arrow::datatypes::DataType;

    use super::*;
    use crate::spec::LeafKind;

    fn leaf(column: &str, width: usize) -> LeafSpec {
        LeafSpec {
            column: column.to_owned(),
            kind: LeafKind::Box,
            shape: vec![width],
            data_type: DataType::Float64,
        }
    }

    fn antmaze() -> ObservationLayout {
        ObservationLayout::new(&[
            leaf("observation.achieved_goal", 2),
            leaf("observation.observation", 27),
            leaf("observation.desired_goal", 2),
        ])
    }

    #[test]
    fn names_and_numbers_select_the_same_columns() {
        let layout = antmaze();
        assert_eq!(layout.width(), 31);
        assert_eq!(layout.select("0..2").unwrap(), [0, 1]);
        assert_eq!(layout.select("achieved_goal").unwrap(), [0, 1]);
        assert_eq!(layout.select("observation.achieved_goal").unwrap(), [0, 1]);
        assert_eq!(layout.select("observation[3..5]").unwrap(), [5, 6]);
        assert_eq!(layout.select("desired_goal[1], 3").unwrap(), [30, 3]);
        assert_eq!(layout.select("observation").unwrap().len(), 27);
        assert_eq!(layout.column_name(29), "desired_goal[0]");
    }

    #[test]
    fn errors_list_what_there_is() {
        let layout = antmaze();
        for bad in [
            "",
            "goal",
            "31",
            "0..32",
            "2..2",
            "5..1",
            "achieved_goal[2]",
            "x[",
            "0,0..2",
            "1e3",
        ] {
            let error = layout.select(bad).unwrap_err().to_string();
            assert!(error.contains("observation (2..29)"), "{bad}: {error}");
        }
    }

    #[test]
    fn a_flat_observation_is_one_leaf() {
        let layout = ObservationLayout::new(&[leaf("observation", 11)]);
        assert_eq!(layout.select("observation[10]").unwrap(), [10]);
        assert_eq!(layout.select("observation").unwrap().len(), 11);
    }
}
