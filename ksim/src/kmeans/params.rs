//! Parameters of a fit, and their check.

use super::{KMeans, init, yinyang};
use crate::error::KMeansError;
use crate::matrix::Matrix;

/// Which code fits the centers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum KMeansBackend {
    /// Our own: greedy k-means++ and Lloyd's iteration with Yinyang bounds.
    #[default]
    Ksim,
    /// linfa's `KMeans`, as an independent reference.
    #[cfg(feature = "linfa")]
    Linfa,
}

/// Rows per cluster that a sample must have at the least.
const SAMPLE_ROWS_PER_CLUSTER: usize = 1000;

/// Every how many rows a sample for the start is taken; `None` where the data are too few to gain
/// by it. A fit of an eighth of the rows costs an eighth, and leaves the full fit the last steps.
fn sample_step(n_rows: usize, n_clusters: usize) -> Option<usize> {
    const STEP: usize = 8;
    (n_rows / STEP >= n_clusters * SAMPLE_ROWS_PER_CLUSTER).then_some(STEP)
}

/// How to fit: setters only store, [`fit`](Self::fit) checks.
///
/// The defaults are the paper's and scikit-learn's: one k-means++ start, at most 300 iterations,
/// tolerance 1e-4, seed 0. Where there are enough rows the start is a fit of every eighth.
#[derive(Debug, Clone, PartialEq)]
pub struct KMeansParams {
    pub(super) n_clusters: usize,
    pub(super) seed: u64,
    pub(super) max_iterations: usize,
    pub(super) tolerance: f64,
    backend: KMeansBackend,
}

impl KMeansParams {
    pub(super) fn new(n_clusters: usize) -> Self {
        Self {
            n_clusters,
            seed: 0,
            max_iterations: 300,
            tolerance: 1e-4,
            backend: KMeansBackend::default(),
        }
    }

    /// Seed of the k-means++ start.
    pub fn seed(mut self, seed: u64) -> Self {
        self.seed = seed;
        self
    }

    /// Lloyd iterations at most, at least 1.
    pub fn max_iterations(mut self, max_iterations: usize) -> Self {
        self.max_iterations = max_iterations.max(1);
        self
    }

    /// The fit rests when the squared shifts of all centers add up to no more than this times the
    /// mean variance of the columns.
    pub fn tolerance(mut self, tolerance: f64) -> Self {
        self.tolerance = tolerance;
        self
    }

    /// Which code fits.
    pub fn backend(mut self, backend: KMeansBackend) -> Self {
        self.backend = backend;
        self
    }

    /// Number of clusters asked for.
    pub fn n_clusters(&self) -> usize {
        self.n_clusters
    }

    fn check(&self, n_rows: usize) -> Result<(), KMeansError> {
        if self.n_clusters == 0 {
            return Err(KMeansError::NoClusters);
        }
        if n_rows < self.n_clusters {
            return Err(KMeansError::TooFewRows {
                n_rows,
                n_clusters: self.n_clusters,
            });
        }
        if !(self.tolerance.is_finite() && self.tolerance >= 0.0) {
            return Err(KMeansError::Tolerance {
                value: self.tolerance,
            });
        }
        Ok(())
    }

    /// Fits centers to `data`; the same bits for any number of threads.
    ///
    /// # Errors
    /// [`KMeansError`] for parameters that cannot be met.
    pub fn fit(&self, data: &Matrix) -> Result<KMeans, KMeansError> {
        self.check(data.n_rows())?;
        match self.backend {
            KMeansBackend::Ksim => {
                let start = match sample_step(data.n_rows(), self.n_clusters) {
                    Some(step) => {
                        let sample = data.every(step);
                        let start = init::plus_plus(&sample, self.n_clusters, self.seed);
                        yinyang::fit(&sample, start, self).centers
                    }
                    None => init::plus_plus(data, self.n_clusters, self.seed),
                };
                Ok(yinyang::fit(data, start, self))
            }
            #[cfg(feature = "linfa")]
            KMeansBackend::Linfa => super::linfa_backend::fit(data, self),
        }
    }
}
