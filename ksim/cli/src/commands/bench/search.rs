//! `ksim bench search`.

use std::path::PathBuf;

use anyhow::{Context as _, Result, bail};
use clap::Args;
use ksim_bench_harness::figure;
use ksim_bench_harness::search_bench::{self, SearchPlan, SearchReport, SourcePart, StepSource};
use ksim_datasets::DatasetInfo;

use super::search_table;
use crate::atomic;
use crate::context::Context;
use crate::data_args::{self, DataArgs, DatasetColumnArgs};
use crate::load::{self, Columns};
use crate::outcome::CommandOutcome;
use crate::output::{self, OutputFormat};
use crate::pairing::{self, Listed};
use crate::settings::SearchName;

/// Rows and columns of generated reference data.
const GENERATED: (usize, usize) = (100_000, 31);

/// Measure the search engines against each other and against the exact oracle
///
/// Builds every engine at every size and width asked for, and asks it with states like the reference's, with noisy
/// ones and with random ones. Reports time, memory, and what clusters cost in recall and in K-Sim. Exact engines are
/// held to the oracle on --n-checked queries: a difference ends the run with an error.
#[derive(Debug, Clone, Args)]
pub(crate) struct SearchBenchArgs {
    /// Reference: a dataset's name or path [default: generated trajectories]
    #[arg(value_name = "DATASET")]
    dataset: Option<String>,
    /// Rollouts to ask with [default: held-out episodes, the same with noise, and random rows]
    #[arg(long, value_name = "FILE", num_args = 1.., requires = "dataset")]
    rollouts: Vec<String>,
    /// State columns of the dataset, as for `ksim score` [default: all]
    #[arg(long, value_name = "COLUMNS", requires = "dataset")]
    state_columns: Option<String>,
    /// Reference rows, such as 1e4,1e6; more than the dataset has come from jittered copies
    /// [default: all of the dataset, or 1e5]
    #[arg(long, value_name = "N,…", value_delimiter = ',', value_parser = count)]
    rows: Vec<usize>,
    /// Widths: the first so many state columns [default: all of the dataset, or 31]
    #[arg(long, value_name = "N,…", value_delimiter = ',', value_parser = count)]
    widths: Vec<usize>,
    /// Engines to measure
    #[arg(
        long,
        value_enum,
        value_name = "ENGINE,…",
        value_delimiter = ',',
        default_value = "auto,clusters"
    )]
    engines: Vec<SearchName>,
    /// Numbers of clusters of the engine `clusters`
    #[arg(long, value_name = "M,…", value_delimiter = ',', default_value = "50", value_parser = count)]
    n_clusters: Vec<usize>,
    /// K: nearest rows asked for
    #[arg(long, value_name = "K", default_value = "50", value_parser = count)]
    n_neighbors: usize,
    /// Queries of every kind, at most
    #[arg(long, value_name = "N", default_value = "4000", value_parser = count)]
    n_queries: usize,
    /// Queries of every kind that the oracle answers too
    #[arg(long, value_name = "N", default_value_t = 100)]
    n_checked: usize,
    /// Queries of every kind that are also asked one at a time, on one thread
    #[arg(long, value_name = "N", default_value_t = 100)]
    n_single: usize,
    /// Numbers of threads to measure with [default: --threads]
    #[arg(long, value_name = "N,…", value_delimiter = ',', value_parser = count)]
    thread_counts: Vec<usize>,
    /// Timed repeats, of which the best counts
    #[arg(long, value_name = "N", default_value = "3", value_parser = count)]
    repeats: usize,
    /// Seed of generated data, k-means and bootstrap
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Resamples of the bootstrap over episodes
    #[arg(long, value_name = "N", default_value_t = 2000)]
    n_resamples: usize,
    /// How to print the result
    #[arg(long, value_enum, default_value_t = OutputFormat::Text)]
    format: OutputFormat,
    /// Draw a figure: time over rows, for several --rows; K-Sim and time over clusters, for several --n-clusters
    #[arg(long, value_name = "FILE.svg")]
    figure: Option<PathBuf>,
    #[command(flatten)]
    data: DataArgs,
    #[command(flatten)]
    dataset_columns: DatasetColumnArgs,
}

/// A whole number from 1, also as 1e6.
fn count(text: &str) -> Result<usize, String> {
    let expected = || "expected a whole number from 1 to 4e9, such as 100000 or 1e5".to_owned();
    let value: f64 = text.trim().parse().map_err(|_| expected())?;
    let fits = (1.0..=4e9).contains(&value) && value.fract() == 0.0;
    if fits {
        Ok(value as usize)
    } else {
        Err(expected())
    }
}

/// What was opened.
struct Opened {
    source: StepSource,
    about: SourcePart,
    infos: Vec<DatasetInfo>,
}

/// Measures and prints.
pub(super) fn run(args: &SearchBenchArgs, context: &Context) -> Result<CommandOutcome> {
    if let Some(target) = &args.figure {
        atomic::check_target(target)?;
        if args.rows.len() < 2 && args.n_clusters.len() < 2 {
            bail!(
                "--figure compares sizes or numbers of clusters: give several --rows or --n-clusters"
            );
        }
    }
    let opened = open(args, context)?;
    if let Some(target) = &args.figure {
        let inputs = opened.infos.iter().map(|info| &*info.path);
        atomic::check_not_an_input(target, inputs)?;
    }
    let plan = plan(args, &opened.source, context);
    let progress = context.spinner("measuring".to_owned());
    let mut say = |what: &str| progress.say(what.to_owned());
    let report = search_bench::run(&opened.source, opened.about, &plan, &mut say)?;
    drop(progress);
    if let Some(target) = &args.figure {
        draw(target, &report)?;
    }
    match args.format {
        OutputFormat::Text => output::text(&search_table::render(&report))?,
        OutputFormat::Json => output::json(&report)?,
    }
    Ok(CommandOutcome::of(&opened.infos))
}

fn draw(target: &std::path::Path, report: &SearchReport) -> Result<()> {
    let heading = match &report.source.dataset {
        Some(dataset) => format!("Search in {dataset}, K = {}", report.n_neighbors),
        None => format!(
            "Search in generated trajectories, K = {}",
            report.n_neighbors
        ),
    };
    let figure = figure::search::draw(&heading, report);
    let svg = figure
        .context("nothing to draw: all measurements have one size and one number of clusters")?;
    atomic::write(target, svg.as_bytes())
}

fn plan(args: &SearchBenchArgs, source: &StepSource, context: &Context) -> SearchPlan {
    let or = |given: &[usize], default: usize| match given {
        [] => vec![default],
        given => given.to_vec(),
    };
    SearchPlan {
        rows: or(&args.rows, source.n_rows().unwrap_or(GENERATED.0)),
        widths: or(&args.widths, source.state_dim().unwrap_or(GENERATED.1)),
        engines: args.engines.iter().map(|engine| engine.engine()).collect(),
        n_clusters: args.n_clusters.clone(),
        n_neighbors: args.n_neighbors,
        n_queries: args.n_queries,
        n_checked: args.n_checked,
        n_single: args.n_single,
        threads: or(&args.thread_counts, context.threads()),
        repeats: args.repeats,
        seed: args.seed,
        n_resamples: args.n_resamples,
    }
}

fn open(args: &SearchBenchArgs, context: &Context) -> Result<Opened> {
    let Some(name) = &args.dataset else {
        return Ok(Opened {
            source: StepSource::Generated { seed: args.seed },
            about: SourcePart {
                dataset: None,
                rollouts: Vec::new(),
            },
            infos: Vec::new(),
        });
    };
    let options = args.data.dataset_open_options(&args.dataset_columns);
    let rollout_options = args.data.open_options();
    let (resolved, dataset) = data_args::open(name, &options)?;
    let columns = Columns::select(&*dataset, args.state_columns.as_deref())
        .with_context(|| dataset.info().path.display().to_string())?;
    let listed = Listed::new(&rollout_options, &options);
    let mut infos = vec![dataset.info().clone()];
    let mut rollouts = Vec::new();
    for file in &args.rollouts {
        let (_, source) = data_args::open(file, &rollout_options)?;
        let own = pairing::columns_of(&*source, &*dataset, &columns, listed)?;
        infos.push(source.info().clone());
        for steps in load::rollouts(&*source, &own, context)? {
            let file = std::path::Path::new(file);
            let stem = file.file_stem().map_or_else(
                || file.display().to_string(),
                |stem| stem.to_string_lossy().into_owned(),
            );
            let name = match &steps.planner {
                Some(planner) => format!("{stem} · {planner}"),
                None => stem,
            };
            rollouts.push((name, steps.into_parts().0));
        }
    }
    for info in &infos {
        for warning in &info.warnings {
            context.warn(&format!("{}: {warning}", info.path.display()));
        }
    }
    let (data, _) = load::dataset(&*dataset, &columns, context)?.into_parts();
    let about = SourcePart {
        dataset: Some(resolved.name),
        rollouts: rollouts.iter().map(|(name, _)| name.clone()).collect(),
    };
    let source = StepSource::Recorded {
        dataset: data,
        rollouts,
        seed: args.seed,
    };
    Ok(Opened {
        source,
        about,
        infos,
    })
}

#[cfg(test)]
mod tests {
    use super::count;

    #[test]
    fn counts_may_be_powers_of_ten() {
        assert_eq!([count("1e6"), count(" 50")], [Ok(1_000_000), Ok(50)]);
        for wrong in ["0", "1.5", "-3", "x", "nan", "1e12"] {
            assert!(count(wrong).is_err(), "{wrong}");
        }
    }
}
