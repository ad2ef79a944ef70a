//! Tables with columns of any names as the canonical layout: what Parquet and Arrow IPC files share.
//!
//! [`columns`] finds the part each column plays, [`table`] describes the result, [`scan`] converts batch after
//! batch, with the checks of [`rows`] and [`place`].

mod columns;
mod names;
pub(crate) mod place;
mod rows;
mod scan;
mod table;

pub(crate) use columns::{FilePlan, Role};
pub use names::ColumnNames;
pub(crate) use scan::{TableReader, TableScan};
pub(crate) use table::{FIRST_ROWS, Table};
