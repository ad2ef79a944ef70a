//! A chunk of samples through a network.

use std::sync::Arc;

use super::chunk::{Chunk, Keep, Kept, Times};
use super::mish;
use super::norm::{self, Plus};
use super::panels::Panels;
use super::plan::{Block, Layer, Plan, Step, Time};
use super::prepared::Prepared;
use super::product::{Product, Start};
use super::shared::{self, Shared};
use super::winograd::{Room, Winograd};

/// A network's numbers.
#[derive(Clone, Copy)]
pub(super) struct Model<'a> {
    pub(super) plan: &'a Plan,
    pub(super) parameters: &'a [f32],
    pub(super) prepared: &'a Prepared,
    /// Windows in a group: it, not the chunk, decides how layers are computed, so that neither the groups beside it
    /// nor threads change a number.
    pub(super) group: usize,
    /// Layers for Winograd are computed by it. Otherwise groups are small, and the way back through some layers takes
    /// the weights of the way forward.
    pub(super) winograd: bool,
    /// Weights are read in half the bytes, except by Winograd.
    pub(super) halves: bool,
    /// As many zeros as a chunk has numbers in one position at most.
    pub(super) zeros: &'a [f32],
}

/// What a norm adds after its Mish.
enum Added {
    Nothing,
    /// The time, from this column on.
    Time(usize),
    Buffer(usize),
}

/// The way forward of one chunk.
pub(super) struct Forward<'a> {
    pub(super) model: Model<'a>,
    pub(super) chunk: &'a mut Chunk,
    pub(super) keep: Keep,
}

impl<'a> Model<'a> {
    /// Runs the windows `x`, one after the other, and writes their outputs.
    pub(super) fn forward(self, chunk: &'a mut Chunk, keep: Keep, x: &[f32], out: &mut [f32]) {
        let samples = chunk.samples;
        let mut run = Forward {
            model: self,
            chunk,
            keep,
        };
        let (length, width) = self.plan.input;
        let mut h = run.chunk.take(length * samples * width);
        to_positions(x, run.chunk.write(h), (samples, length, width));
        let mut skips = Vec::new();
        for step in &self.plan.steps {
            h = run.step(step, h, &mut skips);
        }
        let (length, width) = self.plan.output;
        from_positions(run.chunk.read(h), out, (samples, length, width));
    }

    /// The times of some samples, one row each. With [`Keep::All`] what the way back takes stays in `chunk`.
    pub(super) fn times(self, chunk: &'a mut Chunk, keep: Keep, time: &Time, t: &[f32]) -> Times {
        let mut run = Forward {
            model: self,
            chunk,
            keep,
        };
        let width = self.plan.layers[time.first].inputs;
        let raw = run.chunk.take(t.len() * width);
        let rows = run.chunk.write(raw).chunks_exact_mut(width);
        rows.zip(t)
            .for_each(|(row, t)| time.embedding.embed(*t, row));
        let hidden = run.layer(time.first, raw);
        let hidden = run.time_mish(hidden);
        let embedding = run.layer(time.second, hidden);
        let numbers = run.chunk.read(embedding).to_vec();
        let activated = run.time_mish(embedding);
        let columns = run.layer(time.columns, activated);
        Times {
            columns: run.chunk.read(columns).to_vec(),
            column_stride: self.plan.layers[time.columns].outputs,
            embedding_stride: self.plan.layers[time.second].outputs,
            embedding: numbers,
        }
    }
}

impl Forward<'_> {
    fn step(&mut self, step: &Step, h: usize, skips: &mut Vec<usize>) -> usize {
        match step {
            Step::Block(block) => self.block(block, h),
            Step::Layer(layer) => {
                let out = self.layer(*layer, h);
                self.chunk.release(h);
                out
            }
            Step::Norm(norm) => self.norm(*norm, h, Added::Nothing),
            Step::Mish => {
                let (out, slopes) = self.mish(h);
                self.keep_slopes(slopes);
                out
            }
            Step::Relu => self.relu(h),
            Step::Push => {
                self.chunk.hold(h);
                skips.push(h);
                h
            }
            Step::Concat {
                length,
                channels,
                skip,
            } => match skips.pop() {
                Some(remembered) => self.concat(*length, (h, *channels), (remembered, *skip)),
                None => h,
            },
            Step::Flatten { length, channels } => self.flatten(*length, *channels, h),
        }
    }

    /// Applies a layer; the input stays held, and with [`Keep::All`] once more.
    fn layer(&mut self, index: usize, input: usize) -> usize {
        let layer = &self.model.plan.layers[index];
        let samples = self.chunk.samples;
        let out = self
            .chunk
            .take(layer.output_length() * samples * layer.outputs);
        let mut output = self.chunk.lend(out);
        let mut room = std::mem::take(&mut self.chunk.room);
        let numbers = self.chunk.read(input);
        self.model
            .apply(layer, samples, numbers, &mut room, &mut output);
        self.chunk.room = room;
        self.chunk.put_back(out, output);
        if self.keep == Keep::All {
            self.chunk.hold(input);
            self.chunk.inputs[index] = Some(input);
        }
        out
    }

    fn block(&mut self, block: &Block, h: usize) -> usize {
        let a = self.layer(block.conv1, h);
        let y = self.norm(block.norm1, a, Added::Time(block.time_column));
        let b = self.layer(block.conv2, y);
        self.chunk.release(y);
        let residual = match block.residual {
            None => h,
            Some(conv) => {
                let out = self.layer(conv, h);
                self.chunk.release(h);
                out
            }
        };
        let out = self.norm(block.norm2, b, Added::Buffer(residual));
        self.chunk.release(residual);
        out
    }

    /// Takes `x` over: it is kept or released.
    fn norm(&mut self, index: usize, x: usize, added: Added) -> usize {
        let norm = &self.model.plan.norms[index];
        let times = Arc::clone(&self.chunk.times);
        let sizes = norm.sizes(self.chunk.samples);
        let len = sizes.length * sizes.samples * sizes.channels;
        let y = self.chunk.take(len);
        let kept = (self.keep != Keep::Nothing).then(|| {
            let slopes = self.chunk.take(len);
            (slopes, self.chunk.take(sizes.samples * sizes.groups))
        });
        let mut activations = self.chunk.lend(x);
        let mut output = self.chunk.lend(y);
        let mut lent =
            kept.map(|(slopes, scales)| (self.chunk.lend(slopes), self.chunk.lend(scales)));
        let (gain, shift) = norm.affine(self.model.parameters);
        norm::Forward {
            sizes,
            gain,
            shift,
            plus: match added {
                Added::Nothing => Plus::Nothing,
                Added::Time(column) => Plus::Rows {
                    rows: &times.columns[column..],
                    stride: times.column_stride,
                },
                Added::Buffer(id) => Plus::All(self.chunk.read(id)),
            },
            kept: lent
                .as_mut()
                .map(|(slopes, scales)| norm::Kept { slopes, scales }),
            x: &mut activations,
            y: &mut output,
        }
        .run();
        self.chunk.put_back(x, activations);
        self.chunk.put_back(y, output);
        match (kept, lent) {
            (Some((slopes, scales)), Some(lent)) => {
                self.chunk.put_back(slopes, lent.0);
                self.chunk.put_back(scales, lent.1);
                self.chunk.tape.push(Kept::Norm { x, slopes, scales });
            }
            _ => self.chunk.release(x),
        }
        y
    }

    /// Takes `x` over; returns Mish of it, and its slopes if they are kept.
    fn mish(&mut self, x: usize) -> (usize, Option<usize>) {
        let len = self.chunk.read(x).len();
        let y = self.chunk.take(len);
        let mut output = self.chunk.lend(y);
        let slopes = (self.keep != Keep::Nothing).then(|| self.chunk.take(len));
        let mut lent = slopes.map(|id| self.chunk.lend(id));
        mish::apply(self.chunk.read(x), &mut output, lent.as_deref_mut());
        self.chunk.put_back(y, output);
        if let (Some(id), Some(lent)) = (slopes, lent) {
            self.chunk.put_back(id, lent);
        }
        self.chunk.release(x);
        (y, slopes)
    }

    fn keep_slopes(&mut self, slopes: Option<usize>) {
        if let Some(slopes) = slopes {
            self.chunk.tape.push(Kept::Slopes(slopes));
        }
    }

    fn time_mish(&mut self, x: usize) -> usize {
        let (out, slopes) = self.mish(x);
        if let Some(slopes) = slopes {
            self.chunk.time_slopes.push(slopes);
        }
        out
    }

    fn relu(&mut self, x: usize) -> usize {
        let len = self.chunk.read(x).len();
        let y = self.chunk.take(len);
        let mut output = self.chunk.lend(y);
        let input = self.chunk.read(x).iter();
        output
            .iter_mut()
            .zip(input)
            .for_each(|(y, x)| *y = x.max(0.0));
        if self.keep != Keep::Nothing {
            let slopes = self.chunk.take(len);
            let numbers = self.chunk.write(slopes).iter_mut();
            numbers
                .zip(output.iter())
                .for_each(|(slope, y)| *slope = f32::from(*y > 0.0));
            self.chunk.tape.push(Kept::Slopes(slopes));
        }
        self.chunk.put_back(y, output);
        self.chunk.release(x);
        y
    }

    fn concat(
        &mut self,
        length: usize,
        (h, channels): (usize, usize),
        (skip, more): (usize, usize),
    ) -> usize {
        let out = self
            .chunk
            .take(length * self.chunk.samples * (channels + more));
        let mut output = self.chunk.lend(out);
        let first = self.chunk.read(h).chunks_exact(channels);
        let pairs = first.zip(self.chunk.read(skip).chunks_exact(more));
        for (row, (first, second)) in output.chunks_exact_mut(channels + more).zip(pairs) {
            row[..channels].copy_from_slice(first);
            row[channels..].copy_from_slice(second);
        }
        self.chunk.put_back(out, output);
        self.chunk.release(h);
        self.chunk.release(skip);
        out
    }

    fn flatten(&mut self, length: usize, channels: usize, h: usize) -> usize {
        let samples = self.chunk.samples;
        let times = Arc::clone(&self.chunk.times);
        let time = self.model.plan.time.as_ref();
        let dim = time.map_or(0, |time| self.model.plan.layers[time.second].outputs);
        let flat = length * channels;
        let out = self.chunk.take(samples * (flat + dim));
        let mut output = self.chunk.lend(out);
        let input = self.chunk.read(h);
        for (n, row) in output.chunks_exact_mut(flat + dim).enumerate() {
            for (index, value) in row[..flat].iter_mut().enumerate() {
                let (channel, position) = (index / length, index % length);
                *value = input[(position * samples + n) * channels + channel];
            }
            row[flat..].copy_from_slice(&times.embedding[n * times.embedding_stride..][..dim]);
        }
        self.chunk.put_back(out, output);
        self.chunk.release(h);
        out
    }
}

impl<'a> Model<'a> {
    fn weights(self, layer: &Layer) -> Panels<'a> {
        self.prepared.weights(layer, self.parameters, self.halves)
    }

    fn apply(
        self,
        layer: &Layer,
        samples: usize,
        input: &[f32],
        room: &mut Room,
        output: &mut [f32],
    ) {
        let start = Start::Bias(&self.parameters[layer.bias..]);
        match &layer.winograd {
            Some(transformed) if self.winograd => Winograd {
                input,
                length: layer.length,
                samples,
                inputs: layer.inputs,
                outputs: layer.outputs,
                weights: &self.prepared.forward()[transformed.start..],
                points: transformed.points,
                start,
                zeros: self.zeros,
            }
            .write(room, output),
            _ => Product {
                input,
                length: layer.length,
                samples,
                inputs: layer.inputs,
                outputs: layer.outputs,
                weights: self.weights(layer),
                taps: layer.kind.taps(),
                passes: &layer.forward,
                start,
                zeros: self.zeros,
            }
            .write(output),
        }
    }

    /// From the gradient by a layer's output to the one by its input.
    pub(super) fn apply_back(
        self,
        layer: &Layer,
        (samples, start): (usize, Start<'_>),
        input: &[f32],
        room: &mut Room,
        output: &mut [f32],
    ) {
        match &layer.winograd {
            Some(transformed) if self.winograd => Winograd {
                input,
                length: layer.length,
                samples,
                inputs: layer.outputs,
                outputs: layer.inputs,
                weights: &self.prepared.backward()[transformed.start..],
                points: transformed.points,
                start,
                zeros: self.zeros,
            }
            .write(room, output),
            _ if !self.winograd && shared::pays(layer, self.group) => Shared {
                gradient: input,
                length: layer.output_length(),
                samples,
                inputs: layer.inputs,
                outputs: layer.outputs,
                taps: layer.kind.taps(),
                weights: self.weights(layer),
                passes: &layer.backward,
                adds: matches!(start, Start::Output),
            }
            .write(&mut room.products, output),
            _ => Product {
                input,
                length: layer.output_length(),
                samples,
                inputs: layer.outputs,
                outputs: layer.inputs,
                weights: self.prepared.transposed(layer, self.halves),
                taps: layer.kind.taps(),
                passes: &layer.backward,
                start,
                zeros: self.zeros,
            }
            .write(output),
        }
    }
}

/// `[sample][position][channel]` to `[position][sample][channel]`.
pub(super) fn to_positions(
    from: &[f32],
    to: &mut [f32],
    (samples, length, width): (usize, usize, usize),
) {
    for n in 0..samples {
        for l in 0..length {
            let row = &from[(n * length + l) * width..][..width];
            to[(l * samples + n) * width..][..width].copy_from_slice(row);
        }
    }
}

/// `[position][sample][channel]` to `[sample][position][channel]`.
pub(super) fn from_positions(
    from: &[f32],
    to: &mut [f32],
    (samples, length, width): (usize, usize, usize),
) {
    for n in 0..samples {
        for l in 0..length {
            let row = &from[(l * samples + n) * width..][..width];
            to[(n * length + l) * width..][..width].copy_from_slice(row);
        }
    }
}
