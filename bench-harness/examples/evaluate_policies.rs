//! Plays networks in the environments that they were trained for, beside the returns recorded by who converted them.
//!
//! ```sh
//! cargo run --release --features mujoco --example evaluate_policies -- FOLDER [N_EPISODES]
//! ```
//!
//! `FOLDER` holds networks named `robot-algorithm.safetensors` and their `evaluation.json`. The seeds of the recorded
//! episodes are not known, so that means can only agree within their standard errors: `z` is their difference in these.
#![expect(clippy::print_stdout, reason = "an example prints")]

use std::path::{Path, PathBuf};

use ksim_bench_harness::HarnessError;
use ksim_bench_harness::policy::{self, PolicySpec};
use ksim_bench_harness::record::{EpisodeRecord, EpisodeTrace};
use ksim_bench_harness::rollout::{Continue, Observer, RolloutConfig, rollout};
use ksim_envs::ResetOptions;
use ksim_envs::registry::{EnvironmentRequest, make};
use ksim_envs::vector::VectorEnvironment;
use serde::Deserialize;

/// One row of `evaluation.json`.
#[derive(Deserialize)]
struct Recorded {
    algo: String,
    env: String,
    file: String,
    ver: String,
    stoch: bool,
    ret: f64,
    std: f64,
}

/// Keeps the numbers of episodes.
#[derive(Default)]
struct Keep(Vec<EpisodeRecord>);

impl Observer for Keep {
    fn episode(&mut self, trace: EpisodeTrace) -> Result<Continue, HarnessError> {
        self.0.push(trace.record);
        Ok(Continue::Yes)
    }
}

fn main() {
    let mut arguments = std::env::args().skip(1);
    let folder = PathBuf::from(arguments.next().expect("usage: FOLDER [N_EPISODES]"));
    let n_episodes = arguments
        .next()
        .map_or(10, |n| n.parse().expect("a number of episodes"));
    let text = std::fs::read(folder.join("evaluation.json")).expect("read evaluation.json");
    let recorded: Vec<Recorded> = serde_json::from_slice(&text).expect("parse evaluation.json");
    println!("| policy | environment | recorded | ours | z |\n|---|---|---|---|---|");
    let mut files: Vec<PathBuf> = std::fs::read_dir(&folder)
        .expect("read the folder")
        .map(|entry| entry.expect("read the folder").path())
        .filter(|path| path.extension().is_some_and(|e| e == "safetensors"))
        .collect();
    files.sort();
    for file in files {
        for row in recorded.iter().filter(|row| is_of(row, &file)) {
            evaluate(&file, row, n_episodes);
        }
    }
}

/// Whether a row is about this network: of several recorded per robot and algorithm, the header names the one.
fn is_of(row: &Recorded, file: &Path) -> bool {
    let bytes = std::fs::read(file).expect("read a network");
    let (_, metadata) = safetensors::SafeTensors::read_metadata(&bytes).expect("a network");
    let header = metadata.metadata().clone().unwrap_or_default();
    let source = header.get("source_path").map_or("", String::as_str);
    let name = format!("{}-{}", row.env.to_lowercase(), row.algo);
    source.ends_with(&format!("/{}", row.file)) && file.file_stem().is_some_and(|s| *s == *name)
}

fn evaluate(file: &Path, row: &Recorded, n_episodes: usize) {
    let request = EnvironmentRequest {
        id: format!("{}-{}", row.env, row.ver),
        ..EnvironmentRequest::default()
    };
    let one = || make(&request).expect("make the environment");
    let environments = (0..2 * rayon::current_num_threads()).map(|_| one());
    let mut environments = VectorEnvironment::new(environments.collect()).expect("equal ones");
    let spec = PolicySpec::Mlp {
        file: file.to_owned(),
        sample: row.stoch,
        noise: 0.0,
    };
    let mut policy = policy::build(&spec, environments.spec()).expect("read the network");
    let config = RolloutConfig {
        n_episodes,
        n_runs: 1,
        seed: 0,
        discount: 1.0,
        reset: ResetOptions::default(),
        reference: None,
    };
    let mut keep = Keep::default();
    rollout(&mut environments, policy.as_mut(), &config, &mut keep).expect("roll out");
    let (mean, std) = mean_and_std(&keep.0);
    let n_recorded = if row.stoch { 5.0 } else { 10.0 };
    let error = (row.std * row.std / n_recorded + std * std / n_episodes as f64).sqrt();
    println!(
        "| {} | {} | {:.1} ± {:.1} | {mean:.1} ± {std:.1} | {:+.1} |",
        policy.name(),
        request.id,
        row.ret,
        row.std,
        (mean - row.ret) / error
    );
}

/// Mean and standard deviation of returns.
fn mean_and_std(records: &[EpisodeRecord]) -> (f64, f64) {
    let n = records.len() as f64;
    let mean = records.iter().map(|r| r.total_return).sum::<f64>() / n;
    let squares = records.iter().map(|r| (r.total_return - mean).powi(2));
    (mean, (squares.sum::<f64>() / n).sqrt())
}
