//! Which planner plays, and how it plans.

use std::num::NonZero;
use std::time::Duration;

use anyhow::{Context as _, Result};
use clap::{Args, ValueEnum};
use ksim_bench_harness::planner_source::{OpenPlanner, PlannerSource};
use ksim_bench_harness::policy::Planned;
use ksim_envs::EnvironmentSpec;
use ksim_planners::process::Timeouts;
use ksim_planners::{LoadOptions, Precision, Registry};
use serde_json::{Value, json};

/// A planner and its options.
#[derive(Debug, Clone, Args)]
#[command(next_help_heading = "Planner")]
pub(crate) struct PlannerArgs {
    /// A run of `ksim train`, or random, nearest:DATASET, nearest-return:DATASET, replay:DATASET, process:COMMAND
    #[arg(long, value_name = "RUN|SPEC")]
    pub(crate) planner: Option<String>,
    #[command(flatten)]
    pub(crate) planning: PlanningArgs,
}

/// How a planner plans; what is not given is as its run says.
#[derive(Debug, Clone, Default, Args)]
#[command(next_help_heading = "Planner")]
pub(crate) struct PlanningArgs {
    /// Candidates of every plan
    #[arg(long, value_name = "K")]
    candidates: Option<NonZero<u32>>,
    /// Steps from one plan to the next [default: 1]
    #[arg(long, value_name = "STEPS")]
    replan_interval: Option<NonZero<u32>>,
    /// Weight of guidance, w_cg of the paper
    #[arg(long, value_name = "W", value_parser = weight, allow_negative_numbers = true)]
    guidance: Option<f64>,
    /// Weight of curiosity, λ of the paper; 0 is Diffuser
    #[arg(long, value_name = "LAMBDA", value_parser = weight, allow_negative_numbers = true)]
    curiosity: Option<f64>,
    /// Denoising steps of a plan
    #[arg(long, value_name = "N")]
    sampling_steps: Option<NonZero<u32>>,
    /// Factor of the initial noise
    #[arg(long, value_name = "FACTOR", value_parser = weight, allow_negative_numbers = true)]
    temperature: Option<f64>,
    /// Start from the plan before, at this share of the diffusion time
    #[arg(long, value_name = "SHARE", value_parser = share)]
    warm_start: Option<f64>,
    /// Who computes the networks: native or torch [default: the first that this build has]
    #[arg(long, value_name = "NAME")]
    backend: Option<String>,
    /// Where: cpu or cuda
    #[arg(long, value_name = "DEVICE")]
    device: Option<String>,
    /// How numbers are computed
    #[arg(long, value_enum, value_name = "TYPE")]
    precision: Option<PrecisionArg>,
    /// Seconds that a planner process may take to start, and to answer
    #[arg(long, value_name = "S", default_value_t = 120)]
    planner_timeout: u16,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum PrecisionArg {
    /// 32 bits
    F32,
    /// 16-bit brain floating point, where the backend has it
    Bf16,
}

fn weight(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(weight) if weight.is_finite() && weight >= 0.0 => Ok(weight),
        _ => Err("expected a finite number of 0 or more".to_owned()),
    }
}

fn share(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(share) if share > 0.0 && share <= 1.0 => Ok(share),
        _ => Err("expected a number above 0 and up to 1".to_owned()),
    }
}

fn count(number: NonZero<u32>) -> usize {
    usize::try_from(number.get()).unwrap_or(usize::MAX)
}

impl PlanningArgs {
    /// How the planner is opened.
    pub(crate) fn open_options(&self, n_threads: usize) -> OpenPlanner {
        let timeout = Duration::from_secs(u64::from(self.planner_timeout));
        OpenPlanner {
            load: LoadOptions {
                backend: self.backend.clone(),
                device: self.device.clone(),
                n_threads: Some(n_threads),
                precision: match self.precision {
                    Some(PrecisionArg::Bf16) => Precision::Bf16,
                    _ => Precision::F32,
                },
                n_candidates: self.candidates.map(count),
                sampling_steps: self.sampling_steps.map(count),
                guidance_weight: self.guidance,
                curiosity_weight: self.curiosity,
                temperature: self.temperature,
                warm_start: self.warm_start,
                replan_interval: None,
            },
            replan_interval: self
                .replan_interval
                .map_or(NonZero::<usize>::MIN, |interval| {
                    NonZero::try_from(interval).unwrap_or(NonZero::<usize>::MIN)
                }),
            timeouts: Timeouts {
                start: timeout,
                answer: timeout,
            },
        }
    }
}

/// A planner that was asked for, read but not opened.
#[derive(Debug, Clone)]
pub(crate) struct Chosen {
    /// As it was written.
    pub(crate) text: String,
    pub(crate) source: PlannerSource,
    pub(crate) options: OpenPlanner,
}

impl Chosen {
    /// Opens the planner to act in an environment.
    pub(crate) fn open(&self, environment: &EnvironmentSpec) -> Result<Planned> {
        let registry = Registry::builtin();
        let planner = self.source.open(&registry, environment, &self.options)?;
        let interval = self.options.replan_interval;
        Planned::new(self.source.to_string(), planner, interval, environment)
            .with_context(|| format!("planner `{}`", self.text))
    }

    /// How it plans, as far as it was said.
    pub(crate) fn describe(&self) -> Value {
        let load = &self.options.load;
        json!({
            "source": self.text,
            "replan_interval": self.options.replan_interval,
            "n_candidates": load.n_candidates,
            "guidance_weight": load.guidance_weight,
            "curiosity_weight": load.curiosity_weight,
            "sampling_steps": load.sampling_steps,
            "temperature": load.temperature,
            "warm_start": load.warm_start,
            "backend": load.backend,
            "device": load.device,
            "precision": load.precision,
        })
    }
}
