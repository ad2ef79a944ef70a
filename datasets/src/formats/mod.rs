//! One module per file format, and what reads HDF5 in this build.

pub(crate) mod d4rl;
pub(crate) mod ipc;
pub(crate) mod minari;
pub(crate) mod parquet;

#[cfg(feature = "hdf5")]
pub(crate) mod hdf5;

#[cfg(not(feature = "hdf5"))]
#[path = "hdf5_disabled.rs"]
pub(crate) mod hdf5_reading;
#[cfg(feature = "hdf5")]
#[path = "hdf5_enabled.rs"]
pub(crate) mod hdf5_reading;
