//! Rows packed column by column, so that one vector instruction serves several rows: what the
//! first pass of a search and the k-means passes have in common.

use pulp::Simd;

use crate::matrix::Matrix;

/// Rows packed at a time: 64 rows of 31 columns are 8 KB, which stay in the first-level cache
/// while every query of a batch passes over them.
pub(crate) const TILE_ROWS: usize = 64;

/// Which rows a pass visits, in this order.
#[derive(Debug, Clone, Copy)]
pub(crate) enum RowSet<'a> {
    Range { start: usize, end: usize },
    Listed(&'a [u32]),
}

impl RowSet<'_> {
    pub(crate) fn len(&self) -> usize {
        match self {
            Self::Range { start, end } => end - start,
            Self::Listed(rows) => rows.len(),
        }
    }

    pub(crate) fn row(&self, at: usize) -> u32 {
        match self {
            Self::Range { start, .. } => (start + at) as u32,
            Self::Listed(rows) => rows[at],
        }
    }
}

/// A buffer for one tile of `width` columns.
pub(crate) fn new_tile(width: usize) -> Vec<f32> {
    vec![0.0; width * TILE_ROWS]
}

/// Packs the `f32` planes of rows `start..start + count` of `rows`, column-major. Places beyond
/// `count` keep what they held: nobody may read results for them.
///
/// Never inlined into a vectorised pass: with AVX-512 at hand the compiler would make the inner
/// loop a scatter, several times slower than plain stores.
#[inline(never)]
pub(crate) fn pack(data: &Matrix, rows: RowSet<'_>, start: usize, count: usize, tile: &mut [f32]) {
    let (columns, _) = tile.as_chunks_mut::<TILE_ROWS>();
    for at in 0..count.min(TILE_ROWS) {
        let row = data.high_row(rows.row(start + at) as usize);
        for (column, &value) in columns.iter_mut().zip(row) {
            column[at] = value;
        }
    }
}

/// Squared distances of `point` to the tile's rows. Returns one bit for every run of four rows in
/// which one may lie within `threshold`; the runs without a bit have none.
///
/// Fused multiply-add in column order for every row, whatever the vector width: the same bits on
/// every machine.
#[inline(always)]
pub(crate) fn squared_distances<S: Simd>(
    simd: S,
    tile: &[f32],
    point: &[f32],
    threshold: f32,
    squared: &mut [f32; TILE_ROWS],
) -> u16 {
    // Four vectors at a time hide the latency of the multiply-add; no vector is wider than 16.
    const VECTORS: usize = 4;
    let step = VECTORS * S::F32_LANES;
    let threshold = simd.splat_f32s(threshold);
    let runs_of_vector = (1u32 << S::F32_LANES.div_ceil(RUN_ROWS)) - 1;
    let mut runs = 0u32;
    for from in (0..TILE_ROWS).step_by(step) {
        let mut sums = [simd.splat_f32s(0.0); VECTORS];
        for (column, &value) in tile.chunks_exact(TILE_ROWS).zip(point) {
            let value = simd.splat_f32s(value);
            let (column, _) = S::as_simd_f32s(&column[from..from + step]);
            for (sum, &x) in sums.iter_mut().zip(column) {
                let difference = simd.sub_f32s(x, value);
                *sum = simd.mul_add_f32s(difference, difference, *sum);
            }
        }
        let (out, _) = S::as_mut_simd_f32s(&mut squared[from..from + step]);
        for (vector, (out, &sum)) in out.iter_mut().zip(&sums).enumerate() {
            *out = sum;
            let within = simd.less_than_or_equal_f32s(sum, threshold);
            if simd.first_true_m32s(within) < S::F32_LANES {
                runs |= runs_of_vector << ((from + vector * S::F32_LANES) / RUN_ROWS);
            }
        }
    }
    runs as u16
}

/// Rows behind one bit of [`squared_distances`].
pub(crate) const RUN_ROWS: usize = 4;
