//! `ksim demo`: bundled rollouts against a bundled dataset, and what the numbers mean.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result};
use clap::Args;
use ksim_datasets::OpenOptions;

use crate::atomic;
use crate::context::Context;
use crate::document::Document;
use crate::outcome::CommandOutcome;
use crate::output::{self, OutputFormat};
use crate::scoring::{self, Job};
use crate::settings::Settings;
use crate::table;

/// A bundled file.
struct Bundled {
    name: &'static str,
    bytes: &'static [u8],
}

/// The bundled file of a name under `ksim/cli/demo`.
macro_rules! bundled {
    ($name:literal) => {
        Bundled {
            name: $name,
            bytes: include_bytes!(concat!("../../demo/", $name)),
        }
    };
}

const DATASET: Bundled = bundled!("dataset.parquet");
const ROLLOUTS: [Bundled; 3] = [
    bundled!("good.parquet"),
    bundled!("noisy.parquet"),
    bundled!("random.parquet"),
];

/// Score bundled rollouts against a bundled dataset, and say what the numbers mean
///
/// The data are MuJoCo simulations of an ant in a maze: a few episodes of a policy that runs to a goal (the
/// dataset), and rollouts of the same policy (good), of it with strong noise on its actions (noisy), and of
/// random actions (random).
#[derive(Debug, Clone, Args)]
pub(crate) struct DemoArgs {
    /// How to print the result
    #[arg(long, value_enum, default_value_t = OutputFormat::Text)]
    format: OutputFormat,
    /// Write the bundled files into this folder instead, to try `ksim score` on them
    #[arg(long, value_name = "FOLDER")]
    export: Option<PathBuf>,
}

/// Runs the demo, or writes its files.
pub(crate) fn run(args: &DemoArgs, context: &Context) -> Result<CommandOutcome> {
    if let Some(folder) = &args.export {
        return export(folder);
    }
    let folder = tempfile::tempdir().context("cannot make a folder for the demo's files")?;
    for file in bundled() {
        let path = folder.path().join(file.name);
        std::fs::write(&path, file.bytes)
            .with_context(|| format!("cannot write {}", path.display()))?;
    }
    let at = |file: &Bundled| folder.path().join(file.name).display().to_string();
    let job = Job {
        dataset: at(&DATASET),
        dataset_options: OpenOptions::default(),
        index: None,
        rollouts: ROLLOUTS.iter().map(at).collect(),
        rollout_options: OpenOptions::default(),
        settings: Settings::default(),
        per_step: None,
        output: None,
    };
    let (mut document, outcome) = scoring::run(&job, context)?;
    // The folder is gone when the user reads this: the names are what the user can export.
    document.dataset.path = DATASET.name.to_owned();
    document.dataset.name = "demo dataset".to_owned();
    for (result, file) in document.results.iter_mut().zip(&ROLLOUTS) {
        result.file = file.name.to_owned();
    }
    match args.format {
        OutputFormat::Text => output::text(&explained(&document))?,
        OutputFormat::Json => output::json(&document)?,
    }
    Ok(outcome)
}

fn bundled() -> impl Iterator<Item = &'static Bundled> {
    std::iter::once(&DATASET).chain(&ROLLOUTS)
}

fn export(folder: &Path) -> Result<CommandOutcome> {
    std::fs::create_dir_all(folder)
        .with_context(|| format!("cannot make the folder {}", folder.display()))?;
    for file in bundled() {
        atomic::write(&folder.join(file.name), file.bytes)?;
    }
    let at = |file: &Bundled| folder.join(file.name).display().to_string();
    let rollouts: Vec<String> = ROLLOUTS.iter().map(at).collect();
    output::text(&format!(
        "wrote 4 files; now try\n  ksim score {} --dataset {}\n",
        rollouts.join(" "),
        at(&DATASET)
    ))?;
    Ok(CommandOutcome::Done)
}

/// The table and what it says, with the numbers of this run.
fn explained(document: &Document) -> String {
    let k_sim = |name: &str| {
        let result = document
            .results
            .iter()
            .find(|result| result.file.starts_with(name));
        result.map_or(f64::NAN, |result| result.k_sim)
    };
    let words = MEANING
        .replace("GOOD", &format!("{:.2}", k_sim("good")))
        .replace("NOISY", &format!("{:.2}", k_sim("noisy")))
        .replace("RANDOM", &format!("{:.2}", k_sim("random")));
    format!(
        "{}\n{}\n{words}",
        table::results(document),
        table::provenance(document)
    )
}

/// What the numbers mean, and what they do not.
const MEANING: &str = "\
What the numbers mean
K-Sim says how closely the behavior in a rollout stays to the training data. For every step it takes
the 50 dataset states nearest to the rollout's state, among them the one whose action is nearest to
what the policy did, and turns the distance of the two steps into a score: 1 beside the data, falling
towards 0 far from it. K-Sim is the mean over all steps.

Here the policy that made the dataset scores GOOD, the same policy with strong noise on its actions
NOISY, and random actions RANDOM: only the first behaves as its data do. The intervals say how much the
mean over episodes may vary with other episodes of the same policy.

What they do not say
- Not whether a policy succeeds: one that fails just as its data do scores high.
- Not which of two poor policies is worse: once behavior leaves the data, all of it is far away, and
  random actions can score above noisy ones.
- Nothing at all where most steps are saturated (score 1): compare the mean d/√d then, which goes on.
- Scores compare only where their fingerprints agree: same dataset, columns, parameters and search.

Try it on files of your own; to begin with these: ksim demo --export demo-data
";
