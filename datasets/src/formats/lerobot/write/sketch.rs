//! Quantiles of a stream in bounded memory.

/// The quantiles that LeRobot records, and their names.
pub(super) const QUANTILES: [(&str, f64); 5] = [
    ("q01", 0.01),
    ("q10", 0.10),
    ("q50", 0.50),
    ("q90", 0.90),
    ("q99", 0.99),
];

/// Values of a stream, thinned out: exact up to `capacity` values, an approximation beyond.
///
/// Level i holds values that stand for 2^i each. A full level is sorted, and every second value goes up one
/// level, the odd and the even ones in turn, so nothing is random (Munro and Paterson, "Selection and sorting
/// with limited storage", 1980; Manku, Rajagopalan and Lindsay, SIGMOD 1998). Each thinning of level i moves a
/// rank by 2^i at most, so with n values the rank of a quantile is off by less than
/// log2(n / capacity) / capacity of n: with 8,192 values kept, under 0.1 % for a million.
#[derive(Debug, Clone)]
pub(super) struct Sketch {
    capacity: usize,
    levels: Vec<Level>,
}

#[derive(Debug, Clone, Default)]
struct Level {
    values: Vec<f64>,
    /// Whether the next thinning keeps the odd places.
    odd: bool,
}

impl Sketch {
    /// `capacity` values a level, at least 2.
    pub(super) fn new(capacity: usize) -> Self {
        Self {
            capacity: capacity.max(2),
            levels: vec![Level::default()],
        }
    }

    /// Adds a finite value.
    pub(super) fn add(&mut self, value: f64) {
        if let Some(level) = self.levels.first_mut() {
            level.values.push(value);
            if level.values.len() > self.capacity {
                self.thin(0);
            }
        }
    }

    /// Takes over the values of another sketch of the same capacity, which is empty afterwards.
    pub(super) fn take(&mut self, other: &mut Self) {
        for (place, level) in other.levels.iter_mut().enumerate() {
            self.level(place).values.append(&mut level.values);
        }
        other.levels.truncate(1);
        let mut place = 0;
        while place < self.levels.len() {
            if self.levels[place].values.len() > self.capacity {
                self.thin(place);
            }
            place += 1;
        }
    }

    fn level(&mut self, place: usize) -> &mut Level {
        if self.levels.len() <= place {
            self.levels.resize_with(place + 1, Level::default);
        }
        &mut self.levels[place]
    }

    fn thin(&mut self, place: usize) {
        let level = self.level(place);
        let mut values = std::mem::take(&mut level.values);
        values.sort_unstable_by(f64::total_cmp);
        // Pairs go up; of an odd number the largest stays.
        if values.len() % 2 == 1 {
            level.values.extend(values.pop());
        }
        let first = usize::from(level.odd);
        level.odd = !level.odd;
        let above = self.level(place + 1);
        above.values.extend(values.iter().skip(first).step_by(2));
        if above.values.len() > self.capacity {
            self.thin(place + 1);
        }
    }

    /// The quantiles of [`QUANTILES`], interpolated as NumPy does; zeros if there is no value.
    pub(super) fn quantiles(&self) -> [f64; QUANTILES.len()] {
        let mut weighted: Vec<(f64, u64)> = Vec::new();
        for (place, level) in self.levels.iter().enumerate() {
            weighted.extend(level.values.iter().map(|value| (*value, 1u64 << place)));
        }
        weighted.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
        let total: u64 = weighted.iter().map(|(_, weight)| weight).sum();
        let at = |rank: f64| {
            let mut before = 0.0;
            let found = weighted.iter().find(|(_, weight)| {
                before += *weight as f64;
                rank < before
            });
            found.or(weighted.last()).map_or(0.0, |(value, _)| *value)
        };
        QUANTILES.map(|(_, quantile)| {
            let rank = quantile * total.saturating_sub(1) as f64;
            let (low, high) = (at(rank.floor()), at(rank.ceil()));
            low + (high - low) * rank.fract()
        })
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn few_values_are_exact() {
        let mut sketch = Sketch::new(100);
        for value in (0..100).rev() {
            sketch.add(f64::from(value));
        }
        // numpy.quantile(arange(100), [.01, .1, .5, .9, .99])
        let exact = [0.99, 9.9, 49.5, 89.1, 98.01];
        for (found, exact) in sketch.quantiles().into_iter().zip(exact) {
            assert!((found - exact).abs() < 1e-9, "{found} {exact}");
        }
        assert_eq!(Sketch::new(4).quantiles(), [0.0; 5]);
    }

    proptest! {
        #[test]
        fn ranks_keep_to_their_bound(
            n in 1usize..20_000,
            capacity in 16usize..200,
            seed in 0u64..1000,
            parts in 1usize..5,
        ) {
            let value = |i: usize| ((i as u64 + seed).wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 11) as f64;
            let mut sketch = Sketch::new(capacity);
            for part in 0..parts {
                let mut other = Sketch::new(capacity);
                (0..n).filter(|i| i % parts == part).for_each(|i| other.add(value(i)));
                sketch.take(&mut other);
            }
            let mut sorted: Vec<f64> = (0..n).map(value).collect();
            sorted.sort_unstable_by(f64::total_cmp);
            let levels = (n as f64 / capacity as f64).log2().max(0.0) + 2.0;
            let bound = levels * n as f64 / capacity as f64 + 2.0;
            for ((_, q), found) in QUANTILES.into_iter().zip(sketch.quantiles()) {
                let rank = sorted.partition_point(|v| *v < found) as f64;
                prop_assert!((rank - q * (n - 1) as f64).abs() <= bound, "{q} {rank} {n} {bound}");
            }
        }
    }
}
