//! What the HDF5 readers share: checked opening of files and arrays, typed reading; and the writers: arrays that
//! grow.
//!
//! libhdf5 is C and these files come from strangers. So before it touches data: links out of the file,
//! external and virtual storage are refused, filters are checked by number, and declared sizes are bounded
//! by the size of the file.

mod array;
mod attributes;
mod builder;
mod file;
mod write;

pub(crate) use array::{Array, open_contained};
pub(crate) use attributes::{attributes, json_value};
pub(crate) use file::{
    H5File, MAX_DEPTH, MemberKind, array_paths, failed, join, members, nested_without_end,
};
pub(crate) use write::{
    ArrayPlan, ArrayWriter, close_file, create_file, write_attribute, write_scalar,
};

pub(crate) use crate::formats::steps::{
    ColumnSource, Element, EpisodeRows, LeafBuilder, Piece, RowRule, StepColumn, StepScan,
    StepTable, table_schema,
};
