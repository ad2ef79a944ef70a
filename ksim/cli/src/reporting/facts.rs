//! What the files say of their episodes beside states and actions.

use std::collections::BTreeMap;

use anyhow::Result;
use ksim_datasets::EpisodeRecord;

use crate::novelty;
use crate::scoring::{ScoredRollouts, Session};

/// What is known of the episodes of one group, in their order.
#[derive(Debug, Default)]
pub(super) struct Facts {
    /// Returns.
    pub(super) total_return: Vec<Option<f64>>,
    /// Whether they succeeded.
    pub(super) success: Vec<Option<bool>>,
    /// Novelty of the plan under way, per row, NaN where it is not known; absent where it is known of no row.
    pub(super) novelty: Option<Vec<f64>>,
}

/// Reads the facts of all groups.
pub(super) fn collect(session: &Session, rollouts: &[ScoredRollouts]) -> Result<Vec<Facts>> {
    let mut by_file = Vec::with_capacity(session.files().len());
    for file in session.files() {
        let source = &*file.source;
        let records = source.episodes()?;
        let novelties = novelty::rows(source, &records)?;
        by_file.push(Recorded::new(records, novelties));
    }
    Ok(rollouts
        .iter()
        .map(|one| by_file[one.file].of(one))
        .collect())
}

/// An episode of a file, and the novelty of its steps.
type Known = (EpisodeRecord, Vec<Option<f64>>);

/// The episodes of a file by number.
struct Recorded(BTreeMap<i64, Vec<Known>>);

impl Recorded {
    fn new(records: Vec<EpisodeRecord>, novelties: Option<Vec<Vec<Option<f64>>>>) -> Self {
        let mut novelties = novelties.unwrap_or_default().into_iter();
        let mut by_number = BTreeMap::<_, Vec<_>>::new();
        for record in records {
            let novelty = novelties.next().unwrap_or_default();
            let same = by_number.entry(record.episode_index).or_default();
            same.push((record, novelty));
        }
        Self(by_number)
    }

    /// The one record of an episode, if it is of the same length: planners of one file may number theirs alike.
    fn one(&self, number: i64, n_steps: usize) -> Option<&Known> {
        match self.0.get(&number).map(Vec::as_slice) {
            Some([one]) if one.0.length == n_steps as u64 => Some(one),
            _ => None,
        }
    }

    fn of(&self, rollouts: &ScoredRollouts) -> Facts {
        let mut facts = Facts::default();
        let mut novelty = Vec::new();
        for episode in &rollouts.report.episodes {
            let found = self.one(episode.episode_index, episode.n_steps);
            let total = found.and_then(|(record, _)| record.total_return);
            facts
                .total_return
                .push(total.filter(|total| total.is_finite()));
            facts
                .success
                .push(found.and_then(|(record, _)| record.success));
            let own = found.map_or(&[][..], |(_, novelty)| novelty);
            let known = |step: usize| own.get(step).copied().flatten().unwrap_or(f64::NAN);
            novelty.extend((0..episode.n_steps).map(known));
        }
        facts.novelty = novelty
            .iter()
            .any(|value| value.is_finite())
            .then_some(novelty);
        facts
    }
}
