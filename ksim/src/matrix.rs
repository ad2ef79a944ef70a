//! Row-major matrices of finite numbers.
//!
//! [`Matrix`] is what a search keeps: every value as two `f32`, whose sum carries 48 bits of
//! significand. The first is what SIMD first passes read, both together what exact ranking reads,
//! and the pair costs no more memory than one `f64`. [`MatrixView`] borrows plain `f64` rows:
//! queries are few.

use crate::buffer::Buffer;
use crate::error::DataError;
use crate::prefetch::prefetch;

/// Borrowed row-major `f64` values of shape `(n_rows, n_features)`, all finite.
#[derive(Debug, Clone, Copy)]
pub struct MatrixView<'a> {
    values: &'a [f64],
    n_features: usize,
}

impl<'a> MatrixView<'a> {
    /// Checks once that the rows are whole and every value is finite.
    ///
    /// # Errors
    /// [`DataError::NoColumns`], [`DataError::RaggedRows`], [`DataError::NonFinite`].
    pub fn new(values: &'a [f64], n_features: usize) -> Result<Self, DataError> {
        check_shape(values.len(), n_features)?;
        check_finite(values, n_features)?;
        Ok(Self { values, n_features })
    }

    /// Number of rows.
    pub fn n_rows(&self) -> usize {
        self.values.len() / self.n_features
    }

    /// Number of columns.
    pub fn n_features(&self) -> usize {
        self.n_features
    }

    /// One row.
    ///
    /// # Panics
    /// If `row` is out of range.
    pub fn row(&self, row: usize) -> &'a [f64] {
        &self.values[row * self.n_features..][..self.n_features]
    }

    /// The rows in order.
    pub fn rows(&self) -> impl ExactSizeIterator<Item = &'a [f64]> + use<'a> {
        self.values.chunks_exact(self.n_features)
    }
}

/// Owned values of shape `(n_rows, n_features)`, all finite, each held as two `f32`.
#[derive(Debug, Clone, PartialEq)]
pub struct Matrix {
    /// The value rounded to `f32`.
    high: Buffer<f32>,
    /// What the rounding left; empty while every value is an `f32`.
    low: Buffer<f32>,
    n_features: usize,
}

impl Matrix {
    /// An empty matrix of the given width.
    ///
    /// # Errors
    /// [`DataError::NoColumns`] for width 0, [`DataError::TooManyColumns`].
    pub fn new(n_features: usize) -> Result<Self, DataError> {
        check_shape(0, n_features)?;
        Ok(Self {
            high: Buffer::default(),
            low: Buffer::default(),
            n_features,
        })
    }

    /// Takes row-major `f32` values as they are, without a copy.
    ///
    /// # Errors
    /// [`DataError::NoColumns`], [`DataError::TooManyColumns`], [`DataError::RaggedRows`],
    /// [`DataError::NonFinite`], [`DataError::TooManyRows`].
    pub fn from_f32(values: Vec<f32>, n_features: usize) -> Result<Self, DataError> {
        check_shape(values.len(), n_features)?;
        check_plane(&values, n_features)?;
        let matrix = Self {
            high: values.into(),
            low: Buffer::default(),
            n_features,
        };
        matrix.check_rows()?;
        Ok(matrix)
    }

    /// Takes both planes as [`planes`](Self::planes) gives them, without a copy.
    ///
    /// # Errors
    /// As [`from_f32`](Self::from_f32) for either plane; [`DataError::Parts`] if the second plane is
    /// neither empty nor as long as the first.
    pub fn from_planes(
        high: Buffer<f32>,
        low: Buffer<f32>,
        n_features: usize,
    ) -> Result<Self, DataError> {
        check_shape(high.len(), n_features)?;
        if !low.is_empty() && low.len() != high.len() {
            return Err(DataError::Parts {
                what: "values of the second plane",
                expected: high.len(),
                found: low.len(),
            });
        }
        for plane in [&*high, &*low] {
            check_plane(plane, n_features)?;
        }
        let matrix = Self {
            high,
            low,
            n_features,
        };
        matrix.check_rows()?;
        Ok(matrix)
    }

    /// A value as the two `f32` that [`planes`](Self::planes) hold: rounded, and what the rounding left.
    #[inline]
    pub fn split(value: f64) -> [f32; 2] {
        let (high, low) = split(value);
        [high, low]
    }

    /// Both planes, row-major: the values rounded to `f32`, and what the rounding left, which is
    /// empty where every value is an `f32`.
    pub fn planes(&self) -> (&[f32], &[f32]) {
        (&self.high, &self.low)
    }

    /// Copies row-major `f64` values.
    ///
    /// # Errors
    /// [`DataError::NoColumns`], [`DataError::RaggedRows`], [`DataError::NonFinite`].
    pub fn from_f64(values: &[f64], n_features: usize) -> Result<Self, DataError> {
        let mut matrix = Self::new(n_features)?;
        matrix.push_rows(values)?;
        Ok(matrix)
    }

    /// Appends row-major values; the matrix is unchanged on error.
    ///
    /// # Errors
    /// [`DataError::RaggedRows`], [`DataError::NonFinite`] (with the row counted within `values`),
    /// [`DataError::TooManyRows`].
    pub fn push_rows(&mut self, values: &[f64]) -> Result<(), DataError> {
        check_shape(values.len(), self.n_features)?;
        check_finite(values, self.n_features)?;
        if self.n_rows() + values.len() / self.n_features > u32::MAX as usize {
            return Err(DataError::TooManyRows);
        }
        let before = self.high.len();
        let high = self.high.to_mut();
        high.extend(values.iter().map(|&v| v as f32));
        let exact = values.iter().all(|&v| f64::from(v as f32) == v);
        if !exact || !self.low.is_empty() {
            // The first value that is not an f32 gives the whole matrix its second plane.
            let low = self.low.to_mut();
            low.resize(before, 0.0);
            low.extend(values.iter().map(|&v| split(v).1));
        }
        Ok(())
    }

    /// Gives back what growing has over-allocated.
    pub fn shrink_to_fit(&mut self) {
        self.high.shrink_to_fit();
        self.low.shrink_to_fit();
    }

    /// Number of rows.
    pub fn n_rows(&self) -> usize {
        self.high.len() / self.n_features
    }

    /// Number of columns.
    pub fn n_features(&self) -> usize {
        self.n_features
    }

    /// One value, to 48 bits of significand.
    ///
    /// # Panics
    /// If `row` or `column` is out of range.
    pub fn value(&self, row: usize, column: usize) -> f64 {
        assert!(
            column < self.n_features,
            "column {column} of {}",
            self.n_features
        );
        let at = row * self.n_features + column;
        f64::from(self.high[at]) + self.low.get(at).map_or(0.0, |&low| f64::from(low))
    }

    /// Writes one row into `out`, which has `n_features` places.
    ///
    /// # Panics
    /// If `row` is out of range or `out` has another length.
    pub fn read_row(&self, row: usize, out: &mut [f64]) {
        let range = row * self.n_features..(row + 1) * self.n_features;
        assert_eq!(out.len(), self.n_features, "length of the output row");
        for (out, &high) in out.iter_mut().zip(&self.high[range.clone()]) {
            *out = f64::from(high);
        }
        if let Some(low) = self.low.get(range) {
            for (out, &low) in out.iter_mut().zip(low) {
                *out += f64::from(low);
            }
        }
    }

    /// Squared L2 distance of a row to `query`, in f64 and in one fixed order of summation: every
    /// engine ranks by this very number, so that all agree to the last bit, ties included.
    ///
    /// # Panics
    /// If `row` is out of range.
    pub fn squared_distance(&self, row: usize, query: &[f64]) -> f64 {
        let range = row * self.n_features..(row + 1) * self.n_features;
        let high = &self.high[range.clone()];
        match self.low.get(range) {
            Some(low) => sum_of_squares(query, |i| f64::from(high[i]) + f64::from(low[i])),
            None => sum_of_squares(query, |i| f64::from(high[i])),
        }
    }

    /// `visit(position, squared distance)` for listed rows, which may lie anywhere: those to come are
    /// asked for ahead of their use.
    ///
    /// # Panics
    /// If a row is out of range.
    pub(crate) fn each_squared_distance(
        &self,
        rows: impl ExactSizeIterator<Item = u32> + Clone,
        query: &[f64],
        mut visit: impl FnMut(usize, f64),
    ) {
        /// The work on so many rows takes about as long as memory does.
        const AHEAD: usize = 6;
        let mut later = rows.clone().skip(AHEAD);
        rows.clone().take(AHEAD).for_each(|row| self.prefetch(row));
        for (at, row) in rows.enumerate() {
            if let Some(later) = later.next() {
                self.prefetch(later);
            }
            visit(at, self.squared_distance(row as usize, query));
        }
    }

    fn prefetch(&self, row: u32) {
        /// f32 values of a cache line.
        const LINE: usize = 16;
        let range = row as usize * self.n_features..(row as usize + 1) * self.n_features;
        for plane in [&self.high, &self.low] {
            let values = plane.get(range.clone()).unwrap_or_default();
            for at in (0..values.len()).step_by(LINE) {
                prefetch(values, at);
            }
            // A row begins anywhere in a line, so that its end may lie in one more.
            prefetch(values, values.len().saturating_sub(1));
        }
    }

    /// The `f32` plane of one row: the value rounded to nearest.
    pub(crate) fn high_row(&self, row: usize) -> &[f32] {
        &self.high[row * self.n_features..][..self.n_features]
    }

    /// A copy of rows 0, `step`, 2 `step`, ….
    pub(crate) fn every(&self, step: usize) -> Self {
        let thin = |plane: &[f32]| -> Vec<f32> {
            plane
                .chunks_exact(self.n_features)
                .step_by(step)
                .flatten()
                .copied()
                .collect()
        };
        Self {
            high: thin(&self.high).into(),
            low: thin(&self.low).into(),
            n_features: self.n_features,
        }
    }

    /// Replaces every value by `map(column, value)`, in place; values that stop being `f32` bring
    /// the second plane into being.
    pub(crate) fn map_in_place(&mut self, map: impl Fn(usize, f64) -> f64 + Sync) {
        use rayon::prelude::*;
        let (high, low) = (self.high.to_mut(), self.low.to_mut());
        low.resize(high.len(), 0.0);
        let width = self.n_features;
        high.par_chunks_mut(width * CHUNK_ROWS)
            .zip(low.par_chunks_mut(width * CHUNK_ROWS))
            .for_each(|(high, low)| {
                for (high, low) in high
                    .chunks_exact_mut(width)
                    .zip(low.chunks_exact_mut(width))
                {
                    for (column, (high, low)) in high.iter_mut().zip(low).enumerate() {
                        let value = map(column, f64::from(*high) + f64::from(*low));
                        (*high, *low) = split(value);
                    }
                }
            });
    }

    fn check_rows(&self) -> Result<(), DataError> {
        if self.n_rows() > u32::MAX as usize {
            return Err(DataError::TooManyRows);
        }
        Ok(())
    }
}

/// A value as two `f32`: rounded, and what the rounding left.
#[inline(always)]
fn split(value: f64) -> (f32, f32) {
    let high = value as f32;
    (high, (value - f64::from(high)) as f32)
}

/// Rows that parallel passes take at a time. Fixed: partial sums are combined in the order of
/// these chunks, which makes every result independent of the number of threads.
pub(crate) const CHUNK_ROWS: usize = 2048;

/// Σ (x_i − q_i)² over four interleaved partial sums, the order of which is part of the contract
/// of [`Matrix::squared_distance`].
#[inline(always)]
fn sum_of_squares(query: &[f64], value: impl Fn(usize) -> f64) -> f64 {
    let mut partial = [0.0f64; 4];
    let whole = query.len() / 4 * 4;
    for i in (0..whole).step_by(4) {
        for lane in 0..4 {
            let difference = value(i + lane) - query[i + lane];
            partial[lane] += difference * difference;
        }
    }
    for i in whole..query.len() {
        let difference = value(i) - query[i];
        partial[i - whole] += difference * difference;
    }
    (partial[0] + partial[2]) + (partial[1] + partial[3])
}

/// Squared L2 distance between two plain rows, in the order of [`Matrix::squared_distance`].
pub(crate) fn squared_distance(a: &[f64], b: &[f64]) -> f64 {
    sum_of_squares(b, |i| a[i])
}

/// Relative error of a sum of `n` products in f32, in any order: nu/(1 − nu), u = 2⁻²⁴ (Higham 2002,
/// §3.1).
pub(crate) fn gamma(n: usize) -> f64 {
    let sum = n as f64 * f64::from(f32::EPSILON) / 2.0;
    sum / (1.0 - sum)
}

/// More than an f32 distance over `width` columns can lose where squares underflow.
pub(crate) fn underflow(width: usize) -> f64 {
    (width as f64).sqrt() * 2f64.powi(-74)
}

/// The largest L2 norm of any row: what error bounds of f32 passes grow with.
pub(crate) fn max_norm(data: &Matrix) -> f64 {
    use rayon::prelude::*;
    let origin = vec![0.0; data.n_features()];
    (0..data.n_rows())
        .into_par_iter()
        .map(|row| data.squared_distance(row, &origin))
        .reduce(|| 0.0, f64::max)
        .sqrt()
}

/// Columns at most: so many groups of four have numbers of 16 bits in the first pass of a search.
const MAX_FEATURES: usize = 1 << 18;

fn check_shape(values: usize, n_features: usize) -> Result<(), DataError> {
    if n_features == 0 {
        return Err(DataError::NoColumns);
    }
    if n_features > MAX_FEATURES {
        return Err(DataError::TooManyColumns {
            most: MAX_FEATURES,
            found: n_features,
        });
    }
    if !values.is_multiple_of(n_features) {
        return Err(DataError::RaggedRows { values, n_features });
    }
    Ok(())
}

fn check_plane(values: &[f32], n_features: usize) -> Result<(), DataError> {
    use rayon::prelude::*;
    match values.par_iter().position_first(|v| !v.is_finite()) {
        Some(at) => Err(non_finite(at, n_features, f64::from(values[at]))),
        None => Ok(()),
    }
}

pub(crate) fn check_finite(values: &[f64], n_features: usize) -> Result<(), DataError> {
    // As f32, so that a value beyond its range is caught here and not as an infinite distance.
    match values.iter().position(|&v| !(v as f32).is_finite()) {
        Some(at) => Err(non_finite(at, n_features, values[at])),
        None => Ok(()),
    }
}

fn non_finite(at: usize, n_features: usize, value: f64) -> DataError {
    DataError::NonFinite {
        row: at / n_features,
        column: at % n_features,
        value,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn f32_values_take_one_plane() {
        let matrix = Matrix::from_f64(&[0.5, 1.25, -3.0, 4.0], 2).unwrap();
        assert!(matrix.low.is_empty());
        assert_eq!(matrix.value(1, 0), -3.0);
    }

    #[test]
    fn a_late_f64_value_fills_the_second_plane() {
        let mut matrix = Matrix::from_f64(&[0.5, 1.25], 2).unwrap();
        matrix.push_rows(&[0.1, 2.0]).unwrap();
        assert_eq!((matrix.value(0, 1), matrix.value(1, 1)), (1.25, 2.0));
        assert!((matrix.value(1, 0) - 0.1).abs() < 1e-15);
    }

    #[test]
    fn bad_input_is_named() {
        let error = Matrix::from_f64(&[1.0, f64::NAN, 2.0, 3.0], 2).unwrap_err();
        assert!(matches!(
            error,
            DataError::NonFinite {
                row: 0,
                column: 1,
                ..
            }
        ));
        assert!(matches!(
            Matrix::from_f64(&[1e39], 1),
            Err(DataError::NonFinite { .. })
        ));
        assert!(matches!(
            Matrix::from_f64(&[1.0], 2),
            Err(DataError::RaggedRows { .. })
        ));
        assert!(matches!(Matrix::new(0), Err(DataError::NoColumns)));
        assert!(matches!(
            Matrix::new(MAX_FEATURES + 1),
            Err(DataError::TooManyColumns { .. })
        ));
        let planes =
            |high: Vec<f32>, low: Vec<f32>| Matrix::from_planes(high.into(), low.into(), 2);
        assert!(planes(vec![1.0, 2.0], vec![0.0, 1e-9]).is_ok());
        for (high, low) in [
            (vec![1.0, f32::NAN], vec![]),
            (vec![1.0, 2.0], vec![0.0, f32::NAN]),
        ] {
            assert!(matches!(
                planes(high, low),
                Err(DataError::NonFinite { column: 1, .. })
            ));
        }
        assert!(matches!(
            Matrix::from_f32(vec![f32::INFINITY], 1),
            Err(DataError::NonFinite { .. })
        ));
    }

    proptest! {
        #[test]
        fn values_keep_48_bits(values in prop::collection::vec(-1e6f64..1e6, 1..40)) {
            let matrix = Matrix::from_f64(&values, 1).unwrap();
            for (row, &value) in values.iter().enumerate() {
                prop_assert!((matrix.value(row, 0) - value).abs() <= value.abs() * 2f64.powi(-47));
            }
        }

        #[test]
        fn distance_is_the_plain_sum(
            row in prop::collection::vec(-10.0f64..10.0, 1..20),
            shift in -5.0f64..5.0,
        ) {
            let query: Vec<f64> = row.iter().map(|v| v + shift).collect();
            let matrix = Matrix::from_f64(&row, row.len()).unwrap();
            let plain: f64 = row.iter().zip(&query).map(|(a, b)| (a - b) * (a - b)).sum();
            prop_assert!((matrix.squared_distance(0, &query) - plain).abs() < 1e-9);
        }
    }
}
