//! What the episodes of a benchmark say: the paper's three tables, with intervals, beside the paper's own figures.

mod json;
mod markdown;
mod paper;

pub use json::json;
pub use markdown::markdown;
pub use paper::{PaperFigure, Rule, SWEEP, SweepPoint};

use crate::k_sim::{EpisodeKSim, KSimSummary};
use crate::record::{EpisodeRecord, Summary};
use crate::run_dir::EpisodeRow;
use crate::stats::{BootstrapOptions, Estimate, bootstrap_mean};
use crate::suite::{Played, Suite};

/// The results of a benchmark.
#[derive(Debug, Clone, PartialEq)]
pub struct Report {
    /// Name of the suite.
    pub suite: String,
    /// Episodes of every run.
    pub episodes: usize,
    /// Runs of every planner in every environment.
    pub runs: usize,
    /// Seed of the first episode.
    pub seed: u64,
    /// A result per environment and planner, in the order of the suite.
    pub entries: Vec<Entry>,
}

/// One planner in one environment, over all its runs.
#[derive(Debug, Clone, PartialEq)]
pub struct Entry {
    /// The environment.
    pub environment: String,
    /// The planner.
    pub planner: String,
    /// Its family, where it is of a run.
    pub family: Option<String>,
    /// Whether its training is finished.
    pub finished: bool,
    /// Returns, scores, success.
    pub summary: Summary,
    /// K-Sim, where it was measured.
    pub k_sim: Option<KSimSummary>,
    /// Mean over episodes of their mean novelty, where the planner knows it.
    pub novelty: Option<Estimate>,
    /// What the paper has for the same task and planner.
    pub paper: Option<&'static PaperFigure>,
}

impl Report {
    /// Summarizes the rows of a benchmark. What was not played is left out.
    pub fn new(suite: &Suite, played: &Played) -> Self {
        let mut entries = Vec::new();
        for environment in &suite.environments {
            let task = paper::task(environment.paper.as_deref(), environment.dataset.as_deref());
            for planner in &suite.planners {
                let own = |row: &&EpisodeRow| {
                    row.planner == planner.name && row.environment == environment.name
                };
                let rows: Vec<&EpisodeRow> = played.rows.iter().filter(own).collect();
                let key = (planner.name.clone(), environment.name.clone());
                let family = played.families.get(&key).cloned();
                let figure = |task: &str| paper::figure(task, family.as_deref()?);
                let paper = task.as_deref().and_then(figure);
                entries.extend(
                    Entry::new(&environment.name, &planner.name, &rows).map(|entry| Entry {
                        family,
                        finished: !played.unfinished.contains(&key),
                        paper,
                        ..entry
                    }),
                );
            }
        }
        Self {
            suite: suite.name.clone(),
            episodes: suite.episodes,
            runs: suite.runs,
            seed: suite.seed,
            entries,
        }
    }
}

impl Entry {
    /// Summarizes some rows; `None` if there are none.
    pub fn new(environment: &str, planner: &str, rows: &[&EpisodeRow]) -> Option<Self> {
        let options = BootstrapOptions::default();
        let records: Vec<EpisodeRecord> = rows.iter().map(|row| row.record.clone()).collect();
        let k_sim: Option<Vec<EpisodeKSim>> = rows.iter().map(|row| row.k_sim).collect();
        let novelty: Option<Vec<f64>> = rows.iter().map(|row| row.mean_novelty).collect();
        Some(Self {
            environment: environment.to_owned(),
            planner: planner.to_owned(),
            family: None,
            finished: true,
            summary: Summary::new(&records, &options)?,
            k_sim: k_sim.and_then(|k_sim| KSimSummary::new(&k_sim)),
            novelty: novelty.and_then(|novelty| bootstrap_mean(&novelty, &options)),
            paper: None,
        })
    }
}
