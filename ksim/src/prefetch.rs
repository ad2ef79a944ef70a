//! Telling the processor what will be read soon.

#![cfg_attr(
    target_arch = "x86_64",
    expect(unsafe_code, reason = "there is no safe intrinsic for it")
)]

/// Asks for the cache line of `items[index]`, which may lie beyond the end: nothing is read, only
/// fetched, and on machines other than x86-64 not even that.
#[inline(always)]
pub fn prefetch<T>(items: &[T], index: usize) {
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};

        let address = items.as_ptr().wrapping_add(index).cast::<i8>();
        // SAFETY: a prefetch neither reads nor writes and never faults, whatever the address.
        unsafe { _mm_prefetch::<_MM_HINT_T0>(address) };
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = (items, index);
}
