//! Rollouts that grow: what was scored before is kept.

use std::collections::BTreeMap;

use anyhow::Result;
use ksim::{EpisodeRows, ScoreOptions, Trajectories};

use crate::context::Context;
use crate::load::{self, Steps};
use crate::scoring::{Job, RolloutFile, Session};
use crate::sparkline;

/// The scores of a file of rollouts as it was read last.
pub(crate) struct Watched<'a> {
    session: &'a Session,
    job: &'a Job,
    /// By planner and episode.
    episodes: BTreeMap<(Option<String>, i64), Known>,
}

/// An episode as far as it is scored.
#[derive(Debug, Default)]
struct Known {
    scores: Vec<f64>,
    /// A hash of these steps.
    hash: String,
}

impl<'a> Watched<'a> {
    /// Nothing is known yet.
    pub(crate) fn new(session: &'a Session, job: &'a Job) -> Self {
        Self {
            session,
            job,
            episodes: BTreeMap::new(),
        }
    }

    /// Scores the steps that are new, and forgets episodes that are gone. Gives a line per episode that is new or has
    /// changed, and one for all; nothing if nothing changed.
    ///
    /// # Errors
    /// The file cannot be read or scored; what was known still is.
    pub(crate) fn update(&mut self, file: &RolloutFile, context: &Context) -> Result<String> {
        let groups = load::rollouts(&*file.source, &file.columns, context)?;
        let mut lines = String::new();
        let mut left = BTreeMap::new();
        let n_before = self.episodes.len();
        for steps in &groups {
            for episode in steps.trajectories.episodes() {
                if episode.rows.is_empty() {
                    continue;
                }
                let key = (steps.planner.clone(), episode.episode_index);
                let (known, n_new) = self.grown(self.episodes.get(&key), steps, episode)?;
                if n_new > 0 {
                    lines += &line(&key, &known, n_new);
                }
                left.insert(key, known);
            }
        }
        let n_kept = left
            .keys()
            .filter(|key| self.episodes.contains_key(key))
            .count();
        self.episodes = left;
        if !lines.is_empty() || n_kept < n_before {
            lines += &self.total();
        }
        Ok(lines)
    }

    /// An episode with the scores of all its steps, and how many of these are new.
    fn grown(
        &self,
        known: Option<&Known>,
        steps: &Steps,
        episode: &EpisodeRows,
    ) -> Result<(Known, usize)> {
        let n = episode.rows.len();
        let n_known = known.map_or(0, |known| known.scores.len());
        let same = known.filter(|known| {
            let begins = n_known <= n
                && part(steps, episode, 0..n_known)
                    .is_ok_and(|part| part.fingerprint() == known.hash);
            begins && !self.job.settings.exclude_same_episode
        });
        let mut scores = same.map_or_else(Vec::new, |known| known.scores.clone());
        let n_new = n - scores.len();
        if n_new > 0 {
            let rollouts = part(steps, episode, scores.len()..n)?;
            let mut options = ScoreOptions {
                exclude_same_episode: self.job.settings.exclude_same_episode,
                progress: None,
            };
            let report = self.session.ksim().score_with(&rollouts, &mut options)?;
            scores.extend(report.steps.iter().map(|step| step.score));
        }
        let hash = part(steps, episode, 0..n)?.fingerprint();
        Ok((Known { scores, hash }, n_new))
    }

    /// A line on all episodes.
    pub(crate) fn total(&self) -> String {
        let episodes = || self.episodes.values().map(|known| &known.scores);
        let n_steps: usize = episodes().map(Vec::len).sum();
        if n_steps == 0 {
            return "no steps yet\n".to_owned();
        }
        let pooled = episodes().flatten().sum::<f64>() / n_steps as f64;
        let means = episodes().map(|scores| mean(scores)).sum::<f64>();
        let n_saturated = episodes().flatten().filter(|score| **score == 1.0).count();
        format!(
            "{}, {}: K-Sim {pooled:.4}, episode mean {:.4}, {:.1} % saturated\n",
            counted(self.episodes.len(), "episode"),
            counted(n_steps, "step"),
            means / self.episodes.len() as f64,
            100.0 * n_saturated as f64 / n_steps as f64
        )
    }
}

/// Some steps of an episode.
fn part(
    steps: &Steps,
    episode: &EpisodeRows,
    places: std::ops::Range<usize>,
) -> Result<Trajectories> {
    let all = &steps.trajectories;
    let mut part = Trajectories::new(all.state_dim(), all.action_dim())?;
    let (mut states, mut actions) = (Vec::new(), Vec::new());
    let (mut state, mut action) = (vec![0.0; all.state_dim()], vec![0.0; all.action_dim()]);
    for place in places {
        all.read_step(episode.rows.start + place, &mut state, &mut action);
        states.extend_from_slice(&state);
        actions.extend_from_slice(&action);
    }
    part.push(episode.episode_index, &states, &actions)?;
    Ok(part)
}

fn line((planner, number): &(Option<String>, i64), known: &Known, n_new: usize) -> String {
    let planner = planner
        .as_ref()
        .map_or(String::new(), |planner| format!(", {planner}"));
    let n = known.scores.len();
    let new = match n_new < n {
        true => format!(" ({n_new} new)"),
        false => String::new(),
    };
    format!(
        "episode {number}{planner}: {}{new}, K-Sim {:.4} {}\n",
        counted(n, "step"),
        mean(&known.scores),
        sparkline::line(known.scores.iter().copied(), sparkline::WIDTH)
    )
}

/// `1 step`, `2 steps`.
fn counted(n: usize, what: &str) -> String {
    format!("{n} {what}{}", if n == 1 { "" } else { "s" })
}

fn mean(scores: &[f64]) -> f64 {
    scores.iter().sum::<f64>() / scores.len().max(1) as f64
}
