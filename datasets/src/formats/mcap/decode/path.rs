//! Paths to fields.

use std::fmt;
use std::str::FromStr;

use crate::error::{DatasetError, Result};

/// Where a field is in a message: `header.stamp`, `position` (a whole array), `position[3]`,
/// `joints[0].position`, or `joints[].position` (that member of every element).
///
/// Members are separated by dots. At most one `[]` is allowed, and what follows it must be single values.
/// Names are taken as they are; one that holds a dot or bracket (JSON) cannot be reached.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct FieldPath {
    pub(crate) steps: Vec<PathStep>,
}

/// One step of a path.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(crate) enum PathStep {
    /// A member of a struct.
    Member(String),
    /// An element of an array.
    Index(usize),
    /// Every element of an array.
    Each,
}

impl FromStr for FieldPath {
    type Err = DatasetError;

    /// Parses a path.
    ///
    /// # Errors
    /// [`DatasetError::BadSelection`] if it is not one.
    fn from_str(text: &str) -> Result<Self> {
        let bad = |reason| DatasetError::BadSelection {
            item: text.to_owned(),
            reason,
            available: "written as in `header.stamp`, `position[3]` or `joints[].position`"
                .to_owned(),
        };
        let mut steps = Vec::new();
        for part in text.split('.') {
            let (name, mut rest) = part.split_at(part.find('[').unwrap_or(part.len()));
            if name.is_empty() || name.contains(']') {
                return Err(bad("a name is empty or holds a bracket"));
            }
            steps.push(PathStep::Member(name.to_owned()));
            while !rest.is_empty() {
                let inner = rest.strip_prefix('[').and_then(|rest| rest.split_once(']'));
                let (index, after) = inner.ok_or_else(|| bad("a bracket is not closed"))?;
                steps.push(match index {
                    "" => PathStep::Each,
                    number => PathStep::Index(
                        number
                            .parse()
                            .map_err(|_| bad("an index is not a number from 0"))?,
                    ),
                });
                rest = after;
            }
        }
        if steps.iter().filter(|&step| *step == PathStep::Each).count() > 1 {
            return Err(bad("`[]` may be used once"));
        }
        Ok(Self { steps })
    }
}

impl fmt::Display for FieldPath {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (i, step) in self.steps.iter().enumerate() {
            match step {
                PathStep::Member(name) if i == 0 => f.write_str(name)?,
                PathStep::Member(name) => write!(f, ".{name}")?,
                PathStep::Index(index) => write!(f, "[{index}]")?,
                PathStep::Each => f.write_str("[]")?,
            }
        }
        Ok(())
    }
}
