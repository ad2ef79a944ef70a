//! `ksim dataset collect`: a Minari dataset of a policy.

use std::path::PathBuf;

use anyhow::Result;
use clap::{Args, ValueEnum};
use ksim_bench_harness::record::Summary;
use ksim_bench_harness::recording::{About, ActionPrecision};
use ksim_bench_harness::stats::BootstrapOptions;
use ksim_datasets::{Format, WriteOptions};
use ksim_envs::registry::{self, Family};
use serde_json::{Map, Value, json};

use crate::atomic;
use crate::commands::rollout;
use crate::context::Context;
use crate::outcome::CommandOutcome;
use crate::output::{self, OutputFormat};
use crate::rolling::{self, Destination, Played, Ready};
use crate::rollout_args::{EnvironmentArgs, PlayArgs, Setup};

/// Name and version of the schema of `ksim dataset collect --format json`.
const SCHEMA: &str = "ksim.dataset-collect/1";
/// Episodes over which Minari averages reference scores.
const REFERENCE_EPISODES: u32 = 100;

/// Collect a Minari dataset: the episodes of a policy in an environment
///
/// Actions are rounded to f32 before they reach the environment, as Gymnasium's action spaces declare them, so that
/// the dataset holds exactly what was done. After Ctrl-C, it holds the episodes that were complete. With --dataset,
/// the environment is the one that dataset was collected in.
#[derive(Debug, Clone, Args)]
pub(crate) struct CollectArgs {
    #[command(flatten)]
    environment: EnvironmentArgs,
    #[command(flatten)]
    play: PlayArgs,
    /// The folder of the dataset, such as ~/.minari/datasets/mine/hopper-v0
    #[arg(short, long, value_name = "FOLDER")]
    output: PathBuf,
    /// Id of the dataset
    #[arg(long, value_name = "[NAMESPACE/]NAME-vN")]
    id: String,
    /// How episodes are stored
    #[arg(long, value_enum, default_value_t = Storage::Hdf5)]
    storage: Storage,
    /// Replace a dataset that is already there
    #[arg(long)]
    overwrite: bool,
    /// How to print the report
    #[arg(long, value_enum, default_value_t = OutputFormat::Text)]
    format: OutputFormat,
    #[command(flatten)]
    metadata: MetadataArgs,
}

/// What the dataset says of itself.
#[derive(Debug, Clone, Args)]
#[command(next_help_heading = "Metadata")]
struct MetadataArgs {
    /// Author; may be given several times
    #[arg(long, value_name = "NAME")]
    author: Vec<String>,
    /// Address of an author
    #[arg(long, value_name = "EMAIL")]
    author_email: Vec<String>,
    /// The algorithm behind the policy [default: the policy's name]
    #[arg(long, value_name = "NAME")]
    algorithm_name: Option<String>,
    /// Where the code is
    #[arg(long, value_name = "URL")]
    code_permalink: Option<String>,
    /// What the dataset is
    #[arg(long, value_name = "TEXT")]
    description: Option<String>,
    /// Return that counts as 0 in normalized scores [default: the environment's or the dataset's]
    #[arg(
        long,
        value_name = "RETURN",
        requires = "ref_max_score",
        allow_negative_numbers = true
    )]
    ref_min_score: Option<f64>,
    /// Return that counts as 1
    #[arg(
        long,
        value_name = "RETURN",
        requires = "ref_min_score",
        allow_negative_numbers = true
    )]
    ref_max_score: Option<f64>,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum Storage {
    Hdf5,
    Arrow,
    Parquet,
}

impl From<Storage> for Format {
    fn from(storage: Storage) -> Self {
        match storage {
            Storage::Hdf5 => Self::MinariHdf5,
            Storage::Arrow => Self::MinariArrow,
            Storage::Parquet => Self::MinariParquet,
        }
    }
}

/// Plays, writes and reports.
pub(super) fn run(args: &CollectArgs, context: &Context) -> Result<CommandOutcome> {
    let mut setup = args.environment.setup(true)?;
    let given = args.metadata.ref_min_score.zip(args.metadata.ref_max_score);
    setup.reference = given.or(setup.reference);
    let destination = Destination {
        path: &args.output,
        format: args.storage.into(),
        options: WriteOptions {
            id: Some(args.id.clone()),
            overwrite: args.overwrite,
            ..WriteOptions::default()
        },
        precision: ActionPrecision::Single,
    };
    destination.check()?;
    let ready = Ready::new(&setup, &args.play, 1, context)?.with_single_precision();
    let env_spec = rolling::env_spec(&setup.request)?;
    let about = About {
        minari: metadata(
            &args.metadata,
            &setup,
            ready.policy_name(),
            env_spec.as_ref(),
        )?,
        env_spec,
        reference: setup.reference,
        ..About::default()
    };
    let _cooperative = atomic::Cooperative::begin();
    let played = ready.play(Some(&destination), about, context)?;
    report(&played, args)?;
    Ok(CommandOutcome::Done)
}

/// Fields of Minari's `metadata.json`.
fn metadata(
    args: &MetadataArgs,
    setup: &Setup,
    policy: &str,
    env_spec: Option<&Value>,
) -> Result<Map<String, Value>> {
    let family = registry::find(&setup.request.id)?.family;
    let text = |spec: Option<&Value>| spec.map(|spec| spec.to_string().into());
    let list = |values: &[String]| (!values.is_empty()).then(|| json!(values));
    let averaged = setup.reference.map(|_| REFERENCE_EPISODES.into());
    let fields = [
        ("env_spec", text(env_spec)),
        (
            "eval_env_spec",
            text(rolling::env_spec(&setup.evaluation)?.as_ref()),
        ),
        (
            "algorithm_name",
            Some(args.algorithm_name.as_deref().unwrap_or(policy).into()),
        ),
        ("author", list(&args.author)),
        ("author_email", list(&args.author_email)),
        (
            "code_permalink",
            args.code_permalink.as_deref().map(Value::from),
        ),
        ("description", args.description.as_deref().map(Value::from)),
        ("num_episodes_average_score", averaged),
        (
            "requirements",
            requirements(family).map(|names| json!(names)),
        ),
    ];
    let given = fields
        .into_iter()
        .filter_map(|(key, value)| Some((key.to_owned(), value?)));
    Ok(given.collect())
}

/// Python packages that make the environment again.
fn requirements(family: Family) -> Option<&'static [&'static str]> {
    match family {
        Family::PointMass => None,
        Family::AntMaze => Some(&["gymnasium-robotics>=1.2.4", "mujoco>=3.1.1"]),
        _ => Some(&["gymnasium>=1.0.0", "mujoco>=3.1.1"]),
    }
}

/// Prints what was collected; nothing where there is no episode, which was said already.
fn report(played: &Played, args: &CollectArgs) -> Result<()> {
    let Some(summary) = Summary::new(&played.records, &BootstrapOptions::default()) else {
        return Ok(());
    };
    let path = args.output.display();
    match args.format {
        OutputFormat::Text => output::text(&format!(
            "{}\n{} is in {path}\n",
            rollout::text(played, &summary),
            args.id
        )),
        OutputFormat::Json => output::json(&json!({
            "schema": SCHEMA,
            "id": args.id,
            "path": path.to_string(),
            "rollout": played.rollout,
            "summary": summary,
        })),
    }
}
