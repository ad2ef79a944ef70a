//! `ksim index build`.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result};
use clap::Args;
use ksim_index::{About, AboutDataset, Clustering};

use crate::atomic::{self, AtomicFile};
use crate::centers::CentersFile;
use crate::context::Context;
use crate::data_args::{self, DataArgs, DatasetColumnArgs};
use crate::indexed;
use crate::load::{self, Columns};
use crate::outcome::CommandOutcome;
use crate::settings::{BackendName, ClusterSettings, Definition, parse_count};

/// Build an index of a dataset, for `ksim score --index`
///
/// The index holds the normalized states and actions, the statistics they were normalized by, and k-means clusters,
/// for one selection of state columns. The dataset may be larger than memory. Scores with the index are those without
/// it, to the last bit.
#[derive(Debug, Clone, Args)]
pub(crate) struct BuildArgs {
    /// The dataset: a file, a folder, or a name such as antmaze-large-play
    #[arg(value_name = "DATASET")]
    dataset: String,
    /// The index to write
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Preset of the state columns
    #[arg(long, value_enum, default_value_t = Definition::Paper)]
    definition: Definition,
    /// State columns, as for `ksim score` [default: by definition]
    #[arg(long, value_name = "COLUMNS")]
    state_columns: Option<String>,
    /// Leave the clusters out: such an index is for exact search only
    #[arg(long, conflicts_with_all = ["n_clusters", "k_means", "centers", "seed"])]
    no_clusters: bool,
    /// Number of clusters [default: 50]
    #[arg(long, value_name = "M", value_parser = parse_count, allow_negative_numbers = true)]
    n_clusters: Option<usize>,
    /// k-means that fits the clusters
    #[arg(long, value_enum, default_value_t = BackendName::Ksim)]
    k_means: BackendName,
    /// Cluster centers to use instead of fitted ones, as for `ksim score`
    #[arg(long, value_name = "FILE.safetensors[:TENSOR]", conflicts_with_all = ["n_clusters", "k_means", "seed"])]
    centers: Option<String>,
    /// Seed of k-means
    #[arg(long, default_value_t = 0)]
    seed: u64,
    #[command(flatten)]
    data: DataArgs,
    #[command(flatten)]
    dataset_columns: DatasetColumnArgs,
}

/// Builds and says what was built.
pub(super) fn run(args: &BuildArgs, context: &Context) -> Result<CommandOutcome> {
    atomic::check_target(&args.output)?;
    let options = args.data.dataset_open_options(&args.dataset_columns);
    let (resolved, source) = data_args::open(&args.dataset, &options)?;
    let info = source.info();
    atomic::check_not_an_input(&args.output, [&*info.path])?;
    for warning in &info.warnings {
        context.warn(&format!("{}: {warning}", info.path.display()));
    }
    let selection = match args.state_columns.as_deref() {
        Some("all") => None,
        Some(columns) => Some(columns),
        None => args.definition.state_columns(),
    };
    let columns =
        Columns::select(&*source, selection).with_context(|| info.path.display().to_string())?;
    let clustering = clustering(args, columns.indices.len())?;
    let about = About {
        ksim: env!("CARGO_PKG_VERSION").to_owned(),
        dataset: AboutDataset {
            name: resolved.name,
            path: info.path.display().to_string(),
            format: info.format.name().to_owned(),
            // Taken before the reading: what changes meanwhile changes the stamp.
            stamp: indexed::stamp(info, &options, &columns)?,
            ..AboutDataset::default()
        },
        state_columns: columns.indices.clone(),
        state_column_names: columns.names.clone(),
        action_dim: indexed::action_dim(info),
        clusters: None,
    };
    let mut file = AtomicFile::create(&args.output)?;
    let folder = match args.output.parent() {
        Some(folder) if folder != Path::new("") => folder,
        _ => Path::new("."),
    };
    let (steps, numbers) = load::staged(&*source, &columns, folder, context)?;
    let progress = context.spinner("building the index".to_owned());
    let mut say = |stage: ksim_index::Stage| progress.say(stage.name().to_owned());
    let staged = file.file().context("cannot write the index")?;
    let written = ksim_index::write(
        steps,
        numbers.values(),
        about,
        clustering.as_ref(),
        staged,
        &mut say,
    );
    let about = written.with_context(|| info.path.display().to_string())?;
    progress.say("putting the index in its place".to_owned());
    file.publish()?;
    drop(progress);
    let clusters = match &about.clusters {
        Some(clusters) => format!("{} clusters", clusters.n_clusters),
        None => "no clusters".to_owned(),
    };
    context.note(&format!(
        "{}: {} steps of {} episodes, {} state columns, {clusters}",
        args.output.display(),
        about.dataset.n_steps,
        about.dataset.n_episodes,
        about.state_columns.len()
    ));
    Ok(CommandOutcome::of([info]))
}

fn clustering(args: &BuildArgs, width: usize) -> Result<Option<Clustering>> {
    if args.no_clusters {
        return Ok(None);
    }
    if let Some(file) = &args.centers {
        let centers = CentersFile::parse(file).read(width)?;
        return Ok(Some(Clustering::Given(centers.values)));
    }
    let settings = ClusterSettings::new(args.n_clusters, args.seed, args.k_means)?;
    Ok(Some(Clustering::Fit {
        params: settings.params(),
        seed: args.seed,
        backend: settings.backend_name(),
    }))
}
