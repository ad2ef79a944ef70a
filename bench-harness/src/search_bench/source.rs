//! Where reference and queries come from, at the size and width that a measurement asks for.

use std::ops::Range;

use ksim::{DataError, Trajectories};

use super::synthetic::Synthetic;
use super::{QueryKind, SearchBenchError};
use crate::rng::{Purpose, Rng};

/// Of a dataset without rollouts, every so many-th episode is held out to ask with.
const HELD_OUT: usize = 20;
/// Standard deviations by which copies of a dataset differ where more rows are asked for than there are.
const JITTER: f64 = 0.01;
/// Standard deviations of the noise on held-out episodes that makes them `noisy`.
const NOISE: f64 = 0.5;
/// Spread of `random` queries, in standard deviations of the dataset.
const RANDOM_SPREAD: f64 = 1.5;

/// Reference and queries.
#[derive(Debug)]
#[expect(
    clippy::large_enum_variant,
    reason = "there is one of them in a whole run"
)]
pub enum StepSource {
    /// Trajectories made from a seed; any width and any number of rows.
    Generated {
        /// The seed.
        seed: u64,
    },
    /// A dataset, and rollouts to ask with. Without rollouts, every twentieth episode is held out and asked with: as
    /// it is, with noise, and replaced by random rows.
    Recorded {
        /// The dataset, in the columns wanted.
        dataset: Trajectories,
        /// Named rollouts, in the same columns.
        rollouts: Vec<(String, Trajectories)>,
        /// Seed of jitter and noise.
        seed: u64,
    },
}

/// Rows of a reference.
#[derive(Debug)]
pub(super) struct ReferenceData {
    pub(super) data: Trajectories,
    /// Rows that are no jittered copies of others.
    pub(super) n_distinct: usize,
}

impl StepSource {
    /// Checks that there is something to ask with.
    pub(super) fn check(&self) -> Result<(), SearchBenchError> {
        if let Self::Recorded {
            dataset, rollouts, ..
        } = self
            && rollouts.is_empty()
            && dataset.episodes().len() < 2
        {
            return Err(SearchBenchError::NothingToAsk);
        }
        Ok(())
    }

    /// The widest state there is; `None` where any width can be made.
    pub fn state_dim(&self) -> Option<usize> {
        match self {
            Self::Generated { .. } => None,
            Self::Recorded { dataset, .. } => Some(dataset.state_dim()),
        }
    }

    /// Rows that are there to be searched; `None` where any number can be made.
    pub fn n_rows(&self) -> Option<usize> {
        match self {
            Self::Generated { .. } => None,
            Self::Recorded {
                dataset, rollouts, ..
            } => {
                let kept = reference_episodes(dataset, rollouts.is_empty());
                Some(kept.iter().map(ExactSizeIterator::len).sum())
            }
        }
    }

    /// `n_rows` rows, of the first `width` state columns.
    pub(super) fn reference(
        &self,
        n_rows: usize,
        width: usize,
    ) -> Result<ReferenceData, SearchBenchError> {
        match self {
            Self::Generated { seed } => {
                let robot = Synthetic::new(*seed, width);
                let data = robot.trajectories(QueryKind::InDistribution, 0, n_rows)?;
                let n_distinct = n_rows;
                Ok(ReferenceData { data, n_distinct })
            }
            Self::Recorded {
                dataset,
                rollouts,
                seed,
            } => {
                let kept = reference_episodes(dataset, rollouts.is_empty());
                let n_distinct = kept
                    .iter()
                    .map(ExactSizeIterator::len)
                    .sum::<usize>()
                    .min(n_rows);
                let data = repeated(dataset, &kept, n_rows, width, *seed)?;
                Ok(ReferenceData { data, n_distinct })
            }
        }
    }

    /// At most `n_queries` steps of every kind that there is, of the first `width` state columns: a run of
    /// consecutive steps from every episode.
    pub(super) fn queries(
        &self,
        n_queries: usize,
        width: usize,
    ) -> Result<Vec<(String, Trajectories)>, SearchBenchError> {
        let mut sets = Vec::new();
        match self {
            Self::Generated { seed } => {
                let robot = Synthetic::new(*seed, width);
                for (kind, stream) in QueryKind::ALL.into_iter().zip(1..) {
                    let n = n_queries.max(8000);
                    let data = robot.trajectories(kind, stream, n)?;
                    sets.push((kind.name().to_owned(), thinned(&data, n_queries, width)?));
                }
            }
            Self::Recorded {
                dataset,
                rollouts,
                seed,
            } if rollouts.is_empty() => {
                let held = held_out(dataset)?;
                for kind in QueryKind::ALL {
                    let data = disturbed(&held, kind, dataset, *seed)?;
                    sets.push((kind.name().to_owned(), thinned(&data, n_queries, width)?));
                }
            }
            Self::Recorded { rollouts, .. } => {
                for (name, data) in rollouts {
                    sets.push((name.clone(), thinned(data, n_queries, width)?));
                }
            }
        }
        Ok(sets)
    }
}

/// Rows of the episodes that are searched.
fn reference_episodes(dataset: &Trajectories, holds_out: bool) -> Vec<Range<usize>> {
    let is_kept = |at: usize| !holds_out || !is_held_out(at, dataset.episodes().len());
    let episodes = dataset.episodes().iter().enumerate();
    episodes
        .filter(|(at, _)| is_kept(*at))
        .map(|(_, episode)| episode.rows.clone())
        .collect()
}

fn is_held_out(at: usize, n_episodes: usize) -> bool {
    let every = HELD_OUT.min(n_episodes);
    at % every == every - 1
}

/// Steps of one set, copied row by row into another.
struct Copier<'a> {
    from: &'a Trajectories,
    state: Vec<f64>,
    action: Vec<f64>,
}

impl<'a> Copier<'a> {
    fn new(from: &'a Trajectories) -> Self {
        Self {
            from,
            state: vec![0.0; from.state_dim()],
            action: vec![0.0; from.action_dim()],
        }
    }

    /// Appends rows as one episode, of the first `width` state columns, each changed by `change`.
    fn push(
        &mut self,
        to: &mut Trajectories,
        episode: i64,
        rows: Range<usize>,
        mut change: impl FnMut(&mut [f64], &mut [f64]),
    ) -> Result<(), DataError> {
        let width = to.state_dim();
        let mut states = Vec::with_capacity(rows.len() * width);
        let mut actions = Vec::with_capacity(rows.len() * self.action.len());
        for row in rows {
            self.from.read_step(row, &mut self.state, &mut self.action);
            change(&mut self.state, &mut self.action);
            states.extend(&self.state[..width]);
            actions.extend(&self.action);
        }
        to.push(episode, &states, &actions)
    }
}

/// The episodes again and again, jittered from the second time on, until there are `n_rows`.
fn repeated(
    dataset: &Trajectories,
    episodes: &[Range<usize>],
    n_rows: usize,
    width: usize,
    seed: u64,
) -> Result<Trajectories, SearchBenchError> {
    let spread = Spread::of(dataset);
    let mut rng = Rng::new(seed, Purpose::QueryNoise);
    let mut copier = Copier::new(dataset);
    let mut data = Trajectories::new(width, dataset.action_dim())?;
    let n_own: usize = episodes.iter().map(ExactSizeIterator::len).sum();
    for (number, rows) in episodes.iter().cycle().enumerate() {
        let left = n_rows - data.n_rows();
        if left == 0 || n_own == 0 {
            break;
        }
        let rows = rows.start..rows.end.min(rows.start + left);
        let is_copy = number >= episodes.len();
        copier.push(&mut data, number as i64, rows, |state, action| {
            if is_copy {
                spread.add_noise(state, action, || JITTER * rng.normal());
            }
        })?;
    }
    Ok(data)
}

/// The held-out episodes, whole.
fn held_out(dataset: &Trajectories) -> Result<Trajectories, SearchBenchError> {
    let mut held = Trajectories::new(dataset.state_dim(), dataset.action_dim())?;
    let mut copier = Copier::new(dataset);
    let n = dataset.episodes().len();
    for (at, episode) in dataset.episodes().iter().enumerate() {
        if is_held_out(at, n) {
            copier.push(
                &mut held,
                episode.episode_index,
                episode.rows.clone(),
                |_, _| (),
            )?;
        }
    }
    Ok(held)
}

/// Held-out steps made into another kind.
fn disturbed(
    held: &Trajectories,
    kind: QueryKind,
    dataset: &Trajectories,
    seed: u64,
) -> Result<Trajectories, SearchBenchError> {
    let spread = Spread::of(dataset);
    let mut rng = Rng::new(seed.wrapping_add(kind as u64), Purpose::QueryNoise);
    let mut data = Trajectories::new(held.state_dim(), held.action_dim())?;
    let mut copier = Copier::new(held);
    for episode in held.episodes() {
        let rows = episode.rows.clone();
        copier.push(
            &mut data,
            episode.episode_index,
            rows,
            |state, action| match kind {
                QueryKind::InDistribution => {}
                QueryKind::Noisy => spread.add_noise(state, action, || NOISE * rng.normal()),
                QueryKind::Random => spread.draw(state, action, || RANDOM_SPREAD * rng.normal()),
            },
        )?;
    }
    Ok(data)
}

/// A run of consecutive steps from every episode, from early in the first to late in the last: `n_queries` at most, and
/// as many of every episode as there are in it.
fn thinned(
    data: &Trajectories,
    n_queries: usize,
    width: usize,
) -> Result<Trajectories, SearchBenchError> {
    let mut queries = Trajectories::new(width, data.action_dim())?;
    let mut copier = Copier::new(data);
    let episodes = data.episodes();
    let lengths: Vec<usize> = episodes.iter().map(|episode| episode.rows.len()).collect();
    for (at, (episode, n)) in episodes.iter().zip(shares(&lengths, n_queries)).enumerate() {
        if n == 0 {
            continue;
        }
        let slack = episode.rows.len() - n;
        let start = episode.rows.start + slack * at / (episodes.len() - 1).max(1);
        copier.push(
            &mut queries,
            episode.episode_index,
            start..start + n,
            |_, _| (),
        )?;
    }
    Ok(queries)
}

/// Equal shares of `n` steps; what short episodes leave over goes to the others.
fn shares(lengths: &[usize], n: usize) -> Vec<usize> {
    let mut shares = vec![0; lengths.len()];
    let mut left = n.min(lengths.iter().sum());
    while left > 0 {
        let all = 0..lengths.len();
        let open: Vec<usize> = all.filter(|&at| shares[at] < lengths[at]).collect();
        let (total, n_open) = (left, open.len());
        for (i, at) in open.into_iter().enumerate() {
            // Rounded so that the shares add up, and the larger ones are spread over all.
            let share = (i + 1) * total / n_open - i * total / n_open;
            let more = share.min(lengths[at] - shares[at]);
            shares[at] += more;
            left -= more;
        }
    }
    shares
}

/// Mean and standard deviation of every column, state then action.
struct Spread {
    mean: Vec<f64>,
    std: Vec<f64>,
    state_dim: usize,
}

impl Spread {
    fn of(data: &Trajectories) -> Self {
        let width = data.state_dim() + data.action_dim();
        let (mut sums, mut squares) = (vec![0.0; width], vec![0.0; width]);
        let (mut state, mut action) = (vec![0.0; data.state_dim()], vec![0.0; data.action_dim()]);
        // A sample is enough for noise, and shifting by its first row keeps the squares small.
        let step = (data.n_rows() / 10_000).max(1);
        let rows: Vec<usize> = (0..data.n_rows()).step_by(step).collect();
        let mut shift = Vec::new();
        for &row in &rows {
            data.read_step(row, &mut state, &mut action);
            let values: Vec<f64> = state.iter().chain(&action).copied().collect();
            if shift.is_empty() {
                shift.clone_from(&values);
            }
            for (column, value) in values.iter().enumerate() {
                let value = value - shift[column];
                sums[column] += value;
                squares[column] += value * value;
            }
        }
        let n = rows.len().max(1) as f64;
        shift.resize(width, 0.0);
        let mean = sums.iter().zip(&shift).map(|(sum, shift)| shift + sum / n);
        let variance = sums
            .iter()
            .zip(&squares)
            .map(|(sum, square)| square / n - (sum / n).powi(2));
        Self {
            mean: mean.collect(),
            std: variance.map(|variance| variance.max(0.0).sqrt()).collect(),
            state_dim: data.state_dim(),
        }
    }

    fn add_noise(&self, state: &mut [f64], action: &mut [f64], mut normal: impl FnMut() -> f64) {
        let (of_state, of_action) = self.std.split_at(self.state_dim);
        for (value, std) in state
            .iter_mut()
            .zip(of_state)
            .chain(action.iter_mut().zip(of_action))
        {
            *value += std * normal();
        }
    }

    fn draw(&self, state: &mut [f64], action: &mut [f64], normal: impl FnMut() -> f64) {
        let (of_state, of_action) = self.mean.split_at(self.state_dim);
        state.copy_from_slice(of_state);
        action.copy_from_slice(of_action);
        self.add_noise(state, action, normal);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn walk(lengths: &[usize]) -> Trajectories {
        let mut data = Trajectories::new(2, 1).unwrap();
        for (episode, &n) in lengths.iter().enumerate() {
            let states: Vec<f64> = (0..2 * n).map(|i| (episode * 100 + i) as f64).collect();
            data.push(episode as i64, &states, &vec![episode as f64; n])
                .unwrap();
        }
        data
    }

    fn recorded(lengths: &[usize]) -> StepSource {
        StepSource::Recorded {
            dataset: walk(lengths),
            rollouts: Vec::new(),
            seed: 0,
        }
    }

    #[test]
    fn held_out_episodes_are_not_searched() {
        let source = recorded(&[10, 20, 30]);
        assert_eq!(source.n_rows(), Some(30));
        let queries = source.queries(1000, 2).unwrap();
        assert_eq!(queries.len(), 3);
        assert!(queries.iter().all(|(_, data)| data.n_rows() == 30));
        let (mut state, mut action) = ([0.0; 2], [0.0]);
        queries[0].1.read_step(0, &mut state, &mut action);
        assert_eq!((state, action), ([200.0, 201.0], [2.0]));
        assert!(matches!(
            recorded(&[10]).check(),
            Err(SearchBenchError::NothingToAsk)
        ));
    }

    #[test]
    fn more_rows_than_there_are_come_from_jittered_copies() {
        let reference = recorded(&[10, 20, 30]).reference(70, 1).unwrap();
        assert_eq!((reference.data.n_rows(), reference.n_distinct), (70, 30));
        let value = |row: usize| {
            let (mut state, mut action) = ([0.0], [0.0]);
            reference.data.read_step(row, &mut state, &mut action);
            state[0]
        };
        assert_eq!((value(0), value(29)), (0.0, 138.0));
        assert!(value(30) != 0.0 && value(30).abs() < 3.0, "{}", value(30));
    }

    #[test]
    fn every_episode_has_its_share_of_the_queries() {
        assert_eq!(shares(&[10; 4], 6), [1, 2, 1, 2]);
        assert_eq!(shares(&[10; 6], 3), [0, 1, 0, 1, 0, 1]);
        // What the short ones leave goes to the long ones.
        assert_eq!(shares(&[1, 100, 2, 100], 40), [1, 18, 2, 19]);
        assert_eq!(shares(&[3, 0, 5], 100), [3, 0, 5]);
        assert!(shares(&[], 5).is_empty());
        let late = thinned(&walk(&[10; 7]), 10, 2).unwrap();
        assert_eq!((late.n_rows(), late.episodes().len()), (10, 7));
    }

    #[test]
    fn queries_are_runs_of_consecutive_steps_of_every_episode() {
        let few = thinned(&walk(&[10, 10, 10]), 9, 2).unwrap();
        let first_of = |episode: usize| {
            let (mut state, mut action) = ([0.0; 2], [0.0]);
            few.read_step(few.episodes()[episode].rows.start, &mut state, &mut action);
            state[0]
        };
        assert_eq!(few.n_rows(), 9);
        // From the first step of the first episode to the last steps of the last.
        assert_eq!([first_of(0), first_of(1), first_of(2)], [0.0, 106.0, 214.0]);
    }
}
