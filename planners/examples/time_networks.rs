//! Milliseconds of a guided plan (20 steps of the U-Net and of the reward and novelty networks with their gradients)
//! and of training updates, by the native backend. Weights are random: they do not change the time.
//!
//! `cargo run --release -p ksim-planners --example time_networks -- [CONFIG] [plan|update] [bf16] [horizon=N]`, with
//! CONFIG one of hopper, walker2d, halfcheetah, antmaze; `bf16` plans with rounded weights. Wall time is the least of
//! several runs; CPU time is the mean over all of them and all threads (Linux; in steps of 10 ms over all runs), which
//! says more on a machine that is not idle.
#![expect(clippy::print_stdout, reason = "an example that prints a table")]

use std::time::Instant;

use ksim_planners::native::NativeBackend;
use ksim_planners::nets::{
    Adam, Architecture, Backend, HalfJannerConfig, JannerConfig, Network, TimestepEmbedding,
    TrainableNetwork, TrainingState, initial_weights,
};
use ksim_planners::{PlannerError, Precision};

const STEPS: usize = 20;

struct Config {
    name: &'static str,
    horizon: usize,
    width: usize,
    model_dim: usize,
    dim_mult: &'static [usize],
}

const CONFIGS: [Config; 4] = [
    Config {
        name: "hopper",
        horizon: 32,
        width: 14,
        model_dim: 32,
        dim_mult: &[1, 2, 2, 2],
    },
    Config {
        name: "walker2d",
        horizon: 32,
        width: 23,
        model_dim: 32,
        dim_mult: &[1, 2, 2, 2],
    },
    Config {
        name: "halfcheetah",
        horizon: 4,
        width: 23,
        model_dim: 32,
        dim_mult: &[1, 4, 2],
    },
    Config {
        name: "antmaze",
        horizon: 64,
        width: 39,
        model_dim: 64,
        dim_mult: &[1, 2, 2, 2],
    },
];

impl Config {
    fn unet(&self) -> Architecture {
        Architecture::Janner(JannerConfig {
            horizon: self.horizon,
            width: self.width,
            model_dim: self.model_dim,
            embedding_dim: self.model_dim,
            dim_mult: self.dim_mult.to_vec(),
            kernel_size: 5,
            embedding: TimestepEmbedding::Sinusoidal,
        })
    }

    fn half(&self, out_dim: usize, model_dim: usize, dim_mult: &[usize]) -> Architecture {
        Architecture::HalfJanner(HalfJannerConfig {
            horizon: self.horizon,
            width: self.width,
            out_dim,
            model_dim,
            embedding_dim: self.model_dim,
            dim_mult: dim_mult.to_vec(),
            kernel_size: 3,
            embedding: TimestepEmbedding::Sinusoidal,
        })
    }

    fn reward(&self) -> Architecture {
        self.half(1, self.model_dim, self.dim_mult)
    }

    fn predictor(&self) -> Architecture {
        self.half(64, self.model_dim, self.dim_mult)
    }

    fn target(&self) -> Architecture {
        self.half(64, self.model_dim / 2, &[1, 2])
    }
}

fn network(
    backend: &dyn Backend,
    architecture: &Architecture,
) -> Result<Box<dyn Network>, PlannerError> {
    backend.network(architecture, &initial_weights(architecture, 1)?)
}

/// The networks of a guided step.
struct Guided {
    unet: Box<dyn Network>,
    classifiers: [Box<dyn Network>; 3],
}

impl Guided {
    fn new(backend: &dyn Backend, config: &Config) -> Result<Self, PlannerError> {
        Ok(Self {
            unet: network(backend, &config.unet())?,
            classifiers: [
                network(backend, &config.reward())?,
                network(backend, &config.predictor())?,
                network(backend, &config.target())?,
            ],
        })
    }

    /// A step for `n` windows. The U-Net, the value and the novelty do not wait for each other.
    fn step(&mut self, x: &[f32], t: f32, n: usize) -> Result<(), PlannerError> {
        let times = vec![t; n];
        let mut prediction = vec![0.0; x.len()];
        let unet = &mut self.unet;
        let [reward, predictor, target] = &mut self.classifiers;
        let (plain, (value, novelty)) = rayon::join(
            || unet.forward(x, &times, false, &mut prediction),
            || {
                rayon::join(
                    || guide(reward.as_mut(), x, &times),
                    || {
                        guide(predictor.as_mut(), x, &times)?;
                        guide(target.as_mut(), x, &times)
                    },
                )
            },
        );
        plain.and(value).and(novelty)
    }
}

/// Outputs of a network and a gradient by its input.
fn guide(network: &mut dyn Network, x: &[f32], times: &[f32]) -> Result<(), PlannerError> {
    let mut out = vec![0.0; times.len() * network.architecture().output_len()];
    let mut gradient = vec![0.0; x.len()];
    network.forward(x, times, true, &mut out)?;
    network.input_gradient(&out, &mut gradient)
}

fn numbers(n: usize) -> Vec<f32> {
    (0..n).map(|i| (i as f32 * 0.7).sin()).collect()
}

/// Milliseconds that the threads of this process have computed.
fn cpu_ms() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    // After the name, which may hold spaces: user and system time are fields 12 and 13, in hundredths of a second.
    let after = stat.rsplit(')').next().unwrap_or_default();
    let fields: Vec<&str> = after.split_whitespace().collect();
    let field = |i: usize| fields.get(i).and_then(|f| f.parse::<f64>().ok());
    match (field(11), field(12)) {
        (Some(user), Some(system)) => (user + system) * 10.0,
        _ => f64::NAN,
    }
}

/// Wall and CPU milliseconds.
type Times = (f64, f64);

/// The least wall time of several calls, and their mean CPU time.
fn time(mut run: impl FnMut() -> Result<(), PlannerError>) -> Result<Times, PlannerError> {
    run()?;
    let cpu = cpu_ms();
    let mut least = f64::INFINITY;
    let (mut total, mut n_runs) = (0.0, 0u32);
    while n_runs < 3 || (total < 2000.0 && n_runs < 100) {
        let start = Instant::now();
        run()?;
        let milliseconds = start.elapsed().as_secs_f64() * 1e3;
        least = least.min(milliseconds);
        total += milliseconds;
        n_runs += 1;
    }
    Ok((least, (cpu_ms() - cpu) / f64::from(n_runs)))
}

fn plans(timed: &Timed, config: &Config) -> Result<(), PlannerError> {
    for n in [1, 4, 16, 64] {
        let mut guided = Guided::new(timed.backend.as_ref(), config)?;
        let x = numbers(n * config.horizon * config.width);
        let times = time(|| {
            (0..STEPS)
                .rev()
                .try_for_each(|t| guided.step(&x, t as f32, n))
        })?;
        let label = format!("plan of {STEPS} steps, {n} candidates");
        timed.row(config, &label, times);
    }
    Ok(())
}

fn updates(timed: &Timed, config: &Config) -> Result<(), PlannerError> {
    let cases = [
        ("diffusion", config.unet(), 64),
        ("reward", config.reward(), 64),
        ("RND", config.predictor(), 64),
        ("RND", config.predictor(), 1024),
    ];
    let adam = Adam {
        beta1: 0.9,
        beta2: 0.999,
        epsilon: 1e-8,
        weight_decay: 1e-5,
        decoupled: true,
        ema_rate: 0.9999,
    };
    for (name, architecture, n) in cases {
        let state = TrainingState::new(initial_weights(&architecture, 1)?);
        let mut network = timed.backend.trainable(&architecture, state)?;
        let x = numbers(n * architecture.input_len());
        let t: Vec<f32> = (0..n).map(|i| (i % 20) as f32).collect();
        let mut out = vec![0.0; n * architecture.output_len()];
        let times = time(|| update(network.as_mut(), &adam, (&x, &t), &mut out))?;
        timed.row(config, &format!("{name} update, batch {n}"), times);
    }
    Ok(())
}

fn update(
    network: &mut dyn TrainableNetwork,
    adam: &Adam,
    (x, t): (&[f32], &[f32]),
    out: &mut [f32],
) -> Result<(), PlannerError> {
    network.forward(x, t, true, out)?;
    network.backward(out)?;
    network.update(adam, 1e-6)
}

/// A backend and the threads that it uses.
struct Timed {
    backend: Box<dyn Backend>,
    precision: Precision,
    n_threads: usize,
    /// Where its calls come from.
    pool: rayon::ThreadPool,
}

impl Timed {
    fn new(
        is_torch: bool,
        precision: Precision,
        n_threads: usize,
    ) -> Result<Self, Box<dyn std::error::Error>> {
        // libtorch has threads of its own: one operation after the other uses all of them.
        let callers = if is_torch { 1 } else { n_threads };
        let pool = rayon::ThreadPoolBuilder::new().num_threads(callers);
        Ok(Self {
            backend: if is_torch {
                torch(n_threads)?
            } else {
                Box::new(NativeBackend::with_precision(precision))
            },
            precision,
            n_threads,
            pool: pool.build()?,
        })
    }

    fn row(&self, config: &Config, what: &str, (wall, cpu): Times) {
        let (backend, threads) = (self.backend.name(), self.n_threads);
        let (name, precision) = (config.name, self.precision);
        println!("| {name} | {what} | {backend} {precision} | {threads} | {wall:.1} | {cpu:.1} |");
    }
}

#[cfg(feature = "torch")]
fn torch(n_threads: usize) -> Result<Box<dyn Backend>, PlannerError> {
    use ksim_planners::torch::{Device, TorchBackend};
    Ok(Box::new(TorchBackend::new(Device::Cpu, n_threads)?))
}

#[cfg(not(feature = "torch"))]
fn torch(_: usize) -> Result<Box<dyn Backend>, &'static str> {
    Err("built without the feature torch")
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let has = |name: &str| arguments.iter().any(|a| a == name);
    let wanted = |names: &[&str], name: &str| !names.iter().any(|name| has(name)) || has(name);
    let precision = match has("bf16") {
        true => Precision::Bf16,
        false => Precision::F32,
    };
    let horizon = arguments.iter().find_map(|a| a.strip_prefix("horizon="));
    let horizon = horizon.map(str::parse::<usize>).transpose()?;
    let names = CONFIGS.map(|config| config.name);
    println!("| network | operation | backend | threads | wall ms | CPU ms |");
    println!("|---|---|---|--:|--:|--:|");
    for n_threads in [1, std::thread::available_parallelism()?.get()] {
        let timed = Timed::new(has("torch"), precision, n_threads)?;
        for config in CONFIGS {
            if !wanted(&names, config.name) {
                continue;
            }
            let horizon = horizon.unwrap_or(config.horizon);
            let config = &Config { horizon, ..config };
            if wanted(&["plan", "update"], "plan") {
                timed.pool.install(|| plans(&timed, config))?;
            }
            if wanted(&["plan", "update"], "update") {
                timed.pool.install(|| updates(&timed, config))?;
            }
        }
    }
    Ok(())
}
