//! Which samples of a topic stand for a moment, and values between two samples.
//!
//! Pure functions over ascending times. Times are nanoseconds of one clock; where several samples have the same
//! time, the order is that of the file and the later one counts as newer.

use serde::Deserialize;

/// How the value of a field at a grid time is found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Align {
    /// The newest sample at or before the time: what a controller could have known.
    Latest,
    /// The sample closest in time; of two that are equally far the earlier.
    Nearest,
    /// Between the samples before and after, in proportion to time.
    Linear,
    /// The first sample at or after the time.
    Next,
}

/// What stands for a moment: samples by their place in the ascending order.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Pick {
    /// The sample, or the one before the moment.
    pub(crate) first: usize,
    /// The sample after the moment and its weight in `(0, 1)`, if the value is between two.
    pub(crate) second: Option<(usize, f64)>,
}

impl Pick {
    fn one(first: usize) -> Self {
        Self {
            first,
            second: None,
        }
    }
}

/// Picks for the moment `at` among ascending `times`. `reach` is how far a single sample may be from the moment,
/// or the two samples of [`Align::Linear`] from each other; both bounds are allowed values.
///
/// `None` if there is no such sample: nothing is ever filled in backward, and [`Align::Linear`] needs a sample on
/// both sides unless one lies exactly there.
pub(crate) fn pick(times: &[i64], at: i64, align: Align, reach: Option<u64>) -> Option<Pick> {
    let in_reach = |a: i64, b: i64| reach.is_none_or(|reach| a.abs_diff(b) <= reach);
    let after = times.partition_point(|&time| time <= at);
    let single = match align {
        Align::Latest => after.checked_sub(1)?,
        Align::Next => times.partition_point(|&time| time < at),
        Align::Nearest => nearest(times, at)?,
        Align::Linear => {
            let before = after.checked_sub(1)?;
            let start = *times.get(before)?;
            if start == at {
                return Some(Pick::one(before));
            }
            let end = *times.get(after)?;
            let weight = start.abs_diff(at) as f64 / start.abs_diff(end) as f64;
            return in_reach(start, end).then_some(Pick {
                first: before,
                second: Some((after, weight)),
            });
        }
    };
    let time = *times.get(single)?;
    in_reach(time, at).then_some(Pick::one(single))
}

fn nearest(times: &[i64], at: i64) -> Option<usize> {
    let after = times.partition_point(|&time| time < at);
    let distance = |place: usize| times.get(place).map(|time| time.abs_diff(at));
    match after.checked_sub(1) {
        Some(before) if distance(before) <= distance(after).or(distance(before)) => Some(before),
        _ => (after < times.len()).then_some(after),
    }
}

/// The value between `a` and `b` at `weight` in `[0, 1]`.
pub(crate) fn between(a: f64, b: f64, weight: f64) -> f64 {
    (1.0 - weight) * a + weight * b
}

/// The angle between `a` and `b` [rad] the short way round; the result stays in (−π, π] if the way crosses ±π.
pub(crate) fn between_angles(a: f64, b: f64, weight: f64) -> f64 {
    use std::f64::consts::{PI, TAU};
    let plain = b - a;
    if plain.abs() <= PI || !plain.is_finite() {
        return between(a, b, weight);
    }
    let turns = (plain / TAU).round();
    let angle = a + weight * (plain - turns * TAU);
    let wrapped = angle - TAU * (angle / TAU).round();
    if wrapped <= -PI { PI } else { wrapped }
}

/// The rotation between two unit quaternions at `weight` (Shoemake 1985, "Animating rotation with quaternion
/// curves"), the short way round: q and −q are the same rotation. The order of the components does not matter.
pub(crate) fn between_quaternions(a: [f64; 4], b: [f64; 4], weight: f64) -> [f64; 4] {
    let dot: f64 = a.iter().zip(&b).map(|(a, b)| a * b).sum();
    let sign = if dot < 0.0 { -1.0 } else { 1.0 };
    let cosine = dot.abs().min(1.0);
    // Below this angle sin(x) is x to double precision, and the formula would divide by almost nothing.
    let (wa, wb) = if cosine > 1.0 - 1e-9 {
        (1.0 - weight, weight)
    } else {
        let angle = cosine.acos();
        let part = |share: f64| (share * angle).sin() / angle.sin();
        (part(1.0 - weight), part(weight))
    };
    let mut mixed = [0.0; 4];
    for (out, (a, b)) in mixed.iter_mut().zip(a.iter().zip(&b)) {
        *out = wa * a + sign * wb * b;
    }
    let norm = mixed.iter().map(|v| v * v).sum::<f64>().sqrt();
    mixed.map(|v| v / norm)
}

/// Grid times by integer arithmetic, so that errors never add up.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Pace {
    /// Steps per 10⁶ seconds: time i is `start + i·10¹⁵ / rate`, rounded down.
    MicroHertz(u64),
    /// A whole number of nanoseconds.
    StepNs(u64),
}

impl Pace {
    /// Time of grid point `i`; `None` beyond the range of the clock.
    pub(crate) fn time(self, start: i64, i: u64) -> Option<i64> {
        let offset = match self {
            Self::MicroHertz(rate) => {
                u128::from(i) * 1_000_000_000_000_000 / u128::from(rate.max(1))
            }
            Self::StepNs(step) => u128::from(i) * u128::from(step),
        };
        i64::try_from(i128::from(start) + i128::try_from(offset).ok()?).ok()
    }

    /// Steps per second.
    pub(crate) fn rate_hz(self) -> f64 {
        match self {
            Self::MicroHertz(rate) => rate as f64 / 1e6,
            Self::StepNs(step) => 1e9 / step as f64,
        }
    }

    /// Number of points from `start` to `end`, both included.
    pub(crate) fn count(self, start: i64, end: i64) -> u64 {
        let Ok(span) = u128::try_from(i128::from(end) - i128::from(start)) else {
            return 0;
        };
        let last = match self {
            // The largest i with floor(i·10¹⁵ / rate) ≤ span.
            Self::MicroHertz(rate) => {
                ((span + 1) * u128::from(rate.max(1))).div_ceil(1_000_000_000_000_000) - 1
            }
            Self::StepNs(step) => span / u128::from(step.max(1)),
        };
        u64::try_from(last).unwrap_or(u64::MAX).saturating_add(1)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const ALL: [Align; 4] = [Align::Latest, Align::Nearest, Align::Linear, Align::Next];

    /// The rules of [`Align`], word by word.
    fn naive(times: &[i64], at: i64, align: Align, reach: Option<u64>) -> Option<Pick> {
        let all = || 0..times.len();
        let found = match align {
            Align::Latest => all().rfind(|&i| times[i] <= at),
            Align::Next => all().find(|&i| times[i] >= at),
            // Of the same time and before the moment the newest; at the moment or after it the oldest.
            Align::Nearest => all().min_by_key(|&i| {
                let tie = if times[i] < at {
                    times.len() - i
                } else {
                    times.len() + i
                };
                (times[i].abs_diff(at), tie)
            }),
            Align::Linear => {
                let before = all().rfind(|&i| times[i] <= at)?;
                if times[before] != at {
                    let after = all().find(|&i| times[i] > at)?;
                    let gap = (times[after] - times[before]) as f64;
                    let weight = (at - times[before]) as f64 / gap;
                    let fits = reach.is_none_or(|r| times[before].abs_diff(times[after]) <= r);
                    let second = Some((after, weight));
                    return fits.then_some(Pick {
                        first: before,
                        second,
                    });
                }
                Some(before)
            }
        };
        let found = found?;
        let fits = reach.is_none_or(|r| times[found].abs_diff(at) <= r);
        fits.then_some(Pick::one(found))
    }

    proptest! {
        #[test]
        fn picks_are_those_of_the_naive_search(
            mut times in prop::collection::vec(-20i64..20, 0..12),
            at in -25i64..25,
            reach in prop::option::of(0u64..15),
        ) {
            times.sort_unstable();
            for align in ALL {
                prop_assert_eq!(pick(&times, at, align, reach), naive(&times, at, align, reach), "{:?}", align);
            }
        }

        #[test]
        fn the_count_of_a_grid_ends_at_its_end(rate in 1u64..200_000_000_000, step in 1u64..1_000_000, span in 0i64..5_000_000_000) {
            for pace in [Pace::MicroHertz(rate), Pace::StepNs(step)] {
                let n = pace.count(7, 7 + span);
                prop_assert!(pace.time(7, n - 1).unwrap() <= 7 + span);
                prop_assert!(pace.time(7, n).unwrap() > 7 + span);
            }
        }
    }

    #[test]
    fn grids_do_not_drift() {
        let pace = Pace::MicroHertz(30_000_000);
        assert_eq!(pace.time(0, 3), Some(100_000_000));
        assert_eq!(pace.time(0, 30 * 3600 * 24), Some(86_400_000_000_000));
        assert_eq!(Pace::StepNs(33_333_333).time(0, 3), Some(99_999_999));
        assert_eq!(pace.time(i64::MAX, 1), None);
        assert_eq!(pace.count(5, 4), 0);
    }

    #[test]
    fn angles_take_the_short_way() {
        let mixed = between_angles(3.0, -3.0, 0.5);
        assert!(
            (mixed.abs() - std::f64::consts::PI).abs() < 1e-12,
            "{mixed}"
        );
        assert!((between_angles(0.1, 0.3, 0.25) - 0.15).abs() < 1e-15);
        assert!(between_angles(3.1, -3.1, 0.9) < -3.1);
        assert!(between_angles(f64::NAN, 1.0, 0.5).is_nan());
    }

    #[test]
    fn quaternions_turn_at_constant_speed() {
        let about_z = |angle: f64| [0.0, 0.0, (angle / 2.0).sin(), (angle / 2.0).cos()];
        for (weight, expected) in [(0.25, 0.4), (0.5, 0.8), (0.75, 1.2)] {
            let close = |q: [f64; 4]| {
                let same: f64 = q.iter().zip(about_z(expected)).map(|(a, b)| a * b).sum();
                assert!((same.abs() - 1.0).abs() < 1e-12, "{q:?}");
            };
            close(between_quaternions(about_z(0.0), about_z(1.6), weight));
            close(between_quaternions(
                about_z(0.0),
                about_z(1.6).map(|v| -v),
                weight,
            ));
        }
        let same = between_quaternions(about_z(0.3), about_z(0.3), 0.5);
        assert!((same[2] - about_z(0.3)[2]).abs() < 1e-15);
    }
}
