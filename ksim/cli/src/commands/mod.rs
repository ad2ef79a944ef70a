//! One file per command: its arguments and its run.

pub(crate) mod convert;
pub(crate) mod dataset;
pub(crate) mod demo;
pub(crate) mod score;
