//! Parquet: the canonical layout, and any file with list or scalar columns.

mod ahead;
mod read;
mod write;

pub(crate) use read::open;
pub use write::ParquetSink;
