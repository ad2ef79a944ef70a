//! D4RL HDF5: flat arrays, episodes one after another.
//!
//! Reading goes in three steps: [`walk`] lists and checks the arrays of the file, [`plan`] cuts the rows into
//! episodes, [`read`] delivers batches. Writing goes in two: [`write_plan`] says which column becomes which
//! array, [`write`] appends rows.

pub(in crate::formats) mod cut;
pub(in crate::formats) mod flat;
pub(in crate::formats) mod plan;
mod policy;

#[cfg(feature = "hdf5")]
mod read;
#[cfg(feature = "hdf5")]
mod walk;
#[cfg(feature = "hdf5")]
mod write;
#[cfg(feature = "hdf5")]
mod write_about;
#[cfg(feature = "hdf5")]
mod write_plan;

pub use policy::EpisodePolicy;
#[cfg(feature = "hdf5")]
pub(crate) use read::D4rlSource;
#[cfg(feature = "hdf5")]
pub(crate) use write::create;
