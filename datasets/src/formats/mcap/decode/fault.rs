//! What can be wrong inside a message.

/// The largest integer up to which all can be `f64`.
const MAX_EXACT: u64 = 1 << f64::MANTISSA_DIGITS;

/// What is wrong in a message, and in which member.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Fault(Box<str>);

pub(super) fn fault(what: impl Into<Box<str>>) -> Fault {
    Fault(what.into())
}

impl Fault {
    /// Adds the member it is in.
    pub(super) fn in_member(self, name: &str) -> Self {
        Self(format!("{name}: {}", self.0).into())
    }

    pub(super) fn into_text(self) -> String {
        self.0.into()
    }
}

pub(super) fn exact_i64(value: i64) -> Result<f64, Fault> {
    match value.unsigned_abs() {
        0..=MAX_EXACT => Ok(value as f64),
        _ => Err(inexact(value)),
    }
}

pub(super) fn exact_u64(value: u64) -> Result<f64, Fault> {
    match value {
        0..=MAX_EXACT => Ok(value as f64),
        _ => Err(inexact(value)),
    }
}

fn inexact(value: impl std::fmt::Display) -> Fault {
    fault(format!(
        "the integer {value} is beyond 2^53 and may not be exact as f64"
    ))
}

/// Nanoseconds of a time or duration in two parts; a point in time has its fraction between 0 and 10^9.
pub(super) fn time_ns(seconds: i64, ns: i64, is_point: bool) -> Result<i64, Fault> {
    const SECOND: i64 = 1_000_000_000;
    if is_point && !(0..SECOND).contains(&ns) {
        return Err(fault(format!("a time has {ns} ns after its second")));
    }
    seconds
        .checked_mul(SECOND)
        .and_then(|whole| whole.checked_add(ns))
        .ok_or_else(|| fault(format!("a time of {seconds} s is out of range")))
}
