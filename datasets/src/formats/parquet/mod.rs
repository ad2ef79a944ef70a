//! Parquet: the canonical layout, and any file with list or scalar columns.

mod ahead;
mod columns;
mod read;
mod rows;
mod write;

pub use columns::ColumnNames;
pub(crate) use read::open;
pub use write::ParquetSink;
