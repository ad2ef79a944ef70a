//! Numbers that start at a cache line, so that no vector lies across two.

use std::ops::{Deref, DerefMut};

const LINE_BYTES: usize = 64;

/// A slice of numbers whose first lies at the start of a cache line.
#[derive(Debug, Default)]
pub(super) struct Aligned<T = f32> {
    numbers: Vec<T>,
    start: usize,
    len: usize,
}

impl<T: Copy + Default> Aligned<T> {
    /// Zeros.
    pub(super) fn zeros(len: usize) -> Self {
        let slack = LINE_BYTES / size_of::<T>();
        let numbers = vec![T::default(); len + slack];
        // Where the offset cannot be told, the numbers are not aligned: slower, never wrong.
        let start = numbers.as_ptr().align_offset(LINE_BYTES).min(slack);
        Self {
            numbers,
            start,
            len,
        }
    }
}

impl Aligned {
    /// The most numbers that it can have.
    pub(super) fn capacity(&self) -> usize {
        self.numbers.len() - self.start
    }

    /// Has `len` numbers from now on, whatever they are, in a new place if this one is too small.
    pub(super) fn grow(&mut self, len: usize) {
        if self.capacity() < len {
            *self = Self::zeros(len);
        }
        self.set_len(len);
    }

    /// Has `len` numbers from now on, at most its capacity; whatever they are.
    pub(super) fn set_len(&mut self, len: usize) {
        self.len = len.min(self.capacity());
    }
}

impl Clone for Aligned {
    fn clone(&self) -> Self {
        let mut copy = Self::zeros(self.len);
        copy.copy_from_slice(self);
        copy
    }
}

impl<T> Deref for Aligned<T> {
    type Target = [T];

    fn deref(&self) -> &[T] {
        &self.numbers[self.start..][..self.len]
    }
}

impl<T> DerefMut for Aligned<T> {
    fn deref_mut(&mut self) -> &mut [T] {
        &mut self.numbers[self.start..][..self.len]
    }
}
