//! The reference's checkpoint files become a run that plans.

#![cfg(feature = "native")]
#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

mod support;
#[path = "support/torch_save.rs"]
mod torch_save;
#[path = "support/toy.rs"]
mod toy;

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use ksim_planners::import::{ReferenceImport, import_run};
use ksim_planners::nets::{Architecture, MlpConfig, Weights, initial_weights};
use ksim_planners::{
    LoadOptions, PlanRequest, Registry, SilentObserver, TrainRequest, model::PlannerFile,
};
use serde_json::{Value, json};
use support::{folders, read_tensors};
use torch_save::{StateDict, torch_save};
use toy::Toy;

/// Steps in a window of the tiny configuration, whose rows have the toy robot's three observations and two actions.
const HORIZON: usize = 8;
const PRESET: &str = "paper-hopper-medium-expert";
const DIFFUSION: &str = "ckpt_tiny_diffusion.pt";
const REWARD: &str = "ckpt_tiny_classifier.pt";
const PREDICTOR: &str = "ckpt_tiny_rnd_classifier.pt";
const TARGET: &str = "ckpt_tiny_rnd_classifier_target.pt";

fn golden(names: &[&str]) -> Vec<PathBuf> {
    let folder = &folders()[0];
    names.iter().map(|name| folder.path(name)).collect()
}

fn import(files: &[PathBuf], horizon: Option<usize>, folder: &Path) -> Result<(), String> {
    let data = Toy::default().open(&folder.join("toy.parquet"));
    let import = ReferenceImport {
        files,
        preset: PRESET,
        horizon,
    };
    let imported = import_run(&import, &*data, &folder.join("run"));
    imported.map(|_| ()).map_err(|error| error.to_string())
}

/// Actions of a plan of two slots.
fn plan(run: &Path) -> Vec<f32> {
    let options = LoadOptions {
        n_candidates: Some(4),
        ..LoadOptions::default()
    };
    let mut planner = Registry::builtin().load(run, &options).unwrap();
    for slot in [0, 1] {
        planner.reset(slot, 3).unwrap();
    }
    let request = PlanRequest {
        slots: &[0, 1],
        observations: &[0.1, -0.2, 0.3, 0.5, 0.0, -0.5],
    };
    let plan = planner.plan(&request).unwrap();
    assert!(plan.scores.iter().all(|score| score.is_finite()));
    plan.actions
}

#[test]
fn golden_files_become_a_run_that_plans() {
    let folder = tempfile::tempdir().unwrap();
    let files = golden(&[TARGET, REWARD, DIFFUSION, PREDICTOR]);
    import(&files, Some(HORIZON), folder.path()).unwrap();
    let run = folder.path().join("run");

    // The moving averages, number by number.
    let mut found = read_tensors(&run.join("planner.safetensors"));
    found.retain(|name, _| !name.starts_with("normalizer."));
    let expected = &golden(&["ckpt_tiny_expected.safetensors"])[0];
    let expected: BTreeMap<String, _> = read_tensors(expected)
        .into_iter()
        .filter_map(|(name, stored)| {
            let (file, rest) = name.split_once('.')?;
            let (network, rest) = match file {
                "diffusion" => ("diffusion", rest.strip_prefix("model_ema.diffusion.")?),
                "classifier" => ("reward", rest.strip_prefix("model_ema.")?),
                "rnd" => ("curiosity-predictor", rest.strip_prefix("model_ema.")?),
                _ => ("curiosity-target", rest),
            };
            Some((format!("{network}.{rest}"), stored))
        })
        .collect();
    assert!(found.keys().eq(expected.keys()));
    for (name, stored) in &expected {
        assert_eq!(found[name].shape, stored.shape, "{name}");
        assert!(found[name].values == stored.values, "{name}");
    }

    let manifest: Value =
        serde_json::from_str(&fs::read_to_string(run.join("manifest.json")).unwrap()).unwrap();
    assert_eq!(manifest["family"], "curiosity-diffuser");
    assert_eq!(manifest["preset"], PRESET);
    assert_eq!(manifest["config"]["mode"], "reference");
    assert_eq!(manifest["config"]["data"]["horizon"], HORIZON);
    assert_eq!(
        manifest["config"]["networks"],
        json!({
            "model_dim": 16,
            "embedding_dim": 16,
            "dim_mult": [1, 2],
            "kernel_size": 5,
            "classifier_kernel_size": 3,
        })
    );
    let hash = blake3::hash(&fs::read(&files[1]).unwrap()).to_hex();
    let reward = json!({"network": "reward", "file": REWARD, "blake3": hash.as_str()});
    assert_eq!(manifest["imported"][3], reward);

    // Others may read them as any file of the user's.
    let plain = folder.path().join("plain");
    fs::write(&plain, "").unwrap();
    let permissions = |path: &Path| fs::metadata(path).unwrap().permissions();
    for entry in fs::read_dir(&run).unwrap() {
        assert_eq!(permissions(&entry.unwrap().path()), permissions(&plain));
    }

    let actions = plan(&run);
    assert_eq!(actions.len(), 2 * 4 * HORIZON * 2);
    assert!(actions.iter().all(|action| action.abs() <= 1.0));
    assert_eq!(actions, plan(&run));

    let again = import(&files, Some(HORIZON), folder.path()).unwrap_err();
    assert!(again.contains("the folder of another run"), "{again}");
}

/// The statistics are those that a training on the dataset takes.
#[test]
fn golden_import_is_a_base_of_a_training() {
    let folder = tempfile::tempdir().unwrap();
    import(&golden(&[DIFFUSION, REWARD]), Some(HORIZON), folder.path()).unwrap();
    let base = folder.path().join("run");
    let overrides = json!({
        "mode": "reference",
        "data": {"horizon": HORIZON},
        "networks": {"model_dim": 16, "embedding_dim": 16, "dim_mult": [1, 2]},
        "curiosity": {"n_updates": 2, "batch_size": 4},
    });
    let request = TrainRequest {
        preset: Some(PRESET.to_owned()),
        overrides: overrides.as_object().unwrap().clone(),
        base: Some(base.clone()),
        ..TrainRequest::default()
    };
    let registry = Registry::builtin();
    let data = Toy::default().open(&folder.path().join("again.parquet"));
    let family = registry.family("curiosity-diffuser").unwrap();
    let run = folder.path().join("curious");
    family
        .train(&request, &*data, &run, &mut SilentObserver)
        .unwrap();
    let read = |run: &Path, family| PlannerFile::read(&PlannerFile::path(run), family).unwrap();
    let (imported, trained) = (read(&base, "diffuser"), read(&run, "curiosity-diffuser"));
    assert_eq!(imported.normalizer, trained.normalizer);
    assert_eq!(
        imported.networks["diffusion"],
        trained.networks["diffusion"]
    );

    let request = TrainRequest {
        resume: true,
        base: None,
        ..request
    };
    let error = family.train(&request, &*data, &base, &mut SilentObserver);
    let error = error.unwrap_err().to_string();
    assert!(error.contains("hold no state of a training"), "{error}");
}

#[test]
fn golden_import_refuses_what_does_not_go_together() {
    let cases: [(&[&str], Option<usize>, &str); 4] = [
        (&[DIFFUSION], Some(HORIZON), "the network \"reward\""),
        (
            &[DIFFUSION, REWARD],
            None,
            "horizons of 1 to 8, expected 32",
        ),
        (&[DIFFUSION, REWARD], Some(6), "power of two"),
        (&[REWARD], Some(HORIZON), "the network \"diffusion\""),
    ];
    for (names, horizon, expected) in cases {
        let folder = tempfile::tempdir().unwrap();
        let error = import(&golden(names), horizon, folder.path()).unwrap_err();
        assert!(error.contains(expected), "{error}, expected {expected}");
        assert!(!folder.path().join("run").exists());
    }
    let folder = tempfile::tempdir().unwrap();
    let wide = Toy {
        observation_dim: 4,
        ..Toy::default()
    };
    let data = wide.open(&folder.path().join("toy.parquet"));
    let import = |preset| {
        let import = ReferenceImport {
            files: &golden(&[DIFFUSION, REWARD]),
            preset,
            horizon: Some(HORIZON),
        };
        let imported = import_run(&import, &*data, &folder.path().join("run"));
        imported.unwrap_err().to_string()
    };
    let error = import(PRESET);
    assert!(error.contains("is 6 (4 and 2), expected 5"), "{error}");
    let error = import("paper");
    assert!(error.contains("no preset \"paper\""), "{error}");
}

/// ReDiffuser's networks, for windows of so many numbers.
fn confidence(in_dim: usize, file: PathBuf) -> (PathBuf, [Weights; 2]) {
    let architecture = Architecture::Mlp(MlpConfig {
        in_dim,
        hidden: vec![12, 10],
        out_dim: 7,
    });
    let weights = [5, 6].map(|seed| initial_weights(&architecture, seed).unwrap());
    let half = |prefix, weights| StateDict {
        under: "",
        prefix,
        weights,
    };
    let halves = [
        half("predictor.", &weights[0]),
        half("target.", &weights[1]),
    ];
    fs::write(&file, torch_save(&halves)).unwrap();
    (file, weights)
}

#[test]
fn golden_files_with_a_confidence_become_rediffuser() {
    let folder = tempfile::tempdir().unwrap();
    let (file, [predictor, target]) = confidence(HORIZON * 5, folder.path().join("rnd.pt"));
    let mut files = golden(&[DIFFUSION, REWARD]);
    files.push(file);
    import(&files, Some(HORIZON), folder.path()).unwrap();
    let run = folder.path().join("run");
    let planner = PlannerFile::read(&PlannerFile::path(&run), "rediffuser").unwrap();
    assert_eq!(planner.networks["confidence-predictor"], predictor);
    assert_eq!(planner.networks["confidence-target"], target);
    plan(&run);

    files.extend(golden(&[PREDICTOR, TARGET]));
    let other = tempfile::tempdir().unwrap();
    let error = import(&files, Some(HORIZON), other.path()).unwrap_err();
    assert!(error.contains("expected those of one planner"), "{error}");
    let mut files = golden(&[DIFFUSION, REWARD]);
    files.push(confidence(16 * 5, folder.path().join("long.pt")).0);
    let error = import(&files, Some(HORIZON), other.path()).unwrap_err();
    assert!(error.contains("horizons of 16, expected 8"), "{error}");
}
