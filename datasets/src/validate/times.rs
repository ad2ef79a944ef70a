//! Time stamps.

use super::drive::Check;
use super::facts::Facts;
use super::magnitudes::Magnitudes;
use super::report::{Finding, Findings, Tally, many};
use super::rows::Segment;
use crate::schema;

/// A gap is longer than this many median steps.
const GAP_MEDIANS: f64 = 3.0;
/// A step that differs by more than this part of the median is uneven.
const UNEVEN: f64 = 0.25;
/// Share of uneven steps from which on it is worth a warning.
const UNEVEN_SHARE: f64 = 0.05;
/// How far the recorded rate may be from the measured one. The median is known to 1.1 %.
const RATE_TOLERANCE: f64 = 0.05;
/// Fewer steps than this have no typical step.
const MIN_STEPS: u64 = 10;

struct Times {
    place: usize,
    fps: Option<f64>,
    steps: Magnitudes,
    not_increasing: Tally,
    late_starts: Tally,
}

pub(super) fn check(facts: &Facts<'_>) -> Option<Box<dyn Check>> {
    let place = facts.find(schema::T_NS)?;
    Some(Box::new(Times {
        place,
        fps: facts.fps,
        steps: Magnitudes::default(),
        not_increasing: Tally::default(),
        late_starts: Tally::default(),
    }))
}

impl Check for Times {
    fn name(&self) -> &'static str {
        "times"
    }

    fn visit(&mut self, segment: &Segment<'_>) {
        let times = segment.column(self.place);
        for (before, row) in segment.pairs() {
            let Some((from, to)) = times.number(before).zip(times.number(row)) else {
                continue;
            };
            if to <= from {
                self.not_increasing.add(|| segment.place(row));
            } else {
                self.steps
                    .add(to - from, segment.episode, segment.step(row));
            }
        }
        let first = segment.rows().start;
        if !segment.continues && times.number(first).is_some_and(|time| time < 0.0) {
            self.late_starts.add(|| segment.place(first));
        }
    }

    fn finish(self: Box<Self>, found: &mut Findings) {
        found.push_at(self.not_increasing, |n| {
            Finding::error(
                "time-not-increasing",
                format!("time stamps do not increase at {}", many(n, "step")),
            )
        });
        found.push_at(self.late_starts, |_| {
            Finding::warning("negative-time", "episodes start before their time 0")
        });
        if self.steps.n() >= MIN_STEPS {
            rhythm(&self.steps, self.fps, found);
        }
    }
}

#[expect(clippy::cast_precision_loss, reason = "counts are far below 2^53")]
fn rhythm(steps: &Magnitudes, fps: Option<f64>, found: &mut Findings) {
    let median = steps.median();
    let (rate, milliseconds) = (1e9 / median, median / 1e6);
    found.push_at(steps.places_above(GAP_MEDIANS * median, schema::T_NS), |n| {
        Finding::warning(
            "time-gap",
            format!(
                "{} of more than {GAP_MEDIANS} times the median step of {milliseconds:.1} ms, up to {:.1} ms",
                many(n, "gap"),
                steps.max() / 1e6
            ),
        )
    });
    let uneven = steps.n_above((1.0 + UNEVEN) * median) + steps.n_below((1.0 - UNEVEN) * median);
    let share = uneven as f64 / steps.n() as f64;
    if share > UNEVEN_SHARE {
        found.push(Finding::warning(
            "uneven-time",
            format!(
                "{:.0} % of the steps are more than {:.0} % away from the median step of {milliseconds:.1} ms",
                100.0 * share,
                100.0 * UNEVEN
            ),
        ));
    }
    if let Some(fps) = fps.filter(|fps| (rate / fps - 1.0).abs() > RATE_TOLERANCE) {
        found.push(Finding::warning(
            "fps-mismatch",
            format!("the dataset declares {fps} steps per second, its time stamps say {rate:.1}"),
        ));
    }
}

#[cfg(test)]
mod tests {
    use crate::validate::synthetic::{Table, codes, findings};

    /// 20 Hz from the start of each episode, but for one row.
    fn times(at: usize, time: i64) -> Table {
        Table::good().with_times(move |row, step| if row == at { time } else { step * 50_000_000 })
    }

    #[test]
    fn an_even_clock_is_silent() {
        assert_eq!(codes(&times(99, 0).with_fps(20.0), "times"), [""; 0]);
    }

    #[test]
    fn a_clock_that_stops_or_jumps_is_seen() {
        assert_eq!(
            codes(&times(5, 200_000_000), "times"),
            ["time-not-increasing"]
        );
        let found = findings(&times(19, 2_000_000_000), "times");
        assert_eq!((found[0].code, found[0].count), ("time-gap", 1));
        assert_eq!(found[0].places[0].to_string(), "t_ns episode 0 step 19");
        assert!(
            found[0].message.contains("up to 1100.0 ms"),
            "{}",
            found[0].message
        );
        assert_eq!(codes(&times(0, -5), "times"), ["negative-time"]);
    }

    #[test]
    fn an_uneven_clock_and_a_wrong_rate_are_seen() {
        let uneven =
            Table::good().with_times(|_, step| step * 50_000_000 + (step % 2) * 20_000_000);
        assert_eq!(codes(&uneven, "times"), ["uneven-time"]);
        assert_eq!(
            codes(&times(99, 0).with_fps(30.0), "times"),
            ["fps-mismatch"]
        );
    }
}
