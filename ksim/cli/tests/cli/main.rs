//! The command at its border: exit codes, stdout and stderr, files.

mod bench_search;
mod collect;
mod convert;
#[cfg(feature = "download")]
mod download;
mod faults;
#[cfg(feature = "hdf5")]
mod golden;
mod index;
#[cfg(feature = "mcap")]
mod mcap;
#[cfg(feature = "mcap")]
mod overlay;
mod pairing;
mod planner;
mod planner_import;
mod plot;
mod process;
mod report;
mod rollout;
mod score;
#[cfg(feature = "download")]
#[expect(dead_code, reason = "the tests of the downloader need more of it")]
#[path = "../../../../datasets/tests/download/server.rs"]
mod server;
#[path = "../../../../planners/tests/support/torch_save.rs"]
mod torch_save;
mod usage;
mod validate;
mod walks;
mod watch;
