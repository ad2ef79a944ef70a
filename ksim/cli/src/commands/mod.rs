//! One file per command: its arguments and its run.

pub(crate) mod bench;
pub(crate) mod convert;
pub(crate) mod dataset;
pub(crate) mod demo;
pub(crate) mod env;
pub(crate) mod export;
pub(crate) mod index;
pub(crate) mod planner;
pub(crate) mod plot;
pub(crate) mod report;
pub(crate) mod rollout;
pub(crate) mod score;
pub(crate) mod train;
pub(crate) mod watch;
