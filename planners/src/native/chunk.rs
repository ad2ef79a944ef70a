//! The samples that go through a network together, and their buffers.

use super::aligned::Aligned;
use super::winograd::Room;

/// What a forward pass keeps.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Keep {
    /// Nothing.
    Nothing,
    /// What the gradient by the input takes.
    Slopes,
    /// And what the gradient by the weights takes.
    All,
}

/// What a step kept for the way back; numbers of buffers.
#[derive(Debug)]
pub(super) enum Kept {
    Norm {
        /// The normalized activations.
        x: usize,
        slopes: usize,
        scales: usize,
    },
    Slopes(usize),
}

/// A buffer is free again when nobody holds it.
#[derive(Debug)]
struct Buffer {
    numbers: Aligned,
    holders: usize,
}

/// The times of a chunk's samples, as the blocks take them.
#[derive(Debug, Default)]
pub(super) struct Times {
    /// What the blocks add, a row per sample or one for all.
    pub(super) columns: Vec<f32>,
    /// The result of the time network, likewise.
    pub(super) embedding: Vec<f32>,
    /// Numbers from one sample's row of `columns` to the next one's; 0 if there is one for all.
    pub(super) column_stride: usize,
    pub(super) embedding_stride: usize,
}

/// Samples that go through a network together.
#[derive(Debug, Default)]
pub(super) struct Chunk {
    pub(super) samples: usize,
    pub(super) times: std::sync::Arc<Times>,
    buffers: Vec<Buffer>,
    /// In the order of the forward pass.
    pub(super) tape: Vec<Kept>,
    /// Per layer: the buffers of its input and of the gradient by its output.
    pub(super) inputs: Vec<Option<usize>>,
    pub(super) gradients: Vec<Option<usize>>,
    /// Slopes of the two Mishes of the time network.
    pub(super) time_slopes: Vec<usize>,
    pub(super) room: Room,
    /// Gradients by the parameters of all norms.
    pub(super) norm_gradients: Vec<f32>,
}

impl Chunk {
    /// Makes room for a new forward pass.
    pub(super) fn reset(&mut self, samples: usize, n_layers: usize) {
        self.samples = samples;
        self.tape.clear();
        self.time_slopes.clear();
        self.inputs.clear();
        self.inputs.resize(n_layers, None);
        self.gradients.clear();
        self.gradients.resize(n_layers, None);
        for buffer in &mut self.buffers {
            buffer.holders = 0;
        }
    }

    /// A buffer of `len` numbers, whatever they are, held once.
    pub(super) fn take(&mut self, len: usize) -> usize {
        let free = |buffer: &Buffer| buffer.holders == 0 && buffer.numbers.capacity() >= len;
        let candidates = self.buffers.iter().enumerate().filter(|(_, b)| free(b));
        let found = candidates.min_by_key(|(_, b)| b.numbers.capacity());
        let id = match found {
            Some((id, _)) => id,
            None => {
                self.buffers.push(Buffer {
                    numbers: Aligned::zeros(len),
                    holders: 0,
                });
                self.buffers.len() - 1
            }
        };
        let buffer = &mut self.buffers[id];
        buffer.holders = 1;
        buffer.numbers.set_len(len);
        id
    }

    pub(super) fn hold(&mut self, id: usize) {
        self.buffers[id].holders += 1;
    }

    pub(super) fn release(&mut self, id: usize) {
        self.buffers[id].holders -= 1;
    }

    pub(super) fn read(&self, id: usize) -> &[f32] {
        &self.buffers[id].numbers
    }

    pub(super) fn write(&mut self, id: usize) -> &mut [f32] {
        &mut self.buffers[id].numbers
    }

    /// Lends a buffer's numbers out, so that others can be read meanwhile; to be put back.
    pub(super) fn lend(&mut self, id: usize) -> Aligned {
        std::mem::take(&mut self.buffers[id].numbers)
    }

    pub(super) fn put_back(&mut self, id: usize, numbers: Aligned) {
        self.buffers[id].numbers = numbers;
    }
}
