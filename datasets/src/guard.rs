//! Keeps panics of decoders we do not own away from the caller.

use std::panic::{AssertUnwindSafe, catch_unwind};

use crate::error::{DatasetError, Result};

/// Runs a step of a decoder that is known to panic on some damaged files (the `parquet` crate on definition
/// levels that end early, for one). After an error the decoder must not be used again.
///
/// The panic's message still goes to the standard error output, unless the program has a hook of its own.
///
/// # Errors
/// Those of `step`, or [`DatasetError::Corrupt`] in place of a panic.
pub(crate) fn decode<T>(step: impl FnOnce() -> Result<T>) -> Result<T> {
    // The state that a panic may leave half changed is the decoder's, which is dropped.
    catch_unwind(AssertUnwindSafe(step)).unwrap_or_else(|panic| {
        let text = panic.downcast_ref::<&str>().map(ToString::to_string);
        let text = text.or_else(|| panic.downcast_ref::<String>().cloned());
        Err(DatasetError::corrupt(format!(
            "its decoder gave up: {}",
            text.unwrap_or_default()
        )))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_panic_becomes_an_error() {
        let error = decode(|| -> Result<()> { panic!("out of bounds") }).unwrap_err();
        assert_eq!(
            error.to_string(),
            "corrupt file: its decoder gave up: out of bounds"
        );
        assert_eq!(decode(|| Ok(3)).unwrap(), 3);
    }
}
