//! The best rows found so far for one query.

use super::Neighbor;

/// Collects rows within a threshold that falls as better ones come in.
#[derive(Debug, Clone)]
pub(super) struct Best {
    /// Squared distance and row.
    found: Vec<(f64, u32)>,
    /// How many are wanted, at least 1.
    wanted: usize,
    /// Rows beyond this squared distance are not taken.
    pub(super) squared: f64,
}

fn nearer(a: &(f64, u32), b: &(f64, u32)) -> std::cmp::Ordering {
    a.0.total_cmp(&b.0).then(a.1.cmp(&b.1))
}

impl Best {
    pub(super) fn new(wanted: usize, squared: f64) -> Self {
        Self {
            found: Vec::with_capacity(2 * wanted.min(1 << 12)),
            wanted,
            squared,
        }
    }

    pub(super) fn len(&self) -> usize {
        self.found.len()
    }

    pub(super) fn want(&mut self, wanted: usize) {
        self.wanted = wanted;
    }

    #[inline(always)]
    pub(super) fn push(&mut self, squared: f64, row: u32) {
        if squared <= self.squared {
            self.found.push((squared, row));
            if self.found.len() >= 2 * self.wanted + 64 {
                self.tighten();
            }
        }
    }

    /// Keeps the best, ties by smaller row, and lowers the threshold to the last of them.
    pub(super) fn tighten(&mut self) {
        if self.found.len() < self.wanted {
            return;
        }
        let (_, last, _) = self.found.select_nth_unstable_by(self.wanted - 1, nearer);
        self.squared = self.squared.min(last.0);
        self.found.truncate(self.wanted);
    }

    /// The same, once so many more than wanted are there, or the first time that there are enough.
    #[inline(always)]
    pub(super) fn tighten_if_more_by(&mut self, spare: usize) {
        let spare = if self.squared == f64::INFINITY {
            0
        } else {
            spare
        };
        if self.found.len() >= self.wanted + spare {
            self.tighten();
        }
    }

    /// The same wish and threshold, with nothing found.
    pub(super) fn empty(&self) -> Self {
        Self::new(self.wanted, self.squared)
    }

    pub(super) fn merge(&mut self, other: Self) {
        self.found.extend(other.found);
        self.squared = self.squared.min(other.squared);
    }

    pub(super) fn into_neighbors(mut self) -> Vec<Neighbor> {
        self.tighten();
        self.found.sort_unstable_by(nearer);
        self.found
            .iter()
            .map(|&(squared, row)| Neighbor {
                row,
                distance: squared.sqrt(),
            })
            .collect()
    }
}
