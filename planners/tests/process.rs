//! A planner process, well-behaved and not.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use ksim_planners::process::{ProcessPlanner, Setting, Timeouts};
use ksim_planners::{Candidates, PlanRequest, Planner, PlannerError};

/// The example `process_peer`, which cargo builds with the tests.
fn peer() -> PathBuf {
    let own = std::env::current_exe().expect("a path");
    let folder = own
        .parent()
        .and_then(|deps| deps.parent())
        .expect("a folder");
    let name = format!("process_peer{}", std::env::consts::EXE_SUFFIX);
    let peer = folder.join("examples").join(name);
    assert!(
        peer.is_file(),
        "{} is not built: cargo build -p ksim-planners --examples",
        peer.display()
    );
    peer
}

fn setting() -> Setting {
    Setting {
        environment: "PointMass-v0".to_owned(),
        observation_dim: 2,
        action_dim: 1,
        action_low: vec![-1.0],
        action_high: vec![1.0],
    }
}

fn command(argument: &str) -> String {
    format!("'{}' {argument}", peer().display())
}

fn start(argument: &str, limit: Duration) -> Result<ProcessPlanner, PlannerError> {
    let timeouts = Timeouts {
        start: limit,
        answer: limit,
    };
    ProcessPlanner::start(&command(argument), setting(), timeouts)
}

const LONG: Duration = Duration::from_secs(60);
/// Enough to start on a busy machine.
const SHORT: Duration = Duration::from_secs(4);

fn plan(planner: &mut ProcessPlanner, observation: &[f64]) -> Result<Candidates, PlannerError> {
    planner.plan(&PlanRequest {
        slots: &[3],
        observations: observation,
    })
}

#[test]
fn it_keeps_to_the_contract() {
    let make = || -> Box<dyn Planner> { Box::new(start("", LONG).expect("it starts")) };
    let observations: Vec<f64> = (0..20).map(|i| f64::from(i) * 0.05).collect();
    ksim_planners::conformance::check(&make, &observations);
}

#[test]
fn plans_come_back_as_they_were_made() {
    let mut planner = start("", LONG).expect("it starts");
    assert_eq!(planner.spec().family, "push");
    assert_eq!((planner.spec().horizon, planner.spec().action_dim), (4, 1));
    for slot in [3, 8] {
        planner.reset(slot, 1).expect("a reset");
    }
    let request = PlanRequest {
        slots: &[3, 8],
        observations: &[1.0, 0.0, 1.0, 0.2],
    };
    let plan = planner.plan(&request).expect("a plan");
    let forces = [0.2f32, 0.1, 0.1, 0.05];
    for (found, expected) in plan.actions.chunks_exact(4).zip(forces) {
        assert!(
            found.iter().all(|value| (value - expected).abs() < 1e-6),
            "{found:?}"
        );
    }
    assert_eq!(
        (plan.n_candidates, plan.horizon, plan.chosen),
        (2, 4, vec![0, 0])
    );
    assert_eq!(
        (plan.scores, plan.novelties),
        (vec![1.0, 0.5, 1.0, 0.5], vec![])
    );
}

#[test]
fn a_refusal_is_told_and_the_next_request_is_answered() {
    let mut planner = start("", LONG).expect("it starts");
    let error = planner.reset(3, 13).expect_err("refused").to_string();
    assert!(
        error.contains("refused: seed is 13 in slot 3, expected a lucky number"),
        "{error}"
    );
    planner.reset(3, 1).expect("a reset");
    plan(&mut planner, &[0.0, 0.0]).expect("a plan");
}

/// The error of the second plan, which is the one that goes wrong, and that of all later ones.
fn second_plan(argument: &str, limit: Duration) -> String {
    let mut planner = start(argument, limit).expect("it starts");
    planner.reset(3, 1).expect("a reset");
    plan(&mut planner, &[0.0, 0.0]).expect("the first plan");
    let error = plan(&mut planner, &[0.0, 0.0])
        .expect_err("a fault")
        .to_string();
    let again = plan(&mut planner, &[0.0, 0.0])
        .expect_err("it is over")
        .to_string();
    assert!(
        again.contains("was ended after an earlier error"),
        "{again}"
    );
    error
}

#[test]
fn faults_in_the_middle_are_told_apart() {
    for (argument, limit, parts) in [
        (
            "crash",
            LONG,
            &[
                "exit status: 7",
                "instead of answering",
                "out of memory, says",
            ][..],
        ),
        ("hang", SHORT, &["did not answer within 4 s"]),
        (
            "print",
            LONG,
            &["wrote \"plan number 2", "belongs on stderr"],
        ),
        (
            "cut",
            LONG,
            &["exit status: 0", "in the middle of a message"],
        ),
        (
            "huge",
            LONG,
            &["2147483647 bytes of metadata", "at most 1048576"],
        ),
    ] {
        let error = second_plan(argument, limit);
        for part in parts {
            assert!(error.contains(part), "{argument}: no {part:?} in {error}");
        }
        assert!(error.contains("process_peer"), "{error}");
    }
}

#[test]
fn faults_of_the_beginning_are_told_apart() {
    for (argument, limit, parts) in [
        ("chatty", LONG, &["wrote \"Loading weights ..."][..]),
        (
            "late",
            SHORT,
            &["did not answer within 4 s", "still importing"],
        ),
        ("mute", SHORT, &["did not answer"]),
        (
            "wide",
            LONG,
            &["observation_dim = 3, the environment has 2"],
        ),
    ] {
        let error = start(argument, limit).expect_err("a fault").to_string();
        for part in parts {
            assert!(error.contains(part), "{argument}: no {part:?} in {error}");
        }
    }
    for (command, part) in [
        ("", "empty or has an open quote"),
        ("python3 'open", "empty or has an open quote"),
        ("/nowhere/planner", "cannot be started"),
        ("true", "instead of answering"),
        ("echo hello", "wrote \"hello\\n\""),
        ("printf ab", "wrote \"ab\""),
    ] {
        let error = ProcessPlanner::start(command, setting(), Timeouts::default());
        let error = error.expect_err("a fault").to_string();
        assert!(error.contains(part), "{command}: {error}");
    }
}

/// Whether a process of this id runs; a zombie does not.
#[cfg(target_os = "linux")]
fn runs(id: u32) -> bool {
    let stat = std::fs::read_to_string(format!("/proc/{id}/stat"));
    stat.is_ok_and(|stat| !stat.contains(") Z "))
}

#[cfg(target_os = "linux")]
#[test]
fn the_process_ends_with_its_planner_even_if_it_hangs() {
    let folder = tempfile::tempdir().expect("a folder");
    let file = folder.path().join("pid");
    // Tells its id, then is replaced by something that reads nothing and never ends.
    let script = format!("echo $$ > '{}'; exec sleep 600", file.display());
    let command = format!("sh -c \"{script}\"");
    let timeouts = Timeouts {
        start: SHORT,
        answer: SHORT,
    };
    let started = Instant::now();
    ProcessPlanner::start(&command, setting(), timeouts).expect_err("it says nothing");
    assert!(started.elapsed() < Duration::from_secs(30));
    let id = std::fs::read_to_string(&file).expect("it was there");
    assert!(!runs(id.trim().parse().expect("a number")));
}

/// The example in Python, where `KSIM_PYTHON` has pyarrow.
#[test]
fn the_python_example_plans_too() {
    let Some(python) = std::env::var_os("KSIM_PYTHON") else {
        println!("SKIPPED: KSIM_PYTHON is not set");
        return;
    };
    let python = python.to_string_lossy();
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/examples/process_planner.py");
    let command = format!("'{python}' '{script}'");
    let make = || -> Box<dyn Planner> {
        let started = ProcessPlanner::start(&command, setting(), Timeouts::default());
        Box::new(started.expect("it starts"))
    };
    let observations: Vec<f64> = (0..20).map(|i| f64::from(i) * 0.05).collect();
    ksim_planners::conformance::check(&make, &observations);
    let mut planner = make();
    planner.reset(3, 1).expect("a reset");
    let request = PlanRequest {
        slots: &[3],
        observations: &[0.0, 0.0],
    };
    assert_eq!(planner.plan(&request).expect("a plan").actions, [1.0; 8]);
}
