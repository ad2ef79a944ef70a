//! Times stepping, for `benches/compare_peers.py`: `time_step ID KWARGS N_ENVIRONMENTS N_STEPS THREADS`.
//!
//! Every environment takes `N_STEPS` random actions, and is reset whenever an episode ends. Prints the seconds that
//! this took on the clock and of the processors (Linux; NaN elsewhere), observations and rewards included, models and
//! actions made before.

use std::error::Error;
use std::time::Instant;

use ksim_envs::numpy_rng::Generator;
use ksim_envs::registry::{EnvironmentRequest, make};
use ksim_envs::vector::{VectorEnvironment, VectorError};
use ksim_envs::{Environment, EnvironmentError, ResetOptions};

/// Steps whose actions are kept; they repeat after that.
const N_KEPT: usize = 100;

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [id, kwargs, n_environments, n_steps, threads] = arguments.as_slice() else {
        return Err("usage: time_step ID KWARGS N_ENVIRONMENTS N_STEPS THREADS".into());
    };
    let request = EnvironmentRequest {
        id: id.clone(),
        kwargs: serde_json::from_str(kwargs)?,
        max_episode_steps: Some(N_KEPT),
    };
    let n_environments: usize = n_environments.parse()?;
    let n_steps: usize = n_steps.parse()?;
    let environments: Result<Vec<Box<dyn Environment>>, EnvironmentError> =
        (0..n_environments).map(|_| make(&request)).collect();
    let mut environments = VectorEnvironment::new(environments?)?;
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads.parse()?)
        .build()?;
    pool.install(|| run(&mut environments, n_steps))?;
    let (start, busy) = (Instant::now(), processor_seconds());
    let total = pool.install(|| run(&mut environments, n_steps))?;
    let (seconds, busy) = (start.elapsed().as_secs_f64(), processor_seconds() - busy);
    // The sum is printed so that no reward goes uncomputed.
    print(seconds, busy, total);
    Ok(())
}

#[expect(clippy::print_stdout, reason = "this program's result")]
fn print(seconds: f64, processor_seconds: f64, total: f64) {
    println!("{seconds} {processor_seconds} {total}");
}

/// Seconds that this program's threads have run: on a machine that others use too, the clock says little.
fn processor_seconds() -> f64 {
    let threads = std::fs::read_dir("/proc/self/task").into_iter().flatten();
    let nanoseconds = threads.map(|thread| {
        let text = std::fs::read_to_string(thread.ok()?.path().join("schedstat")).ok()?;
        text.split_whitespace().next()?.parse::<f64>().ok()
    });
    let total: Option<f64> = nanoseconds.sum();
    total
        .filter(|total| *total > 0.0)
        .map_or(f64::NAN, |ns| ns * 1e-9)
}

fn run(environments: &mut VectorEnvironment, n_steps: usize) -> Result<f64, VectorError> {
    let options = ResetOptions::default();
    let slots: Vec<usize> = (0..environments.len()).collect();
    let width = environments.len() * environments.spec().action_dim();
    let mut generator = Generator::new(0);
    let actions: Vec<f64> = (0..N_KEPT * width)
        .map(|_| generator.uniform(-1.0, 1.0))
        .collect();
    for &slot in &slots {
        environments.reset(slot, Some(slot as u64), &options)?;
    }
    let mut total = 0.0;
    for actions in actions.chunks(width).cycle().take(n_steps) {
        environments.step(&slots, actions)?;
        for &slot in &slots {
            let outcome = environments.outcomes()[slot];
            total += outcome.reward;
            if outcome.is_last() {
                environments.reset(slot, None, &options)?;
            }
        }
    }
    Ok(total)
}
