//! Training data: episodes, their normalizer, windows with values, and batches of them.

mod batches;
mod episodes;
mod normalizer;
mod windows;

pub use batches::Batches;
pub use episodes::{EpisodeSpan, Episodes};
pub(crate) use episodes::{goal_order, has_goal};
pub use normalizer::Normalizer;
pub use windows::{Subset, Windows};
