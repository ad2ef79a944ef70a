//! Sizes of a quantity in bounded memory.

use std::collections::BTreeMap;

use super::report::{Place, Tally};

/// Bins per doubling: a value is known to 1.1 %.
const PER_OCTAVE: f64 = 64.0;
/// Largest values kept with their places.
const KEPT: usize = 5;

/// A histogram of values above 0 in bins of equal ratio (at most some 130 000 bins), and the largest values.
#[derive(Debug, Clone, Default)]
pub(super) struct Magnitudes {
    bins: BTreeMap<i32, u64>,
    n_zero: u64,
    n: u64,
    /// Largest first; of equal ones the first found.
    largest: Vec<(f64, i64, i64)>,
}

impl Magnitudes {
    /// Counts a value; one that is not finite or is below 0 is left out.
    pub(super) fn add(&mut self, value: f64, episode: i64, step: i64) {
        if !value.is_finite() || value < 0.0 {
            return;
        }
        self.n += 1;
        if value == 0.0 {
            self.n_zero += 1;
            return;
        }
        *self.bins.entry(bin(value)).or_default() += 1;
        if self.largest.len() < KEPT || self.largest.last().is_some_and(|(v, ..)| value > *v) {
            let at = self.largest.partition_point(|(v, ..)| *v >= value);
            self.largest.insert(at, (value, episode, step));
            self.largest.truncate(KEPT);
        }
    }

    /// How many values were counted.
    pub(super) fn n(&self) -> u64 {
        self.n
    }

    /// The median, to the width of a bin; 0 without values.
    pub(super) fn median(&self) -> f64 {
        let values = self.bins.iter().map(|(&bin, &n)| (middle(bin), n));
        weighted_median([(0.0, self.n_zero)].into_iter().chain(values), self.n)
    }

    /// Median of the distances from `center`.
    pub(super) fn deviation(&self, center: f64) -> f64 {
        let values = self.bins.iter().map(|(&bin, &n)| (middle(bin), n));
        let mut distances: Vec<(f64, u64)> = [(0.0, self.n_zero)]
            .into_iter()
            .chain(values)
            .map(|(value, n)| ((value - center).abs(), n))
            .collect();
        distances.sort_by(|a, b| a.0.total_cmp(&b.0));
        weighted_median(distances, self.n)
    }

    /// How many values lie above `limit`, by at least a bin.
    pub(super) fn n_above(&self, limit: f64) -> u64 {
        self.bins.range(above(limit)..).map(|(_, n)| n).sum()
    }

    /// How many values lie below `limit`, by at least a bin.
    pub(super) fn n_below(&self, limit: f64) -> u64 {
        let below: u64 = self.bins.range(..bin(limit)).map(|(_, n)| n).sum();
        below + self.n_zero
    }

    /// The values above `limit`: how many, and the places of the largest.
    pub(super) fn places_above(&self, limit: f64, column: &str) -> Tally {
        let places = self
            .largest
            .iter()
            .filter(|(value, ..)| bin(*value) >= above(limit))
            .map(|&(_, episode, step)| Place::step(episode, step).of(column));
        Tally::of(self.n_above(limit), places)
    }

    /// The largest value.
    pub(super) fn max(&self) -> f64 {
        self.largest.first().map_or(0.0, |(value, ..)| *value)
    }
}

/// The bin of a value above 0.
fn bin(value: f64) -> i32 {
    #[expect(clippy::cast_possible_truncation, reason = "between -68736 and 65536")]
    let bin = (value.log2() * PER_OCTAVE).floor() as i32;
    bin
}

fn above(limit: f64) -> i32 {
    bin(limit).saturating_add(1)
}

fn middle(bin: i32) -> f64 {
    ((f64::from(bin) + 0.5) / PER_OCTAVE).exp2()
}

fn weighted_median(values: impl IntoIterator<Item = (f64, u64)>, n: u64) -> f64 {
    let mut seen = 0;
    for (value, count) in values {
        seen += count;
        if count > 0 && 2 * seen >= n {
            return value;
        }
    }
    0.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_middle_is_close_and_outliers_are_counted_with_their_places() {
        let mut sizes = Magnitudes::default();
        for step in 0..100 {
            sizes.add(if step == 40 { 50.0 } else { 2.0 }, 7, step);
        }
        sizes.add(f64::NAN, 0, 0);
        assert_eq!(sizes.n(), 100);
        assert!((sizes.median() - 2.0).abs() < 0.03, "{}", sizes.median());
        assert!(sizes.deviation(2.0) < 0.03);
        assert_eq!((sizes.n_above(10.0), sizes.n_below(1.0)), (1, 0));
        assert_eq!(sizes.max(), 50.0);
        let expected = Tally::of(1, [Place::step(7, 40).of("x")]);
        assert_eq!(
            format!("{:?}", sizes.places_above(10.0, "x")),
            format!("{expected:?}")
        );
    }

    #[test]
    fn zeros_and_nothing_have_a_median_too() {
        assert_eq!(Magnitudes::default().median(), 0.0);
        let mut sizes = Magnitudes::default();
        for value in [0.0, 0.0, 1.0] {
            sizes.add(value, 0, 0);
        }
        assert_eq!((sizes.median(), sizes.n_below(0.5)), (0.0, 2));
    }
}
