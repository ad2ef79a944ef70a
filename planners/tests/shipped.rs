//! The trained planners that come with the repository do what every planner must.
#![cfg(feature = "native")]

use std::path::{Path, PathBuf};

use ksim_planners::{LoadOptions, Precision, Registry, conformance};

fn shipped() -> Vec<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../examples/planners");
    let entries = std::fs::read_dir(folder).expect("the folder is there");
    let mut runs: Vec<PathBuf> = entries
        .map(|entry| entry.expect("an entry").path())
        .collect();
    runs.retain(|path| path.is_dir());
    runs.sort();
    runs
}

#[test]
fn shipped_planners_load_and_plan() {
    let runs = shipped();
    assert!(!runs.is_empty());
    for run in runs {
        // Few candidates and many take different ways through the networks.
        for (n_candidates, precision) in [
            (1, Precision::F32),
            (1, Precision::Bf16),
            (3, Precision::F32),
            (5, Precision::F32),
        ] {
            let options = LoadOptions {
                n_candidates: Some(n_candidates),
                precision,
                ..LoadOptions::default()
            };
            let make = || Registry::builtin().load(&run, &options).unwrap();
            let width = make().spec().observation_dim;
            let observations: Vec<f64> = (0..9 * width).map(|at| 0.3 * (at as f64).sin()).collect();
            conformance::check(&make, &observations);
        }
    }
}
