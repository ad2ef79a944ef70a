//! Training data: episodes, their normalizer, windows with values, and batches of them.

mod batches;
mod episodes;
mod normalizer;
mod windows;

pub use batches::Batches;
pub(crate) use episodes::goal_order;
pub use episodes::{EpisodeSpan, Episodes};
pub use normalizer::Normalizer;
pub use windows::{Subset, Windows};
