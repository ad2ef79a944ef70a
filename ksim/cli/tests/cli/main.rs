//! The command at its border: exit codes, stdout and stderr, files.

mod convert;
mod faults;
#[cfg(feature = "hdf5")]
mod golden;
mod pairing;
mod process;
mod score;
mod usage;
mod validate;
