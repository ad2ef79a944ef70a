//! `ksim planner import`: a run of the reference implementation's files.

use std::num::NonZero;
use std::path::PathBuf;

use anyhow::Result;
use clap::Args;
use ksim_datasets::OpenOptions;
use ksim_planners::import::{ReferenceImport, import_run};

use crate::context::Context;
use crate::data_args;
use crate::outcome::CommandOutcome;
use crate::output;
use crate::table;

/// Make a run of .pt files that the reference implementation trained
///
/// Which file is which is told by its tensors. The run plans as the reference does, defects included; nothing in the
/// files is executed.
#[derive(Debug, Clone, Args)]
pub(super) struct ImportArgs {
    /// diffusion_ckpt_*.pt and classifier_ckpt_*.pt; for Curiosity-Diffuser also the classifier_ckpt_*.pt of its random
    /// network distillation and rnd_classifier_target.pt, for ReDiffuser rnd_ckpt_*.pt
    #[arg(value_name = "FILE.pt", required = true)]
    files: Vec<PathBuf>,
    /// The dataset that they were trained on, for the statistics of its observations: a file, a folder, or a name
    #[arg(long, value_name = "NAME|PATH")]
    dataset: String,
    /// Named settings for all that is not in the files, such as paper-antmaze (see `ksim planner list`)
    #[arg(long, value_name = "NAME")]
    preset: String,
    /// Steps in a window [default: the preset's]
    #[arg(long, value_name = "N")]
    horizon: Option<NonZero<u32>>,
    /// The run folder
    #[arg(short, long, value_name = "RUN")]
    output: PathBuf,
}

/// Imports.
pub(super) fn run(args: &ImportArgs, context: &Context) -> Result<CommandOutcome> {
    let horizon = args.horizon.map(NonZero::get).map(usize::try_from);
    let import = ReferenceImport {
        files: &args.files,
        preset: &args.preset,
        horizon: horizon.transpose()?,
    };
    let (_, source) = data_args::open(&args.dataset, &OpenOptions::default())?;
    for warning in &source.info().warnings {
        context.warn(&format!("{}: {warning}", source.info().path.display()));
    }
    let meta = import_run(&import, &*source, &args.output)?;
    let run = args.output.display();
    let networks: Vec<&str> = meta.architectures().into_keys().collect();
    let dims = format!("{} and {}", meta.observation_dim, meta.action_dim);
    let next = format!(
        "ksim rollout --planner {run} --dataset {} --episodes 20",
        args.dataset
    );
    output::text(&table::properties(&[
        ("planner", meta.family.clone()),
        ("run", run.to_string()),
        ("mode", "reference".to_owned()),
        ("networks", networks.join(", ")),
        ("observations and actions", dims),
        ("horizon", meta.config.data.horizon.to_string()),
        ("next", next),
    ]))?;
    Ok(CommandOutcome::of([source.info()]))
}
