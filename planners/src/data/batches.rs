//! Which windows make up which batch.

use super::{Subset, Windows};
use crate::error::PlannerError;
use crate::rng::{Purpose, Rng};

/// Batches of windows in shuffled epochs: uniform without replacement, the incomplete rest of an epoch dropped.
///
/// Which windows a batch has follows from the seed and its number alone, so that a training which goes on draws what
/// it would have drawn.
#[derive(Debug)]
pub struct Batches {
    subset: Subset,
    batch_size: usize,
    seed: u64,
    purpose: Purpose,
    epoch: Option<u64>,
    order: Vec<u32>,
}

impl Batches {
    /// Batches of a subset of windows.
    ///
    /// # Errors
    /// There are fewer windows than a batch has.
    pub(crate) fn new(
        windows: &Windows,
        subset: Subset,
        batch_size: usize,
        seed: u64,
        purpose: Purpose,
    ) -> Result<Self, PlannerError> {
        let n_windows = windows.n_windows(subset);
        if batch_size == 0 || n_windows < batch_size {
            return Err(PlannerError::DatasetFit {
                what: match subset {
                    Subset::All => "the number of windows",
                    Subset::Successful => "the number of windows of successful episodes",
                },
                expected: format!("at least {} (the batch size)", batch_size.max(1)),
                found: n_windows.to_string(),
            });
        }
        Ok(Self {
            subset,
            batch_size,
            seed,
            purpose,
            epoch: None,
            order: (0..n_windows as u32).collect(),
        })
    }

    /// Writes batch number `index`, from 0: windows of the shape `(batch_size, horizon, width)` and their values.
    pub(crate) fn fill(
        &mut self,
        windows: &Windows,
        index: u64,
        x0: &mut [f32],
        values: &mut [f32],
    ) {
        let per_epoch = (self.order.len() / self.batch_size) as u64;
        self.shuffle(index / per_epoch);
        let first = (index % per_epoch) as usize * self.batch_size;
        let chosen = &self.order[first..first + self.batch_size];
        let window_len = x0.len() / self.batch_size;
        for ((&window, x0), value) in chosen
            .iter()
            .zip(x0.chunks_exact_mut(window_len))
            .zip(values)
        {
            windows.fill(self.subset, window as usize, x0);
            *value = windows.value(self.subset, window as usize);
        }
    }

    /// Brings the order of an epoch about.
    fn shuffle(&mut self, epoch: u64) {
        if self.epoch == Some(epoch) {
            return;
        }
        let mut rng = Rng::new(self.seed, self.purpose, epoch);
        for (at, slot) in self.order.iter_mut().enumerate() {
            *slot = at as u32;
        }
        for at in (1..self.order.len()).rev() {
            self.order.swap(at, rng.below(at + 1));
        }
        self.epoch = Some(epoch);
    }
}
