//! Recorded next observations against the rows that follow.

use super::drive::Check;
use super::facts::{Facts, Kind, Role};
use super::report::{Finding, Findings, Tally};
use super::rows::Segment;
use crate::schema;

/// Differences up to this part of a value are rounding (`f32` has 24 bits).
const ROUNDING: f64 = 1e-6;

struct NextObservations {
    /// Places of a next observation and of the observation it should be, with the name.
    pairs: Vec<(usize, usize, String)>,
    differs: Tally,
    n_compared: u64,
}

pub(super) fn check(facts: &Facts<'_>) -> Option<Box<dyn Check>> {
    let pair = |(place, column): (usize, &super::facts::Column)| {
        let leaf = column.name.strip_prefix(schema::NEXT_OBSERVATION)?;
        let observation = facts.find(&format!("{}{leaf}", schema::OBSERVATION))?;
        let fits = facts.columns[observation].width == column.width && column.kind == Kind::Float;
        fits.then(|| (place, observation, column.name.clone()))
    };
    let pairs: Vec<_> = facts
        .with_role(Role::NextObservation)
        .filter_map(pair)
        .collect();
    (!pairs.is_empty()).then(|| {
        Box::new(NextObservations {
            pairs,
            differs: Tally::default(),
            n_compared: 0,
        }) as Box<dyn Check>
    })
}

impl Check for NextObservations {
    fn name(&self) -> &'static str {
        "next-observations"
    }

    fn visit(&mut self, segment: &Segment<'_>) {
        for (before, row) in segment.pairs() {
            for (next, observation, name) in &self.pairs {
                let promised = segment.column(*next).row(before);
                let Some((promised, actual)) = promised.zip(segment.column(*observation).row(row))
                else {
                    continue;
                };
                self.n_compared += 1;
                if promised.iter().zip(actual).any(|(a, b)| !is_same(*a, *b)) {
                    self.differs.add(|| segment.place(before).of(name));
                }
            }
        }
    }

    fn finish(self: Box<Self>, found: &mut Findings) {
        let n_compared = self.n_compared;
        found.push_at(self.differs, |n| {
            Finding::warning(
                "next-observation-differs",
                format!(
                    "the next observation of {n} of {n_compared} steps is not the observation of the row that follows in the episode"
                ),
            )
        });
    }
}

fn is_same(a: f64, b: f64) -> bool {
    a == b || (a.is_nan() && b.is_nan()) || (a - b).abs() <= ROUNDING * a.abs().max(b.abs())
}

#[cfg(test)]
mod tests {
    use crate::validate::synthetic::{Table, codes, findings};

    #[test]
    fn a_shift_inside_episodes_is_silent() {
        assert_eq!(
            codes(&Table::good().with_next(None), "next-observations"),
            [""; 0]
        );
    }

    #[test]
    fn another_row_is_seen_but_not_across_a_border() {
        let found = findings(&Table::good().with_next(Some(7)), "next-observations");
        assert_eq!(
            (found[0].code, found[0].count),
            ("next-observation-differs", 1)
        );
        assert!(
            found[0].message.contains("of 57 steps"),
            "{}",
            found[0].message
        );
        // The last row of an episode has no row to be compared with.
        assert_eq!(
            codes(&Table::good().with_next(Some(19)), "next-observations"),
            [""; 0]
        );
    }
}
