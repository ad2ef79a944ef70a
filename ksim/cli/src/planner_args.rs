//! Which planner plays, and how it plans.

use std::num::NonZero;
use std::time::Duration;

use anyhow::{Context as _, Result};
use clap::{Args, ValueEnum};
use ksim_bench_harness::planner_source::{OpenPlanner, PlannerSource};
use ksim_bench_harness::policy::Planned;
use ksim_bench_harness::suite::PlannerEntry;
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
    #[command(flatten)]
    plan: PlanArgs,
    /// Weight of curiosity, λ of the paper; 0 is Diffuser
    #[arg(long, value_name = "LAMBDA", value_parser = weight, allow_negative_numbers = true)]
    curiosity: Option<f64>,
    /// Seconds that a planner process may take to start, and to answer [default: 120]
    #[arg(long, value_name = "S")]
    planner_timeout: Option<u16>,
}

/// How a planner plans with whatever weight of curiosity.
#[derive(Debug, Clone, Default, Args)]
#[command(next_help_heading = "Planner")]
pub(crate) struct PlanArgs {
    /// Candidates of every plan
    #[arg(long, value_name = "K")]
    candidates: Option<NonZero<u32>>,
    /// Steps from one plan to the next [default: 1]
    #[arg(long, value_name = "STEPS")]
    replan_interval: Option<NonZero<u32>>,
    /// Weight of guidance, w_cg of the paper
    #[arg(long, value_name = "W", value_parser = weight, allow_negative_numbers = true)]
    guidance: Option<f64>,
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
}

/// Seconds that a planner process may take.
const TIMEOUT_S: u16 = 120;

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

impl PlanArgs {
    /// The flags that were given, and those that were not.
    fn given(&self) -> [(&'static str, bool); 9] {
        [
            ("--candidates", self.candidates.is_some()),
            ("--replan-interval", self.replan_interval.is_some()),
            ("--guidance", self.guidance.is_some()),
            ("--sampling-steps", self.sampling_steps.is_some()),
            ("--temperature", self.temperature.is_some()),
            ("--warm-start", self.warm_start.is_some()),
            ("--backend", self.backend.is_some()),
            ("--device", self.device.is_some()),
            ("--precision", self.precision.is_some()),
        ]
    }

    fn precision(&self) -> Option<Precision> {
        self.precision.map(|precision| match precision {
            PrecisionArg::F32 => Precision::F32,
            PrecisionArg::Bf16 => Precision::Bf16,
        })
    }

    /// The same in a suite.
    pub(crate) fn entry(&self) -> PlannerEntry {
        PlannerEntry {
            replan_interval: self.replan_interval.and_then(|n| n.try_into().ok()),
            candidates: self.candidates.map(count),
            guidance: self.guidance,
            sampling_steps: self.sampling_steps.map(count),
            temperature: self.temperature,
            warm_start: self.warm_start,
            backend: self.backend.clone(),
            device: self.device.clone(),
            precision: self.precision(),
            ..PlannerEntry::default()
        }
    }
}

impl PlanningArgs {
    /// The first flag that was given.
    pub(crate) fn first_given(&self) -> Option<&'static str> {
        let own = [
            ("--curiosity", self.curiosity.is_some()),
            ("--planner-timeout", self.planner_timeout.is_some()),
        ];
        let mut all = own.into_iter().chain(self.plan.given());
        all.find(|(_, is_given)| *is_given).map(|(flag, _)| flag)
    }

    /// How the planner is opened.
    pub(crate) fn open_options(&self, n_threads: usize) -> OpenPlanner {
        let timeout = self.planner_timeout.unwrap_or(TIMEOUT_S);
        let timeout = Duration::from_secs(u64::from(timeout));
        let plan = &self.plan;
        OpenPlanner {
            load: LoadOptions {
                backend: plan.backend.clone(),
                device: plan.device.clone(),
                n_threads: Some(n_threads),
                precision: plan.precision().unwrap_or_default(),
                n_candidates: plan.candidates.map(count),
                sampling_steps: plan.sampling_steps.map(count),
                guidance_weight: plan.guidance,
                curiosity_weight: self.curiosity,
                temperature: plan.temperature,
                warm_start: plan.warm_start,
                replan_interval: None,
            },
            replan_interval: plan
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

    /// What to know about it before it plays.
    pub(crate) fn warning(&self) -> Option<String> {
        let warning = || format!("the training of {} is not finished", self.text);
        (self.source.is_finished() == Some(false)).then(warning)
    }

    /// How it plans, as far as it was said.
    pub(crate) fn describe(&self) -> Value {
        let load = &self.options.load;
        json!({
            "source": self.text,
            "finished": self.source.is_finished(),
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
