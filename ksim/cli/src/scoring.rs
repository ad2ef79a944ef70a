//! Scoring files against a dataset: open, check, read, fit, score.

use std::path::PathBuf;
use std::time::Instant;

use anyhow::{Context as _, Result, bail};
use ksim::{ApproximationError, KSim, Prepared, Reference, Report, ScoreOptions, Search};
use ksim_datasets::{DatasetInfo, DatasetSource, OpenOptions};
use ksim_index::SavedIndex;

use crate::atomic;
use crate::centers::Centers;
use crate::context::Context;
use crate::data_args;
use crate::document::{
    DatasetPart, Document, Parameters, RolloutResult, SCHEMA, SearchPart, fingerprint,
};
use crate::indexed::{self, Request};
use crate::load::{self, Columns, StepNumbers, Steps};
use crate::outcome::CommandOutcome;
use crate::pairing::{self, Listed};
use crate::per_step::{Labels, PerStepWriter, Scored};
use crate::settings::Settings;
use crate::table;

/// Share of saturated steps above which a score says little.
const MUCH_SATURATION: f64 = 0.9;

/// Steps closer than this, in standard deviations, are the same but for the rounding of storage as f32.
const SAME_STEP: f64 = 1e-5;

/// Everything a run of `ksim score` needs to know.
#[derive(Debug, Clone)]
pub(crate) struct Job {
    /// Name or path of the reference.
    pub(crate) dataset: String,
    /// How to open it.
    pub(crate) dataset_options: OpenOptions,
    /// A saved index of it.
    pub(crate) index: Option<PathBuf>,
    /// Names or paths of the rollouts.
    pub(crate) rollouts: Vec<String>,
    /// How to open them.
    pub(crate) rollout_options: OpenOptions,
    /// How to score.
    pub(crate) settings: Settings,
    /// Where to write the evidence.
    pub(crate) per_step: Option<PathBuf>,
}

/// The opened files of a job.
struct Inputs {
    dataset_name: String,
    dataset: Box<dyn DatasetSource>,
    columns: Columns,
    rollouts: Vec<RolloutFile>,
}

/// One opened file of rollouts.
struct RolloutFile {
    /// As given on the command line.
    name: String,
    source: Box<dyn DatasetSource>,
    /// Its columns that go with the dataset's.
    columns: Columns,
}

/// A fitted reference and what is known about it.
struct Fitted {
    ksim: KSim,
    /// An exact search over the same reference, if the approximation error is wanted.
    exact: Option<KSim>,
    /// The index the reference lies in, which bounds the memory of a large one while it lives.
    _saved: Option<SavedIndex>,
    steps: StepNumbers,
    dataset: DatasetPart,
    parameters: Parameters,
    search: SearchPart,
    fingerprint: String,
}

/// Runs a job. Writes the per-step file, prints nothing but warnings and progress.
pub(crate) fn run(job: &Job, context: &Context) -> Result<(Document, CommandOutcome)> {
    let started = Instant::now();
    if let Some(path) = &job.per_step {
        atomic::check_target(path)?;
    }
    for idle in job.settings.idle_flags() {
        context.warn(&idle);
    }
    let inputs = open(job, context)?;
    check_output(job, &inputs)?;
    let fitted = fit(&inputs, job, context)?;
    let results = score_all(&inputs, &fitted, job, context)?;
    let document = Document {
        schema: SCHEMA,
        version: env!("CARGO_PKG_VERSION"),
        results,
        dataset: fitted.dataset,
        parameters: fitted.parameters,
        search: fitted.search,
        fingerprint: fitted.fingerprint,
        threads: context.threads(),
        elapsed_s: started.elapsed().as_secs_f64(),
    };
    let sources = inputs.rollouts.iter().map(|file| file.source.info());
    let outcome = CommandOutcome::of(sources.chain([inputs.dataset.info()]));
    Ok((document, outcome))
}

/// Opens every file and checks that they fit, before anything is computed.
fn open(job: &Job, context: &Context) -> Result<Inputs> {
    let (resolved, dataset) = data_args::open(&job.dataset, &job.dataset_options)?;
    warn_of(dataset.info(), context);
    let columns = Columns::select(&*dataset, job.settings.state_columns.as_deref())
        .with_context(|| dataset.info().path.display().to_string())?;
    let listed = Listed::new(&job.rollout_options, &job.dataset_options);
    let mut rollouts = Vec::with_capacity(job.rollouts.len());
    for name in &job.rollouts {
        let (_, source) = data_args::open(name, &job.rollout_options)?;
        let columns = pairing::columns_of(&*source, &*dataset, &columns, listed)?;
        warn_of(source.info(), context);
        if let Some(warning) = load::ignored_planners(&*source) {
            context.warn(&format!("{}: {warning}", source.info().path.display()));
        }
        rollouts.push(RolloutFile {
            name: name.clone(),
            source,
            columns,
        });
    }
    Ok(Inputs {
        dataset_name: resolved.name,
        dataset,
        columns,
        rollouts,
    })
}

/// Refuses to write over what is read.
fn check_output(job: &Job, inputs: &Inputs) -> Result<()> {
    let Some(target) = &job.per_step else {
        return Ok(());
    };
    let rollouts = inputs.rollouts.iter().map(|file| &*file.source);
    let sources = rollouts.chain([&*inputs.dataset]);
    let paths = sources.map(|source| &*source.info().path);
    let centers = job.settings.centers.iter().map(|file| &*file.path);
    let index = job.index.as_deref();
    atomic::check_not_an_input(target, paths.chain(centers).chain(index))
}

fn warn_of(info: &DatasetInfo, context: &Context) {
    for warning in &info.warnings {
        context.warn(&format!("{}: {warning}", info.path.display()));
    }
}

/// A normalized reference, and what is known about it.
struct Loaded {
    reference: Reference,
    prepared: Prepared,
    fingerprint: String,
    steps: StepNumbers,
    saved: Option<SavedIndex>,
}

/// Takes the reference from the index, or reads and normalizes the dataset.
fn load_reference(
    inputs: &Inputs,
    centers: Option<&Centers>,
    job: &Job,
    context: &Context,
) -> Result<Loaded> {
    let (source, columns) = (&*inputs.dataset, &inputs.columns);
    if let Some(path) = &job.index {
        let request = Request {
            source,
            options: &job.dataset_options,
            columns,
            settings: &job.settings,
            centers,
        };
        let indexed = indexed::open(path, &request, context)?;
        return Ok(Loaded {
            reference: indexed.reference,
            prepared: indexed.prepared,
            fingerprint: indexed.saved.about().dataset.fingerprint.clone(),
            steps: indexed.numbers,
            saved: Some(indexed.saved),
        });
    }
    let (data, steps) = load::dataset(source, columns, context)?.into_parts();
    Ok(Loaded {
        fingerprint: data.fingerprint(),
        reference: Reference::new(data)?,
        prepared: Prepared::default(),
        steps,
        saved: None,
    })
}

/// Builds the search over the dataset.
fn fit(inputs: &Inputs, job: &Job, context: &Context) -> Result<Fitted> {
    let settings = &job.settings;
    let info = inputs.dataset.info();
    let columns = &inputs.columns;
    let centers = read_centers(settings, columns.indices.len())?;
    let loaded = load_reference(inputs, centers.as_ref(), job, context)?;
    let reference = loaded.reference;
    let dataset = DatasetPart {
        n_episodes: reference.episodes().len(),
        n_steps: reference.states().n_rows(),
        fingerprint: loaded.fingerprint,
        ..DatasetPart::new(&inputs.dataset_name, info)
    };
    let mut parameters = Parameters::new(settings, columns, reference.actions().n_features());
    let working = match (settings.search, &centers, &loaded.prepared.clusters) {
        (Search::Clusters, None, None) => "fitting the clusters",
        _ => "building the search",
    };
    let progress = context.spinner(working.to_owned());
    let given = centers.as_ref().map(|centers| centers.values.clone());
    let n_steps = inputs
        .rollouts
        .iter()
        .map(|file| file.source.info().n_steps);
    let mut params = settings.params(given);
    if let Some(n_steps) = n_steps.sum::<Option<u64>>() {
        params = params.n_queries(usize::try_from(n_steps)?);
    }
    let ksim = params
        .fit_prepared(reference, loaded.prepared)
        .with_context(|| info.path.display().to_string())?;
    let exact = settings
        .approximation_error
        .then(|| ksim.with_search(Search::Auto))
        .transpose()?;
    drop(progress);
    let mut search = SearchPart::new(settings, centers.as_ref(), &ksim);
    search.index = job.index.as_ref().map(|path| path.display().to_string());
    parameters.n_clusters = search.clusters.as_ref().map(|clusters| clusters.n_clusters);
    let fingerprint = fingerprint(&dataset, &parameters, &search, centers.as_ref());
    Ok(Fitted {
        ksim,
        exact,
        _saved: loaded.saved,
        steps: loaded.steps,
        dataset,
        parameters,
        search,
        fingerprint,
    })
}

fn read_centers(settings: &Settings, width: usize) -> Result<Option<Centers>> {
    let Some(file) = &settings.centers else {
        return Ok(None);
    };
    let centers = file.read(width)?;
    let found = centers.values.len() / width;
    if settings.n_clusters_given && found != settings.n_clusters {
        bail!(
            "{}: tensor \"{}\" holds {found} centers, expected {} as --n-clusters says",
            file.path.display(),
            centers.tensor,
            settings.n_clusters
        );
    }
    Ok(Some(centers))
}

fn score_all(
    inputs: &Inputs,
    fitted: &Fitted,
    job: &Job,
    context: &Context,
) -> Result<Vec<RolloutResult>> {
    let labels = Labels {
        file: inputs.rollouts.len() > 1,
        planner: inputs
            .rollouts
            .iter()
            .any(|file| load::names_planners(&*file.source)),
    };
    let mut per_step = job
        .per_step
        .as_deref()
        .map(|path| PerStepWriter::create(path, labels))
        .transpose()?;
    let mut results = Vec::new();
    for RolloutFile {
        name: file,
        source,
        columns,
    } in &inputs.rollouts
    {
        let path = source.info().path.display();
        for steps in load::rollouts(&**source, columns, context)? {
            let (mut result, report) = score_one(file, &steps, fitted, (&job.settings, context))
                .with_context(|| path.to_string())?;
            let of_reader = source.info().warnings.iter().map(ToString::to_string);
            let own = warnings(&report, &job.settings);
            for warning in &own {
                context.warn(&format!("{}: {warning}", result.label()));
            }
            let of_planners = load::ignored_planners(&**source);
            result.warnings = of_reader.chain(of_planners).chain(own).collect();
            if let Some(writer) = &mut per_step {
                writer.write(&Scored {
                    file,
                    steps: &steps,
                    report: &report,
                    ksim: &fitted.ksim,
                    reference: &fitted.steps,
                })?;
            }
            results.push(result);
        }
    }
    per_step.map(PerStepWriter::finish).transpose()?;
    Ok(results)
}

fn score_one(
    file: &str,
    steps: &Steps,
    fitted: &Fitted,
    (settings, context): (&Settings, &Context),
) -> Result<(RolloutResult, Report)> {
    let started = Instant::now();
    let n_steps = steps.trajectories.n_rows() as u64;
    let progress = context.bar(format!("scoring {file}"), n_steps, "steps");
    let mut set = |done: usize| progress.set(done as u64);
    let mut options = ScoreOptions {
        exclude_same_episode: settings.exclude_same_episode,
        progress: Some(&mut set),
    };
    let report = fitted.ksim.score_with(&steps.trajectories, &mut options)?;
    let mut result = RolloutResult::new(file, steps.planner.clone(), &report);
    result.elapsed_s = started.elapsed().as_secs_f64();
    if let Some(exact) = &fitted.exact {
        let excluded = settings.exclude_same_episode;
        let error =
            ApproximationError::measure(&fitted.ksim, exact, &steps.trajectories, excluded)?;
        result.approximation_error = Some(error.into());
    }
    Ok((result, report))
}

/// What a reader of the number should know.
fn warnings(report: &Report, settings: &Settings) -> Vec<String> {
    let mut warnings = Vec::new();
    let on_the_data = report.steps.iter().all(|step| step.distance < SAME_STEP);
    if on_the_data && !settings.exclude_same_episode {
        warnings.push(
            "every step is itself a step of the dataset, so every score is 1; to score a dataset \
             against itself add --exclude-same-episode"
                .to_owned(),
        );
    } else if report.saturated_share > MUCH_SATURATION {
        let [low, _, median, _, high] = report.scaled_distance_quantiles;
        warnings.push(format!(
            "{:.1} % of the steps are saturated (score 1): K-Sim says little here; compare d/√d, \
             which does not saturate: mean {}, median {}, 5–95 % {}–{}",
            100.0 * report.saturated_share,
            table::decimals(report.mean_scaled_distance),
            table::decimals(median),
            table::decimals(low),
            table::decimals(high)
        ));
    }
    if report.state_action.interval_95.is_none() && settings.n_resamples > 0 {
        warnings.push("a single episode has no interval".to_owned());
    }
    warnings
}
