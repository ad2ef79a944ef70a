//! The way back of a chunk of samples: the gradient by its input, and what the gradient by the weights takes.

use super::chunk::{Chunk, Keep, Kept};
use super::forward::{Model, from_positions, to_positions};
use super::norm;
use super::plan::{Block, Step};
use super::product::Start;

/// The way back of one chunk.
struct Backward<'a> {
    model: Model<'a>,
    chunk: &'a mut Chunk,
    keep: Keep,
    /// Gradients by what the blocks add of the time, and by the result of the time network: a row per sample.
    by_columns: Vec<f32>,
    by_embedding: Vec<f32>,
}

impl<'a> Model<'a> {
    /// From the gradient by the outputs to the gradient by the windows, if there is room for it. With [`Keep::All`]
    /// the gradients by the outputs of all layers stay in the chunk.
    pub(super) fn backward(
        self,
        chunk: &'a mut Chunk,
        keep: Keep,
        cotangent: &[f32],
        gradient: Option<&mut [f32]>,
    ) {
        let samples = chunk.samples;
        let mut run = Backward {
            model: self,
            chunk,
            keep,
            by_columns: Vec::new(),
            by_embedding: Vec::new(),
        };
        run.prepare();
        let (length, width) = self.plan.output;
        let mut dh = run.chunk.take(length * samples * width);
        to_positions(cotangent, run.chunk.write(dh), (samples, length, width));
        let mut skips = Vec::new();
        for (index, step) in self.plan.steps.iter().enumerate().rev() {
            dh = run.step(step, dh, &mut skips, index > 0 || gradient.is_some());
        }
        if let Some(gradient) = gradient {
            let (length, width) = self.plan.input;
            from_positions(run.chunk.read(dh), gradient, (samples, length, width));
        }
        if keep == Keep::All {
            run.time();
        }
    }
}

impl Backward<'_> {
    fn prepare(&mut self) {
        if self.keep != Keep::All {
            return;
        }
        let plan = self.model.plan;
        self.chunk.norm_gradients.clear();
        self.chunk
            .norm_gradients
            .resize(plan.n_parameters - plan.norms_start, 0.0);
        if let Some(time) = &plan.time {
            let samples = self.chunk.samples;
            self.by_columns = vec![0.0; samples * plan.layers[time.columns].outputs];
            self.by_embedding = vec![0.0; samples * plan.layers[time.second].outputs];
        }
    }

    /// Takes `dh` over. If the input's gradient is not `wanted`, what is returned holds nothing of use.
    fn step(&mut self, step: &Step, dh: usize, skips: &mut Vec<usize>, wanted: bool) -> usize {
        match step {
            Step::Block(block) => self.block(block, dh, wanted),
            Step::Layer(layer) => {
                self.record(*layer, dh);
                let out = if wanted {
                    self.layer(*layer, dh, None)
                } else {
                    dh
                };
                if wanted {
                    self.chunk.release(dh);
                }
                out
            }
            Step::Norm(norm) => self.norm(*norm, dh),
            Step::Mish | Step::Relu => self.slopes(dh),
            Step::Push => match skips.pop() {
                Some(skip) => self.add(dh, skip),
                None => dh,
            },
            Step::Concat {
                length,
                channels,
                skip,
            } => {
                let (out, remembered) = self.split(*length, *channels, *skip, dh);
                skips.push(remembered);
                out
            }
            Step::Flatten { length, channels } => self.unflatten(*length, *channels, dh),
        }
    }

    fn record(&mut self, layer: usize, gradient: usize) {
        if self.keep == Keep::All {
            self.chunk.hold(gradient);
            self.chunk.gradients[layer] = Some(gradient);
        }
    }

    /// The gradient by a layer's input, in a buffer of its own or added to one.
    fn layer(&mut self, index: usize, gradient: usize, add_to: Option<usize>) -> usize {
        let layer = &self.model.plan.layers[index];
        let samples = self.chunk.samples;
        let (out, start) = match add_to {
            Some(out) => (out, Start::Output),
            None => (
                self.chunk.take(layer.length * samples * layer.inputs),
                Start::Zero,
            ),
        };
        let mut output = self.chunk.lend(out);
        let mut room = std::mem::take(&mut self.chunk.room);
        let numbers = self.chunk.read(gradient);
        self.model
            .apply_back(layer, (samples, start), numbers, &mut room, &mut output);
        self.chunk.room = room;
        self.chunk.put_back(out, output);
        out
    }

    fn block(&mut self, block: &Block, dh: usize, wanted: bool) -> usize {
        // The norms take the gradient by their output over, but this one is still needed.
        self.chunk.hold(dh);
        let db = self.norm(block.norm2, dh);
        self.record(block.conv2, db);
        let dy = self.layer(block.conv2, db, None);
        self.chunk.release(db);
        self.time_columns(block, dy);
        let da = self.norm(block.norm1, dy);
        self.record(block.conv1, da);
        let out = match block.residual {
            None => dh,
            Some(conv) => {
                self.record(conv, dh);
                if !wanted {
                    return dh;
                }
                let out = self.layer(conv, dh, None);
                self.chunk.release(dh);
                out
            }
        };
        if wanted {
            self.layer(block.conv1, da, Some(out));
        }
        self.chunk.release(da);
        out
    }

    /// Takes `dy` over; returns the gradient by the norm's input.
    fn norm(&mut self, index: usize, dy: usize) -> usize {
        let Some(Kept::Norm { x, slopes, scales }) = self.chunk.tape.pop() else {
            return dy;
        };
        let norm = &self.model.plan.norms[index];
        let mut gradient = self.chunk.lend(x);
        let mut lent = self.chunk.lend(slopes);
        let mut norm_gradients = std::mem::take(&mut self.chunk.norm_gradients);
        let parameters = (self.keep == Keep::All).then(|| {
            let start = norm.gain - self.model.plan.norms_start;
            let both = &mut norm_gradients[start..];
            both.split_at_mut(norm.shift - norm.gain)
        });
        norm::Backward {
            sizes: norm.sizes(self.chunk.samples),
            gain: norm.affine(self.model.parameters).0,
            slopes: &mut lent,
            scales: self.chunk.read(scales),
            parameters,
            dy: self.chunk.read(dy),
            x: &mut gradient,
        }
        .run();
        self.chunk.norm_gradients = norm_gradients;
        self.chunk.put_back(x, gradient);
        self.chunk.put_back(slopes, lent);
        self.chunk.release(slopes);
        self.chunk.release(scales);
        self.chunk.release(dy);
        x
    }

    /// Multiplies the gradient by the slopes of an activation.
    fn slopes(&mut self, dh: usize) -> usize {
        if let Some(Kept::Slopes(slopes)) = self.chunk.tape.pop() {
            self.multiply(dh, slopes)
        } else {
            dh
        }
    }

    /// A new buffer: the one that is taken over may be recorded.
    fn multiply(&mut self, dh: usize, slopes: usize) -> usize {
        let out = self.chunk.take(self.chunk.read(dh).len());
        let mut product = self.chunk.lend(out);
        let pairs = self.chunk.read(dh).iter().zip(self.chunk.read(slopes));
        product
            .iter_mut()
            .zip(pairs)
            .for_each(|(product, (a, b))| *product = a * b);
        self.chunk.put_back(out, product);
        self.chunk.release(dh);
        self.chunk.release(slopes);
        out
    }

    fn add(&mut self, dh: usize, skip: usize) -> usize {
        let mut sum = self.chunk.lend(dh);
        let more = self.chunk.read(skip).iter();
        sum.iter_mut()
            .zip(more)
            .for_each(|(sum, more)| *sum += more);
        self.chunk.put_back(dh, sum);
        self.chunk.release(skip);
        dh
    }

    fn split(&mut self, length: usize, channels: usize, more: usize, dh: usize) -> (usize, usize) {
        let rows = length * self.chunk.samples;
        let (first, second) = (
            self.chunk.take(rows * channels),
            self.chunk.take(rows * more),
        );
        for (id, range) in [(first, 0..channels), (second, channels..channels + more)] {
            let mut part = self.chunk.lend(id);
            let rows = self.chunk.read(dh).chunks_exact(channels + more);
            for (part, row) in part.chunks_exact_mut(range.len()).zip(rows) {
                part.copy_from_slice(&row[range.clone()]);
            }
            self.chunk.put_back(id, part);
        }
        self.chunk.release(dh);
        (first, second)
    }

    fn unflatten(&mut self, length: usize, channels: usize, dh: usize) -> usize {
        let samples = self.chunk.samples;
        let flat = length * channels;
        let out = self.chunk.take(samples * flat);
        let mut output = self.chunk.lend(out);
        let gradient = self.chunk.read(dh);
        let width = gradient.len() / samples;
        for (n, row) in gradient.chunks_exact(width).enumerate() {
            for (index, value) in row[..flat].iter().enumerate() {
                let (channel, position) = (index / length, index % length);
                output[(position * samples + n) * channels + channel] = *value;
            }
            if let Some(by_embedding) = self.by_embedding.get_mut(n * (width - flat)..) {
                let pairs = by_embedding.iter_mut().zip(&row[flat..]);
                pairs.for_each(|(sum, value)| *sum += value);
            }
        }
        self.chunk.put_back(out, output);
        self.chunk.release(dh);
        out
    }

    /// The gradient by what a block adds of the time: the sum over positions.
    fn time_columns(&mut self, block: &Block, dy: usize) {
        let Some(time) = self.model.plan.time.as_ref() else {
            return;
        };
        if self.keep != Keep::All {
            return;
        }
        let channels = self.model.plan.layers[block.conv1].outputs;
        let stride = self.model.plan.layers[time.columns].outputs;
        for (row, dy) in self.chunk.read(dy).chunks_exact(channels).enumerate() {
            let start = row % self.chunk.samples * stride + block.time_column;
            let sums = self.by_columns[start..][..channels].iter_mut();
            sums.zip(dy).for_each(|(sum, dy)| *sum += dy);
        }
    }

    /// Back through the time network.
    fn time(&mut self) {
        let Some(time) = self.model.plan.time.as_ref() else {
            return;
        };
        let columns = self.chunk.take(self.by_columns.len());
        self.chunk.write(columns).copy_from_slice(&self.by_columns);
        self.record(time.columns, columns);
        let activated = self.layer(time.columns, columns, None);
        let Some(slopes) = self.chunk.time_slopes.pop() else {
            return;
        };
        let embedding = self.multiply(activated, slopes);
        let sums = self.chunk.write(embedding).iter_mut();
        sums.zip(&self.by_embedding)
            .for_each(|(sum, more)| *sum += more);
        self.record(time.second, embedding);
        let hidden = self.layer(time.second, embedding, None);
        if let Some(slopes) = self.chunk.time_slopes.pop() {
            let hidden = self.multiply(hidden, slopes);
            self.record(time.first, hidden);
        }
    }
}
