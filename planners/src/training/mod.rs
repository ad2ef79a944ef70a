//! Training: phases of updates, checkpoints to go on from, and the folder of a run.
//!
//! Everything that is drawn follows from the seed and the number of the update, so a training that was stopped goes on
//! with the numbers it would have had.

mod begin;
mod checkpoint;
mod confidence;
mod curiosity;
mod diffusion;
mod history;
mod learner;
mod manifest;
mod run;
mod session;
mod setting;

pub(crate) use checkpoint::CHECKPOINT_FILE;
pub(crate) use history::HISTORY_FILE;
pub use learner::{Learner, Rate, Update, cosine_rate};
pub(crate) use manifest::{MANIFEST_FILE, MANIFEST_FORMAT, Program};
pub(crate) use run::{TrainedFamily, train};
