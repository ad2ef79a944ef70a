//! The command at its border: exit codes, stdout and stderr, files.

mod convert;
#[cfg(feature = "download")]
mod download;
mod faults;
#[cfg(feature = "hdf5")]
mod golden;
mod pairing;
mod process;
mod score;
#[cfg(feature = "download")]
#[path = "../../../../datasets/tests/download/server.rs"]
mod server;
mod usage;
mod validate;
