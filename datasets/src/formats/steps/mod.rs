//! What the readers of arrays share, whatever file the arrays lie in: types, columns, and the batch loop.

mod builder;
mod element;
mod pager;
mod scan;

pub(crate) use builder::LeafBuilder;
#[cfg(feature = "hdf5")]
pub(in crate::formats) use builder::Values;
pub(crate) use element::{ArrayInfo, Element};
pub(crate) use pager::Piece;
pub(crate) use scan::{
    ColumnSource, EpisodeRows, RowRule, StepColumn, StepScan, StepTable, table_schema,
};
