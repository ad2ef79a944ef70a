//! The grid that rows and queries are rounded to.

use rayon::prelude::*;

use crate::matrix::{CHUNK_ROWS, Matrix};

/// Rows that the grid is measured on.
const SAMPLE_ROWS: usize = 4096;

/// The grid reaches this many times as far as 99 % of a column's values: 5 standard deviations of
/// a normal distribution.
const REACH: f64 = 2.0;

/// The largest code.
pub(super) const LARGEST: f64 = 127.0;

/// Half of a typical squared distance, in steps of the grid, is at most this: within 16 bits.
const TYPICAL: f64 = 25_000.0;

/// Codes are `round((x − center) / step)`, clamped to ±127.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Scale {
    /// Per column.
    pub(crate) center: Vec<f64>,
    /// One for all columns, so that distances keep their proportions.
    pub(crate) step: f64,
    /// Variance of the codes, per column: only a guide to which columns tell rows apart.
    pub(crate) variance: Vec<f64>,
}

impl Scale {
    /// A grid for `data`, by its medians and its widest column: a few wild rows do not coarsen it.
    pub(super) fn measure(data: &Matrix) -> Self {
        let width = data.n_features();
        let sampled = data.n_rows().min(SAMPLE_ROWS);
        let rows: Vec<usize> = (0..sampled).map(|i| i * data.n_rows() / sampled).collect();
        let mut center = vec![0.0; width];
        let mut deviations = vec![Vec::new(); width];
        let mut reach = 0.0f64;
        for column in 0..width {
            let mut values: Vec<f64> = rows.iter().map(|&row| data.value(row, column)).collect();
            center[column] = quantile(&mut values, 0.5);
            values
                .iter_mut()
                .for_each(|v| *v = (*v - center[column]).abs());
            reach = reach.max(REACH * quantile(&mut values, 0.99));
            deviations[column] = values;
        }
        if reach == 0.0 {
            reach = largest_deviation(data, &center);
        }
        let mean_square = |values: &Vec<f64>| {
            let sum: f64 = values.iter().map(|v| v.min(reach).powi(2)).sum();
            sum / sampled.max(1) as f64
        };
        let spread: Vec<f64> = deviations.iter().map(mean_square).collect();
        let total: f64 = spread.iter().sum();
        let step = (reach / LARGEST).max((total / TYPICAL).sqrt());
        let step = if step > 0.0 && step.is_finite() {
            step
        } else {
            1.0
        };
        let variance = spread.iter().map(|v| v / (step * step)).collect();
        Self {
            center,
            step,
            variance,
        }
    }

    /// How far from the center the grid reaches.
    pub(super) fn limit(&self) -> f64 {
        self.step * LARGEST
    }
}

/// Zero for no values.
fn quantile(values: &mut [f64], share: f64) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let at = ((values.len() - 1) as f64 * share) as usize;
    *values.select_nth_unstable_by(at, f64::total_cmp).1
}

fn largest_deviation(data: &Matrix, center: &[f64]) -> f64 {
    let chunks: Vec<usize> = (0..data.n_rows()).step_by(CHUNK_ROWS).collect();
    chunks
        .into_par_iter()
        .map(|start| {
            let mut values = vec![0.0; center.len()];
            let mut most = 0.0f64;
            for row in start..(start + CHUNK_ROWS).min(data.n_rows()) {
                data.read_row(row, &mut values);
                for (value, center) in values.iter().zip(center) {
                    most = most.max((value - center).abs());
                }
            }
            most
        })
        .reduce(|| 0.0, f64::max)
}
