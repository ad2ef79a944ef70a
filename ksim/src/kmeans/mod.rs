//! k-means: the fitted model.

mod init;
#[cfg(feature = "linfa")]
mod linfa_backend;
mod params;
mod scan;
mod yinyang;

pub use params::{KMeansBackend, KMeansParams};

use rayon::prelude::*;

use crate::error::KMeansError;
use crate::matrix::{CHUNK_ROWS, Matrix, check_finite, squared_distance};

/// Cluster centers, and the cluster of every row they were fitted to.
///
/// Labels are exact: each row belongs to the center at the smallest f64 distance, ties to the
/// smaller cluster number, whatever the vector instructions of the machine.
///
/// ```
/// let data = ksim::Matrix::from_f32(vec![0.0, 0.1, 10.0, 10.1], 1)?;
/// let fitted = ksim::KMeans::params(2).seed(0).fit(&data).unwrap();
/// assert_eq!(fitted.labels()[0], fitted.labels()[1]);
/// assert_ne!(fitted.labels()[1], fitted.labels()[2]);
/// # Ok::<(), ksim::DataError>(())
/// ```
#[derive(Debug, Clone)]
pub struct KMeans {
    /// Row-major, shape `(n_clusters, n_features)`.
    centers: Vec<f64>,
    n_features: usize,
    labels: Vec<u32>,
    inertia: f64,
    n_iterations: Option<usize>,
    converged: Option<bool>,
}

impl KMeans {
    /// Parameters with their defaults: see [`KMeansParams`].
    pub fn params(n_clusters: usize) -> KMeansParams {
        KMeansParams::new(n_clusters)
    }

    /// Takes given centers (row-major, shape `(n_clusters, n_features)`, finite) and assigns every
    /// row of `data` to the nearest.
    ///
    /// # Errors
    /// [`KMeansError::NoClusters`], [`KMeansError::CenterWidth`], [`KMeansError::Center`].
    pub fn from_centers(
        centers: &[f64],
        n_features: usize,
        data: &Matrix,
    ) -> Result<Self, KMeansError> {
        if centers.is_empty() || n_features == 0 {
            return Err(KMeansError::NoClusters);
        }
        if n_features != data.n_features() || !centers.len().is_multiple_of(n_features) {
            return Err(KMeansError::CenterWidth {
                expected: data.n_features(),
                found: n_features,
            });
        }
        check_finite(centers, n_features).map_err(KMeansError::Center)?;
        let labels = scan::assign(data, centers);
        Ok(Self::assigned(centers.to_vec(), labels, data, None, None))
    }

    /// Puts clusters together again from what their fit gave: labels of all rows, inertia, iterations
    /// and convergence as the methods of those names return them.
    ///
    /// # Errors
    /// [`KMeansError::NoClusters`], [`KMeansError::CenterWidth`], [`KMeansError::Center`],
    /// [`KMeansError::Label`].
    pub fn from_fit(
        centers: Vec<f64>,
        n_features: usize,
        labels: Vec<u32>,
        inertia: f64,
        (n_iterations, converged): (Option<usize>, Option<bool>),
    ) -> Result<Self, KMeansError> {
        if centers.is_empty() || n_features == 0 {
            return Err(KMeansError::NoClusters);
        }
        if !centers.len().is_multiple_of(n_features) {
            return Err(KMeansError::CenterWidth {
                expected: n_features,
                found: centers.len() % n_features,
            });
        }
        check_finite(&centers, n_features).map_err(KMeansError::Center)?;
        let n_clusters = centers.len() / n_features;
        let is_known = |&label: &u32| (label as usize) < n_clusters;
        if let Some(row) = labels.iter().position(|label| !is_known(label)) {
            return Err(KMeansError::Label {
                row,
                label: labels[row],
                n_clusters,
            });
        }
        Ok(Self {
            centers,
            n_features,
            labels,
            inertia,
            n_iterations,
            converged,
        })
    }

    /// Itself, if it was fitted to as many rows of the same width.
    pub(crate) fn checked_for(self, data: &Matrix) -> Result<Self, KMeansError> {
        if self.n_features != data.n_features() {
            return Err(KMeansError::CenterWidth {
                expected: data.n_features(),
                found: self.n_features,
            });
        }
        if self.labels.len() != data.n_rows() {
            return Err(KMeansError::OtherRows {
                expected: data.n_rows(),
                found: self.labels.len(),
            });
        }
        Ok(self)
    }

    fn assigned(
        centers: Vec<f64>,
        labels: Vec<u32>,
        data: &Matrix,
        n_iterations: Option<usize>,
        converged: Option<bool>,
    ) -> Self {
        let n_features = data.n_features();
        let inertia = inertia(data, &centers, &labels);
        Self {
            centers,
            n_features,
            labels,
            inertia,
            n_iterations,
            converged,
        }
    }

    /// Number of clusters.
    pub fn n_clusters(&self) -> usize {
        self.centers.len() / self.n_features
    }

    /// The centers, row-major, shape `(n_clusters, n_features)`.
    pub fn centers(&self) -> &[f64] {
        &self.centers
    }

    /// The cluster of every fitted row.
    pub fn labels(&self) -> &[u32] {
        &self.labels
    }

    /// Sum over rows of the squared distance to their center.
    pub fn inertia(&self) -> f64 {
        self.inertia
    }

    /// Iterations made on all rows; `None` for given centers, and from linfa, which does not say.
    pub fn n_iterations(&self) -> Option<usize> {
        self.n_iterations
    }

    /// Whether the centers came to rest (by the tolerance) before the limit of iterations; `None`
    /// as for [`n_iterations`](Self::n_iterations).
    pub fn converged(&self) -> Option<bool> {
        self.converged
    }

    /// The cluster whose center is nearest to `query`, ties to the smaller number.
    pub fn nearest_center(&self, query: &[f64]) -> u32 {
        nearest_center(&self.centers, query).0
    }

    /// All clusters, by ascending distance of their center to `query`.
    pub fn centers_by_distance(&self, query: &[f64]) -> Vec<u32> {
        let mut order: Vec<(f64, u32)> = self
            .centers
            .chunks_exact(self.n_features)
            .zip(0..)
            .map(|(center, cluster)| (squared_distance(center, query), cluster))
            .collect();
        order.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        order.into_iter().map(|(_, cluster)| cluster).collect()
    }
}

/// The nearest center and its squared distance, ties to the smaller number.
fn nearest_center(centers: &[f64], point: &[f64]) -> (u32, f64) {
    let mut best = (0, f64::INFINITY);
    for (center, cluster) in centers.chunks_exact(point.len()).zip(0..) {
        let squared = squared_distance(center, point);
        if squared < best.1 {
            best = (cluster, squared);
        }
    }
    best
}

fn inertia(data: &Matrix, centers: &[f64], labels: &[u32]) -> f64 {
    let width = data.n_features();
    let partial: Vec<f64> = labels
        .par_chunks(CHUNK_ROWS)
        .enumerate()
        .map(|(chunk, labels)| {
            labels
                .iter()
                .zip(chunk * CHUNK_ROWS..)
                .map(|(&label, row)| {
                    data.squared_distance(row, &centers[label as usize * width..][..width])
                })
                .sum()
        })
        .collect();
    partial.iter().sum()
}
