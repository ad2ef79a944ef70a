//! One module per file format, and what reads and writes HDF5 and MCAP in this build.

pub(crate) mod d4rl;
pub(crate) mod episode_rows;
pub(crate) mod fill;
pub(crate) mod ipc;
pub(crate) mod lerobot;
pub(crate) mod minari;
pub(crate) mod npz;
pub(crate) mod parquet;
pub(crate) mod steps;
pub(crate) mod tabular;

#[cfg(feature = "hdf5")]
pub(crate) mod hdf5;
#[cfg(feature = "mcap")]
pub(crate) mod mcap;
#[cfg(feature = "hdf5")]
pub(crate) mod robomimic;

#[cfg(not(feature = "hdf5"))]
#[path = "hdf5_disabled.rs"]
pub(crate) mod hdf5_reading;
#[cfg(feature = "hdf5")]
#[path = "hdf5_enabled.rs"]
pub(crate) mod hdf5_reading;

#[cfg(not(feature = "hdf5"))]
#[path = "hdf5_writing_disabled.rs"]
pub(crate) mod hdf5_writing;
#[cfg(feature = "hdf5")]
#[path = "hdf5_writing_enabled.rs"]
pub(crate) mod hdf5_writing;

#[cfg(not(feature = "mcap"))]
#[path = "mcap_disabled.rs"]
pub(crate) mod mcap_files;
#[cfg(feature = "mcap")]
#[path = "mcap_enabled.rs"]
pub(crate) mod mcap_files;
