//! A planner process in Rust: pushes a point mass towards 1 with the strength that remains.
//!
//! `ksim rollout --planner process:target/debug/examples/process_peer --env PointMass-v0 --episodes 5`
//!
//! With an argument it misbehaves in the way that it names, for the tests.

use std::io::{self, Read as _, Write as _};
use std::process::ExitCode;
use std::time::Duration;

use ksim_planners::process::{Setting, serve};
use ksim_planners::{Candidates, PlanRequest, Planner, PlannerError, PlannerSpec};

/// Actions in a plan.
const HORIZON: usize = 4;
/// Gains of the controller, on distance and velocity.
const GAINS: [f64; 2] = [2.0, 0.5];

/// Every second candidate holds back.
struct Push {
    spec: PlannerSpec,
    misbehaves: bool,
    n_plans: usize,
}

impl Planner for Push {
    fn spec(&self) -> &PlannerSpec {
        &self.spec
    }

    fn reset(&mut self, slot: usize, seed: u64) -> Result<(), PlannerError> {
        match seed {
            13 => Err(PlannerError::Request {
                what: "seed",
                expected: "a lucky number".to_owned(),
                found: format!("{seed} in slot {slot}"),
            }),
            _ => Ok(()),
        }
    }

    fn plan(&mut self, request: &PlanRequest<'_>) -> Result<Candidates, PlannerError> {
        request.check(&self.spec, |_| true)?;
        self.n_plans += 1;
        if self.misbehaves && self.n_plans == 2 {
            misbehave();
        }
        let mut plan = Candidates {
            n_candidates: 2,
            horizon: HORIZON,
            actions: Vec::new(),
            scores: Vec::new(),
            novelties: Vec::new(),
            chosen: vec![0; request.slots.len()],
        };
        for observation in request.observations.chunks_exact(self.spec.observation_dim) {
            let [place, velocity] = [observation[0], observation[1]];
            let force = GAINS[0] * (1.1 - place) - GAINS[1] * velocity;
            for share in [1.0, 0.5] {
                let action = (share * force).clamp(-1.0, 1.0) as f32;
                plan.actions.extend([action; HORIZON]);
                plan.scores.push(share);
            }
        }
        Ok(plan)
    }
}

/// What the argument says, in the middle of a request.
#[expect(clippy::print_stdout, reason = "the fault that is to be found")]
#[expect(
    clippy::print_stderr,
    reason = "last words, for the one who started it"
)]
fn misbehave() {
    match std::env::args().nth(1).as_deref() {
        Some("crash") => {
            eprintln!("out of memory, says the peer");
            std::process::exit(7);
        }
        Some("hang") => std::thread::sleep(Duration::from_secs(600)),
        Some("print") => println!("plan number 2"),
        Some("cut") => {
            // A length, and nothing that has it.
            let _ = io::stdout().write_all(&[0xff, 0xff, 0xff, 0xff, 64, 0, 0, 0, 1, 2, 3]);
            let _ = io::stdout().flush();
            std::process::exit(0);
        }
        Some("huge") => {
            let _ = io::stdout().write_all(&[0xff, 0xff, 0xff, 0xff, 255, 255, 255, 127]);
            let _ = io::stdout().flush();
            std::thread::sleep(Duration::from_secs(600));
        }
        _ => {}
    }
}

fn make(setting: &Setting, misbehaves: bool) -> Box<dyn Planner> {
    let wrong = usize::from(std::env::args().nth(1).as_deref() == Some("wide"));
    Box::new(Push {
        spec: PlannerSpec {
            family: "push".to_owned(),
            observation_dim: setting.observation_dim + wrong,
            action_dim: setting.action_dim,
            horizon: HORIZON,
        },
        misbehaves,
        n_plans: 0,
    })
}

#[expect(clippy::print_stdout, reason = "the fault that is to be found")]
#[expect(
    clippy::print_stderr,
    reason = "last words, for the one who started it"
)]
fn main() -> ExitCode {
    let argument = std::env::args().nth(1);
    match argument.as_deref() {
        Some("mute") => {
            // Reads all and answers nothing.
            let _ = io::stdin().read_to_end(&mut Vec::new());
            return ExitCode::SUCCESS;
        }
        Some("chatty") => println!("Loading weights ..."),
        Some("late") => {
            eprintln!("still importing");
            std::thread::sleep(Duration::from_secs(600));
        }
        _ => {}
    }
    let made = |setting: &Setting| Ok(make(setting, argument.is_some()));
    match serve(made, io::stdin().lock(), io::stdout()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{error}");
            ExitCode::FAILURE
        }
    }
}
