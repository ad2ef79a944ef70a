//! One binary for all cross-crate tests: it links once.

mod layering;
mod repository;
