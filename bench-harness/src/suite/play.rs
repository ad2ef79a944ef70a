//! Playing a benchmark.

use std::collections::BTreeMap;
use std::fmt;
use std::num::NonZeroUsize;
use std::path::Path;

use ksim_datasets::{DatasetSource, OpenOptions, SearchRoots};
use ksim_envs::ResetOptions;
use ksim_envs::registry::{self, EnvironmentRequest};
use ksim_envs::vector::VectorEnvironment;
use ksim_planners::{Registry, family_of};
use serde_json::{Value, json};

use super::config::{EnvironmentEntry, PlannerEntry, Suite, file_name};
use super::error::SuiteError;
use crate::error::HarnessError;
use crate::k_sim::Reference;
use crate::planner_source::{OpenPlanner, PlannerSource};
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
    /// What the results were made with.
    pub manifest: Value,
}

/// Plays the cells that are missing in the folder, `n_slots` environments at a time.
///
/// Writes `manifest.json` before the first cell, each cell as it is done, and `episodes.parquet` in the end.
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
        manifest: Value::Null,
    };
    let mut sites = Vec::new();
    for environment in &suite.environments {
        let site = Site::new(environment, observer)?;
        for planner in suite
            .planners
            .iter()
            .filter(|planner| planner.plays_in(environment))
        {
            let source = planner.source_in(environment, &suite.folder)?;
            if let Some(PlannerSource::Run(run)) = &source {
                let key = (planner.name.clone(), environment.name.clone());
                let failed = |source| crate::planner_source::SourceError::Planner {
                    planner: planner.name.clone(),
                    source,
                };
                played.families.insert(key, family_of(run).map_err(failed)?);
            }
        }
        sites.push(site);
    }
    played.manifest = manifest(suite, &sites, &played.families);
    let text = serde_json::to_string_pretty(&played.manifest).unwrap_or_default();
    run_dir.write_text("manifest.json", &(text + "\n"))?;
    let of_site = |site: &Site<'_>| {
        let players = suite
            .planners
            .iter()
            .filter(|planner| planner.plays_in(site.entry));
        players.count() * suite.runs
    };
    let n_cells = sites.iter().map(of_site).sum();
    let mut number = 0;
    for site in &mut sites {
        for planner in suite
            .planners
            .iter()
            .filter(|planner| planner.plays_in(site.entry))
        {
            for run in 0..suite.runs {
                number += 1;
                let cell = Cell {
                    suite,
                    families,
                    planner,
                    run,
                    n_slots,
                };
                let name = cell.name(site);
                let place = (number, n_cells);
                let found = cell.played(site, run_dir, place, observer);
                match found.map_err(|source| SuiteError::Cell {
                    cell: name.clone(),
                    source: Box::new(source),
                })? {
                    Some(rows) => played.rows.extend(rows),
                    None => {
                        played.finished = false;
                        return Ok(played);
                    }
                }
            }
        }
        // The search over its dataset is not needed any more.
        site.reference = None;
    }
    run_dir.write_episodes(&played.rows)?;
    Ok(played)
}

/// What the results are made with: enough to make them again.
fn manifest(
    suite: &Suite,
    sites: &[Site<'_>],
    families: &BTreeMap<(String, String), String>,
) -> Value {
    let environments: Vec<Value> = sites.iter().map(Site::describe).collect();
    let runs: Vec<Value> = families
        .iter()
        .map(|((planner, environment), family)| {
            json!({"planner": planner, "environment": environment, "family": family})
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

/// What is played in one go.
struct Cell<'a> {
    suite: &'a Suite,
    families: &'a Registry,
    planner: &'a PlannerEntry,
    run: usize,
    n_slots: NonZeroUsize,
}

impl Cell<'_> {
    fn name(&self, site: &Site<'_>) -> String {
        let name = CellName {
            planner: &self.planner.name,
            environment: &site.entry.name,
            run: self.run,
        };
        name.to_string()
    }

    /// The episodes of the cell, from its file or played now; `None` where the observer stopped it.
    fn played(
        &self,
        site: &mut Site<'_>,
        run_dir: &RunDir,
        (number, of): (usize, usize),
        observer: &mut dyn SuiteObserver,
    ) -> Result<Option<Vec<EpisodeRow>>, SuiteError> {
        let source = self.planner.source_in(site.entry, &self.suite.folder)?;
        let settings = self.settings(site, source.as_ref());
        let file = format!(
            "{}--{}--{}",
            file_name(&self.planner.name),
            file_name(&site.entry.name),
            self.run
        );
        let done = run_dir.read_cell(&file, &settings)?;
        let name = CellName {
            planner: &self.planner.name,
            environment: &site.entry.name,
            run: self.run,
        };
        observer.cell(&name, number, of, done.is_some());
        if done.is_some() {
            return Ok(done);
        }
        let rows = self.play(site, source.as_ref(), observer)?;
        match rows.len() == self.suite.episodes {
            true => run_dir.write_cell(&file, &settings, &rows)?,
            false => return Ok(None),
        }
        Ok(Some(rows))
    }

    /// Everything that the cell's numbers follow from.
    fn settings(&self, site: &Site<'_>, source: Option<&PlannerSource>) -> Value {
        let hash = match source {
            Some(PlannerSource::Run(run)) => run_hash(run),
            _ => None,
        };
        let mut planner = self.planner.clone();
        // Neither the name nor where else it plays changes what it does.
        planner.name.clear();
        planner.environments.clear();
        json!({
            "planner": planner,
            "run_hash": hash,
            "environment": site.describe(),
            "goal_cell": site.entry.goal_cell,
            "reset_cell": site.entry.reset_cell,
            "k_sim": site.entry.measures_k_sim(),
            "run": self.run,
            "episodes": self.suite.episodes,
            "seed": self.suite.seed,
            "discount": self.suite.discount,
        })
    }

    fn play(
        &self,
        site: &mut Site<'_>,
        source: Option<&PlannerSource>,
        observer: &mut dyn SuiteObserver,
    ) -> Result<Vec<EpisodeRow>, SuiteError> {
        let n_slots = self.n_slots.get().min(self.suite.episodes);
        let environments = (0..n_slots).map(|_| registry::make(&site.request));
        let mut environments =
            VectorEnvironment::new(environments.collect::<Result<Vec<_>, _>>()?)?;
        let mut policy = self.policy(source, &environments)?;
        if let (true, None, Some(source)) =
            (site.entry.measures_k_sim(), &site.reference, &site.source)
        {
            site.reference = Some(Reference::fit(source.as_ref(), environments.spec())?);
        }
        let first = (self.run as u64).saturating_mul(self.suite.episodes as u64);
        let config = RolloutConfig {
            n_episodes: self.suite.episodes,
            n_runs: 1,
            seed: self.suite.seed.saturating_add(first),
            discount: self.suite.discount,
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

    fn policy(
        &self,
        source: Option<&PlannerSource>,
        environments: &VectorEnvironment,
    ) -> Result<Box<dyn Policy>, SuiteError> {
        let environment = environments.spec();
        let Some(source) = source else {
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

/// A hash of the files of a run, of those that planning may read: another run of the same name, or one that was
/// trained further, is another planner.
fn run_hash(run: &Path) -> Option<String> {
    let mut files: Vec<_> = std::fs::read_dir(run)
        .ok()?
        .filter_map(|entry| Some(entry.ok()?.path()).filter(|path| path.is_file()))
        .filter(|path| {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            !name.starts_with("checkpoint") && !name.starts_with("losses")
        })
        .collect();
    files.sort();
    let mut hasher = blake3::Hasher::new();
    for path in files {
        let name = path.file_name()?.to_string_lossy().into_owned();
        let bytes = std::fs::read(&path).ok()?;
        hasher.update(name.as_bytes());
        hasher.update(&(bytes.len() as u64).to_le_bytes());
        hasher.update(&bytes);
    }
    Some(hasher.finalize().to_hex()[..32].to_owned())
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
            planner: self.cell.planner.name.clone(),
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
