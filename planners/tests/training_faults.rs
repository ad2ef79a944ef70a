//! Trainings and planners that are refused, and what is left of runs that fail.

#![cfg(feature = "native")]
#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

#[path = "support/toy.rs"]
mod toy;
#[path = "support/training.rs"]
mod training;

use std::fs;
use std::path::{Path, PathBuf};

use ksim_planners::{LoadOptions, PlanRequest, Registry, SilentObserver, TrainRequest, run_info};
use serde_json::{Value, json};
use toy::Toy;
use training::{Stopping, contents, smoke, table, train};

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
            "for a maze choose a preset",
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
