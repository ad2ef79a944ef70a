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

use crate::error::PlannerError;

/// Refuses a count of 0.
fn at_least_1(name: &'static str, found: usize) -> Result<(), PlannerError> {
    if found > 0 {
        return Ok(());
    }
    let expected = "at least 1".to_owned();
    let found = found.to_string();
    Err(BaselineError::Setting {
        name,
        expected,
        found,
    }
    .into())
}
