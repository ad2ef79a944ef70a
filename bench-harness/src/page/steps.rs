//! Steps as columns, thinned where there are very many.

use ksim::{EpisodeRows, KSim, Report, StepScore, Trajectories};
use serde::Serialize;

use super::data::ReferencePart;
use super::pack::Column;

/// Most steps on a page: beyond, of every so many steps of an episode only the farthest is kept.
pub const MAX_STEPS: usize = 120_000;
/// Most episodes on a page.
pub const MAX_EPISODES: usize = 10_000;

/// Rollouts with their scores.
#[derive(Clone, Copy)]
pub struct Scored<'a> {
    /// What they were scored by.
    pub ksim: &'a KSim,
    /// Their states and actions, raw units.
    pub trajectories: &'a Trajectories,
    /// Their scores.
    pub report: &'a Report,
    /// The number that the rollouts give to a row that is so many steps after its episode's first.
    pub number: &'a dyn Fn(usize, usize) -> i64,
    /// The same of the dataset's rows.
    pub reference_number: &'a dyn Fn(usize, usize) -> i64,
}

impl<'a> Scored<'a> {
    /// The episodes that have steps, in the order of the report's.
    pub fn episodes(&self) -> impl Iterator<Item = &'a EpisodeRows> + use<'a> {
        let episodes = self.trajectories.episodes().iter();
        episodes.filter(|episode| !episode.rows.is_empty())
    }

    /// Distances of a step in units that do not depend on the number of columns: of state and action together (d/√d),
    /// of the state alone, of the action alone.
    pub fn scaled(&self, step: &StepScore) -> [f64; 3] {
        Self::scaled_by(self.trajectories, step)
    }

    /// The same for a step of some rollouts.
    pub fn scaled_by(rollouts: &Trajectories, step: &StepScore) -> [f64; 3] {
        let state = rollouts.state_dim() as f64;
        let action = rollouts.action_dim() as f64;
        [
            step.distance / (state + action).sqrt(),
            step.state_distance / state.sqrt(),
            step.action_distance / action.sqrt(),
        ]
    }

    /// The farthest of some rows; the first of equals.
    pub fn farthest(&self, rows: std::ops::Range<usize>) -> usize {
        let distance = |row: usize| self.report.steps[row].distance;
        rows.clone().fold(rows.start, |best, row| {
            match distance(row) > distance(best) {
                true => row,
                false => best,
            }
        })
    }

    /// Episode and step number of a reference row.
    pub fn matched(&self, row: u32) -> (i64, i64) {
        let (episode, position) = self.ksim.reference_step(row);
        (episode, (self.reference_number)(row as usize, position))
    }
}

/// Of how many steps one is kept, so that episodes of these lengths stay within [`MAX_STEPS`]; 1 keeps all.
pub fn stride(lengths: &[usize]) -> usize {
    let kept = |stride: usize| lengths.iter().map(|n| n.div_ceil(stride)).sum::<usize>();
    let longest = lengths.iter().copied().max().unwrap_or(1).max(1);
    // The more are left out, the fewer are kept: halving finds the first that fits.
    let (mut low, mut high) = (1, longest);
    while low < high {
        let middle = usize::midpoint(low, high);
        match kept(middle) <= MAX_STEPS {
            true => high = middle,
            false => low = middle + 1,
        }
    }
    low
}

/// Steps of a group as columns, episode after episode.
#[derive(Debug, Clone, Serialize)]
pub struct StepColumns {
    /// Steps of every episode that are here.
    pub n: Vec<usize>,
    /// Their numbers; absent where every episode has all of 0, 1, 2, …
    pub step: Option<Column>,
    /// d/√d of state and action together.
    pub scaled: Column,
    /// The same of the state part.
    pub state: Column,
    /// The same of the action part.
    pub action: Column,
    /// Place of the matched episode in [`ReferencePart::episodes`].
    pub match_episode: Column,
    /// Number of the matched step.
    pub match_step: Column,
    /// Where the step lies on the map.
    pub x: Column,
    /// See `x`.
    pub y: Column,
    /// Where the matched step lies.
    pub match_x: Column,
    /// See `match_x`.
    pub match_y: Column,
    /// Novelty of the plan under way.
    pub novelty: Option<Column>,
}

/// Rows that are kept.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Kept {
    n: Vec<usize>,
    rows: Vec<usize>,
    /// What the rollouts call them.
    numbers: Vec<i64>,
}

impl Kept {
    /// Of every `stride` steps of an episode the farthest.
    pub fn new(scored: &Scored<'_>, stride: usize) -> Self {
        let mut kept = Self {
            n: Vec::new(),
            rows: Vec::new(),
            numbers: Vec::new(),
        };
        for episode in scored.episodes() {
            let before = kept.rows.len();
            for start in episode.rows.clone().step_by(stride) {
                let row = scored.farthest(start..(start + stride).min(episode.rows.end));
                kept.rows.push(row);
                let number = (scored.number)(row, row - episode.rows.start);
                kept.numbers.push(number);
            }
            kept.n.push(kept.rows.len() - before);
        }
        kept
    }

    /// The rows.
    pub fn rows(&self) -> &[usize] {
        &self.rows
    }

    /// The rows of every episode.
    pub fn by_episode(&self) -> impl Iterator<Item = &[usize]> {
        let mut rest = &*self.rows;
        self.n.iter().map(move |n| {
            let (rows, others) = rest.split_at(*n);
            rest = others;
            rows
        })
    }

    /// Whether the steps of every episode are numbered 0, 1, 2, …
    fn counts_on(&self) -> bool {
        let expected = self.n.iter().flat_map(|n| 0..*n as i64);
        self.numbers.iter().copied().eq(expected)
    }
}

/// Where rows lie on the map, and its ranges.
#[derive(Debug, Clone, Copy)]
pub struct Places<'a> {
    /// Of the rows of the rollouts.
    pub of: &'a [[f64; 2]],
    /// Of the rows of the dataset.
    pub of_reference: &'a [[f64; 2]],
    /// From left to right, and from bottom to top.
    pub ranges: [[f64; 2]; 2],
}

impl StepColumns {
    /// Packs some rows. `novelty` has a number per row of the rollouts.
    pub fn new(
        scored: &Scored<'_>,
        kept: &Kept,
        places: &Places<'_>,
        novelty: Option<&[f64]>,
        reference: &mut ReferencePart,
    ) -> Self {
        let rows = || kept.rows.iter().copied();
        let steps = || rows().map(|row| &scored.report.steps[row]);
        // What the page calls saturated is what the score calls so.
        let gamma = scored.ksim.gamma();
        let scaled = |part: usize| {
            let values = steps().map(|step| {
                let value = scored.scaled(step)[part];
                let is_whole = part == 0;
                (
                    value,
                    if is_whole {
                        step.score >= 1.0
                    } else {
                        value <= gamma
                    },
                )
            });
            Column::beside(values, gamma)
        };
        let matches: Vec<(i64, i64)> = steps()
            .map(|step| scored.matched(step.reference_row))
            .collect();
        let mut of_episode = reference.places();
        let episodes: Vec<i64> = matches
            .iter()
            .map(|(episode, _)| reference.place(&mut of_episode, *episode))
            .collect();
        let numbers: Vec<i64> = matches.iter().map(|(_, number)| *number).collect();
        let [x, y] = places.ranges;
        let matched = |axis: usize| {
            steps().map(move |step| places.of_reference[step.reference_row as usize][axis])
        };
        Self {
            n: kept.n.clone(),
            step: (!kept.counts_on()).then(|| Column::integers(&kept.numbers)),
            scaled: scaled(0),
            state: scaled(1),
            action: scaled(2),
            match_episode: Column::integers(&episodes),
            match_step: Column::integers(&numbers),
            x: Column::places(rows().map(|row| places.of[row][0]), x),
            y: Column::places(rows().map(|row| places.of[row][1]), y),
            match_x: Column::places(matched(0), x),
            match_y: Column::places(matched(1), y),
            novelty: novelty.map(|novelty| Column::f32(rows().map(|row| novelty[row]))),
        }
    }
}

impl ReferencePart {
    fn places(&self) -> std::collections::BTreeMap<i64, i64> {
        let places = self.episodes.iter().enumerate();
        places
            .map(|(place, episode)| (*episode, place as i64))
            .collect()
    }

    fn place(&mut self, places: &mut std::collections::BTreeMap<i64, i64>, episode: i64) -> i64 {
        *places.entry(episode).or_insert_with(|| {
            self.episodes.push(episode);
            self.episodes.len() as i64 - 1
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn many_steps_are_thinned_so_that_they_fit_and_no_more_than_that() {
        assert_eq!(stride(&[]), 1);
        assert_eq!(stride(&[1000; 100]), 1);
        assert_eq!(stride(&[1000; 120]), 1);
        assert_eq!(stride(&[1000; 121]), 2);
        // An episode keeps a step, however many there are.
        let lengths = [300; MAX_EPISODES];
        let stride = stride(&lengths);
        let kept: usize = lengths.iter().map(|n| n.div_ceil(stride)).sum();
        assert!((MAX_EPISODES..=MAX_STEPS).contains(&kept));
    }

    #[test]
    fn of_thinned_steps_the_farthest_stay() {
        let mut reference = Trajectories::new(1, 1).unwrap();
        reference.push(7, &[0.0, 1.0], &[0.0, 0.0]).unwrap();
        let mut rollouts = Trajectories::new(1, 1).unwrap();
        rollouts
            .push(3, &[0.0, 9.0, 1.0, 0.5, 1.0], &[0.0; 5])
            .unwrap();
        let ksim = KSim::params().fit(reference).unwrap();
        let report = ksim.score(&rollouts).unwrap();
        let scored = Scored {
            ksim: &ksim,
            trajectories: &rollouts,
            report: &report,
            number: &|_, position| position as i64 + 10,
            reference_number: &|_, position| position as i64,
        };
        let kept = Kept::new(&scored, 2);
        assert_eq!(kept.rows, [1, 3, 4]);
        assert_eq!((kept.n.as_slice(), kept.counts_on()), (&[3][..], false));
        let mut part = ReferencePart::default();
        let places = Places {
            of: &[[1.0; 2]; 5],
            of_reference: &[[2.0; 2]; 2],
            ranges: [[0.0, 4.0]; 2],
        };
        let columns = StepColumns::new(&scored, &kept, &places, None, &mut part);
        assert_eq!(part.episodes, [7]);
        assert_eq!(columns.step, Some(Column::integers(&[11, 13, 14])));
        let again = StepColumns::new(&scored, &kept, &places, None, &mut part);
        assert_eq!(
            (part.episodes.len(), again.match_episode),
            (1, columns.match_episode)
        );
    }
}
