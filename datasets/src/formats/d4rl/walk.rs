//! Listing and checking the arrays of a D4RL file.

use serde_json::{Map, Value, json};

use super::flat::{FlatArrays, FlatRows, OBSERVATIONS, REQUIRED, check, is_known, missing};
use crate::error::{DatasetError, Result};
use crate::formats::hdf5::{
    Array, H5File, LeafBuilder, MAX_DEPTH, MemberKind, failed, join, json_value, members,
    open_contained,
};
use crate::formats::steps::ArrayInfo;
use crate::source::Warning;

pub(super) const METADATA: &str = "metadata";
/// Copies of slices for partial loading.
const VIRTUAL: &str = "virtual";
/// Arrays of a file, at most.
const MAX_ARRAYS: usize = 4096;

/// The arrays of a file with one row per step, all of the same length.
pub(super) struct Walked {
    /// In the library's order (by key).
    pub(super) arrays: Vec<Array>,
    pub(super) n_rows: u64,
    pub(super) metadata: Map<String, Value>,
    pub(super) warnings: Vec<Warning>,
}

impl Walked {
    pub(super) fn find(&self, key: &str) -> Option<&Array> {
        self.arrays.iter().find(|array| array.key() == key)
    }

    /// One of the keys that were checked to be there.
    pub(super) fn required(&self, key: &str) -> Result<&Array> {
        self.find(key)
            .ok_or_else(|| missing(key, self.arrays.iter().map(Array::key)))
    }
}

/// Lists a file.
///
/// # Errors
/// A required key is missing, an array has another length than the observations or a shape that cannot be,
/// and what [`Array::open`] finds.
pub(super) fn walk(file: &H5File) -> Result<Walked> {
    let mut walk = Walk {
        file,
        arrays: Vec::new(),
        metadata: Map::new(),
        warnings: Vec::new(),
    };
    walk.group("", 0)?;
    for key in REQUIRED {
        if !walk.arrays.iter().any(|array| array.key() == key) {
            return Err(missing(key, walk.arrays.iter().map(Array::key)));
        }
    }
    let n_rows = walk
        .arrays
        .iter()
        .find(|array| array.key() == OBSERVATIONS)
        .map_or(0, Array::n_rows);
    let Walk {
        mut arrays,
        metadata,
        mut warnings,
        ..
    } = walk;
    arrays.retain(|array| {
        let keep = is_known(array.key()) || array.n_rows() == n_rows;
        if !keep {
            let reason = "it does not have one row per step";
            warnings.push(Warning::ColumnLeftOut {
                column: array.key().to_owned(),
                reason,
            });
        }
        keep
    });
    for array in &arrays {
        check(&array.info(), n_rows)?;
    }
    Ok(Walked {
        arrays,
        n_rows,
        metadata,
        warnings,
    })
}

/// The file for [`super::plan`].
impl FlatArrays for Walked {
    fn infos(&self) -> Vec<ArrayInfo> {
        self.arrays.iter().map(Array::info).collect()
    }

    fn n_rows(&self) -> u64 {
        self.n_rows
    }

    fn rows<'a>(&'a self, key: &str) -> Result<Box<dyn FlatRows + 'a>> {
        Ok(Box::new(self.required(key)?))
    }
}

impl FlatRows for &Array {
    fn append(&mut self, start: u64, n: usize, to: &mut LeafBuilder) -> Result<()> {
        to.append(self, start, n)
    }
}

struct Walk<'f> {
    file: &'f H5File,
    arrays: Vec<Array>,
    metadata: Map<String, Value>,
    warnings: Vec<Warning>,
}

impl Walk<'_> {
    fn group(&mut self, key: &str, depth: usize) -> Result<()> {
        if depth > MAX_DEPTH || self.arrays.len() > MAX_ARRAYS {
            return Err(DatasetError::corrupt(format!(
                "group \"{key}\" is nested without end"
            )));
        }
        let opened;
        let group = if key.is_empty() {
            self.file.root()
        } else {
            opened = self.file.group(key)?;
            &opened
        };
        for member in members(group, key)? {
            let path = join(key, &member.name);
            match member.kind {
                MemberKind::Group if path == VIRTUAL => {}
                MemberKind::Group if path == METADATA => {
                    self.metadata = describe(group, &member.name, &path, 0)?;
                }
                MemberKind::Group => self.group(&path, depth + 1)?,
                MemberKind::Array => self.array(&path)?,
            }
        }
        Ok(())
    }

    fn array(&mut self, key: &str) -> Result<()> {
        let array = match self.file.array(key) {
            Ok(array) => array,
            // What nobody needs may have any type.
            Err(DatasetError::WrongType { .. } | DatasetError::ShapeMismatch { .. })
                if !is_known(key) =>
            {
                let reason = "its type or shape cannot be a column";
                self.warnings.push(Warning::ColumnLeftOut {
                    column: key.to_owned(),
                    reason,
                });
                return Ok(());
            }
            Err(error) => return Err(error),
        };
        if array.width() == 0 {
            if REQUIRED.contains(&key) {
                let (actual, expected) = (
                    array.row_shape().to_vec(),
                    "at least one value a row".to_owned(),
                );
                return Err(DatasetError::ShapeMismatch {
                    key: key.to_owned(),
                    actual,
                    expected,
                });
            }
            let reason = "its rows are empty";
            self.warnings.push(Warning::ColumnLeftOut {
                column: key.to_owned(),
                reason,
            });
            return Ok(());
        }
        self.arrays.push(array);
        Ok(())
    }
}

/// A metadata group as nested JSON: small values as they are, network weights by shape and type.
fn describe(
    parent: &hdf5_metno::Group,
    name: &str,
    key: &str,
    depth: usize,
) -> Result<Map<String, Value>> {
    let mut fields = Map::new();
    if depth > MAX_DEPTH {
        return Ok(fields);
    }
    let group = parent.group(name).map_err(failed("open group", key))?;
    for member in members(&group, key)? {
        let path = join(key, &member.name);
        let value = match member.kind {
            MemberKind::Group => Value::Object(describe(&group, &member.name, &path, depth + 1)?),
            MemberKind::Array => {
                let (dataset, _) = open_contained(&group, &member.name, &path)?;
                match json_value(&dataset) {
                    Some(value) => value,
                    None => {
                        json!({ "shape": dataset.get_shape().map_err(failed("read the shape of", &path))? })
                    }
                }
            }
        };
        fields.insert(member.name, value);
    }
    Ok(fields)
}
