//! Replays of recorded episodes: one step from every recorded state, and whole episodes.
//!
//! The physics is chaotic and MuJoCo calls the system's math library, which computes last bits differently on other
//! processors. So every machine has to be within 1e-9 after one step and within 1e-6 for a number of steps that
//! another math library was seen to keep; a machine that repeats long runs of HalfCheetah, the most sensitive robot,
//! to the last bit has to repeat everything so.

use ksim_envs::StepOutcome;
use ksim_envs::mujoco::MujocoEnvironment;

use crate::recording::{Recording, Row};

/// Starts at a recorded state, with what the simulator remembers besides it, and with a goal.
fn restore(environment: &mut dyn MujocoEnvironment, row: &Row, goal: &[f64]) {
    let info = [&row.qpos[..], &row.qvel, goal].concat();
    environment.restore(&info).unwrap();
    let physics = environment.physics_mut();
    physics
        .qacc_warmstart_mut()
        .copy_from_slice(&row.qacc_warmstart);
    physics.xpos_mut()[1].copy_from_slice(&row.torso_xpos);
}

/// The largest difference, infinite where a number is not finite.
fn difference(found: &[f64], expected: &[f64]) -> f64 {
    assert_eq!(found.len(), expected.len());
    let differences = found.iter().zip(expected).map(|(a, b)| (a - b).abs());
    differences.fold(0.0, |worst, next| {
        if next <= worst {
            worst
        } else {
            next.min(f64::INFINITY)
        }
    })
}

/// The largest difference of what a step gave from a row: observation, reward, and its terms where recorded.
fn step_difference(
    recording: &Recording,
    row: &Row,
    observation: &[f64],
    outcome: &StepOutcome,
) -> f64 {
    let terms = [
        outcome.terms.forward,
        outcome.terms.survive,
        outcome.terms.control,
        outcome.terms.contact,
    ];
    let mut worst = difference(observation, &row.obs).max((outcome.reward - row.reward).abs());
    if !recording.is_maze() {
        for (found, expected) in terms.iter().zip(row.terms) {
            worst = expected.map_or(worst, |expected| worst.max((found - expected).abs()));
        }
    }
    worst
}

/// The worst difference of one step from every recorded state.
fn single_steps(recording: &Recording) -> f64 {
    let mut environment = recording.make().unwrap();
    let mut observation = vec![0.0; environment.spec().observation_dim()];
    let mut worst: f64 = 0.0;
    for (episode, rows) in recording.episodes.iter().enumerate() {
        for (step, pair) in (1..).zip(rows.windows(2)) {
            let [before, after] = pair else {
                unreachable!()
            };
            restore(environment.as_mut(), before, &after.goal);
            let outcome = environment.step(&after.action, &mut observation).unwrap();
            let place = format!("{}, episode {episode}, step {step}", recording.name);
            assert_eq!(outcome.terminated, after.terminated, "{place}");
            assert_eq!(outcome.success, after.success, "{place}");
            let difference = step_difference(recording, after, &observation, &outcome);
            assert!(difference <= 1e-9, "{place}: {difference:e}");
            worst = worst.max(difference);
        }
    }
    worst
}

/// Moves the goal of an episode that is under way, and nothing else.
fn change_goal(environment: &mut dyn MujocoEnvironment, goal: &[f64]) {
    let physics = environment.physics();
    let (warmstart, xpos) = (physics.qacc_warmstart().to_vec(), physics.xpos().to_vec());
    let info = [physics.qpos(), physics.qvel(), goal].concat();
    environment.restore(&info).unwrap();
    let physics = environment.physics_mut();
    physics.qacc_warmstart_mut().copy_from_slice(&warmstart);
    physics.xpos_mut().copy_from_slice(&xpos);
}

/// The worst differences of whole episodes from their recorded start: within the horizon, and at all.
fn free_runs(recording: &Recording) -> (f64, f64) {
    let mut environment = recording.make().unwrap();
    let mut observation = vec![0.0; environment.spec().observation_dim()];
    let mut info = vec![0.0; environment.spec().info_dim()];
    let mut worst: (f64, f64) = (0.0, 0.0);
    for (episode, rows) in recording.episodes.iter().enumerate() {
        let start = [&rows[0].qpos[..], &rows[0].qvel, &rows[0].goal].concat();
        environment.restore(&start).unwrap();
        environment.observe(&mut observation).unwrap();
        assert_eq!(observation, rows[0].obs, "{}, start", recording.name);
        for (step, row) in rows.iter().enumerate().skip(1) {
            environment.read_info(&mut info);
            if !info.ends_with(&row.goal) {
                // A new goal was drawn: from the recording's generator, whose state we do not know.
                change_goal(environment.as_mut(), &row.goal);
            }
            let outcome = environment.step(&row.action, &mut observation).unwrap();
            let difference = step_difference(recording, row, &observation, &outcome);
            worst.1 = worst.1.max(difference);
            let place = format!("{}, episode {episode}, step {step}", recording.name);
            if step <= recording.horizon() {
                assert!(difference <= 1e-6, "{place}: {difference:e}");
                assert_eq!(outcome.terminated, row.terminated, "{place}");
                assert_eq!(outcome.success, row.success, "{place}");
                worst.0 = worst.0.max(difference);
            }
            assert_eq!(outcome.truncated, row.truncated, "{place}");
            if outcome.is_last() {
                break;
            }
        }
    }
    worst
}

#[test]
fn golden_single_steps_from_every_recorded_state() {
    for recording in Recording::all() {
        let worst = single_steps(&recording);
        println!("{}: {worst:e}", recording.name);
    }
}

#[test]
fn golden_free_runs() {
    let recordings = Recording::all();
    let differences: Vec<(f64, f64)> = recordings.iter().map(free_runs).collect();
    for (recording, (early, whole)) in recordings.iter().zip(&differences) {
        println!(
            "{}: {early:e} within the horizon, {whole:e} at all",
            recording.name
        );
    }
    let mut probes = (recordings.iter().zip(&differences))
        .filter(|(recording, _)| recording.is_probe())
        .peekable();
    if probes.peek().is_some() && probes.all(|(_, (_, whole))| *whole == 0.0) {
        for (recording, (_, whole)) in recordings.iter().zip(&differences) {
            // NumPy computes the norm and exponential of dense rewards in its own way.
            let tolerance = if recording.is_maze() { 1e-16 } else { 0.0 };
            assert!(*whole <= tolerance, "{}: {whole:e}", recording.name);
        }
    }
}
