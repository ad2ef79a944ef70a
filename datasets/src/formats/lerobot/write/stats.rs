//! Statistics of features, for `meta/stats.json` and the columns `stats/*` of the episodes.
//!
//! Minimum, maximum, mean and standard deviation (of the population) are exact; quantiles are exact up to the
//! capacity of a [`Sketch`] and an approximation beyond. Values that are not finite take no part; a dimension
//! without a finite value has zeros.

use serde_json::{Map, Value, json};

use super::sketch::{QUANTILES, Sketch};

/// Names of what is recorded besides the count, in the order of [`Dimension::summary`].
pub(super) const NAMES: [&str; 9] = [
    "min",
    "max",
    "mean",
    "std",
    QUANTILES[0].0,
    QUANTILES[1].0,
    QUANTILES[2].0,
    QUANTILES[3].0,
    QUANTILES[4].0,
];
/// Values that all sketches keep on one level together, about.
const KEPT: usize = 1 << 19;

/// Statistics of one feature over some rows.
#[derive(Debug, Clone)]
pub(super) struct FeatureStats {
    dimensions: Vec<Dimension>,
    n_rows: u64,
}

/// What [`FeatureStats`] comes to: for each of [`NAMES`] a value for each dimension.
#[derive(Debug, Clone)]
pub(super) struct StatsRow {
    pub(super) values: Vec<Vec<f64>>,
    pub(super) count: i64,
}

#[derive(Debug, Clone)]
struct Dimension {
    n: u64,
    min: f64,
    max: f64,
    mean: f64,
    /// Sum of the squared distances to the mean.
    squares: f64,
    sketch: Sketch,
}

/// Values a sketch keeps where there are so many dimensions in all.
pub(super) fn capacity(n_dimensions: usize) -> usize {
    (KEPT / n_dimensions.max(1)).clamp(64, 8192)
}

impl FeatureStats {
    pub(super) fn new(width: usize, capacity: usize) -> Self {
        Self {
            dimensions: vec![Dimension::new(capacity); width],
            n_rows: 0,
        }
    }

    /// Adds rows, given one after another.
    pub(super) fn add(&mut self, rows: &[f64]) {
        let width = self.dimensions.len().max(1);
        self.n_rows += (rows.len() / width) as u64;
        for row in rows.chunks_exact(width) {
            for (dimension, value) in self.dimensions.iter_mut().zip(row) {
                if value.is_finite() {
                    dimension.add(*value);
                }
            }
        }
    }

    /// Takes over the rows of another, which is empty afterwards.
    pub(super) fn take(&mut self, other: &mut Self) {
        self.n_rows += std::mem::take(&mut other.n_rows);
        for (own, other) in self.dimensions.iter_mut().zip(&mut other.dimensions) {
            own.take(other);
        }
    }

    pub(super) fn summary(&self) -> StatsRow {
        let summaries: Vec<_> = self.dimensions.iter().map(Dimension::summary).collect();
        let column = |place: usize| summaries.iter().map(|s| s[place]).collect();
        StatsRow {
            values: (0..NAMES.len()).map(column).collect(),
            count: i64::try_from(self.n_rows).unwrap_or(i64::MAX),
        }
    }

    /// The entry of `stats.json` for a feature of this shape.
    pub(super) fn json(&self, shape: &[usize]) -> Value {
        let summary = self.summary();
        let entries = NAMES.iter().zip(&summary.values);
        let mut object: Map<String, Value> = entries
            .map(|(name, values)| ((*name).to_owned(), nested(values, shape)))
            .collect();
        object.insert("count".to_owned(), json!([summary.count]));
        Value::Object(object)
    }
}

/// Values in C order as nested lists.
fn nested(values: &[f64], shape: &[usize]) -> Value {
    match shape {
        [] | [_] => json!(values),
        [first, rest @ ..] => {
            let part = values.len() / (*first).max(1);
            let parts = values.chunks(part.max(1));
            Value::Array(parts.map(|part| nested(part, rest)).collect())
        }
    }
}

impl Dimension {
    fn new(capacity: usize) -> Self {
        Self {
            n: 0,
            min: 0.0,
            max: 0.0,
            mean: 0.0,
            squares: 0.0,
            sketch: Sketch::new(capacity),
        }
    }

    /// Welford's update.
    fn add(&mut self, value: f64) {
        (self.min, self.max) = match self.n {
            0 => (value, value),
            _ => (self.min.min(value), self.max.max(value)),
        };
        self.n += 1;
        let distance = value - self.mean;
        self.mean += distance / self.n as f64;
        self.squares += distance * (value - self.mean);
        self.sketch.add(value);
    }

    /// Chan's update for two parts.
    fn take(&mut self, other: &mut Self) {
        if other.n > 0 {
            (self.min, self.max) = match self.n {
                0 => (other.min, other.max),
                _ => (self.min.min(other.min), self.max.max(other.max)),
            };
            let n = (self.n + other.n) as f64;
            let distance = other.mean - self.mean;
            self.squares +=
                other.squares + distance * distance * (self.n as f64 / n) * other.n as f64;
            self.mean += distance * (other.n as f64 / n);
            self.n += other.n;
            self.sketch.take(&mut other.sketch);
        }
        (other.n, other.mean, other.squares) = (0, 0.0, 0.0);
    }

    fn summary(&self) -> [f64; NAMES.len()] {
        let std = match self.n {
            0 => 0.0,
            n => (self.squares / n as f64).sqrt(),
        };
        let [a, b, c, d, e] = self.sketch.quantiles();
        [self.min, self.max, self.mean, std, a, b, c, d, e]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_give_what_the_whole_gives() {
        let rows: Vec<f64> = (0..60).map(|i| f64::from(i * i % 17) - 3.0).collect();
        let mut whole = FeatureStats::new(2, 100);
        whole.add(&rows);
        let mut parts = FeatureStats::new(2, 100);
        let mut part = FeatureStats::new(2, 100);
        for rows in rows.chunks(14) {
            part.add(rows);
            parts.take(&mut part);
        }
        let (whole, parts) = (whole.summary(), parts.summary());
        assert_eq!((whole.count, parts.count), (30, 30));
        for (a, b) in whole
            .values
            .iter()
            .flatten()
            .zip(parts.values.iter().flatten())
        {
            assert!((a - b).abs() < 1e-12);
        }
        // The textbook's two passes.
        let first: Vec<f64> = rows.iter().step_by(2).copied().collect();
        let mean = first.iter().sum::<f64>() / 30.0;
        let squares = first.iter().map(|v| (v - mean) * (v - mean)).sum::<f64>();
        assert!((parts.values[2][0] - mean).abs() < 1e-12);
        assert!((parts.values[3][0] - (squares / 30.0).sqrt()).abs() < 1e-12);
    }

    #[test]
    fn what_is_not_finite_takes_no_part() {
        let mut stats = FeatureStats::new(2, 10);
        stats.add(&[1.0, f64::NAN, 3.0, f64::INFINITY]);
        let json = stats.json(&[2]);
        assert_eq!(json["max"], json!([3.0, 0.0]));
        assert_eq!(json["mean"], json!([2.0, 0.0]));
        assert_eq!(json["count"], json!([2]));
    }
}
