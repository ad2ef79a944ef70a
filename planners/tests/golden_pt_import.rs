//! Checkpoint files that the reference implementation's own code saved, against their contents.

#![allow(
    clippy::unwrap_used,
    reason = "a test that cannot read its files fails"
)]

mod support;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use ksim_planners::import::{ImportedNetwork, read_state_dicts, reference_networks};
use ksim_planners::model::network;
use ksim_planners::nets::{Architecture, Weights};
use support::{Stored, read_tensors};

/// Under which name `ckpt_tiny_expected` has the contents of a file.
const FILES: [(&str, &str); 4] = [
    ("ckpt_tiny_diffusion.pt", "diffusion"),
    ("ckpt_tiny_classifier.pt", "classifier"),
    ("ckpt_tiny_rnd_classifier.pt", "rnd"),
    ("ckpt_tiny_rnd_classifier_target.pt", "rnd_target"),
];
/// Steps in a window of the tiny configuration.
const HORIZON: usize = 8;

fn golden(name: &str) -> PathBuf {
    let root = match std::env::var_os("KSIM_GOLDEN") {
        Some(root) => PathBuf::from(root).join("planners"),
        None => Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/golden/planners"),
    };
    root.join(name)
}

#[test]
fn golden_pt_import_reads_every_number() {
    let mut expected = read_tensors(&golden("ckpt_tiny_expected.safetensors"));
    for (file, prefix) in FILES {
        let found = read_state_dicts(&golden(file)).unwrap();
        let mut compare = |weights: &Weights, under: &str| {
            assert!(!weights.tensors.is_empty(), "{file} {under}");
            for (name, tensor) in &weights.tensors {
                let name = format!("{under}.{name}");
                let Stored { shape, values } = expected.remove(&name).unwrap();
                assert_eq!(tensor.shape, shape, "{name}");
                assert_eq!(tensor.values, values, "{name}");
            }
        };
        match found.model_ema {
            Some(ema) => {
                compare(&found.model, &format!("{prefix}.model"));
                compare(&ema, &format!("{prefix}.model_ema"));
            }
            None => compare(&found.model, prefix),
        }
    }
    let left: Vec<&String> = expected.keys().collect();
    assert!(left.is_empty(), "not read: {left:?}");
}

fn networks(
    files: &[&str],
    horizon: Option<usize>,
) -> Result<BTreeMap<&'static str, ImportedNetwork>, String> {
    let paths: Vec<PathBuf> = files.iter().map(|file| golden(file)).collect();
    reference_networks(&paths, horizon).map_err(|error| error.to_string())
}

#[test]
fn golden_pt_import_finds_the_networks() {
    // In any order.
    let files = [FILES[3].0, FILES[2].0, FILES[0].0, FILES[1].0];
    let networks = networks(&files, Some(HORIZON)).unwrap();
    let names: Vec<&str> = networks.keys().copied().collect();
    let expected = [
        network::CURIOSITY_PREDICTOR,
        network::CURIOSITY_TARGET,
        network::DIFFUSION,
        network::REWARD,
    ];
    assert_eq!(names, expected);
    let unet = &networks[network::DIFFUSION];
    assert!(unet.path.ends_with("ckpt_tiny_diffusion.pt"));
    let Architecture::Janner(diffusion) = &unet.architecture else {
        panic!("{:?}", unet.architecture)
    };
    assert_eq!((diffusion.width, diffusion.model_dim), (5, 16));
    assert_eq!((diffusion.kernel_size, diffusion.horizon), (5, HORIZON));
    assert_eq!(diffusion.dim_mult, [1, 2]);
    let name = "downs.0.0.conv1.0.weight";
    assert_ne!(unet.weights.tensors[name], unet.ema.tensors[name]);
    let outputs = |name| networks[name].architecture.output_len();
    assert_eq!(outputs(network::REWARD), 1);
    assert_eq!(outputs(network::CURIOSITY_PREDICTOR), 64);
    let Architecture::HalfJanner(target) = &networks[network::CURIOSITY_TARGET].architecture else {
        panic!("{networks:?}")
    };
    assert_eq!((target.model_dim, target.embedding_dim), (8, 16));
    assert_eq!((target.out_dim, target.kernel_size), (64, 3));
}

#[test]
fn golden_pt_import_says_what_does_not_fit() {
    let [diffusion, reward, predictor, target] = FILES.map(|(file, _)| file);
    let all = [diffusion, reward, predictor, target];
    let cases: [(&[&str], Option<usize>, &str); 6] = [
        (&all, None, "leave the horizon open (2 to 8): say which"),
        (&all, Some(16), "horizons of 1 to 8, expected 16"),
        (
            &[reward, predictor],
            Some(HORIZON),
            "none of the files holds the network \"diffusion\"",
        ),
        (
            &[diffusion, predictor],
            Some(HORIZON),
            "none of the files holds the network \"curiosity-target\"",
        ),
        (
            &[diffusion, target],
            Some(HORIZON),
            "none of the files holds the network \"curiosity-predictor\"",
        ),
        (
            &[diffusion, reward, reward],
            Some(HORIZON),
            "a second network \"reward\", beside",
        ),
    ];
    for (files, horizon, expected) in cases {
        let found = networks(files, horizon).unwrap_err();
        assert!(found.contains(expected), "{found}, expected {expected}");
    }
}
