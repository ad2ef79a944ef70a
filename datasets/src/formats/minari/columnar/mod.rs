//! Minari's Arrow and Parquet storages: a folder per episode with one columnar file and its own
//! `metadata.json`.
//!
//! All columns have N+1 rows, so Minari pads what belongs to steps: the last row of actions, rewards and flags
//! is zeros. Here it is null, as in the canonical layout. Shapes of more than one axis stand in the spaces
//! only; the files have flat lists.

mod convert;
mod encode;
mod leaves;
mod part;
mod source;
mod write;

pub(crate) use source::ColumnarSource;
pub(crate) use write::create;
