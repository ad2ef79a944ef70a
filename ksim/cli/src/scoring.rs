//! Scoring files against a dataset: open, check, read, fit, score.

mod fitted;

use std::path::PathBuf;
use std::time::Instant;

use anyhow::{Context as _, Result};
use ksim::{ApproximationError, KSim, Report, ScoreOptions};
use ksim_datasets::{DatasetInfo, DatasetSource, OpenOptions};

use self::fitted::{Fitted, fit};
use crate::atomic;
use crate::context::Context;
use crate::data_args;
use crate::document::{Document, RolloutResult, SCHEMA};
use crate::load::{self, Columns, StepNumbers, Steps};
use crate::outcome::CommandOutcome;
use crate::pairing::{self, Listed};
use crate::per_step::{Labels, PerStepWriter, Scored};
use crate::settings::Settings;
use crate::table;

/// Share of saturated steps above which a score says little.
pub(crate) const MUCH_SATURATION: f64 = 0.9;

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
    /// What else the command writes: no input may be there.
    pub(crate) output: Option<PathBuf>,
}

/// A job whose files are opened and whose dataset is fitted.
pub(crate) struct Session {
    inputs: Inputs,
    fitted: Fitted,
}

/// One scored file of rollouts, or one planner of it.
pub(crate) struct ScoredRollouts {
    /// Place of the file among those of the session.
    pub(crate) file: usize,
    /// States and actions.
    pub(crate) steps: Steps,
    /// Their scores.
    pub(crate) report: Report,
}

/// What a command asks of the opened dataset and rollouts, before anything is read.
pub(crate) type Check<'a> = dyn Fn(&dyn DatasetSource, &[RolloutFile]) -> Result<()> + 'a;

/// Takes what was scored.
pub(crate) type Visit<'a> = dyn FnMut(ScoredRollouts) -> Result<()> + 'a;

/// The opened files of a job.
struct Inputs {
    dataset_name: String,
    dataset: Box<dyn DatasetSource>,
    columns: Columns,
    rollouts: Vec<RolloutFile>,
}

/// One opened file of rollouts.
pub(crate) struct RolloutFile {
    /// As given on the command line.
    pub(crate) name: String,
    /// The opened file.
    pub(crate) source: Box<dyn DatasetSource>,
    /// Its columns that go with the dataset's.
    pub(crate) columns: Columns,
}

/// Runs a job. Writes the per-step file, prints nothing but warnings and progress.
pub(crate) fn run(job: &Job, context: &Context) -> Result<(Document, CommandOutcome)> {
    let started = Instant::now();
    let session = Session::open(job, context)?;
    let results = session.score(job, context, &mut |_| Ok(()))?;
    let mut document = session.document(results, context);
    document.elapsed_s = started.elapsed().as_secs_f64();
    Ok((document, session.outcome()))
}

impl Session {
    /// Opens all files, checks that they fit, reads the dataset and builds the search.
    pub(crate) fn open(job: &Job, context: &Context) -> Result<Self> {
        Self::open_checked(job, context, &|_, _| Ok(()))
    }

    /// The same with a further check of the opened files.
    pub(crate) fn open_checked(job: &Job, context: &Context, check: &Check<'_>) -> Result<Self> {
        for path in [&job.per_step, &job.output].into_iter().flatten() {
            atomic::check_target(path)?;
        }
        for idle in job.settings.idle_flags() {
            context.warn(&idle);
        }
        let inputs = open(job, context)?;
        check_outputs(job, &inputs)?;
        check(&*inputs.dataset, &inputs.rollouts)?;
        let fitted = fit(&inputs, job, context)?;
        Ok(Self { inputs, fitted })
    }

    /// Scores all files in their order and hands on what came of each. Writes the per-step file.
    pub(crate) fn score(
        &self,
        job: &Job,
        context: &Context,
        visit: &mut Visit<'_>,
    ) -> Result<Vec<RolloutResult>> {
        score_all(&self.inputs, &self.fitted, job, context, visit)
    }

    /// Opens rollouts that are not among the job's.
    pub(crate) fn open_rollouts(&self, name: &str, job: &Job) -> Result<RolloutFile> {
        open_rollouts(name, job, (&*self.inputs.dataset, &self.inputs.columns))
    }

    /// The document of the results, without the time they took.
    pub(crate) fn document(&self, results: Vec<RolloutResult>, context: &Context) -> Document {
        let fitted = &self.fitted;
        Document {
            schema: SCHEMA,
            version: env!("CARGO_PKG_VERSION"),
            results,
            dataset: fitted.dataset.clone(),
            parameters: fitted.parameters.clone(),
            search: fitted.search.clone(),
            fingerprint: fitted.fingerprint.clone(),
            threads: context.threads(),
            elapsed_s: 0.0,
        }
    }

    /// How the command ends, as far as the readers know.
    pub(crate) fn outcome(&self) -> CommandOutcome {
        let inputs = &self.inputs;
        let sources = inputs.rollouts.iter().map(|file| file.source.info());
        CommandOutcome::of(sources.chain([inputs.dataset.info()]))
    }

    /// The engine, fitted to the dataset.
    pub(crate) fn ksim(&self) -> &KSim {
        &self.fitted.ksim
    }

    /// Step numbers of the dataset.
    pub(crate) fn reference_numbers(&self) -> &StepNumbers {
        &self.fitted.steps
    }

    /// The dataset.
    pub(crate) fn dataset(&self) -> &dyn DatasetSource {
        &*self.inputs.dataset
    }

    /// The rollouts.
    pub(crate) fn files(&self) -> &[RolloutFile] {
        &self.inputs.rollouts
    }

    /// Names of the state columns.
    pub(crate) fn state_names(&self) -> &[String] {
        &self.inputs.columns.names
    }
}

/// Opens every file and checks that they fit, before anything is computed.
fn open(job: &Job, context: &Context) -> Result<Inputs> {
    let (resolved, dataset) = data_args::open(&job.dataset, &job.dataset_options)?;
    warn_of(dataset.info(), context);
    let columns = Columns::select(&*dataset, job.settings.state_columns.as_deref())
        .with_context(|| dataset.info().path.display().to_string())?;
    let mut rollouts = Vec::with_capacity(job.rollouts.len());
    for name in &job.rollouts {
        let file = open_rollouts(name, job, (&*dataset, &columns))?;
        warn_of(file.source.info(), context);
        if let Some(warning) = load::ignored_planners(&*file.source) {
            context.warn(&format!("{}: {warning}", file.source.info().path.display()));
        }
        rollouts.push(file);
    }
    Ok(Inputs {
        dataset_name: resolved.name,
        dataset,
        columns,
        rollouts,
    })
}

/// Opens rollouts and finds their columns that go with the chosen ones of the dataset.
fn open_rollouts(
    name: &str,
    job: &Job,
    (dataset, columns): (&dyn DatasetSource, &Columns),
) -> Result<RolloutFile> {
    let (_, source) = data_args::open(name, &job.rollout_options)?;
    let listed = Listed::new(&job.rollout_options, &job.dataset_options);
    let columns = pairing::columns_of(&*source, dataset, columns, listed)?;
    Ok(RolloutFile {
        name: name.to_owned(),
        source,
        columns,
    })
}

/// Refuses to write over what is read.
fn check_outputs(job: &Job, inputs: &Inputs) -> Result<()> {
    for target in [&job.per_step, &job.output].into_iter().flatten() {
        let rollouts = inputs.rollouts.iter().map(|file| &*file.source);
        let sources = rollouts.chain([&*inputs.dataset]);
        let paths = sources.map(|source| &*source.info().path);
        let centers = job.settings.centers.iter().map(|file| &*file.path);
        let index = job.index.as_deref();
        atomic::check_not_an_input(target, paths.chain(centers).chain(index))?;
    }
    Ok(())
}

fn warn_of(info: &DatasetInfo, context: &Context) {
    for warning in &info.warnings {
        context.warn(&format!("{}: {warning}", info.path.display()));
    }
}

fn score_all(
    inputs: &Inputs,
    fitted: &Fitted,
    job: &Job,
    context: &Context,
    visit: &mut Visit<'_>,
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
    for (place, rollouts) in inputs.rollouts.iter().enumerate() {
        let RolloutFile {
            name: file,
            source,
            columns,
        } = rollouts;
        let path = source.info().path.display();
        let groups = load::rollouts(&**source, columns, context)?;
        for steps in groups {
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
            visit(ScoredRollouts {
                file: place,
                steps,
                report,
            })?;
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

/// What is to be said of much saturation.
pub(crate) fn saturated(share: f64, mean_scaled_distance: f64) -> String {
    format!(
        "{:.1} % of the steps are saturated (score 1): K-Sim says little here; compare d/√d, \
         which does not saturate: mean {}",
        100.0 * share,
        table::decimals(mean_scaled_distance)
    )
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
        let mean = saturated(report.saturated_share, report.mean_scaled_distance);
        let [low, median, high] = [low, median, high].map(table::decimals);
        warnings.push(format!("{mean}, median {median}, 5–95 % {low}–{high}"));
    }
    if report.state_action.interval_95.is_none() && settings.n_resamples > 0 {
        warnings.push("a single episode has no interval".to_owned());
    }
    warnings
}
