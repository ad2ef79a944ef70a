//! Trainings on a toy's data.

#![allow(dead_code, reason = "no test uses all of it")]

use std::fs;
use std::path::Path;

use ksim_planners::{
    Candidates, LoadOptions, PlanRequest, PlannerError, Registry, TrainControl, TrainObserver,
    TrainProgress, TrainRequest, TrainSummary,
};
use serde_json::{Map, Value};

use crate::toy::Toy;

pub(crate) const FAMILIES: [&str; 3] = ["diffuser", "rediffuser", "curiosity-diffuser"];

pub(crate) fn table(value: Value) -> Map<String, Value> {
    value.as_object().unwrap().clone()
}

pub(crate) fn smoke() -> TrainRequest {
    TrainRequest {
        preset: Some("smoke".to_owned()),
        seed: 3,
        ..TrainRequest::default()
    }
}

pub(crate) fn train(
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

pub(crate) fn plan(family: &str, run: &Path, options: &LoadOptions, slots: &[usize]) -> Candidates {
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
pub(crate) struct Stopping(pub(crate) Vec<u64>);

impl TrainObserver for Stopping {
    fn progress(&mut self, progress: &TrainProgress<'_>) -> TrainControl {
        if self.0.contains(&progress.total_update) {
            TrainControl::Stop
        } else {
            TrainControl::Continue
        }
    }
}

pub(crate) fn contents(folder: &Path) -> Vec<(String, Vec<u8>)> {
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
