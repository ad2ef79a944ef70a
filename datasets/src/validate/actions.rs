//! Actions against the bounds of their space.

use serde_json::Value;

use super::drive::Check;
use super::facts::{Column, Facts, Family, Kind, Role};
use super::report::{Finding, Findings, Place, Tally, many};
use super::rows::Segment;
use crate::schema;

/// How far rounding may carry a value over its bound, in parts of the bound: `f32` has 24 bits.
const ROUNDING: f64 = 1e-6;
/// Share of values at a bound from which on it is worth a word.
const SATURATED_SHARE: f64 = 0.01;

/// Bounds of one value.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Bounds {
    low: f64,
    high: f64,
}

struct Action {
    place: usize,
    column: Column,
    /// For each value.
    bounds: Vec<Bounds>,
    outside: Tally,
    furthest: f64,
    n_at_bound: u64,
    n_bounded: u64,
}

struct Actions {
    columns: Vec<Action>,
    source: String,
}

pub(super) fn check(facts: &Facts<'_>) -> Option<Box<dyn Check>> {
    let space: Option<Value> = facts
        .schema
        .metadata()
        .get(schema::SPACE_ACTION)
        .and_then(|json| serde_json::from_str(json).ok());
    let source = match (&space, facts.family) {
        (Some(_), _) => "the recorded action space".to_owned(),
        (None, family) => format!("the rule of {}", rule(family)?),
    };
    let mut columns = Vec::new();
    for (place, column) in facts.with_role(Role::Action) {
        let bounds = match &space {
            Some(space) => leaf_bounds(space, schema::ACTION, column, 0),
            None => Some(vec![
                Bounds {
                    low: -1.0,
                    high: 1.0
                };
                column.width
            ]),
        };
        if let (Some(bounds), true) = (bounds, column.kind != Kind::Opaque) {
            columns.push(Action {
                place,
                column: column.clone(),
                bounds,
                outside: Tally::default(),
                furthest: 0.0,
                n_at_bound: 0,
                n_bounded: 0,
            });
        }
    }
    (!columns.is_empty()).then(|| Box::new(Actions { columns, source }) as Box<dyn Check>)
}

/// The families whose actions lie in [-1, 1], by name.
fn rule(family: Family) -> Option<&'static str> {
    match family {
        Family::Antmaze(_) => Some("D4RL's antmaze"),
        Family::Maze2d => Some("D4RL's maze2d"),
        Family::Kitchen => Some("D4RL's kitchen"),
        Family::Adroit => Some("D4RL's adroit"),
        Family::Locomotion => Some("D4RL's locomotion"),
        Family::Robomimic => Some("robomimic"),
        Family::Other => None,
    }
}

/// The bounds of the leaf that is stored in `column`, found by walking the space as the readers name it.
fn leaf_bounds(space: &Value, name: &str, column: &Column, depth: usize) -> Option<Vec<Bounds>> {
    if depth > 32 || !schema::belongs_to(&column.name, name) {
        return None;
    }
    let number = |key: &str| space.get(key).and_then(Value::as_f64);
    let whole = |bounds| Some(vec![bounds; column.width]);
    match space.get("type").and_then(Value::as_str)? {
        "Dict" => space
            .get("subspaces")?
            .as_object()?
            .iter()
            .find_map(|(key, part)| {
                leaf_bounds(part, &schema::join_key(name, key), column, depth + 1)
            }),
        "Tuple" => space
            .get("subspaces")?
            .as_array()?
            .iter()
            .enumerate()
            .find_map(|(index, part)| {
                leaf_bounds(part, &format!("{name}[{index}]"), column, depth + 1)
            }),
        _ if column.name != name => None,
        "Box" => {
            let (mut low, mut high) = (Vec::new(), Vec::new());
            flatten(space.get("low")?, &mut low)?;
            flatten(space.get("high")?, &mut high)?;
            let at = |values: &[f64], index: usize| match values {
                [one] => Some(*one),
                many => many.get(index).copied(),
            };
            let bounds = (0..column.width).map(|index| {
                Some(Bounds {
                    low: at(&low, index)?,
                    high: at(&high, index)?,
                })
            });
            bounds.collect()
        }
        "Discrete" => {
            let low = number("start").unwrap_or(0.0);
            whole(Bounds {
                low,
                high: low + number("n")? - 1.0,
            })
        }
        "MultiBinary" => whole(Bounds {
            low: 0.0,
            high: 1.0,
        }),
        _ => None,
    }
}

/// The numbers of a nested list; infinities may be strings.
fn flatten(value: &Value, flat: &mut Vec<f64>) -> Option<()> {
    match value {
        Value::Array(items) => items.iter().try_for_each(|item| flatten(item, flat)),
        Value::String(text) => text.parse().ok().map(|number| flat.push(number)),
        other => other.as_f64().map(|number| flat.push(number)),
    }
}

impl Check for Actions {
    fn name(&self) -> &'static str {
        "actions"
    }

    fn visit(&mut self, segment: &Segment<'_>) {
        for action in &mut self.columns {
            for row in segment.rows() {
                if let Some(values) = segment.column(action.place).row(row) {
                    action.look_at(values, || segment.place(row));
                }
            }
        }
    }

    fn finish(self: Box<Self>, found: &mut Findings) {
        for action in self.columns {
            action.finish(&self.source, found);
        }
    }
}

impl Action {
    fn look_at(&mut self, values: &[f64], place: impl Fn() -> Place) {
        for (index, (value, bounds)) in values.iter().zip(&self.bounds).enumerate() {
            let slack = |bound: f64| ROUNDING * bound.abs().max(1.0);
            // Values that are not finite are another check's; infinite bounds bound nothing.
            let beyond = (bounds.low - value).max(value - bounds.high);
            let is_outside = *value < bounds.low - slack(bounds.low)
                || *value > bounds.high + slack(bounds.high);
            if value.is_finite() && is_outside {
                self.outside
                    .add(|| place().of(self.column.value_name(index)));
                self.furthest = self.furthest.max(beyond);
            }
            if bounds.low.is_finite() && bounds.high.is_finite() {
                self.n_bounded += 1;
                self.n_at_bound += u64::from(!is_outside && beyond >= 0.0);
            }
        }
    }

    #[expect(clippy::cast_precision_loss, reason = "counts are far below 2^53")]
    fn finish(self, source: &str, found: &mut Findings) {
        let name = &self.column.name;
        let range = range(&self.bounds);
        let furthest = self.furthest;
        found.push_at(self.outside, |n| {
            Finding::warning(
                "action-out-of-range",
                format!(
                    "{} of \"{name}\" outside {range} ({source}), by up to {furthest:.3e}",
                    many(n, "value")
                ),
            )
        });
        let share = self.n_at_bound as f64 / self.n_bounded.max(1) as f64;
        if self.column.kind == Kind::Float && share >= SATURATED_SHARE {
            found.push(
                Finding::note(
                    "actions-at-bound",
                    format!(
                        "{:.1} % of the values of \"{name}\" are at a bound of {range} ({source})",
                        100.0 * share
                    ),
                )
                .at(Tally::of(1, [Place::column(name)])),
            );
        }
    }
}

fn range(bounds: &[Bounds]) -> String {
    match bounds {
        [first, rest @ ..] if rest.iter().all(|other| other == first) => {
            format!("[{}, {}]", first.low, first.high)
        }
        _ => "their bounds".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use crate::validate::synthetic::{Table, codes, findings};

    const SPACE: &str =
        r#"{"type":"Box","shape":[2],"low":[-2,"-Infinity"],"high":[2,"Infinity"]}"#;

    #[test]
    fn actions_inside_are_silent() {
        assert_eq!(
            codes(&Table::good().with_action_space(SPACE), "actions"),
            [""; 0]
        );
        assert_eq!(
            codes(&Table::good().with_action(3, 0, 7.0), "actions"),
            [""; 0]
        );
    }

    #[test]
    fn actions_outside_are_counted_and_the_bound_is_named() {
        let recorded = Table::good()
            .with_action_space(SPACE)
            .with_action(3, 0, 2.5);
        let found = findings(&recorded.with_action(3, 1, 1e3), "actions");
        assert_eq!(found.len(), 1);
        assert_eq!((found[0].code, found[0].count), ("action-out-of-range", 1));
        assert!(found[0].message.contains("recorded action space"));
        assert_eq!(found[0].places[0].to_string(), "action[0] episode 0 step 3");
        let by_rule = Table::good()
            .d4rl("hopper_medium-v2")
            .with_action(3, 0, 1.5);
        let found = findings(&by_rule, "actions");
        assert!(
            found[0]
                .message
                .contains("[-1, 1] (the rule of D4RL's locomotion)")
        );
        // One f32 step over the bound is rounding.
        let rounded = Table::good()
            .d4rl("hopper-v2")
            .with_action(3, 0, f64::from(1.000_000_1f32));
        assert_eq!(codes(&rounded, "actions"), [""; 0]);
    }

    #[test]
    fn saturation_is_a_note_and_nested_spaces_are_found() {
        let many = (0..30).fold(Table::good().d4rl("hopper-v2"), |t, row| {
            t.with_action(row, 0, -1.0)
        });
        assert_eq!(codes(&many, "actions"), ["actions-at-bound"]);
        let space = r#"{"type":"Dict","subspaces":{"a.b":{"type":"Tuple","subspaces":[{"type":"Discrete","n":3}]}}}"#;
        let space = serde_json::from_str(space).unwrap();
        let mut column = Table::column("action.a~1b[0]");
        column.width = 1;
        let bounds = super::leaf_bounds(&space, "action", &column, 0).unwrap();
        assert_eq!((bounds[0].low, bounds[0].high), (0.0, 2.0));
    }
}
