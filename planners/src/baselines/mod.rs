//! Planners without a network: what any other has to beat.

mod demonstrations;
mod error;
mod families;
mod nearest;
mod random;
mod replay;
mod saved;

pub use demonstrations::Demonstrations;
pub use error::BaselineError;
pub use families::{NearestFamily, RandomFamily, ReplayFamily};
pub use nearest::{Choice, Nearest, NearestOptions};
pub use random::Random;
pub use replay::{Replay, ReplayOptions};

use crate::config::MOST;
use crate::error::PlannerError;

/// Refuses a count of 0, and one that no memory holds.
fn check_count(name: &'static str, found: usize) -> Result<(), PlannerError> {
    if (1..=MOST).contains(&found) {
        return Ok(());
    }
    let expected = format!("1 to {MOST}");
    let found = found.to_string();
    Err(BaselineError::Setting {
        name,
        expected,
        found,
    }
    .into())
}
