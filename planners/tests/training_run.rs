//! Trainings from a dataset to a planner: stopped and gone on with, with other settings, on data that does not fit.

#![cfg(feature = "native")]
#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

#[path = "support/toy.rs"]
mod toy;

use std::fs;
use std::path::{Path, PathBuf};

use ksim_planners::{
    Candidates, LoadOptions, PlanRequest, PlannerError, Registry, SilentObserver, TrainControl,
    TrainObserver, TrainProgress, TrainRequest, TrainSummary, run_info,
};
use serde_json::{Map, Value, json};
use toy::Toy;

const FAMILIES: [&str; 3] = ["diffuser", "rediffuser", "curiosity-diffuser"];

fn table(value: Value) -> Map<String, Value> {
    value.as_object().unwrap().clone()
}

fn smoke() -> TrainRequest {
    TrainRequest {
        preset: Some("smoke".to_owned()),
        seed: 3,
        ..TrainRequest::default()
    }
}

fn train(
    family: &str,
    request: &TrainRequest,
    toy: Toy,
    folder: &Path,
    observer: &mut dyn TrainObserver,
) -> Result<TrainSummary, PlannerError> {
    let data = toy.open(&folder.join("toy.parquet"));
    let registry = Registry::builtin();
    registry
        .family(family)?
        .train(request, data.as_ref(), &folder.join("run"), observer)
}

fn plan(family: &str, run: &Path, options: &LoadOptions, slots: &[usize]) -> Candidates {
    let registry = Registry::builtin();
    let mut planner = registry.family(family).unwrap().load(run, options).unwrap();
    let observation_dim = planner.spec().observation_dim;
    for &slot in slots {
        planner.reset(slot, 100 + slot as u64).unwrap();
    }
    let row = |slot: usize| (0..observation_dim).map(move |k| (slot as f64 + k as f64).sin());
    let observations: Vec<f64> = slots.iter().flat_map(|&slot| row(slot)).collect();
    let request = PlanRequest {
        slots,
        observations: &observations,
    };
    planner.plan(&request).unwrap()
}

/// Stops at given updates.
struct Stopping(Vec<u64>);

impl TrainObserver for Stopping {
    fn progress(&mut self, progress: &TrainProgress<'_>) -> TrainControl {
        if self.0.contains(&progress.total_update) {
            TrainControl::Stop
        } else {
            TrainControl::Continue
        }
    }
}

fn contents(folder: &Path) -> Vec<(String, Vec<u8>)> {
    let files = fs::read_dir(folder.join("run"))
        .unwrap()
        .map(|entry| entry.unwrap());
    let mut files: Vec<_> = files
        .map(|file| {
            (
                file.file_name().into_string().unwrap(),
                fs::read(file.path()).unwrap(),
            )
        })
        .collect();
    files.sort();
    files
}

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

/// The message of a training that fails, and what the run folder holds then.
fn refused(family: &str, request: &TrainRequest, toy: Toy, folder: &Path) -> String {
    let result = train(family, request, toy, folder, &mut SilentObserver);
    result
        .expect_err("a training that does not fit")
        .to_string()
}

#[test]
fn what_does_not_fit_is_refused_before_anything_is_written() {
    let with = |overrides: Value| TrainRequest {
        overrides: table(overrides),
        ..smoke()
    };
    let toy = Toy::default();
    let cases = [
        (
            with(json!({"diffusion": {"speed": 3}})),
            toy,
            "no setting \"diffusion.speed\"",
        ),
        (
            with(json!({"data": {"horizon": 6}})),
            toy,
            "\"data.horizon\" is 6",
        ),
        (
            with(json!({"data": {"horizon": 64}})),
            toy,
            "at least 64 steps",
        ),
        (
            with(json!({"diffusion": {"batch_size": 4096}})),
            toy,
            "at least 4096",
        ),
        (
            with(json!({"networks": {"model_dim": 8}})),
            toy,
            "\"networks.model_dim\" is 8",
        ),
        (
            with(json!({"data": {"horizon": "four"}})),
            toy,
            "\"data.horizon\" is \"four\" (invalid type",
        ),
        (
            with(json!({"diffusion": {"n_updates": "abc"}})),
            toy,
            "\"diffusion.n_updates\" is \"abc\"",
        ),
        (
            with(json!({"networks": {"model_dim": 65536}})),
            toy,
            "the number of parameters of a network",
        ),
        (
            smoke(),
            Toy {
                sparse: true,
                ..toy
            },
            "choose a preset for mazes",
        ),
        (
            smoke(),
            Toy {
                broken: true,
                ..toy
            },
            "NaN in episode 0, step 7",
        ),
        (
            with(json!({"data": {"rule": "goal"}})),
            toy,
            "expected 0 or 1",
        ),
    ];
    for (request, toy, expected) in cases {
        let folder = tempfile::tempdir().unwrap();
        let message = refused("diffuser", &request, toy, folder.path());
        assert!(message.contains(expected), "{message}");
        assert!(!folder.path().join("run").exists(), "{message}");
    }
    let folder = tempfile::tempdir().unwrap();
    let unknown = TrainRequest {
        preset: Some("huge".to_owned()),
        ..smoke()
    };
    let message = refused("diffuser", &unknown, toy, folder.path());
    assert!(
        message.contains("no preset \"huge\"") && message.contains("cpu"),
        "{message}"
    );
}

#[test]
fn another_run_is_not_gone_on_with() {
    let folder = tempfile::tempdir().unwrap();
    let toy = Toy::default();
    train(
        "diffuser",
        &smoke(),
        toy,
        folder.path(),
        &mut Stopping(vec![10]),
    )
    .unwrap();
    let before = contents(folder.path());
    let again = TrainRequest {
        resume: true,
        ..smoke()
    };
    let seed = TrainRequest {
        seed: 4,
        ..again.clone()
    };
    let width = Toy {
        observation_dim: 4,
        ..toy
    };
    let other = TrainRequest {
        overrides: table(json!({"diffusion": {"learning_rate": 1e-3}})),
        ..again.clone()
    };
    let cases = [
        ("diffuser", smoke(), toy, "empty, or a run to go on with"),
        (
            "rediffuser",
            again.clone(),
            toy,
            "the planner of the run is diffuser",
        ),
        ("diffuser", seed, toy, "the seed of the run is 3"),
        ("diffuser", again.clone(), width, "the dataset of the run"),
        (
            "diffuser",
            other,
            toy,
            "setting diffusion.learning_rate of the run is 0.0005",
        ),
    ];
    for (family, request, toy, expected) in cases {
        let message = refused(family, &request, toy, folder.path());
        assert!(message.contains(expected), "{message}");
    }
    assert!(contents(folder.path()) == before);
    let checkpoint = folder.path().join("run/checkpoint.safetensors");
    let bytes = fs::read(&checkpoint).unwrap();
    fs::write(&checkpoint, &bytes[..bytes.len() / 2]).unwrap();
    let message = refused("diffuser", &again, toy, folder.path());
    assert!(
        message.contains("checkpoint.safetensors: damaged"),
        "{message}"
    );
}

#[test]
fn a_loss_that_is_no_number_ends_the_training_and_keeps_the_checkpoint() {
    let folder = tempfile::tempdir().unwrap();
    let request = TrainRequest {
        overrides: table(json!({"diffusion": {"learning_rate": 1e18}})),
        checkpoint_interval: Some(1),
        ..smoke()
    };
    let message = refused("diffuser", &request, Toy::default(), folder.path());
    assert!(message.contains("is not finite in its update"), "{message}");
    assert!(
        message.contains("is kept in") && message.contains("checkpoint"),
        "{message}"
    );
    let before = contents(folder.path());
    let again = TrainRequest {
        resume: true,
        ..request
    };
    // What is kept is read, and ends as before.
    assert_eq!(
        refused("diffuser", &again, Toy::default(), folder.path()),
        message
    );
    assert!(contents(folder.path()) == before);
}

/// Weights that an update has made infinite.
#[test]
fn a_network_that_diverged_does_not_replace_a_checkpoint() {
    let [base, folder, new] = [(), (), ()].map(|()| tempfile::tempdir().unwrap());
    let toy = Toy::default();
    train("diffuser", &smoke(), toy, base.path(), &mut SilentObserver).unwrap();
    let request = TrainRequest {
        overrides: table(json!({"curiosity": {"learning_rate": 1e300}})),
        base: Some(base.path().join("run")),
        checkpoint_interval: Some(1),
        ..smoke()
    };
    let family = "curiosity-diffuser";
    let message = refused(family, &request, toy, folder.path());
    assert!(
        message.contains("of network \"curiosity-predictor\" is not finite after its update 1"),
        "{message}"
    );
    assert!(message.contains("is kept in"), "{message}");
    let before = contents(folder.path());
    let again = TrainRequest {
        resume: true,
        ..request
    };
    assert_eq!(refused(family, &again, toy, folder.path()), message);
    assert!(contents(folder.path()) == before);
    // Nothing is left of a training that never was finite.
    let request = TrainRequest {
        overrides: table(json!({"diffusion": {"learning_rate": 1e300}})),
        checkpoint_interval: Some(1),
        ..smoke()
    };
    let message = refused("diffuser", &request, toy, new.path());
    assert!(!message.contains("is kept in"), "{message}");
    let names: Vec<String> = contents(new.path())
        .into_iter()
        .map(|(name, _)| name)
        .collect();
    assert_eq!(names, ["manifest.json"]);
}

/// Replaces text in the header of a safetensors file.
fn edit(path: &Path, from: &str, to: &str) {
    let bytes = fs::read(path).unwrap();
    let (length, rest) = bytes.split_at(8);
    let length = usize::try_from(u64::from_le_bytes(length.try_into().unwrap())).unwrap();
    let header = std::str::from_utf8(&rest[..length]).unwrap();
    assert!(header.contains(from), "no {from} in {header}");
    let mut header = header.replacen(from, to, 1);
    header += &" ".repeat(header.len().next_multiple_of(8) - header.len());
    let mut bytes = (header.len() as u64).to_le_bytes().to_vec();
    bytes.extend(header.as_bytes());
    bytes.extend(&rest[length..]);
    fs::write(path, bytes).unwrap();
}

#[test]
fn a_checkpoint_that_makes_no_sense_is_refused_and_named() {
    let folder = tempfile::tempdir().unwrap();
    let toy = Toy::default();
    let family = "curiosity-diffuser";
    train(
        family,
        &smoke(),
        toy,
        folder.path(),
        &mut Stopping(vec![10]),
    )
    .unwrap();
    let path = folder.path().join("run/checkpoint.safetensors");
    let good = fs::read(&path).unwrap();
    let again = TrainRequest {
        resume: true,
        ..smoke()
    };
    for (from, to, expected) in [
        (
            r#"n_phases\":0"#,
            r#"n_phases\":7"#,
            "the number of phases done is 7, expected at most 2",
        ),
        (
            r#"n_phases\":0"#,
            r#"n_phases\":1"#,
            "a network is missing, expected \"diffusion\"",
        ),
        (
            r#"update\":10"#,
            r#"update\":24"#,
            "the number of updates is 24, expected at most 23",
        ),
        (
            r#"update\":10"#,
            r#"update\":9"#,
            "the number of updates of network \"diffusion\" is 10",
        ),
        (
            r#"reward\":5"#,
            r#"reward\":18446744073709551615"#,
            "of network \"reward\" is 184",
        ),
        (
            r#"learning\":{\"diffusion\":10,"#,
            r#"learning\":{"#,
            "a tensor is diffusion.",
        ),
    ] {
        edit(&path, from, to);
        let message = refused(family, &again, toy, folder.path());
        assert!(message.contains("checkpoint.safetensors"), "{message}");
        assert!(message.contains(expected), "{message}");
        fs::write(&path, &good).unwrap();
    }
    train(family, &again, toy, folder.path(), &mut SilentObserver).unwrap();
}

#[test]
fn a_base_belongs_to_its_run() {
    let [base, folder, other] = [(), (), ()].map(|()| tempfile::tempdir().unwrap());
    let toy = Toy::default();
    train("diffuser", &smoke(), toy, base.path(), &mut SilentObserver).unwrap();
    let seed = TrainRequest { seed: 4, ..smoke() };
    train("diffuser", &seed, toy, other.path(), &mut SilentObserver).unwrap();
    let family = "curiosity-diffuser";
    let request = TrainRequest {
        base: Some(base.path().join("run")),
        ..smoke()
    };
    train(
        family,
        &request,
        toy,
        folder.path(),
        &mut Stopping(vec![30]),
    )
    .unwrap();
    let again = |base: Option<PathBuf>| TrainRequest {
        base,
        resume: true,
        ..smoke()
    };
    let message = refused(
        family,
        &again(Some(other.path().join("run"))),
        toy,
        folder.path(),
    );
    assert!(message.contains("the base of the run"), "{message}");
    let message = refused(family, &again(Some("nowhere".into())), toy, folder.path());
    assert!(message.contains("nowhere: cannot read"), "{message}");
    let checkpoint = folder.path().join("run/checkpoint.safetensors");
    let bytes = fs::read(&checkpoint).unwrap();
    fs::remove_file(&checkpoint).unwrap();
    let message = refused(family, &again(None), toy, folder.path());
    assert!(
        message.contains("the checkpoint of a run that began with a base is missing"),
        "{message}"
    );
    fs::write(&checkpoint, bytes).unwrap();
    train(
        family,
        &again(request.base),
        toy,
        folder.path(),
        &mut SilentObserver,
    )
    .unwrap();
}

#[test]
fn the_file_of_a_planner_is_one_and_tells_whether_it_is_finished() {
    let folder = tempfile::tempdir().unwrap();
    let toy = Toy::default();
    train(
        "diffuser",
        &smoke(),
        toy,
        folder.path(),
        &mut Stopping(vec![10]),
    )
    .unwrap();
    let run = folder.path().join("run");
    let file = run.join("planner.safetensors");
    let info = run_info(&file).unwrap();
    assert_eq!((info.family.as_str(), info.finished), ("diffuser", false));
    assert_eq!(run_info(&run).unwrap(), info);
    let registry = Registry::builtin();
    registry.load(&file, &LoadOptions::default()).unwrap();
    fs::remove_file(run.join("manifest.json")).unwrap();
    let message = refused("diffuser", &smoke(), toy, folder.path());
    assert!(
        message.contains("a folder with planner.safetensors and without a manifest"),
        "{message}"
    );
    edit(&file, r#"action_dim\":2"#, r#"action_dim\":3"#);
    let load = |file: &Path| {
        let error = registry
            .load(file, &LoadOptions::default())
            .map(drop)
            .unwrap_err();
        let cause = std::error::Error::source(&error).map(ToString::to_string);
        format!("{error}: {}", cause.unwrap_or_default())
    };
    assert!(load(&file).contains("the number of bounds of actions"));
    edit(&file, r#"action_dim\":3"#, r#"action_dim\":2"#);
    edit(&file, r#"model_dim\":16"#, r#"model_dim\":32"#);
    let message = load(&file);
    assert!(
        message.contains("planner.safetensors: network \"diffusion\": tensor "),
        "{message}"
    );
    edit(
        &file,
        r#"n_candidates\":4"#,
        r#"n_candidates\":4611686018427387904"#,
    );
    assert!(load(&file).contains("planner.safetensors: setting \"planning.n_candidates\""));
}

#[test]
fn a_planner_of_another_family_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    train(
        "diffuser",
        &smoke(),
        Toy::default(),
        folder.path(),
        &mut SilentObserver,
    )
    .unwrap();
    let run = folder.path().join("run");
    let registry = Registry::builtin();
    let load = |family: &str, options: &LoadOptions| {
        let result = registry.family(family).unwrap().load(&run, options);
        result.map(|_| ()).expect_err("refused").to_string()
    };
    let message = load("rediffuser", &LoadOptions::default());
    assert!(
        message.contains("the planner is diffuser, expected rediffuser"),
        "{message}"
    );
    let curious = LoadOptions {
        curiosity_weight: Some(1.0),
        ..LoadOptions::default()
    };
    assert!(load("diffuser", &curious).contains("has no curiosity"));
    let none = LoadOptions {
        n_candidates: Some(0),
        ..LoadOptions::default()
    };
    assert!(load("diffuser", &none).contains("planning.n_candidates"));
    let many = LoadOptions {
        n_candidates: Some(1 << 32),
        ..LoadOptions::default()
    };
    assert!(load("diffuser", &many).contains("expected 1 to 65536"));
    let slow = LoadOptions {
        sampling_steps: Some(21),
        ..LoadOptions::default()
    };
    assert!(load("diffuser", &slow).contains("expected 1 to 20 (diffusion.n_timesteps)"));
    let file = run.join("planner.safetensors");
    let bytes = fs::read(&file).unwrap();
    fs::write(&file, &bytes[..bytes.len() - 9]).unwrap();
    assert!(load("diffuser", &LoadOptions::default()).contains("planner.safetensors: damaged"));
}

#[test]
fn requests_that_do_not_fit_are_refused() {
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
    let family = registry.family("diffuser").unwrap();
    let mut planner = family
        .load(&folder.path().join("run"), &LoadOptions::default())
        .unwrap();
    planner.reset(2, 0).unwrap();
    planner.reset(3, 0).unwrap();
    let mut ask = |slots: &[usize], observations: &[f64]| {
        let request = PlanRequest {
            slots,
            observations,
        };
        planner
            .plan(&request)
            .map(|_| ())
            .expect_err("refused")
            .to_string()
    };
    assert!(ask(&[2], &[0.0; 4]).contains("expected 3"));
    assert!(ask(&[3, 2], &[0.0; 6]).contains("ascending"));
    assert!(ask(&[2, 2], &[0.0; 6]).contains("ascending"));
    assert!(ask(&[1], &[0.0; 3]).contains("one that has been reset"));
    assert!(ask(&[2], &[0.0, f64::NAN, 0.0]).contains("NaN"));
    assert!(ask(&[2], &[0.0, 1e300, 0.0]).contains("1e300 in column 1"));
    let none = PlanRequest {
        slots: &[],
        observations: &[],
    };
    assert!(planner.plan(&none).unwrap().chosen.is_empty());
}
