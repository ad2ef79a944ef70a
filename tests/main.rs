//! One binary for all cross-crate tests: it links once.

mod formats_agree;
mod layering;
mod repository;
mod score_golden;
