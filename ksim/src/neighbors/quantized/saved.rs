//! Rounded rows as flat arrays that can be kept in a file, and put together again.

use std::sync::Arc;

use rayon::prelude::*;

use super::codes::{Codes, GROUP, GROUP_BYTES, LEVELS, NO_ROW, STRIP_ROWS};
use super::scale::{LARGEST, Scale};
use crate::buffer::{Buffer, Shared};
use crate::error::SearchError;

/// The rounded rows behind [`Blocked`](crate::Blocked) and [`Clusters`](crate::Clusters), as flat arrays.
///
/// They depend on the data alone, so that whoever keeps them in a file saves their making. How they are laid
/// out may change between versions of this crate.
#[derive(Debug, Clone)]
pub struct RoundedRows {
    /// Step of the grid, then center and variance of every column.
    pub scale: Vec<f64>,
    /// Codes of all rows, in strips of 16 rows.
    pub strips: Buffer<i8>,
    /// The row at every place of the strips.
    pub order: Buffer<u32>,
    /// First strip of every block, and the end.
    pub block_starts: Buffer<u32>,
    /// How far the rows of every block are rounded, at most.
    pub block_errors: Buffer<f64>,
    /// Whether the rows of a block lie beyond the grid: 0 or 1.
    pub block_clipped: Buffer<u8>,
    /// First block of every level of every segment, and the end.
    pub levels: Buffer<u32>,
    /// The largest L2 norm of any row.
    pub max_norm: f64,
}

impl RoundedRows {
    pub(crate) fn of(codes: &Codes, max_norm: f64) -> Self {
        let Scale {
            center,
            step,
            variance,
        } = &codes.scale;
        let scale = [*step].into_iter().chain(center.iter().copied());
        let clipped: Vec<u8> = codes.block_clipped.iter().copied().map(u8::from).collect();
        Self {
            scale: scale.chain(variance.iter().copied()).collect(),
            strips: Arc::clone(&codes.strips).into(),
            order: Arc::clone(&codes.order).into(),
            block_starts: codes.block_starts.clone().into(),
            block_errors: codes.block_errors.clone().into(),
            block_clipped: clipped.into(),
            levels: codes.levels.clone().into(),
            max_norm,
        }
    }

    /// Checks that the arrays go together and name every one of `n_rows` rows once, then puts them to use:
    /// what is in them beyond that decides how good the search's bounds are, so it must be what was saved.
    pub(crate) fn into_codes(
        self,
        (n_rows, n_features): (usize, usize),
        n_segments: usize,
    ) -> Result<(Codes, f64), SearchError> {
        self.check((n_rows, n_features), n_segments)?;
        let (center, variance) = self.scale[1..].split_at(n_features);
        let codes = Codes {
            scale: Scale {
                center: center.to_vec(),
                step: self.scale[0],
                variance: variance.to_vec(),
            },
            strips: Arc::new(self.strips) as Shared<i8>,
            order: Arc::new(self.order) as Shared<u32>,
            block_starts: self.block_starts.to_vec(),
            block_errors: self.block_errors.to_vec(),
            block_clipped: self.block_clipped.iter().map(|&byte| byte == 1).collect(),
            levels: self.levels.to_vec(),
        };
        Ok((codes, self.max_norm))
    }

    fn check(
        &self,
        (n_rows, n_features): (usize, usize),
        n_segments: usize,
    ) -> Result<(), SearchError> {
        let refused = |what| Err(SearchError::RoundedRows { what });
        let n_blocks = self.block_errors.len();
        let n_strips = self.order.len() / STRIP_ROWS;
        let strip_bytes = n_features.div_ceil(GROUP) * GROUP_BYTES;
        let grows = |values: &[u32], end: usize| {
            values.first() == Some(&0)
                && values.last().is_some_and(|&last| last as usize == end)
                && values.is_sorted()
        };
        let is_grid = |(step, columns): (&f64, &[f64])| {
            *step > 0.0 && (step * LARGEST).is_finite() && columns.iter().all(|v| v.is_finite())
        };
        if self.scale.len() != 1 + 2 * n_features || !self.scale.split_first().is_some_and(is_grid)
        {
            return refused("their grid");
        }
        if self.order.len() != n_strips * STRIP_ROWS || self.strips.len() != n_strips * strip_bytes
        {
            return refused("the number of their codes");
        }
        // Nothing is rounded to this one, the square of which is beyond what the units sum.
        if self
            .strips
            .par_chunks(1 << 16)
            .any(|codes| codes.contains(&i8::MIN))
        {
            return refused("their codes");
        }
        if self.block_starts.len() != n_blocks + 1
            || self.block_clipped.len() != n_blocks
            || !self.block_clipped.iter().all(|&byte| byte <= 1)
            || !grows(&self.block_starts, n_strips)
            || self.block_starts.windows(2).any(|ends| ends[0] == ends[1])
        {
            return refused("their blocks");
        }
        if self.levels.len() != n_segments * LEVELS + 1 || !grows(&self.levels, n_blocks) {
            return refused("their levels");
        }
        let sizes = self.block_errors.iter().chain([&self.max_norm]);
        if !sizes
            .into_iter()
            .all(|size| size.is_finite() && *size >= 0.0)
        {
            return refused("their bounds");
        }
        let mut seen = vec![false; n_rows];
        for &row in self.order.iter().filter(|&&row| row != NO_ROW) {
            match seen.get_mut(row as usize) {
                Some(seen) if !*seen => *seen = true,
                _ => return refused("the rows they name"),
            }
        }
        match seen.iter().all(|&seen| seen) {
            true => Ok(()),
            false => refused("the rows they name"),
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::{Blocked, Clusters, KMeans, Matrix, MatrixView, NeighborIndex, SearchRequest};

    fn walk() -> Arc<Matrix> {
        let values: Vec<f64> = (0..5000 * 9)
            .map(|i| (f64::from(i) * 0.013).sin() * 2.0)
            .collect();
        Arc::new(Matrix::from_f64(&values, 9).unwrap())
    }

    #[test]
    fn saved_rows_answer_as_those_they_were_saved_from() {
        let data = walk();
        let queries: Vec<f64> = (0..40 * 9).map(|i| (f64::from(i) * 0.31).cos()).collect();
        let request = SearchRequest::new(MatrixView::new(&queries, 9).unwrap(), 12);
        let own = Blocked::new(Arc::clone(&data));
        let saved = Blocked::from_rounded(Arc::clone(&data), own.rounded()).unwrap();
        assert_eq!(own.search(&request), saved.search(&request));
        let kmeans = KMeans::params(6).fit(&data).unwrap();
        let own = Clusters::new(Arc::clone(&data), kmeans.clone());
        let saved = Clusters::from_rounded(Arc::clone(&data), kmeans, own.rounded()).unwrap();
        assert_eq!(own.search(&request), saved.search(&request));
    }

    #[test]
    fn arrays_that_do_not_go_together_are_refused() {
        let data = walk();
        let good = Blocked::new(Arc::clone(&data)).rounded();
        let refused = |change: &dyn Fn(&mut RoundedRows), what: &str| {
            let mut bad = good.clone();
            change(&mut bad);
            let error = Blocked::from_rounded(Arc::clone(&data), bad).unwrap_err();
            assert!(error.to_string().contains(what), "{error}");
        };
        refused(&|bad| bad.scale[0] = f64::NAN, "grid");
        refused(&|bad| bad.scale.truncate(3), "grid");
        refused(&|bad| bad.scale[0] = f64::MAX, "grid");
        refused(&|bad| bad.strips.to_mut().truncate(10), "codes");
        refused(&|bad| bad.strips.to_mut()[7] = -128, "codes");
        refused(&|bad| bad.order.to_mut().clear(), "codes");
        refused(&|bad| bad.block_starts.to_mut().swap(0, 1), "blocks");
        // A block without rows.
        refused(
            &|bad| {
                let end = *bad.block_starts.last().unwrap();
                bad.block_starts.to_mut().push(end);
                bad.block_errors.to_mut().push(0.0);
                bad.block_clipped.to_mut().push(0);
                *bad.levels.to_mut().last_mut().unwrap() += 1;
            },
            "blocks",
        );
        refused(&|bad| bad.block_clipped.to_mut()[0] = 2, "blocks");
        refused(&|bad| bad.levels.to_mut().push(0), "levels");
        refused(&|bad| bad.block_errors.to_mut()[0] = -1.0, "bounds");
        refused(&|bad| bad.max_norm = f64::INFINITY, "bounds");
        refused(&|bad| bad.order.to_mut()[0] = 4999, "rows");
        refused(&|bad| bad.order.to_mut()[0] = 5000, "rows");
        refused(&|bad| bad.order.to_mut()[0] = NO_ROW, "rows");
        // Of clusters of other numbers.
        let kmeans = KMeans::params(6).fit(&data).unwrap();
        let error = Clusters::from_rounded(Arc::clone(&data), kmeans.clone(), good).unwrap_err();
        assert!(error.to_string().contains("levels"), "{error}");
        // Of as many clusters with other rows in them.
        let rounded = Clusters::new(Arc::clone(&data), kmeans.clone()).rounded();
        let (centers, inertia) = (kmeans.centers().to_vec(), kmeans.inertia());
        let mut labels = kmeans.labels().to_vec();
        let elsewhere = labels.iter().position(|label| *label != labels[0]);
        labels.swap(0, elsewhere.unwrap());
        let other = KMeans::from_fit(centers, 9, labels, inertia, (None, None)).unwrap();
        let error = Clusters::from_rounded(Arc::clone(&data), other, rounded).unwrap_err();
        assert!(error.to_string().contains("clusters"), "{error}");
    }
}
