//! Minari dataset folders: `data/metadata.json` beside the episodes, which are one HDF5 file (`read`) or a
//! folder each (`columnar`).
//!
//! Leaves of nested observations and actions come in this order: `achieved_goal` first, then the other keys
//! by name (bytewise), `desired_goal` last; tuple elements by number. So AntMaze gives `achieved_goal` (2),
//! `observation` (27), `desired_goal` (2).

mod columnar;
mod describe;
mod empty;
pub(crate) mod json;
pub(crate) mod metadata;
mod space;
mod write;

#[cfg(feature = "hdf5")]
mod read;
#[cfg(feature = "hdf5")]
mod structure;

pub(crate) use columnar::ColumnarSource;
pub(crate) use columnar::create as create_columnar;
#[cfg(feature = "hdf5")]
pub(crate) use read::MinariSource;
#[cfg(feature = "hdf5")]
pub(crate) use write::create_hdf5;

#[cfg(all(test, feature = "hdf5"))]
mod tests;
