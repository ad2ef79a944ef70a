//! Mean and deviation of observations.

use serde::{Deserialize, Serialize};

use crate::error::PlannerError;

/// Mean and population deviation of every column, accumulated in f64 and kept in f32.
///
/// The reference accumulates in f32, so its statistics of a million rows carry errors of about 1e-4.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Normalizer {
    /// Mean of each column.
    pub mean: Vec<f32>,
    /// Deviation of each column; 1 where a column is constant.
    pub std: Vec<f32>,
}

impl Normalizer {
    /// Of `rows` of the shape `(n_rows, width)`, at least one row.
    pub fn fit(rows: &[f64], width: usize) -> Self {
        let n_rows = (rows.len() / width.max(1)).max(1) as f64;
        let mut mean = vec![0.0; width];
        for row in rows.chunks_exact(width) {
            for (sum, value) in mean.iter_mut().zip(row) {
                *sum += value;
            }
        }
        mean.iter_mut().for_each(|sum| *sum /= n_rows);
        let mut variance = vec![0.0; width];
        for row in rows.chunks_exact(width) {
            for ((sum, value), mean) in variance.iter_mut().zip(row).zip(&mean) {
                *sum += (value - mean).powi(2);
            }
        }
        let std = variance.iter().map(|sum| (sum / n_rows).sqrt() as f32);
        Self {
            mean: mean.iter().map(|&mean| mean as f32).collect(),
            std: std.map(|std| if std == 0.0 { 1.0 } else { std }).collect(),
        }
    }

    /// Columns.
    pub fn width(&self) -> usize {
        self.mean.len()
    }

    /// (row − mean) / std, computed in f64. Both slices have [`Normalizer::width`] numbers.
    pub fn normalize(&self, row: &[f64], out: &mut [f32]) {
        for (((out, value), mean), std) in out.iter_mut().zip(row).zip(&self.mean).zip(&self.std) {
            *out = ((value - f64::from(*mean)) / f64::from(*std)) as f32;
        }
    }

    /// row · std + mean, the inverse.
    pub fn denormalize(&self, row: &[f32], out: &mut [f32]) {
        for (((out, value), mean), std) in out.iter_mut().zip(row).zip(&self.mean).zip(&self.std) {
            *out = value * std + mean;
        }
    }

    /// Checks statistics that were read from a file.
    ///
    /// # Errors
    /// Another width, numbers that are not finite, a deviation that is not positive.
    pub fn check(&self, width: usize) -> Result<(), PlannerError> {
        for (what, values) in [
            ("normalizer mean", &self.mean),
            ("normalizer std", &self.std),
        ] {
            if values.len() != width {
                return Err(PlannerError::Length {
                    what,
                    expected: width,
                    found: values.len(),
                });
            }
        }
        let finite = self.mean.iter().all(|mean| mean.is_finite());
        let positive = self.std.iter().all(|std| std.is_finite() && *std > 0.0);
        if !(finite && positive) {
            return Err(PlannerError::NotFinite {
                what: "the normalizer".to_owned(),
                place: "in a planner's file".to_owned(),
                checkpoint: None,
            });
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_constant_column_has_the_deviation_one() {
        let normalizer = Normalizer::fit(&[1.0, 5.0, 3.0, 5.0], 2);
        assert_eq!(normalizer.mean, [2.0, 5.0]);
        assert_eq!(normalizer.std, [1.0, 1.0]);
        let (mut out, mut back) = ([0.0; 2], [0.0; 2]);
        normalizer.normalize(&[3.0, 6.0], &mut out);
        assert_eq!(out, [1.0, 1.0]);
        normalizer.denormalize(&out, &mut back);
        assert_eq!(back, [3.0, 6.0]);
    }

    #[test]
    fn sums_stay_exact_where_f32_would_not() {
        let rows: Vec<f64> = (0..200_000)
            .map(|row| 1000.0 + f64::from(row % 2))
            .collect();
        let normalizer = Normalizer::fit(&rows, 1);
        assert_eq!((normalizer.mean[0], normalizer.std[0]), (1000.5, 0.5));
    }

    #[test]
    fn statistics_of_a_file_are_checked() {
        let normalizer = Normalizer {
            mean: vec![0.0, 0.0],
            std: vec![1.0, 0.0],
        };
        assert!(normalizer.check(2).is_err());
        assert!(Normalizer::fit(&[1.0, 2.0], 2).check(3).is_err());
    }
}
