//! Trainings from a dataset to a planner: stopped and gone on with, with other settings, on data that does not fit.

#![cfg(feature = "native")]
#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

#[path = "support/toy.rs"]
mod toy;
#[path = "support/training.rs"]
mod training;

use ksim_planners::{
    LoadOptions, PlanRequest, Registry, SilentObserver, TrainControl, TrainObserver, TrainProgress,
    TrainRequest,
};
use serde_json::json;
use toy::Toy;
use training::{FAMILIES, Stopping, contents, plan, smoke, table, train};

#[test]
fn a_run_that_was_stopped_ends_with_the_same_bytes() {
    for family in FAMILIES {
        let [whole, broken] = [(), ()].map(|()| tempfile::tempdir().unwrap());
        let mut request = smoke();
        let summary = train(
            family,
            &request,
            Toy::default(),
            whole.path(),
            &mut SilentObserver,
        )
        .unwrap();
        assert!(summary.finished);
        // In the middle of the first phase, between two checkpoints, at its end, and in the last phase of two.
        let mut stops = Stopping(vec![5, 13, 24, 30]);
        let mut n_sessions = 0;
        loop {
            let summary =
                train(family, &request, Toy::default(), broken.path(), &mut stops).unwrap();
            n_sessions += 1;
            request.resume = true;
            if summary.finished {
                break;
            }
        }
        assert_eq!(n_sessions, if family == "diffuser" { 3 } else { 5 });
        let (found, expected) = (contents(broken.path()), contents(whole.path()));
        assert_eq!(found.len(), expected.len(), "{family}");
        for (found, expected) in found.iter().zip(&expected) {
            assert_eq!(found.0, expected.0);
            assert!(found.1 == expected.1, "{family}: {} differs", found.0);
        }
    }
}

#[test]
fn threads_change_nothing() {
    let folders = [1, 2].map(|n_threads| {
        let folder = tempfile::tempdir().unwrap();
        let request = TrainRequest {
            n_threads: Some(n_threads),
            ..smoke()
        };
        train(
            "diffuser",
            &request,
            Toy::default(),
            folder.path(),
            &mut SilentObserver,
        )
        .unwrap();
        folder
    });
    assert!(contents(folders[0].path()) == contents(folders[1].path()));
}

#[test]
fn without_curiosity_it_is_diffuser_bit_for_bit() {
    let [diffuser, curiosity] = [(), ()].map(|()| tempfile::tempdir().unwrap());
    train(
        "diffuser",
        &smoke(),
        Toy::default(),
        diffuser.path(),
        &mut SilentObserver,
    )
    .unwrap();
    let base = diffuser.path().join("run");
    let request = TrainRequest {
        base: Some(base.clone()),
        ..smoke()
    };
    let family = "curiosity-diffuser";
    let summary = train(
        family,
        &request,
        Toy::default(),
        curiosity.path(),
        &mut SilentObserver,
    )
    .unwrap();
    // The first phase was taken over.
    let losses: Vec<&str> = summary
        .final_losses
        .iter()
        .map(|(name, _)| name.as_str())
        .collect();
    assert_eq!(losses, ["curiosity-predictor"]);
    let expected = plan("diffuser", &base, &LoadOptions::default(), &[0, 4]);
    let with = |weight| LoadOptions {
        curiosity_weight: Some(weight),
        ..LoadOptions::default()
    };
    let run = curiosity.path().join("run");
    assert_eq!(plan(family, &run, &with(0.0), &[0, 4]), expected);
    let curious = plan(family, &run, &with(1e4), &[0, 4]);
    assert_ne!(curious.actions, expected.actions);
    assert_eq!(curious.novelties.len(), curious.scores.len());
}

#[test]
fn guidance_by_curiosity_lowers_novelty() {
    let folder = tempfile::tempdir().unwrap();
    let family = "curiosity-diffuser";
    train(
        family,
        &smoke(),
        Toy::default(),
        folder.path(),
        &mut SilentObserver,
    )
    .unwrap();
    let novelty = |guidance_weight, curiosity_weight| {
        let options = LoadOptions {
            guidance_weight: Some(guidance_weight),
            curiosity_weight: Some(curiosity_weight),
            n_candidates: Some(16),
            ..LoadOptions::default()
        };
        let slots: Vec<usize> = (0..8).collect();
        let novelties = plan(family, &folder.path().join("run"), &options, &slots).novelties;
        novelties.iter().sum::<f64>() / novelties.len() as f64
    };
    // Without guidance curiosity is measured only.
    let (free, guided) = (novelty(0.0, 10.0), novelty(0.01, 10.0));
    assert!(guided < free, "{guided} is not below {free}");
}

#[test]
fn a_plan_does_not_depend_on_those_beside_it() {
    for family in FAMILIES {
        let folder = tempfile::tempdir().unwrap();
        train(
            family,
            &smoke(),
            Toy::default(),
            folder.path(),
            &mut SilentObserver,
        )
        .unwrap();
        let run = folder.path().join("run");
        let options = LoadOptions::default();
        let together = plan(family, &run, &options, &[0, 1, 5]);
        for (at, slot) in [0, 1, 5].into_iter().enumerate() {
            let alone = plan(family, &run, &options, &[slot]);
            let part = alone.actions.len();
            assert_eq!(
                alone.actions,
                together.actions[at * part..(at + 1) * part],
                "{family}"
            );
            assert_eq!(alone.chosen[0], together.chosen[at], "{family}");
        }
        let more = LoadOptions {
            n_candidates: Some(9),
            ..LoadOptions::default()
        };
        let more = plan(family, &run, &more, &[1]);
        let part = together.actions.len() / 3;
        assert_eq!(
            more.actions[..part],
            together.actions[part..2 * part],
            "{family}"
        );
    }
}

#[test]
fn a_warm_start_stays_near_the_plan_before() {
    let folder = tempfile::tempdir().unwrap();
    train(
        "diffuser",
        &smoke(),
        Toy::default(),
        folder.path(),
        &mut SilentObserver,
    )
    .unwrap();
    let registry = Registry::builtin();
    let options = LoadOptions {
        warm_start: Some(0.3),
        sampling_steps: Some(10),
        n_candidates: Some(1),
        ..LoadOptions::default()
    };
    let family = registry.family("diffuser").unwrap();
    let mut planner = family.load(&folder.path().join("run"), &options).unwrap();
    planner.reset(0, 1).unwrap();
    let request = PlanRequest {
        slots: &[0],
        observations: &[0.1, 0.2, 0.3],
    };
    let first = planner.plan(&request).unwrap().actions;
    let second = planner.plan(&request).unwrap().actions;
    planner.reset(0, 2).unwrap();
    let other = planner.plan(&request).unwrap().actions;
    // One step later: the second action of the plan before is the first of this one.
    let distance = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).sum::<f32>();
    assert!(distance(&second[..4], &first[2..6]) < distance(&other[..4], &first[2..6]));
}

#[test]
fn the_original_confidence_trains_on_generated_plans() {
    let folder = tempfile::tempdir().unwrap();
    let request = TrainRequest {
        overrides: table(json!({
            "confidence": {"rule": "plans", "hidden": [32, 16], "target_hidden": [32]}
        })),
        ..smoke()
    };
    train(
        "rediffuser",
        &request,
        Toy::default(),
        folder.path(),
        &mut SilentObserver,
    )
    .unwrap();
    let run = folder.path().join("run");
    let candidates = plan("rediffuser", &run, &LoadOptions::default(), &[0]);
    assert_eq!(candidates.novelties.len(), 4);
    assert!(candidates.novelties.iter().all(|novelty| *novelty > 0.0));
    // Stopped while plans are made, it goes on to the same bytes.
    let broken = tempfile::tempdir().unwrap();
    let stopped = train(
        "rediffuser",
        &request,
        Toy::default(),
        broken.path(),
        &mut Impatient,
    );
    let stopped = stopped.unwrap();
    assert_eq!((stopped.finished, stopped.total_update), (false, 24));
    let request = TrainRequest {
        resume: true,
        ..request
    };
    train(
        "rediffuser",
        &request,
        Toy::default(),
        broken.path(),
        &mut SilentObserver,
    )
    .unwrap();
    assert!(contents(broken.path()) == contents(folder.path()));
}

/// Stops as soon as something is prepared.
struct Impatient;

impl TrainObserver for Impatient {
    fn progress(&mut self, _: &TrainProgress<'_>) -> TrainControl {
        TrainControl::Continue
    }

    fn preparing(&mut self, _: &str, done: u64, _: u64) -> TrainControl {
        match done {
            0 => TrainControl::Continue,
            _ => TrainControl::Stop,
        }
    }
}

#[test]
fn mode_reference_trains_and_plans() {
    let folder = tempfile::tempdir().unwrap();
    let request = TrainRequest {
        overrides: table(json!({"mode": "reference"})),
        ..smoke()
    };
    train(
        "curiosity-diffuser",
        &request,
        Toy::default(),
        folder.path(),
        &mut SilentObserver,
    )
    .unwrap();
    let run = folder.path().join("run");
    let candidates = plan("curiosity-diffuser", &run, &LoadOptions::default(), &[0]);
    assert_eq!(candidates.actions.len(), 4 * 4 * 2);
    assert!(
        candidates
            .actions
            .iter()
            .all(|action| (-1.0..=1.0).contains(action))
    );
}
