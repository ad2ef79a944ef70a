//! Where the noise of a plan comes from.

use crate::config::MOST;
use crate::rng::{Purpose, Rng};

/// Draws noise for all candidates of a batch.
pub trait Noise {
    /// Writes standard normal numbers of the shape `(n, horizon, width)`. Called once for the start and once for every
    /// step that needs noise.
    fn draw(&mut self, out: &mut [f32]);
}

/// Noise that was recorded.
#[derive(Debug)]
pub struct RecordedNoise<'a> {
    numbers: &'a [f32],
}

impl<'a> RecordedNoise<'a> {
    /// Draws one after the other.
    pub fn new(numbers: &'a [f32]) -> Self {
        Self { numbers }
    }
}

impl Noise for RecordedNoise<'_> {
    fn draw(&mut self, out: &mut [f32]) {
        let (drawn, rest) = self.numbers.split_at(out.len());
        out.copy_from_slice(drawn);
        self.numbers = rest;
    }
}

/// Noise of a stream of its own for every candidate, so that a plan depends neither on the plans beside it nor on how
/// many candidates there are.
#[derive(Debug)]
pub struct SeededNoise {
    streams: Vec<Rng>,
}

/// Candidates of a plan that have streams of their own.
const MAX_CANDIDATES: u64 = MOST as u64;

impl SeededNoise {
    /// `n_candidates` for each plan, given by the seed of its episode and its number in the episode.
    pub fn new(plans: impl Iterator<Item = (u64, u64)>, n_candidates: usize) -> Self {
        Self::of(Purpose::Plan, plans, n_candidates)
    }

    /// As [`SeededNoise::new`], from the streams of another purpose.
    pub(crate) fn of(
        purpose: Purpose,
        plans: impl Iterator<Item = (u64, u64)>,
        n_candidates: usize,
    ) -> Self {
        let streams = plans.flat_map(|(seed, plan)| {
            let first = plan.wrapping_mul(MAX_CANDIDATES);
            (0..n_candidates as u64).map(move |at| Rng::new(seed, purpose, first.wrapping_add(at)))
        });
        Self {
            streams: streams.collect(),
        }
    }
}

impl Noise for SeededNoise {
    fn draw(&mut self, out: &mut [f32]) {
        let window_len = out.len() / self.streams.len().max(1);
        for (stream, window) in self
            .streams
            .iter_mut()
            .zip(out.chunks_exact_mut(window_len))
        {
            stream.fill_normal(window);
        }
    }
}
