//! A planner in a separate process, in any language: Arrow IPC streams over its stdin and stdout.
//!
//! The protocol stands in `docs/planner-processes.md`. [`ProcessPlanner`] is our end of it, [`serve`] the other end
//! for planners written in Rust.

mod answer;
mod child;
mod error;
mod frames;
mod protocol;
mod serve;

use std::collections::BTreeSet;
use std::time::Duration;

pub use error::{ProcessError, ProcessErrorKind};
pub use protocol::{Setting, VERSION};
pub use serve::serve;

use self::child::Child;
use crate::error::PlannerError;
use crate::planner::{Candidates, PlanRequest, Planner, PlannerSpec};

/// How long the process may take.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Timeouts {
    /// From its start to the answer to the handshake: imports and weights are loaded in this time.
    pub start: Duration,
    /// From a request to its answer.
    pub answer: Duration,
}

impl Default for Timeouts {
    fn default() -> Self {
        Self {
            start: Duration::from_secs(120),
            answer: Duration::from_secs(120),
        }
    }
}

/// A planner in a process of its own, which is ended with it.
///
/// Plans are as deterministic as the process makes them: it is told the seed of every episode.
#[derive(Debug)]
pub struct ProcessPlanner {
    spec: PlannerSpec,
    setting: Setting,
    child: Child,
    answer_timeout: Duration,
    started: BTreeSet<usize>,
}

impl ProcessPlanner {
    /// Starts a command, split into words as a POSIX shell does (no variables, no globs), and shakes hands with it.
    ///
    /// # Errors
    /// The command cannot be started, does not answer in time, or not as the protocol says, or is a planner of other
    /// widths than those of the setting.
    pub fn start(
        command: &str,
        setting: Setting,
        timeouts: Timeouts,
    ) -> Result<Self, PlannerError> {
        let mut child = Child::start(command, &setting)?;
        let spec = child.handshake(timeouts.start)?;
        for (what, expected, found) in [
            (
                "observation_dim",
                setting.observation_dim,
                spec.observation_dim,
            ),
            ("action_dim", setting.action_dim, spec.action_dim),
        ] {
            if expected != found {
                return Err(child
                    .error(ProcessErrorKind::Width {
                        what,
                        expected,
                        found,
                    })
                    .into());
            }
        }
        Ok(Self {
            spec,
            setting,
            child,
            answer_timeout: timeouts.answer,
            started: BTreeSet::new(),
        })
    }
}

impl Planner for ProcessPlanner {
    fn spec(&self) -> &PlannerSpec {
        &self.spec
    }

    fn reset(&mut self, slot: usize, seed: u64) -> Result<(), PlannerError> {
        let message = protocol::reset(&self.setting, slot, seed);
        let answer = self.child.ask(message, self.answer_timeout)?;
        answer::refusal(&answer).map_err(|kind| self.child.error(kind))?;
        if answer.num_rows() > 0 {
            let kind = ProcessErrorKind::Rows {
                of: "reset",
                expected: "no rows".to_owned(),
                found: answer.num_rows(),
            };
            return Err(self.child.error(kind).into());
        }
        self.started.insert(slot);
        Ok(())
    }

    fn plan(&mut self, request: &PlanRequest<'_>) -> Result<Candidates, PlannerError> {
        request.check(&self.spec, |slot| self.started.contains(&slot))?;
        if request.slots.is_empty() {
            return Ok(Candidates {
                n_candidates: 1,
                horizon: self.spec.horizon,
                actions: Vec::new(),
                scores: Vec::new(),
                novelties: Vec::new(),
                chosen: Vec::new(),
            });
        }
        let message = protocol::plan(&self.setting, request);
        let answer = self.child.ask(message, self.answer_timeout)?;
        let plan = answer::plan(&answer, &self.spec, request.slots)
            .map_err(|kind| self.child.error(kind))?;
        plan.check(&self.spec, request.slots.len())?;
        Ok(plan)
    }
}
