//! Writing v3.0 folders.
//!
//! One row group per episode (short ones share), data files of about 100 MB, times on the grid of `fps`.
//! Memory: one row group of about 32 MiB, a batch, and the thinned-out values of the statistics.

mod arrays;
mod counts;
mod files;
mod meta;
mod plan;
mod rate;
mod sink;
mod sketch;
mod stats;
mod table;
mod tasks;

pub(super) use sink::LeRobotSink;
