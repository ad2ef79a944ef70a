//! Two rollouts on common seeds.

use std::collections::BTreeMap;

use serde::Serialize;

use super::EpisodeRecord;
use crate::stats::{BootstrapOptions, Estimate, McNemar, mcnemar, paired_difference};

/// How one rollout (a) did against another (b) in the episodes that began alike. What the starts have in common is
/// taken out of the comparison, so that it needs fewer episodes than two summaries side by side.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Comparison {
    /// Episodes with a seed that both have.
    pub n_pairs: usize,
    /// Mean of return a - return b, its interval over pairs.
    pub return_difference: Estimate,
    /// Whether a and b succeed (at any step) equally often, where the environment reports success.
    pub success: Option<McNemar>,
}

impl Comparison {
    /// Pairs episodes by their seeds; `None` if none is common. Both rollouts must come from the same environment. Of
    /// several episodes with one seed the first counts.
    pub fn new(
        a: &[EpisodeRecord],
        b: &[EpisodeRecord],
        options: &BootstrapOptions,
    ) -> Option<Self> {
        let b = by_seed(b);
        let pairs: Vec<(&EpisodeRecord, &EpisodeRecord)> = by_seed(a)
            .into_iter()
            .filter_map(|(seed, record)| Some((record, *b.get(&seed)?)))
            .collect();
        let (a, b): (Vec<f64>, Vec<f64>) = pairs
            .iter()
            .map(|(a, b)| (a.total_return, b.total_return))
            .unzip();
        let successes: Option<(Vec<bool>, Vec<bool>)> = pairs
            .iter()
            .map(|(a, b)| Some((a.success?, b.success?)))
            .collect();
        Some(Self {
            n_pairs: pairs.len(),
            return_difference: paired_difference(&a, &b, options).ok()??,
            success: successes.and_then(|(a, b)| mcnemar(&a, &b).ok()),
        })
    }
}

fn by_seed(records: &[EpisodeRecord]) -> BTreeMap<u64, &EpisodeRecord> {
    let mut found = BTreeMap::new();
    for record in records {
        found.entry(record.seed).or_insert(record);
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::record::tests::record;

    #[test]
    fn episodes_are_paired_by_seed_in_any_order() {
        let episode = |seed, total_return, success: Option<bool>| EpisodeRecord {
            seed,
            success,
            ..record(0, total_return, None)
        };
        let a = [
            episode(3, 5.0, Some(true)),
            episode(1, 4.0, Some(true)),
            episode(9, 100.0, Some(false)),
        ];
        let mut b = [
            episode(1, 1.0, Some(false)),
            episode(2, -100.0, Some(true)),
            episode(3, 4.0, Some(true)),
        ];
        let options = BootstrapOptions::default();
        let comparison = Comparison::new(&a, &b, &options).unwrap();
        assert_eq!(comparison.n_pairs, 2);
        assert_eq!(comparison.return_difference.value, 2.0);
        let success = comparison.success.unwrap();
        assert_eq!((success.n_only_a, success.n_only_b), (1, 0));
        assert!((success.p_value - 1.0).abs() < 1e-12);
        assert_eq!(Comparison::new(&a[2..], &b, &options), None);
        b[0].success = None;
        assert_eq!(Comparison::new(&a, &b, &options).unwrap().success, None);
    }
}
