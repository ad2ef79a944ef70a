//! What the episodes of a rollout say together.

use serde::Serialize;

use super::EpisodeRecord;
use crate::stats::{BootstrapOptions, Estimate, bootstrap_mean, stratified_iqm, wilson};

/// How often the task was solved, by both accountings; intervals are Wilson's.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct SuccessRates {
    /// Episodes with a success at any step, the reset included.
    pub ever: Estimate,
    /// Episodes whose last step was one.
    pub at_end: Estimate,
    /// Mean number of steps to the first success, over the episodes that had one.
    pub mean_first_success_step: Option<f64>,
}

/// A rollout in a few numbers. Means have bootstrap intervals over episodes.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Summary {
    /// Number of episodes, of all runs together.
    pub n_episodes: usize,
    /// Number of runs.
    pub n_runs: usize,
    /// Mean undiscounted return.
    pub total_return: Estimate,
    /// Mean discounted return.
    pub discounted_return: Estimate,
    /// Mean normalized score, where there are reference returns.
    pub normalized_score: Option<Estimate>,
    /// Interquartile mean of the runs' mean returns, its interval over runs; `None` for a single run.
    pub iqm_of_runs: Option<Estimate>,
    /// Success rates, where the environment reports success.
    pub success: Option<SuccessRates>,
    /// Mean number of steps.
    pub mean_length: f64,
    /// Episodes that the task ended.
    pub n_terminated: usize,
    /// Episodes that the time limit ended and not the task.
    pub n_truncated: usize,
}

impl Summary {
    /// Summarizes episodes; `None` if there are none. Intervals are at `options.level`, Wilson's included.
    pub fn new(records: &[EpisodeRecord], options: &BootstrapOptions) -> Option<Self> {
        let column =
            |value: fn(&EpisodeRecord) -> f64| -> Vec<f64> { records.iter().map(value).collect() };
        let scores: Option<Vec<f64>> = records.iter().map(|r| r.normalized_score).collect();
        let runs = run_means(records);
        let lengths = column(|record| record.length as f64);
        Some(Self {
            n_episodes: records.len(),
            n_runs: runs.len(),
            total_return: bootstrap_mean(&column(|record| record.total_return), options)?,
            discounted_return: bootstrap_mean(&column(|record| record.discounted_return), options)?,
            normalized_score: scores.and_then(|scores| bootstrap_mean(&scores, options)),
            iqm_of_runs: stratified_iqm(&[&runs], options).filter(|_| runs.len() > 1),
            success: SuccessRates::new(records, options.level),
            mean_length: lengths.iter().sum::<f64>() / lengths.len() as f64,
            n_terminated: records.iter().filter(|record| record.terminated).count(),
            n_truncated: records.iter().filter(|record| !record.terminated).count(),
        })
    }
}

impl SuccessRates {
    fn new(records: &[EpisodeRecord], level: f64) -> Option<Self> {
        let ever: Option<Vec<bool>> = records.iter().map(|record| record.success).collect();
        let at_end: Option<Vec<bool>> = records.iter().map(|r| r.success_at_end).collect();
        let rate = |flags: Vec<bool>| {
            let n_successes = flags.iter().filter(|&&flag| flag).count();
            wilson(n_successes, flags.len(), level)
        };
        let firsts = records.iter().filter_map(|r| r.first_success_step);
        let n_firsts = firsts.clone().count();
        Some(Self {
            ever: rate(ever?)?,
            at_end: rate(at_end?)?,
            mean_first_success_step: (n_firsts > 0)
                .then(|| firsts.sum::<usize>() as f64 / n_firsts as f64),
        })
    }
}

/// Mean return of every run, in the order of the runs; records of a run stand together.
fn run_means(records: &[EpisodeRecord]) -> Vec<f64> {
    let runs = records.chunk_by(|a, b| a.run == b.run);
    runs.map(|run| run.iter().map(|record| record.total_return).sum::<f64>() / run.len() as f64)
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::record::tests::record;

    #[test]
    fn numbers_are_those_of_the_episodes() {
        let records = [
            record(0, 1.0, None),
            record(0, 2.0, Some(4)),
            record(1, 3.0, Some(10)),
            record(1, 6.0, Some(4)),
        ];
        let summary = Summary::new(&records, &BootstrapOptions::default()).unwrap();
        assert_eq!((summary.n_episodes, summary.n_runs), (4, 2));
        assert_eq!(summary.total_return.value, 3.0);
        assert_eq!(summary.discounted_return.value, 1.5);
        assert_eq!(summary.normalized_score.unwrap().value, 0.75);
        assert_eq!(summary.iqm_of_runs.unwrap().value, 3.0);
        let success = summary.success.unwrap();
        assert_eq!((success.ever.value, success.at_end.value), (0.75, 0.25));
        assert_eq!(success.mean_first_success_step, Some(6.0));
        assert_eq!((summary.n_terminated, summary.n_truncated), (1, 3));
        assert_eq!(summary.mean_length, 10.0);
    }

    #[test]
    fn what_is_not_known_of_every_episode_is_not_summarized() {
        assert_eq!(Summary::new(&[], &BootstrapOptions::default()), None);
        let mut records = [record(0, 1.0, None), record(0, 2.0, None)];
        records[1].normalized_score = None;
        records[0].success = None;
        let summary = Summary::new(&records, &BootstrapOptions::default()).unwrap();
        assert_eq!(summary.normalized_score, None);
        assert_eq!((summary.success, summary.iqm_of_runs), (None, None));
    }
}
