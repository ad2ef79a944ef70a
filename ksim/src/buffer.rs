//! Flat arrays of plain numbers, owned or lent by whoever keeps them: a mapped index, for one.

use std::fmt;
use std::ops::Deref;
use std::sync::Arc;

use bytemuck::Pod;
use bytes::Bytes;

use crate::error::DataError;

/// Read-only `T`s: a vector, or bytes that another owner keeps in memory, such as a mapped file.
///
/// What is lent is never copied by reading it; what changes it makes a copy first.
///
/// ```
/// let owned = ksim::Buffer::from(vec![1u32, 2]);
/// let lent = ksim::Buffer::<u32>::lent(bytes::Bytes::from_owner(vec![7u8, 0, 0, 0]));
/// assert_eq!(owned[1], 2);
/// // Little-endian, as the numbers of a file are; refused where memory is not aligned.
/// assert!(lent.is_err() || *lent.unwrap() == [7]);
/// ```
#[derive(Clone)]
pub struct Buffer<T>(Storage<T>);

#[derive(Clone)]
enum Storage<T> {
    Owned(Vec<T>),
    /// Whole `T`s, aligned: [`Buffer::lent`] has checked it.
    Lent(Bytes),
    /// What somebody else here holds, too.
    Shared(Shared<T>),
}

/// Numbers that several hold, whoever made them.
pub(crate) type Shared<T> = Arc<dyn AsRef<[T]> + Send + Sync>;

impl<T: Pod> Buffer<T> {
    /// Borrows little-endian values from `bytes`, for as long as the buffer and its clones live.
    ///
    /// # Errors
    /// [`DataError::Lent`] where they are not whole values, not aligned, or the machine is big-endian.
    pub fn lent(bytes: Bytes) -> Result<Self, DataError> {
        let refused = |reason| DataError::Lent {
            bytes: bytes.len(),
            reason,
        };
        if cfg!(target_endian = "big") && size_of::<T>() > 1 {
            return Err(refused("this machine is not little-endian"));
        }
        match bytemuck::try_cast_slice::<u8, T>(&bytes) {
            Ok(_) => Ok(Self(Storage::Lent(bytes))),
            Err(bytemuck::PodCastError::TargetAlignmentGreaterAndInputNotAligned) => {
                Err(refused("they are not aligned"))
            }
            Err(_) => Err(refused("they are not whole values")),
        }
    }

    /// The values as a vector that can change: lent ones are copied, once.
    pub(crate) fn to_mut(&mut self) -> &mut Vec<T> {
        if !matches!(self.0, Storage::Owned(_)) {
            self.0 = Storage::Owned(self.to_vec());
        }
        match &mut self.0 {
            Storage::Owned(values) => values,
            Storage::Lent(_) | Storage::Shared(_) => unreachable!("made an owned one above"),
        }
    }

    /// Gives back what growing has over-allocated.
    pub(crate) fn shrink_to_fit(&mut self) {
        if let Storage::Owned(values) = &mut self.0 {
            values.shrink_to_fit();
        }
    }
}

impl<T: Pod> Deref for Buffer<T> {
    type Target = [T];

    #[inline]
    fn deref(&self) -> &[T] {
        match &self.0 {
            Storage::Owned(values) => values,
            Storage::Lent(bytes) => bytemuck::cast_slice(bytes),
            Storage::Shared(values) => (**values).as_ref(),
        }
    }
}

impl<T: Pod> AsRef<[T]> for Buffer<T> {
    fn as_ref(&self) -> &[T] {
        self
    }
}

impl<T> From<Vec<T>> for Buffer<T> {
    fn from(values: Vec<T>) -> Self {
        Self(Storage::Owned(values))
    }
}

impl<T> From<Shared<T>> for Buffer<T> {
    fn from(values: Shared<T>) -> Self {
        Self(Storage::Shared(values))
    }
}

impl<T> Default for Buffer<T> {
    fn default() -> Self {
        Self::from(Vec::new())
    }
}

impl<T: Pod + PartialEq> PartialEq for Buffer<T> {
    fn eq(&self, other: &Self) -> bool {
        **self == **other
    }
}

impl<T> fmt::Debug for Buffer<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.0 {
            Storage::Owned(values) => write!(f, "Buffer(owned, {} values)", values.len()),
            Storage::Lent(bytes) => write!(f, "Buffer(lent, {} bytes)", bytes.len()),
            Storage::Shared(values) => {
                write!(f, "Buffer(shared, {} values)", (**values).as_ref().len())
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Bytes that begin at a multiple of 8.
    fn aligned(values: &[u64]) -> Bytes {
        struct Owner(Vec<u64>);
        impl AsRef<[u8]> for Owner {
            fn as_ref(&self) -> &[u8] {
                bytemuck::cast_slice(&self.0)
            }
        }
        Bytes::from_owner(Owner(values.to_vec()))
    }

    #[test]
    fn lent_values_read_like_owned_ones_and_are_copied_by_the_first_change() {
        let bytes = aligned(&[1 | 2 << 32, 3]);
        let mut lent = Buffer::<u32>::lent(bytes.clone()).unwrap();
        assert_eq!(lent, Buffer::from(vec![1, 2, 3, 0]));
        lent.to_mut().push(9);
        assert_eq!(*lent, [1, 2, 3, 0, 9]);
        assert_eq!(bytes[0], 1);
    }

    #[test]
    fn what_does_not_fit_is_refused() {
        let bytes = aligned(&[0, 0]);
        let lent = |range: std::ops::Range<usize>| Buffer::<f64>::lent(bytes.slice(range));
        assert!(lent(0..16).is_ok());
        assert!(matches!(
            lent(0..12),
            Err(DataError::Lent { bytes: 12, .. })
        ));
        assert!(lent(4..12).is_err());
    }
}
