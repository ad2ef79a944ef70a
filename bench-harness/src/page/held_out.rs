//! What "in the data" looks like: the dataset's own episodes, each compared with all others.

use ksim::{KSim, Reference, Report, ScoreError, ScoreOptions, Trajectories};

use crate::rng::{Purpose, Rng};

/// Share of the dataset's episodes that is held out, and most of them and of their steps.
const ONE_IN: usize = 10;
const MAX_EPISODES: usize = 20;
const MAX_STEPS: usize = 20_000;

/// Scored episodes of the dataset.
#[derive(Debug, Clone, PartialEq)]
pub struct HeldOut {
    /// Their numbers, ascending.
    pub episode_index: Vec<i64>,
    /// Their scores.
    pub report: Report,
}

/// Why no episode of the dataset can be held against the others.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum NoHeldOut {
    /// There are no others.
    #[error("the dataset has a single episode")]
    SingleEpisode,
    /// The search has too little left, or the numbers are too large to be told apart.
    #[error(transparent)]
    Score(#[from] ScoreError),
    /// The numbers cannot be used.
    #[error(transparent)]
    Data(#[from] ksim::DataError),
}

impl HeldOut {
    /// Chooses a tenth of the episodes by seed, at most 20 of them with about 20 000 steps, and scores every one against
    /// all others by the search of `ksim`. The normalization stays that of the whole dataset.
    ///
    /// # Errors
    /// [`NoHeldOut`]; a dataset for which this is so can still be scored against.
    pub fn score(ksim: &KSim, seed: u64) -> Result<Self, NoHeldOut> {
        let reference = ksim.reference();
        let chosen = choose(reference, seed);
        if reference.episodes().len() < 2 || chosen.is_empty() {
            return Err(NoHeldOut::SingleEpisode);
        }
        let mut rollouts = Trajectories::new(
            reference.states().n_features(),
            reference.actions().n_features(),
        )?;
        for episode in &chosen {
            let episode = &reference.episodes()[*episode];
            let (states, actions) = raw(reference, episode.rows.clone());
            rollouts.push(episode.episode_index, &states, &actions)?;
        }
        let mut options = ScoreOptions {
            exclude_same_episode: true,
            progress: None,
        };
        let report = ksim.score_with(&rollouts, &mut options)?;
        let episodes = rollouts.episodes().iter();
        Ok(Self {
            episode_index: episodes.map(|episode| episode.episode_index).collect(),
            report,
        })
    }
}

/// Places of the chosen episodes, ascending.
fn choose(reference: &Reference, seed: u64) -> Vec<usize> {
    let episodes = reference.episodes();
    let wanted = episodes.len().div_ceil(ONE_IN).min(MAX_EPISODES);
    let mut rng = Rng::new(seed, Purpose::HeldOut);
    let mut places: Vec<usize> = (0..episodes.len())
        .filter(|place| !episodes[*place].rows.is_empty())
        .collect();
    let mut chosen = Vec::new();
    let mut n_steps = 0;
    while chosen.len() < wanted && n_steps < MAX_STEPS && !places.is_empty() {
        let place = places.swap_remove(rng.below(places.len()));
        n_steps += episodes[place].rows.len();
        chosen.push(place);
    }
    chosen.sort_unstable();
    chosen
}

/// States and actions of some rows, in raw units.
fn raw(reference: &Reference, rows: std::ops::Range<usize>) -> (Vec<f64>, Vec<f64>) {
    let (of_states, of_actions) = reference.normalizers();
    let read = |matrix: &ksim::Matrix, normalizer: &ksim::Normalizer| {
        let mut row = vec![0.0; matrix.n_features()];
        let mut values = Vec::with_capacity(rows.len() * row.len());
        for number in rows.clone() {
            matrix.read_row(number, &mut row);
            let columns = row.iter().enumerate();
            values.extend(columns.map(|(column, value)| normalizer.denormalize(column, *value)));
        }
        values
    };
    (
        read(reference.states(), of_states),
        read(reference.actions(), of_actions),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    fn dataset(n_episodes: i64) -> KSim {
        let mut data = Trajectories::new(2, 1).unwrap();
        for episode in 0..n_episodes {
            let states: Vec<f64> = (0..40)
                .map(|i| 1e3 + (f64::from(i) * 0.3 + episode as f64).sin())
                .collect();
            data.push(episode + 5, &states, &[0.5; 20]).unwrap();
        }
        KSim::params().fit(data).unwrap()
    }

    #[test]
    fn a_tenth_is_chosen_by_seed_and_no_step_is_matched_with_its_own_episode() {
        let ksim = dataset(30);
        let held = HeldOut::score(&ksim, 0).unwrap();
        assert_eq!(held.episode_index.len(), 3);
        assert_eq!(held, HeldOut::score(&ksim, 0).unwrap());
        assert_ne!(
            held.episode_index,
            HeldOut::score(&ksim, 1).unwrap().episode_index
        );
        for (place, step) in held.report.steps.iter().enumerate() {
            let (matched, _) = ksim.reference_step(step.reference_row);
            assert_ne!(matched, held.episode_index[place / 20]);
        }
        assert!(held.report.mean_scaled_distance > 0.0);
    }

    #[test]
    fn a_single_episode_has_no_others() {
        let error = HeldOut::score(&dataset(1), 0).unwrap_err();
        assert!(matches!(error, NoHeldOut::SingleEpisode));
    }
}
