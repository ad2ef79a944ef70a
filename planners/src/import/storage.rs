//! Raw numbers, and tensors as views of them.

use half::{bf16, f16};

/// Dimensions of a tensor, at most.
const MAX_DIMENSIONS: usize = 8;

/// How a number is stored, little-endian.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum NumberType {
    F16,
    Bf16,
    F32,
    F64,
}

impl NumberType {
    pub(super) fn n_bytes(self) -> usize {
        match self {
            Self::F16 | Self::Bf16 => 2,
            Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    /// Appends the numbers of whole `bytes`, rounded to f32.
    pub(super) fn decode(self, bytes: &[u8], into: &mut Vec<f32>) {
        match self {
            Self::F16 => {
                let (numbers, _) = bytes.as_chunks();
                into.extend(numbers.iter().map(|&n| f16::from_le_bytes(n).to_f32()));
            }
            Self::Bf16 => {
                let (numbers, _) = bytes.as_chunks();
                into.extend(numbers.iter().map(|&n| bf16::from_le_bytes(n).to_f32()));
            }
            Self::F32 => {
                let (numbers, _) = bytes.as_chunks();
                into.extend(numbers.iter().map(|&n| f32::from_le_bytes(n)));
            }
            Self::F64 => {
                let (numbers, _) = bytes.as_chunks();
                into.extend(numbers.iter().map(|&n| f64::from_le_bytes(n) as f32));
            }
        }
    }
}

/// Numbers in an entry of the archive.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Storage {
    /// Name of the entry, below `data/`.
    pub(super) key: String,
    pub(super) numbers: NumberType,
    pub(super) n_numbers: usize,
}

/// A tensor: which numbers of a storage, in which order. No number is in it twice, and all are in the storage.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct View {
    pub(super) storage: Storage,
    offset: usize,
    pub(super) shape: Vec<usize>,
    strides: Vec<usize>,
    n_numbers: usize,
}

/// Why there is no such view.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct ViewProblem(pub(super) String);

impl View {
    pub(super) fn new(
        storage: Storage,
        offset: usize,
        shape: Vec<usize>,
        strides: Vec<usize>,
    ) -> Result<Self, ViewProblem> {
        let problem = |text: String| Err(ViewProblem(text));
        if shape.len() != strides.len() || shape.len() > MAX_DIMENSIONS {
            let (n, m) = (shape.len(), strides.len());
            return problem(format!(
                "{n} sizes and {m} strides, expected as many, {MAX_DIMENSIONS} at most"
            ));
        }
        let product = shape
            .iter()
            .try_fold(1usize, |n, &size| n.checked_mul(size));
        let n_numbers = match product {
            Some(n) if n <= storage.n_numbers => n,
            _ => {
                let stored = storage.n_numbers;
                return problem(format!(
                    "the shape {shape:?} on a storage of {stored} numbers"
                ));
            }
        };
        if !is_without_overlap(&shape, &strides) {
            return problem(format!(
                "strides {strides:?} for the shape {shape:?} meet a number twice"
            ));
        }
        let mut steps = shape.iter().zip(&strides).filter(|_| n_numbers > 0);
        let last = steps.try_fold(offset, |last, (&size, &stride)| {
            last.checked_add((size - 1).checked_mul(stride)?)
        });
        let end = last.and_then(|last| last.checked_add(usize::from(n_numbers > 0)));
        if end.is_none_or(|end| end > storage.n_numbers) {
            let stored = storage.n_numbers;
            return problem(format!(
                "offset {offset} and strides {strides:?} for the shape {shape:?} lead out of a storage of {stored} numbers"
            ));
        }
        Ok(Self {
            storage,
            offset,
            shape,
            strides,
            n_numbers,
        })
    }

    /// The tensor's numbers row by row, of all those of its storage.
    pub(super) fn gather(&self, stored: Vec<f32>) -> Vec<f32> {
        if self.n_numbers == stored.len() && self.is_row_by_row() {
            return stored;
        }
        let mut values = Vec::with_capacity(self.n_numbers);
        let mut index = vec![0usize; self.shape.len()];
        for _ in 0..self.n_numbers {
            let steps = index
                .iter()
                .zip(&self.strides)
                .map(|(&i, &stride)| i * stride);
            values.push(stored[self.offset + steps.sum::<usize>()]);
            for (place, &size) in index.iter_mut().zip(&self.shape).rev() {
                *place += 1;
                if *place < size {
                    break;
                }
                *place = 0;
            }
        }
        values
    }

    fn is_row_by_row(&self) -> bool {
        let mut expected = 1;
        self.shape
            .iter()
            .zip(&self.strides)
            .rev()
            .all(|(&size, &stride)| {
                let is_next = size == 1 || stride == expected;
                expected *= size;
                is_next
            })
    }
}

/// Whether each dimension steps over all that those of smaller strides reach.
fn is_without_overlap(shape: &[usize], strides: &[usize]) -> bool {
    let mut steps: Vec<(usize, usize)> =
        strides.iter().copied().zip(shape.iter().copied()).collect();
    steps.retain(|&(_, size)| size > 1);
    steps.sort_unstable();
    let mut reached = 1usize;
    steps.iter().all(|&(stride, size)| {
        let is_beyond = stride >= reached;
        reached = stride.saturating_mul(size);
        is_beyond
    })
}
