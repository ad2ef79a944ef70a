//! Checkpoint files that the reference implementation's own code saved, against their contents.

#![allow(
    clippy::unwrap_used,
    reason = "a test that cannot read its files fails"
)]

mod support;

use std::path::{Path, PathBuf};

use ksim_planners::import::{
    ReferenceFiles, ReferenceNetworks, read_state_dicts, reference_networks,
};
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

fn networks(horizon: Option<usize>) -> Result<ReferenceNetworks, String> {
    let [diffusion, reward, predictor, target] = FILES.map(|(file, _)| golden(file));
    let files = ReferenceFiles {
        diffusion: &diffusion,
        reward: Some(&reward),
        rnd: Some((&predictor, &target)),
        horizon,
    };
    reference_networks(&files).map_err(|error| error.to_string())
}

#[test]
fn golden_pt_import_finds_the_networks() {
    let networks = networks(Some(HORIZON)).unwrap();
    let Architecture::Janner(diffusion) = &networks.diffusion.architecture else {
        panic!("{:?}", networks.diffusion.architecture)
    };
    assert_eq!((diffusion.width, diffusion.model_dim), (5, 16));
    assert_eq!((diffusion.kernel_size, diffusion.horizon), (5, HORIZON));
    assert_eq!(diffusion.dim_mult, [1, 2]);
    let name = "downs.0.0.conv1.0.weight";
    assert_ne!(
        networks.diffusion.weights.tensors[name],
        networks.diffusion.ema.tensors[name]
    );
    let reward = networks.reward.unwrap();
    assert_eq!(reward.architecture.output_len(), 1);
    let rnd = networks.rnd.unwrap();
    assert_eq!(rnd.predictor.architecture.output_len(), 64);
    let Architecture::HalfJanner(target) = &rnd.target else {
        panic!("{:?}", rnd.target)
    };
    assert_eq!((target.model_dim, target.embedding_dim), (8, 16));
    assert_eq!((target.out_dim, target.kernel_size), (64, 3));
}

#[test]
fn golden_pt_import_says_what_does_not_fit() {
    let open = networks(None).unwrap_err();
    assert!(
        open.ends_with("leave the horizon open (2 to 8): say which"),
        "{open}"
    );
    let long = networks(Some(16)).unwrap_err();
    assert!(
        long.ends_with("a network for horizons of 1 to 8, expected 16"),
        "{long}"
    );
    let [diffusion, reward, predictor, target] = FILES.map(|(file, _)| golden(file));
    let problem = |files: ReferenceFiles| reference_networks(&files).unwrap_err().to_string();
    let alone = ReferenceFiles {
        diffusion: &diffusion,
        reward: None,
        rnd: None,
        horizon: Some(HORIZON),
    };
    let swapped = problem(ReferenceFiles {
        diffusion: &reward,
        ..alone
    });
    assert!(
        swapped.contains("expected \"diffusion.\" before its name"),
        "{swapped}"
    );
    let wrong = problem(ReferenceFiles {
        reward: Some(&predictor),
        ..alone
    });
    assert!(wrong.contains("64 outputs, expected 1"), "{wrong}");
    let wrong = problem(ReferenceFiles {
        rnd: Some((&target, &predictor)),
        ..alone
    });
    assert!(wrong.contains("no \"model\" and \"model_ema\""), "{wrong}");
    let wrong = problem(ReferenceFiles {
        rnd: Some((&predictor, &predictor)),
        ..alone
    });
    assert!(wrong.contains("is it the predictor?"), "{wrong}");
}
