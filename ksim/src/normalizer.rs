//! Column-wise z-scores with the reference's own statistics.

use rayon::prelude::*;

use crate::error::DataError;
use crate::matrix::{CHUNK_ROWS, Matrix};

/// A standard deviation below this counts as 1: the column does not vary.
const SMALLEST_STD: f64 = 1e-6;

/// Mean and population standard deviation of every column, accumulated in f64.
#[derive(Debug, Clone, PartialEq)]
pub struct Normalizer {
    mean: Vec<f64>,
    std: Vec<f64>,
}

impl Normalizer {
    /// Statistics of a matrix of shape `(n_rows, n_features)`; an empty one gives mean 0, std 1.
    ///
    /// Two passes (mean, then squared deviations), summed over fixed chunks of rows in their
    /// order: the same bits for any number of threads.
    pub fn fit(data: &Matrix) -> Self {
        let (mean, variance) = mean_and_variance(data);
        let std = variance
            .iter()
            .map(|variance| variance.sqrt())
            .map(|std| if std < SMALLEST_STD { 1.0 } else { std })
            .collect();
        Self { mean, std }
    }

    /// Takes statistics that were computed before, one mean and one deviation per column.
    ///
    /// # Errors
    /// [`DataError::Parts`] for unequal numbers of them, [`DataError::Statistics`] for a mean that is not
    /// finite or a deviation that is not finite and above 0.
    pub fn from_statistics(mean: Vec<f64>, std: Vec<f64>) -> Result<Self, DataError> {
        if mean.len() != std.len() {
            return Err(DataError::Parts {
                what: "standard deviations",
                expected: mean.len(),
                found: std.len(),
            });
        }
        for (column, (&mean, &std)) in mean.iter().zip(&std).enumerate() {
            if !(mean.is_finite() && std.is_finite() && std > 0.0) {
                return Err(DataError::Statistics { column, mean, std });
            }
        }
        Ok(Self { mean, std })
    }

    /// Column means, raw units.
    pub fn mean(&self) -> &[f64] {
        &self.mean
    }

    /// Column standard deviations, raw units; 1 where the column does not vary.
    pub fn std(&self) -> &[f64] {
        &self.std
    }

    /// `(value − mean) / std` of one column.
    pub fn normalize(&self, column: usize, value: f64) -> f64 {
        (value - self.mean[column]) / self.std[column]
    }

    /// `value · std + mean` of one column: back to raw units.
    pub fn denormalize(&self, column: usize, value: f64) -> f64 {
        value * self.std[column] + self.mean[column]
    }

    pub(crate) fn normalize_in_place(&self, data: &mut Matrix) {
        data.map_in_place(|column, value| self.normalize(column, value));
    }

    /// Normalized copies of a range of rows, row-major, in f64.
    ///
    /// # Panics
    /// If `rows` is out of range or `data` has another width.
    pub fn normalized_rows(&self, data: &Matrix, rows: std::ops::Range<usize>) -> Vec<f64> {
        let width = data.n_features();
        let mut out = vec![0.0; rows.len() * width];
        for (row, out) in rows.zip(out.chunks_exact_mut(width)) {
            data.read_row(row, out);
            for (column, value) in out.iter_mut().enumerate() {
                *value = self.normalize(column, *value);
            }
        }
        out
    }
}

/// Population variance of every column.
pub(crate) fn column_variances(data: &Matrix) -> Vec<f64> {
    mean_and_variance(data).1
}

fn mean_and_variance(data: &Matrix) -> (Vec<f64>, Vec<f64>) {
    let n = data.n_rows().max(1) as f64;
    let mean: Vec<f64> = column_sums(data, |_, v| v).iter().map(|s| s / n).collect();
    let squares = column_sums(data, |column, v| (v - mean[column]) * (v - mean[column]));
    (mean, squares.iter().map(|s| s / n).collect())
}

/// Per-column sums of `term(column, value)`.
fn column_sums(data: &Matrix, term: impl Fn(usize, f64) -> f64 + Sync) -> Vec<f64> {
    let width = data.n_features();
    let partial: Vec<Vec<f64>> = (0..data.n_rows().div_ceil(CHUNK_ROWS))
        .into_par_iter()
        .map(|chunk| {
            let (mut sums, mut row) = (vec![0.0; width], vec![0.0; width]);
            let end = ((chunk + 1) * CHUNK_ROWS).min(data.n_rows());
            for r in chunk * CHUNK_ROWS..end {
                data.read_row(r, &mut row);
                for (column, (sum, &value)) in sums.iter_mut().zip(&row).enumerate() {
                    *sum += term(column, value);
                }
            }
            sums
        })
        .collect();
    let mut sums = vec![0.0; width];
    for chunk in partial {
        for (sum, part) in sums.iter_mut().zip(chunk) {
            *sum += part;
        }
    }
    sums
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn population_statistics_and_constant_columns() {
        let data = Matrix::from_f64(&[1.0, 7.0, 3.0, 7.0], 2).unwrap();
        let normalizer = Normalizer::fit(&data);
        assert_eq!(normalizer.mean(), [2.0, 7.0]);
        assert_eq!(normalizer.std(), [1.0, 1.0]);
        let mut normalized = data.clone();
        normalizer.normalize_in_place(&mut normalized);
        assert_eq!(
            normalizer.normalized_rows(&data, 0..2),
            [-1.0, 0.0, 1.0, 0.0]
        );
        assert_eq!((normalized.value(1, 0), normalized.value(1, 1)), (1.0, 0.0));
    }

    #[test]
    fn statistics_of_no_use_are_refused() {
        let of = |mean: f64, std: f64| Normalizer::from_statistics(vec![0.0, mean], vec![1.0, std]);
        assert!(of(1.0, 2.0).is_ok());
        for (mean, std) in [
            (f64::NAN, 1.0),
            (0.0, 0.0),
            (0.0, -1.0),
            (0.0, f64::INFINITY),
        ] {
            let error = of(mean, std).unwrap_err();
            assert!(matches!(error, DataError::Statistics { column: 1, .. }));
        }
        assert!(Normalizer::from_statistics(vec![0.0], vec![]).is_err());
    }

    #[test]
    fn statistics_do_not_depend_on_threads() {
        let values: Vec<f64> = (0..60_000)
            .map(|i| (f64::from(i) * 0.7).sin() * 1e3)
            .collect();
        let data = Matrix::from_f64(&values, 3).unwrap();
        let on = |threads| {
            let pool = rayon::ThreadPoolBuilder::new()
                .num_threads(threads)
                .build()
                .unwrap();
            pool.install(|| Normalizer::fit(&data))
        };
        assert_eq!(on(1), on(3));
    }
}
