//! How far numbers may be off.

/// The largest difference of `found` from `expected`, over the largest magnitude of `expected`.
pub(crate) fn relative_error(found: &[f32], expected: &[f32]) -> f64 {
    assert_eq!(found.len(), expected.len());
    let largest = expected
        .iter()
        .fold(0.0f64, |a, b| a.max(f64::from(b.abs())));
    let pairs = found.iter().zip(expected);
    let error = pairs.fold(0.0f64, |worst, (a, b)| {
        let error = (f64::from(*a) - f64::from(*b)).abs();
        if error.is_nan() {
            f64::INFINITY
        } else {
            worst.max(error)
        }
    });
    if error == 0.0 { 0.0 } else { error / largest }
}

/// Asserts that `found` is within `tolerance` of `expected`, relative to its largest magnitude.
#[track_caller]
pub(crate) fn assert_close(found: &[f32], expected: &[f32], tolerance: f64, what: &str) {
    let error = relative_error(found, expected);
    assert!(
        error <= tolerance,
        "{what} is off by {error:e}, allowed {tolerance:e}"
    );
}
