//! Playing a benchmark.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::num::NonZeroUsize;

use ksim_datasets::{DatasetSource, OpenOptions, SearchRoots};
use ksim_envs::ResetOptions;
use ksim_envs::registry::{self, EnvironmentRequest};
use ksim_envs::vector::VectorEnvironment;
use ksim_planners::{Registry, run_info};
use serde_json::{Value, json};

use super::config::{EnvironmentEntry, PlannerEntry, Suite, file_name};
use super::contents::Contents;
use super::error::SuiteError;
use crate::error::HarnessError;
use crate::k_sim::Reference;
use crate::planner_source::{OpenPlanner, PlannerSource, SourceError};
use crate::policy::{self, Planned, Policy, PolicySpec};
use crate::record::EpisodeTrace;
use crate::rollout::{Continue, Observer, RolloutConfig, rollout};
use crate::run_dir::{EpisodeRow, RunDir};

/// Which cell.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct CellName<'a> {
    /// Name of the planner.
    pub planner: &'a str,
    /// Name of the environment.
    pub environment: &'a str,
    /// Number of the run, from 0.
    pub run: usize,
}

impl fmt::Display for CellName<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "{} in {}, run {}",
            self.planner, self.environment, self.run
        )
    }
}

/// Who watches a benchmark.
pub trait SuiteObserver {
    /// A cell is next; `is_done` says that it was played before.
    fn cell(&mut self, cell: &CellName<'_>, number: usize, of: usize, is_done: bool);

    /// So many episodes and steps of the cell are done. `Stop` gives the cell up.
    fn progress(&mut self, n_episodes: usize, n_steps: u64) -> Continue {
        let _ = (n_episodes, n_steps);
        Continue::Yes
    }

    /// What to know before numbers are compared.
    fn note(&mut self, message: &str) {
        let _ = message;
    }
}

/// What was played.
#[derive(Debug, Clone, PartialEq)]
pub struct Played {
    /// A row per episode: environments, planners and runs in the order of the suite.
    pub rows: Vec<EpisodeRow>,
    /// Whether all cells are done; otherwise the observer stopped it.
    pub finished: bool,
    /// Family of every planner's run, by the names of planner and environment.
    pub families: BTreeMap<(String, String), String>,
    /// Those whose training is not finished.
    pub unfinished: BTreeSet<(String, String)>,
    /// What the results were made with.
    pub manifest: Value,
}

/// Plays the cells that are missing in the folder, `n_slots` environments at a time.
///
/// Whatever can be wrong before a step is played is found first: cells of other settings, and planners that cannot be
/// opened. Then it writes `manifest.json`, each cell as it is done, and `episodes.parquet` in the end.
///
/// # Errors
/// The first cell that fails, after those before it were kept.
pub fn play(
    suite: &Suite,
    families: &Registry,
    run_dir: &RunDir,
    n_slots: NonZeroUsize,
    observer: &mut dyn SuiteObserver,
) -> Result<Played, SuiteError> {
    suite.check()?;
    let mut played = Played {
        rows: Vec::new(),
        finished: true,
        families: BTreeMap::new(),
        unfinished: BTreeSet::new(),
        manifest: Value::Null,
    };
    let sites = suite.environments.iter();
    let sites = sites.map(|environment| Site::new(environment, observer));
    let mut sites = sites.collect::<Result<Vec<_>, _>>()?;
    let mut contents = Contents::default();
    let mut cells = Vec::new();
    for (at, site) in sites.iter().enumerate() {
        for planner in &suite.planners {
            if !planner.plays_in(site.entry) {
                continue;
            }
            let player = Player {
                suite,
                families,
                planner,
                source: planner.source_in(site.entry, &suite.folder)?,
                n_slots,
            };
            player.describe(site, &mut played, observer)?;
            let name = CellName {
                planner: &planner.name,
                environment: &site.entry.name,
                run: 0,
            };
            let settings = player.settings(site, &mut contents);
            let settings = settings.map_err(in_cell(name.to_string()))?;
            cells.extend(player.cells(at, site, &settings, run_dir)?);
        }
    }
    played.manifest = manifest(suite, &sites, &played);
    let text = serde_json::to_string_pretty(&played.manifest).unwrap_or_default();
    run_dir.write_text("manifest.json", &(text + "\n"))?;
    let n_cells = cells.len();
    let mut last_site = 0;
    for (number, cell) in cells.into_iter().enumerate() {
        if cell.site != last_site {
            // The search over its dataset is not needed any more.
            sites[last_site].reference = None;
            last_site = cell.site;
        }
        let site = &mut sites[cell.site];
        observer.cell(&cell.name(site), number + 1, n_cells, cell.done.is_some());
        let name = cell.name(site).to_string();
        let found = cell.played(site, run_dir, observer);
        match found.map_err(in_cell(name))? {
            Some(rows) => played.rows.extend(rows),
            None => {
                played.finished = false;
                return Ok(played);
            }
        }
    }
    run_dir.write_episodes(&played.rows)?;
    Ok(played)
}

fn in_cell(cell: String) -> impl FnOnce(SuiteError) -> SuiteError {
    move |source| SuiteError::Cell {
        cell,
        source: Box::new(source),
    }
}

/// What the results are made with: enough to make them again.
fn manifest(suite: &Suite, sites: &[Site<'_>], played: &Played) -> Value {
    let environments: Vec<Value> = sites.iter().map(Site::describe).collect();
    let runs: Vec<Value> = played
        .families
        .iter()
        .map(|(key, family)| {
            let ((planner, environment), finished) = (key, !played.unfinished.contains(key));
            json!({"planner": planner, "environment": environment, "family": family, "finished": finished})
        })
        .collect();
    json!({
        "schema": "ksim.bench-planners/1",
        "ksim_version": env!("CARGO_PKG_VERSION"),
        "features": {"mujoco": cfg!(feature = "mujoco")},
        "suite": suite,
        "environments": environments,
        "families": runs,
    })
}

/// An environment of a suite, found.
struct Site<'a> {
    entry: &'a EnvironmentEntry,
    request: EnvironmentRequest,
    /// Returns that count as 0 and 1.
    scores: Option<(f64, f64)>,
    source: Option<Box<dyn DatasetSource>>,
    /// Made when the first cell needs it.
    reference: Option<Reference>,
}

impl<'a> Site<'a> {
    fn new(
        entry: &'a EnvironmentEntry,
        observer: &mut dyn SuiteObserver,
    ) -> Result<Self, SuiteError> {
        let source = match &entry.dataset {
            None => None,
            Some(name) => {
                let resolved = ksim_datasets::resolve(name, &SearchRoots::from_env())?;
                Some(ksim_datasets::open(
                    &resolved.path,
                    &OpenOptions::default(),
                )?)
            }
        };
        let of_dataset = source
            .as_ref()
            .map(|source| registry::for_dataset(source.info()));
        let (mut request, scores) = match (&entry.env, of_dataset) {
            (None, Some(found)) => {
                let found = found?;
                if let Some(note) = found.note {
                    observer.note(&format!("{}: {note}", entry.name));
                }
                (found.evaluation, found.reference)
            }
            (Some(id), of_dataset) => {
                let info = registry::find(id)?;
                let scores = of_dataset.and_then(|found| found.ok()?.reference);
                let scores = scores.or(info.family.reference_scores());
                (EnvironmentRequest::of_id(&info.id), scores)
            }
            (None, None) => {
                return Err(SuiteError::Entry {
                    place: format!("environment \"{}\"", entry.name),
                    expected: "env or dataset".to_owned(),
                    found: "neither".to_owned(),
                });
            }
        };
        request.kwargs.extend(entry.env_args.clone());
        request.max_episode_steps = entry.max_steps.or(request.max_episode_steps);
        Ok(Self {
            entry,
            request,
            scores,
            source,
            reference: None,
        })
    }

    fn describe(&self) -> Value {
        json!({
            "name": self.entry.name,
            "id": self.request.id,
            "kwargs": self.request.kwargs,
            "max_episode_steps": self.request.max_episode_steps,
            "reference_returns": self.scores.map(|(low, high)| [low, high]),
            "dataset": self.source.as_ref().map(|source| source.info().id.clone()),
        })
    }
}

/// A planner in an environment.
#[derive(Clone)]
struct Player<'a> {
    suite: &'a Suite,
    families: &'a Registry,
    planner: &'a PlannerEntry,
    source: Option<PlannerSource>,
    n_slots: NonZeroUsize,
}

/// What is played in one go.
struct Cell<'a> {
    player: Player<'a>,
    /// Number of the environment.
    site: usize,
    run: usize,
    settings: Value,
    /// Its episodes, if it was played before.
    done: Option<Vec<EpisodeRow>>,
}

impl<'a> Player<'a> {
    /// Keeps what a run says of itself, and tells of what is not finished.
    fn describe(
        &self,
        site: &Site<'_>,
        played: &mut Played,
        observer: &mut dyn SuiteObserver,
    ) -> Result<(), SuiteError> {
        let Some(PlannerSource::Run(run)) = &self.source else {
            return Ok(());
        };
        let info = run_info(run).map_err(|source| SourceError::Planner {
            planner: self.planner.name.clone(),
            source,
        })?;
        let key = (self.planner.name.clone(), site.entry.name.clone());
        if !info.finished {
            let (planner, run) = (&self.planner.name, run.display());
            observer.note(&format!("{planner}: the training of {run} is not finished"));
            played.unfinished.insert(key.clone());
        }
        played.families.insert(key, info.family);
        Ok(())
    }

    /// Its cells, with what is done of them. If something is left to play, the planner is opened once to see that it
    /// can be.
    fn cells(
        &self,
        at: usize,
        site: &Site<'_>,
        settings: &Value,
        run_dir: &RunDir,
    ) -> Result<Vec<Cell<'a>>, SuiteError> {
        let mut cells = Vec::with_capacity(self.suite.runs);
        for run in 0..self.suite.runs {
            let mut cell = Cell {
                player: self.clone(),
                site: at,
                run,
                settings: settings.clone(),
                done: None,
            };
            cell.settings["run"] = json!(run);
            let done = run_dir.read_cell(&cell.file(site), &cell.settings);
            let name = cell.name(site).to_string();
            cell.done = done.map_err(|error| in_cell(name)(error.into()))?;
            cells.push(cell);
        }
        if let Some(cell) = cells.iter().find(|cell| cell.done.is_none()) {
            let opened = || {
                let environment = registry::make(&site.request)?;
                let environments = VectorEnvironment::new(vec![environment])?;
                self.policy(&environments).map(drop)
            };
            opened().map_err(in_cell(cell.name(site).to_string()))?;
        }
        Ok(cells)
    }

    /// Everything that the numbers of its cells follow from, but for the number of the run.
    fn settings(&self, site: &Site<'_>, contents: &mut Contents) -> Result<Value, SuiteError> {
        let run = match &self.source {
            Some(PlannerSource::Run(run)) => Some(contents.of_run(run)?),
            _ => None,
        };
        let mut files = Vec::new();
        match &self.source {
            Some(PlannerSource::Nearest { dataset, .. } | PlannerSource::Replay { dataset }) => {
                files.push(ksim_datasets::resolve(dataset, &SearchRoots::from_env())?.path)
            }
            Some(_) => {}
            None => {
                let text = self.planner.policy.as_deref().unwrap_or_default();
                files.extend(PolicySpec::parse(text)?.files());
            }
        }
        let files: Result<Vec<String>, SuiteError> =
            files.iter().map(|path| contents.of(path)).collect();
        let dataset = match &site.source {
            Some(source) => Some(contents.of(&source.info().path)?),
            None => None,
        };
        let mut planner = self.planner.clone();
        // Neither the name nor where else it plays changes what it does.
        planner.name.clear();
        planner.environments.clear();
        Ok(json!({
            "version": env!("CARGO_PKG_VERSION"),
            "planner": planner,
            "run_hash": run,
            "file_hashes": files?,
            "dataset_hash": dataset,
            "environment": site.describe(),
            "goal_cell": site.entry.goal_cell,
            "reset_cell": site.entry.reset_cell,
            "k_sim": site.entry.measures_k_sim(),
            "episodes": self.suite.episodes,
            "seed": self.suite.seed,
            "discount": self.suite.discount,
        }))
    }

    fn policy(&self, environments: &VectorEnvironment) -> Result<Box<dyn Policy>, SuiteError> {
        let environment = environments.spec();
        let Some(source) = &self.source else {
            let text = self.planner.policy.as_deref().unwrap_or_default();
            return Ok(policy::build(&PolicySpec::parse(text)?, environment)?);
        };
        let options = OpenPlanner {
            load: self.planner.load_options(rayon::current_num_threads()),
            replan_interval: self.planner.replan_interval.unwrap_or(NonZeroUsize::MIN),
            ..OpenPlanner::default()
        };
        let planner = source.open(self.families, environment, &options)?;
        let name = self.planner.name.clone();
        let interval = options.replan_interval;
        Ok(Box::new(Planned::new(
            name,
            planner,
            interval,
            environment,
        )?))
    }
}

impl Cell<'_> {
    fn name<'b>(&'b self, site: &'b Site<'_>) -> CellName<'b> {
        CellName {
            planner: &self.player.planner.name,
            environment: &site.entry.name,
            run: self.run,
        }
    }

    /// Name of its file.
    fn file(&self, site: &Site<'_>) -> String {
        format!(
            "{}--{}--{}",
            file_name(&self.player.planner.name),
            file_name(&site.entry.name),
            self.run
        )
    }

    /// The episodes of the cell, from its file or played now; `None` where the observer stopped it.
    fn played(
        mut self,
        site: &mut Site<'_>,
        run_dir: &RunDir,
        observer: &mut dyn SuiteObserver,
    ) -> Result<Option<Vec<EpisodeRow>>, SuiteError> {
        if let Some(rows) = self.done.take() {
            return Ok(Some(rows));
        }
        let rows = self.play(site, observer)?;
        match rows.len() == self.player.suite.episodes {
            true => run_dir.write_cell(&self.file(site), &self.settings, &rows)?,
            false => return Ok(None),
        }
        Ok(Some(rows))
    }

    fn play(
        &self,
        site: &mut Site<'_>,
        observer: &mut dyn SuiteObserver,
    ) -> Result<Vec<EpisodeRow>, SuiteError> {
        let Player { suite, n_slots, .. } = self.player;
        let n_slots = n_slots.get().min(suite.episodes);
        let environments = (0..n_slots).map(|_| registry::make(&site.request));
        let mut environments =
            VectorEnvironment::new(environments.collect::<Result<Vec<_>, _>>()?)?;
        let mut policy = self.player.policy(&environments)?;
        if let (true, None, Some(source)) =
            (site.entry.measures_k_sim(), &site.reference, &site.source)
        {
            site.reference = Some(Reference::fit(source.as_ref(), environments.spec())?);
        }
        let first = (self.run as u64).saturating_mul(suite.episodes as u64);
        let config = RolloutConfig {
            n_episodes: suite.episodes,
            n_runs: 1,
            seed: suite.seed.saturating_add(first),
            discount: suite.discount,
            reset: ResetOptions {
                goal_cell: site.entry.goal_cell,
                reset_cell: site.entry.reset_cell,
            },
            reference: site.scores,
        };
        let mut watcher = Watcher {
            cell: self,
            environment: &site.entry.name,
            n_notes: policy.annotations().len(),
            reference: site.reference.as_ref(),
            rows: Vec::new(),
            observer,
        };
        rollout(&mut environments, &mut *policy, &config, &mut watcher)?;
        Ok(watcher.rows)
    }
}

/// Keeps a row per episode.
struct Watcher<'a> {
    cell: &'a Cell<'a>,
    environment: &'a str,
    n_notes: usize,
    reference: Option<&'a Reference>,
    rows: Vec<EpisodeRow>,
    observer: &'a mut dyn SuiteObserver,
}

impl Observer for Watcher<'_> {
    fn episode(&mut self, trace: EpisodeTrace) -> Result<Continue, HarnessError> {
        let k_sim = match self.reference {
            Some(reference) => Some(reference.score(&trace)?.0),
            None => None,
        };
        let mean_novelty = match self.n_notes {
            0 => None,
            n => mean(trace.annotations.chunks_exact(n).map(|notes| notes[0])),
        };
        let mut record = trace.record;
        record.run = self.cell.run;
        self.rows.push(EpisodeRow {
            planner: self.cell.player.planner.name.clone(),
            environment: self.environment.to_owned(),
            record,
            k_sim,
            mean_novelty,
        });
        Ok(Continue::Yes)
    }

    fn progress(&mut self, n_steps: u64) -> Continue {
        self.observer.progress(self.rows.len(), n_steps)
    }
}

/// The mean of numbers; `None` if there are none or one is not known.
fn mean(values: impl Iterator<Item = f64>) -> Option<f64> {
    let (sum, n) = values.fold((0.0, 0usize), |(sum, n), value| (sum + value, n + 1));
    (n > 0)
        .then(|| sum / n as f64)
        .filter(|mean| mean.is_finite())
}

#[cfg(test)]
mod tests;
