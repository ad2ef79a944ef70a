//! Values that are no numbers, too large, or always the same.

use super::drive::Check;
use super::facts::{Column, Facts, Kind, Role};
use super::report::{Finding, Findings, Place, Tally, many};
use super::rows::Segment;

/// States and actions beyond this are taken for a fault: in SI units nothing a robot measures is so large
/// (10 mm in nanometres, 1 MN, 1000 km), and an `f32` there has steps of 1/16 and more.
const HUGE: f64 = 1e6;
/// Rows from which on a value that never changes is worth a word.
const MIN_ROWS: u64 = 10;

struct Seen {
    place: usize,
    column: Column,
    n_rows: u64,
    n_null: u64,
    nan: Tally,
    infinite: Tally,
    huge: Tally,
    largest: f64,
    /// The first row, and which of its values changed since.
    first: Option<Vec<f64>>,
    changed: Vec<bool>,
}

struct ValuesCheck {
    columns: Vec<Seen>,
}

pub(super) fn check(facts: &Facts<'_>) -> Option<Box<dyn Check>> {
    let columns = facts.columns.iter().enumerate();
    let columns = columns.filter(|(_, column)| column.role != Role::Index);
    let columns: Vec<Seen> = columns
        .map(|(place, column)| Seen::new(place, column))
        .collect();
    (!columns.is_empty()).then(|| Box::new(ValuesCheck { columns }) as Box<dyn Check>)
}

impl Check for ValuesCheck {
    fn name(&self) -> &'static str {
        "values"
    }

    fn visit(&mut self, segment: &Segment<'_>) {
        for seen in &mut self.columns {
            seen.visit(segment);
        }
    }

    fn finish(self: Box<Self>, found: &mut Findings) {
        for seen in self.columns {
            seen.finish(found);
        }
    }
}

impl Seen {
    fn new(place: usize, column: &Column) -> Self {
        Self {
            place,
            column: column.clone(),
            n_rows: 0,
            n_null: 0,
            nan: Tally::default(),
            infinite: Tally::default(),
            huge: Tally::default(),
            largest: 0.0,
            first: None,
            changed: vec![false; column.width],
        }
    }

    fn visit(&mut self, segment: &Segment<'_>) {
        let values = segment.column(self.place);
        for row in segment.rows() {
            self.n_rows += 1;
            if values.is_null(row) {
                self.n_null += 1;
            }
            let Some(numbers) = values.row(row) else {
                continue;
            };
            if self.column.kind == Kind::Float {
                self.look_at(numbers, || segment.place(row));
            }
            let first = self.first.get_or_insert_with(|| numbers.to_vec());
            for ((changed, first), value) in self.changed.iter_mut().zip(first).zip(numbers) {
                *changed |= first.to_bits() != value.to_bits();
            }
        }
    }

    fn look_at(&mut self, numbers: &[f64], place: impl Fn() -> Place) {
        // Sums up to one comparison in the common case.
        if numbers.iter().all(|value| value.abs() <= HUGE) {
            return;
        }
        for (index, value) in numbers.iter().enumerate() {
            let at = || place().of(self.column.value_name(index));
            if value.is_nan() {
                self.nan.add(at);
            } else if value.is_infinite() {
                self.infinite.add(at);
            } else if value.abs() > HUGE && self.column.role != Role::Info {
                self.huge.add(at);
                self.largest = self.largest.max(value.abs());
            }
        }
    }

    fn finish(self, found: &mut Findings) {
        let name = &self.column.name;
        let not_finite = |what: String| {
            let message = format!("{what} in \"{name}\"");
            match self.column.role {
                Role::Info => Finding::warning("not-finite", message),
                _ => Finding::error("not-finite", message),
            }
        };
        found.push_at(self.nan, |n| not_finite(format!("{n} NaN")));
        found.push_at(self.infinite, |n| not_finite(many(n, "infinite value")));
        let largest = self.largest;
        found.push_at(self.huge, |n| {
            Finding::warning(
                "huge-values",
                format!(
                    "{} of \"{name}\" beyond ±{HUGE:e}, up to {largest:.3e}",
                    many(n, "value")
                ),
            )
        });
        if self.n_rows > 0 && self.n_null == self.n_rows {
            found.push(
                Finding::warning("all-null", format!("\"{name}\" has no value in any row"))
                    .at(Tally::of(1, [Place::column(name)])),
            );
        }
        let n_values = self.n_rows - self.n_null;
        if n_values >= MIN_ROWS && matches!(self.column.role, Role::Observation | Role::Action) {
            constant(&self.column, &self.changed, found);
        }
    }
}

fn constant(column: &Column, changed: &[bool], found: &mut Findings) {
    let constant = |(index, changed): (usize, &bool)| (!changed).then_some(index);
    let constant: Vec<usize> = changed.iter().enumerate().filter_map(constant).collect();
    if column.kind == Kind::Opaque || constant.is_empty() {
        return;
    }
    let is_whole = constant.len() == column.width;
    let name = &column.name;
    let message = match is_whole {
        true => format!("\"{name}\" has the same value in all rows"),
        false => format!(
            "{} of {} values of \"{name}\" never change",
            constant.len(),
            column.width
        ),
    };
    // One goal for all episodes is common, an action that never changes is not.
    let finding = match column.role {
        Role::Action if is_whole => Finding::warning("constant-values", message),
        _ => Finding::note("constant-values", message),
    };
    let places: Vec<Place> = match is_whole {
        true => vec![Place::column(name)],
        false => {
            let at = |&index| Place::column(column.value_name(index));
            constant.iter().map(at).collect()
        }
    };
    found.push(finding.at(Tally::of(places.len() as u64, places)));
}

#[cfg(test)]
mod tests {
    use crate::validate::Severity;
    use crate::validate::synthetic::{Table, codes, findings};

    #[test]
    fn ordinary_values_are_silent() {
        assert_eq!(codes(&Table::good(), "values"), [""; 0]);
    }

    #[test]
    fn values_that_are_no_numbers_are_named() {
        for (value, what) in [(f64::NAN, "1 NaN"), (f64::INFINITY, "1 infinite")] {
            let found = findings(&Table::good().with_observation(25, 1, value), "values");
            assert_eq!(found.len(), 1);
            assert_eq!(
                (found[0].code, found[0].severity),
                ("not-finite", Severity::Error)
            );
            assert!(found[0].message.contains(what), "{}", found[0].message);
            assert_eq!(
                found[0].places[0].to_string(),
                "observation[1] episode 1 step 5"
            );
        }
    }

    #[test]
    fn huge_constant_and_missing_values_are_seen() {
        let huge = Table::good().with_observation(3, 0, -2e6);
        assert_eq!(codes(&huge, "values"), ["huge-values"]);
        let constant = (0..60).fold(Table::good(), |table, row| {
            table.with_observation(row, 1, 4.0)
        });
        assert_eq!(codes(&constant, "values"), ["constant-values"]);
        let null = Table::good().without_rewards();
        assert_eq!(codes(&null, "values"), ["all-null"]);
    }
}
