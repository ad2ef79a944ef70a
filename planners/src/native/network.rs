//! A network for inference.

use std::sync::Arc;

use rayon::prelude::*;

use super::aligned::Aligned;
use super::chunk::{Chunk, Keep, Times};
use super::forward::Model;
use super::parameters;
use super::plan::Plan;
use super::prepared::Prepared;
use super::winograd::LEAST_SAMPLES;
use crate::error::PlannerError;
use crate::nets::{Architecture, Network, Weights};

/// The most samples in a chunk: their activations stay in the cache of a core.
pub(super) const CHUNK: usize = 16;

/// Timesteps whose times are remembered; a sampling schedule has fewer.
const REMEMBERED: usize = 256;

/// A network by our own kernels.
#[derive(Debug)]
pub(super) struct NativeNetwork {
    architecture: Architecture,
    pub(super) plan: Plan,
    pub(super) parameters: Aligned,
    /// Smaller groups of windows than Winograd takes are computed with weights in half the bytes.
    halves: bool,
    /// Windows of a group, whose size decides how all of a call are computed; without one a call is a group.
    group: Option<usize>,
    prepared: Prepared,
    zeros: Vec<f32>,
    pub(super) chunks: Vec<Chunk>,
    /// For the times that all samples of a call have.
    time_chunk: Chunk,
    times: Vec<(u32, Arc<Times>)>,
    /// What the last forward pass kept, and of how many samples.
    kept: Option<Kept>,
}

/// A forward pass that a gradient can be taken of.
#[derive(Debug, Clone, Copy)]
pub(super) struct Kept {
    pub(super) keep: Keep,
    pub(super) samples: usize,
    /// Samples in a group.
    group: usize,
    /// Samples in a chunk.
    pub(super) chunk: usize,
}

impl NativeNetwork {
    pub(super) fn new(
        architecture: &Architecture,
        weights: &Weights,
        halves: bool,
    ) -> Result<Self, PlannerError> {
        architecture.check_weights(weights)?;
        let plan = Plan::new(architecture);
        let parameters = parameters::gather(&plan, weights)?;
        let widest = plan
            .layers
            .iter()
            .map(|layer| layer.inputs.max(layer.outputs))
            .max();
        Ok(Self {
            architecture: architecture.clone(),
            zeros: vec![0.0; CHUNK * widest.unwrap_or(0)],
            plan,
            parameters,
            halves,
            group: None,
            prepared: Prepared::default(),
            chunks: Vec::new(),
            time_chunk: Chunk::default(),
            times: Vec::new(),
            kept: None,
        })
    }

    /// What the last forward pass kept, which is used up.
    ///
    /// # Errors
    /// There was none that kept enough, or `cotangent` does not fit it.
    pub(super) fn take_kept(
        &mut self,
        asked: &'static str,
        enough: impl Fn(Keep) -> bool,
        cotangent: &[f32],
    ) -> Result<Kept, PlannerError> {
        let missing = "forward pass with `keep`";
        let kept = self.kept.filter(|kept| enough(kept.keep));
        let kept = kept.ok_or(PlannerError::Order { asked, missing })?;
        check(
            "cotangent",
            cotangent.len(),
            kept.samples * self.architecture.output_len(),
        )?;
        self.kept = None;
        Ok(kept)
    }

    /// After the parameters have changed: weights for the way back and times anew.
    pub(super) fn refresh(&mut self) {
        self.prepared.refresh(&self.plan, &self.parameters);
        self.times.clear();
        self.kept = None;
    }

    pub(super) fn run(
        &mut self,
        x: &[f32],
        t: &[f32],
        keep: Keep,
        out: &mut [f32],
    ) -> Result<(), PlannerError> {
        let (input, output) = (
            self.architecture.input_len(),
            self.architecture.output_len(),
        );
        check("x", x.len(), t.len() * input)?;
        check("out", out.len(), t.len() * output)?;
        self.kept = None;
        let size = chunk_size(t.len(), keep);
        let times = match t.first() {
            Some(first)
                if keep != Keep::All && t.iter().all(|t| t.to_bits() == first.to_bits()) =>
            {
                Some(self.remembered_times(*first))
            }
            _ => None,
        };
        let group = self.group.unwrap_or(t.len());
        let winograd = group >= LEAST_SAMPLES;
        let halves = self.halves && !winograd;
        let (plan, back) = (&self.plan, keep != Keep::Nothing);
        self.prepared.need(plan, &self.parameters, back, winograd);
        if halves {
            self.prepared.need_halves(plan, &self.parameters, back);
        }
        let model = Model {
            plan,
            parameters: &self.parameters,
            prepared: &self.prepared,
            group,
            winograd,
            halves,
            zeros: &self.zeros,
        };
        let n_chunks = t.len().div_ceil(size);
        if self.chunks.len() < n_chunks {
            self.chunks.resize_with(n_chunks, Chunk::default);
        }
        let one = |chunk: &mut Chunk, x: &[f32], t: &[f32], out: &mut [f32]| {
            chunk.reset(t.len(), model.plan.layers.len());
            match (&times, &model.plan.time) {
                (Some(times), _) => chunk.times = Arc::clone(times),
                (None, Some(time)) => chunk.times = Arc::new(model.times(chunk, keep, time, t)),
                (None, None) => {}
            }
            model.forward(chunk, keep, x, out);
        };
        let chunks = self.chunks[..n_chunks].par_iter_mut();
        let windows = x.par_chunks(size * input).zip(t.par_chunks(size));
        if n_chunks == 1 {
            one(&mut self.chunks[0], x, t, out);
        } else {
            chunks
                .zip(windows)
                .zip(out.par_chunks_mut(size * output))
                .for_each(|((chunk, (x, t)), out)| one(chunk, x, t, out));
        }
        self.kept = (keep != Keep::Nothing).then_some(Kept {
            keep,
            samples: t.len(),
            group,
            chunk: size,
        });
        Ok(())
    }

    fn remembered_times(&mut self, t: f32) -> Arc<Times> {
        let found = self.times.iter().find(|(bits, _)| *bits == t.to_bits());
        if let Some((_, times)) = found {
            return Arc::clone(times);
        }
        let Some(time) = &self.plan.time else {
            return Arc::default();
        };
        let model = Model {
            plan: &self.plan,
            parameters: &self.parameters,
            prepared: &self.prepared,
            group: 1,
            winograd: false,
            halves: false,
            zeros: &self.zeros,
        };
        self.time_chunk.reset(1, self.plan.layers.len());
        let mut times = model.times(&mut self.time_chunk, Keep::Nothing, time, &[t]);
        (times.column_stride, times.embedding_stride) = (0, 0);
        let times = Arc::new(times);
        if self.times.len() == REMEMBERED {
            self.times.clear();
        }
        self.times.push((t.to_bits(), Arc::clone(&times)));
        times
    }

    /// The way back of all chunks; `gradient`, if there is one, is written.
    pub(super) fn back(&mut self, kept: Kept, cotangent: &[f32], gradient: Option<&mut [f32]>) {
        let (input, output) = (
            self.architecture.input_len(),
            self.architecture.output_len(),
        );
        let model = Model {
            plan: &self.plan,
            parameters: &self.parameters,
            prepared: &self.prepared,
            group: kept.group,
            winograd: kept.group >= LEAST_SAMPLES,
            halves: self.halves && kept.group < LEAST_SAMPLES,
            zeros: &self.zeros,
        };
        let n_chunks = kept.samples.div_ceil(kept.chunk);
        let chunks = &mut self.chunks[..n_chunks];
        let cotangents = cotangent.par_chunks(kept.chunk * output);
        match (gradient, chunks) {
            (None, chunks) => chunks
                .par_iter_mut()
                .zip(cotangents)
                .for_each(|(chunk, c)| {
                    model.backward(chunk, kept.keep, c, None);
                }),
            (Some(gradient), [chunk]) => {
                model.backward(chunk, kept.keep, cotangent, Some(gradient))
            }
            (Some(gradient), chunks) => {
                let gradients = gradient.par_chunks_mut(kept.chunk * input);
                let all = chunks.par_iter_mut().zip(cotangents).zip(gradients);
                all.for_each(|((chunk, c), gradient)| {
                    model.backward(chunk, kept.keep, c, Some(gradient));
                });
            }
        }
    }
}

/// Samples in a chunk. In training it is fixed, since gradients by weights are added chunk by chunk; otherwise it
/// changes no number, and all threads get some.
fn chunk_size(samples: usize, keep: Keep) -> usize {
    if keep == Keep::All {
        return CHUNK;
    }
    samples
        .div_ceil(rayon::current_num_threads())
        .clamp(1, CHUNK)
}

fn check(what: &'static str, found: usize, expected: usize) -> Result<(), PlannerError> {
    if found == expected {
        return Ok(());
    }
    Err(PlannerError::Length {
        what,
        expected,
        found,
    })
}

impl Network for NativeNetwork {
    fn architecture(&self) -> &Architecture {
        &self.architecture
    }

    fn on_rayon(&self) -> bool {
        true
    }

    fn in_groups_of(&mut self, n: usize) {
        self.group = Some(n);
    }

    fn forward(
        &mut self,
        x: &[f32],
        t: &[f32],
        keep: bool,
        out: &mut [f32],
    ) -> Result<(), PlannerError> {
        let keep = if keep { Keep::Slopes } else { Keep::Nothing };
        self.run(x, t, keep, out)
    }

    fn input_gradient(
        &mut self,
        cotangent: &[f32],
        gradient: &mut [f32],
    ) -> Result<(), PlannerError> {
        let kept = self.take_kept("a gradient by the input", |_| true, cotangent)?;
        check(
            "gradient",
            gradient.len(),
            kept.samples * self.architecture.input_len(),
        )?;
        self.back(kept, cotangent, Some(gradient));
        Ok(())
    }
}
