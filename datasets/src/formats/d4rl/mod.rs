//! D4RL HDF5: flat arrays, episodes one after another.
//!
//! Reading goes in three steps: [`walk`] lists and checks the arrays of the file, [`plan`] cuts the rows into
//! episodes, [`read`] delivers batches.

pub(in crate::formats) mod cut;
pub(in crate::formats) mod flat;
pub(in crate::formats) mod plan;
mod policy;

#[cfg(feature = "hdf5")]
mod read;
#[cfg(feature = "hdf5")]
mod walk;

pub use policy::EpisodePolicy;
#[cfg(feature = "hdf5")]
pub(crate) use read::D4rlSource;
