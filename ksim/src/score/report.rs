//! The result of scoring: every step, every episode, and their aggregates.

use super::bootstrap::{interval_95, quantile};
use super::params::KSimParams;
use super::step_score;
use crate::trajectories::Trajectories;

/// One closed-loop step and the reference step it was matched with.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepScore {
    /// `min(1, γ√d / distance)`, in `(0, 1]`.
    pub score: f64,
    /// L2 distance of the normalized state-action pairs.
    pub distance: f64,
    /// Its part from the state columns.
    pub state_distance: f64,
    /// Its part from the action columns.
    pub action_distance: f64,
    /// The cluster that was searched, where the search has clusters.
    pub cluster: Option<u32>,
    /// The matched reference row.
    pub reference_row: u32,
}

/// One episode's means.
#[derive(Debug, Clone, PartialEq)]
pub struct EpisodeScore {
    /// The episode's own number.
    pub episode_index: i64,
    /// Its number of steps.
    pub n_steps: usize,
    /// Mean step score over state and action, in `(0, 1]`.
    pub k_sim: f64,
    /// The same over the state part of the matched pair.
    pub k_sim_state: f64,
    /// The same over the action part of the matched pair.
    pub k_sim_action: f64,
    /// Share of its steps with score 1.
    pub saturated_share: f64,
    /// Mean of distance / √d.
    pub mean_scaled_distance: f64,
}

/// One score, both ways of averaging it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Aggregate {
    /// Mean over all steps of all episodes: K-Sim as the paper defines it.
    pub pooled: f64,
    /// Mean of the episodes' own means.
    pub episode_mean: f64,
    /// 95 % bootstrap interval of `episode_mean`, `[low, high]`; `None` below two episodes.
    pub interval_95: Option<[f64; 2]>,
}

/// Scores of one set of rollouts.
#[derive(Debug, Clone, PartialEq)]
pub struct Report {
    /// Over state and action: K-Sim.
    pub state_action: Aggregate,
    /// Over the state part of the same matched pairs, `min(1, γ√dim_s / state_distance)`.
    pub state: Aggregate,
    /// Over the action part of the same matched pairs, `min(1, γ√dim_a / action_distance)`.
    pub action: Aggregate,
    /// Share of steps with score 1: they say nothing about how close they are.
    pub saturated_share: f64,
    /// Mean of distance / √d, the twin of K-Sim that does not saturate: 0 on the data, near √2
    /// for two unrelated normalized rows.
    pub mean_scaled_distance: f64,
    /// Quantiles 0.05, 0.25, 0.5, 0.75, 0.95 of distance / √d.
    pub scaled_distance_quantiles: [f64; 5],
    /// Every episode, in the order of the rollouts.
    pub episodes: Vec<EpisodeScore>,
    /// Every step, in the order of the rollouts.
    pub steps: Vec<StepScore>,
}

impl Report {
    /// The quantiles given in [`scaled_distance_quantiles`](Self::scaled_distance_quantiles).
    pub const QUANTILES: [f64; 5] = [0.05, 0.25, 0.5, 0.75, 0.95];

    pub(super) fn new(rollouts: &Trajectories, steps: Vec<StepScore>, params: &KSimParams) -> Self {
        let (dim_s, dim_a) = (rollouts.state_dim() as f64, rollouts.action_dim() as f64);
        let scale = (dim_s + dim_a).sqrt();
        let state = |s: &StepScore| step_score(params.gamma, dim_s, s.state_distance);
        let action = |s: &StepScore| step_score(params.gamma, dim_a, s.action_distance);
        let episodes: Vec<EpisodeScore> = rollouts
            .episodes()
            .iter()
            .filter(|episode| !episode.rows.is_empty())
            .map(|episode| {
                let steps = &steps[episode.rows.clone()];
                EpisodeScore {
                    episode_index: episode.episode_index,
                    n_steps: steps.len(),
                    k_sim: mean(steps, |s| s.score),
                    k_sim_state: mean(steps, state),
                    k_sim_action: mean(steps, action),
                    saturated_share: mean(steps, saturated),
                    mean_scaled_distance: mean(steps, |s| s.distance / scale),
                }
            })
            .collect();
        let aggregate = |pooled: f64, of_episode: fn(&EpisodeScore) -> f64| {
            let means: Vec<f64> = episodes.iter().map(of_episode).collect();
            Aggregate {
                pooled,
                episode_mean: means.iter().sum::<f64>() / means.len() as f64,
                interval_95: interval_95(&means, params.n_resamples, params.seed),
            }
        };
        let mut scaled: Vec<f64> = steps.iter().map(|s| s.distance / scale).collect();
        scaled.sort_by(f64::total_cmp);
        Self {
            state_action: aggregate(mean(&steps, |s| s.score), |e| e.k_sim),
            state: aggregate(mean(&steps, state), |e| e.k_sim_state),
            action: aggregate(mean(&steps, action), |e| e.k_sim_action),
            saturated_share: mean(&steps, saturated),
            mean_scaled_distance: mean(&steps, |s| s.distance / scale),
            scaled_distance_quantiles: Self::QUANTILES.map(|q| quantile(&scaled, q)),
            episodes,
            steps,
        }
    }
}

fn saturated(step: &StepScore) -> f64 {
    f64::from(u8::from(step.score >= 1.0))
}

fn mean(steps: &[StepScore], value: impl Fn(&StepScore) -> f64) -> f64 {
    steps.iter().map(value).sum::<f64>() / steps.len() as f64
}
