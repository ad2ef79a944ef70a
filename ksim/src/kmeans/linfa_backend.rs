//! linfa's k-means as an independent reference: its k-means++ and plain Lloyd iteration.

use std::sync::Arc;

use linfa::traits::Fit;
use linfa_clustering::KMeansInit;
use ndarray::Array2;
use rand_xoshiro::Xoshiro256Plus;
use rand_xoshiro::rand_core::SeedableRng;

use super::params::KMeansParams;
use super::{KMeans, scan};
use crate::error::KMeansError;
use crate::matrix::Matrix;

/// Fits in f64 on a copy of the data. linfa rests when the centers move less than the square root
/// of our tolerance in all, which for normalized columns is the same rule.
pub(super) fn fit(data: &Matrix, params: &KMeansParams) -> Result<KMeans, KMeansError> {
    let width = data.n_features();
    let records = Array2::from_shape_fn((data.n_rows(), width), |(row, column)| {
        data.value(row, column)
    });
    let rng = Xoshiro256Plus::seed_from_u64(params.seed);
    let fitted = linfa_clustering::KMeans::params_with_rng(params.n_clusters, rng)
        .init_method(KMeansInit::KMeansPlusPlus)
        .n_runs(1)
        .max_n_iterations(params.max_iterations as u64)
        .tolerance(params.tolerance.max(f64::MIN_POSITIVE).sqrt())
        .fit(&linfa::DatasetBase::from(records))
        .map_err(|error| KMeansError::Linfa(Arc::new(error)))?;
    let centers: Vec<f64> = fitted.centroids().iter().copied().collect();
    let labels = scan::assign(data, &centers);
    Ok(KMeans::assigned(centers, labels, data, None, None))
}
