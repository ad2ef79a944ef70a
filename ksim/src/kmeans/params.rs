//! Parameters of a fit, and their check.

use super::{KMeans, init, yinyang};
use crate::error::KMeansError;
use crate::matrix::Matrix;
use crate::rng::{Purpose, Rng};

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

/// A start is fitted to every eighth row first, as long as that leaves this many a cluster: it
/// costs an eighth, and leaves the full fit the last steps only.
const SAMPLE_STEP: usize = 8;
const SAMPLE_ROWS_PER_CLUSTER: usize = 128;

/// How to fit: setters only store, [`fit`](Self::fit) checks.
///
/// The defaults are the paper's and scikit-learn's: a k-means++ start, at most 300 iterations,
/// tolerance 1e-4, seed 0; but the start is the best of four by inertia, fitted to a sample where
/// there are rows enough, so that one unlucky draw does not decide.
#[derive(Debug, Clone, PartialEq)]
pub struct KMeansParams {
    pub(super) n_clusters: usize,
    pub(super) seed: u64,
    pub(super) max_iterations: usize,
    pub(super) tolerance: f64,
    n_starts: usize,
    backend: KMeansBackend,
}

impl KMeansParams {
    pub(super) fn new(n_clusters: usize) -> Self {
        Self {
            n_clusters,
            seed: 0,
            max_iterations: 300,
            tolerance: 1e-4,
            n_starts: 4,
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

    /// k-means++ starts to choose from, at least 1.
    pub fn n_starts(mut self, n_starts: usize) -> Self {
        self.n_starts = n_starts.max(1);
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
            KMeansBackend::Ksim => Ok(self.fit_from_sample(data)),
            #[cfg(feature = "linfa")]
            KMeansBackend::Linfa => super::linfa_backend::fit(data, self),
        }
    }

    /// Fits from where a fit of every eighth row rests; the smallest sample from the best start.
    fn fit_from_sample(&self, data: &Matrix) -> KMeans {
        if data.n_rows() / SAMPLE_STEP >= self.n_clusters * SAMPLE_ROWS_PER_CLUSTER {
            let start = self.fit_from_sample(&data.every(SAMPLE_STEP)).centers;
            return yinyang::fit(data, start, self);
        }
        let mut rng = Rng::new(self.seed, Purpose::KMeansInit);
        let mut fit = || yinyang::fit(data, init::plus_plus(data, self.n_clusters, &mut rng), self);
        let mut best = fit();
        for _ in 1..self.n_starts {
            let next = fit();
            if next.inertia < best.inertia {
                best = next;
            }
        }
        best
    }
}
