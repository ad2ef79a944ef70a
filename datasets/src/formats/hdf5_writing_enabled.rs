//! The HDF5 writers of a build with the feature `hdf5`.

pub(crate) use crate::formats::d4rl::create as create_d4rl;
pub(crate) use crate::formats::minari::create_hdf5 as create_minari;
