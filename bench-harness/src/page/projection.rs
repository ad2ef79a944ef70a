//! States in two dimensions: their main components.

use ksim::Reference;

/// Numbers that a component is computed from, at most: beyond, only every second, third, … row is taken.
const MAX_VALUES: usize = 1_000_000;
/// Rounds of the power iteration. Components that are still turning after them explain equally much, so that any turn
/// of theirs is as good.
const ROUNDS: usize = 100;
/// Columns that a component is described by.
const NAMED: usize = 3;

/// The two directions in which the dataset's normalized states vary most (Pearson, 1901).
#[derive(Debug, Clone, PartialEq)]
pub struct Projection {
    /// Unit vectors, of the width of a state; the second is 0 where a state has one column.
    components: [Vec<f64>; 2],
    /// Share of the variance that each explains, 0 to 1.
    shares: [f64; 2],
}

impl Projection {
    /// Finds the components by power iteration, from a start that is always the same.
    pub fn new(reference: &Reference) -> Self {
        let states = reference.states();
        let width = states.n_features();
        let stride = (states.n_rows() * width).div_ceil(MAX_VALUES).max(1);
        let mut rows = Vec::new();
        let mut row = vec![0.0; width];
        for number in (0..states.n_rows()).step_by(stride) {
            states.read_row(number, &mut row);
            rows.extend_from_slice(&row);
        }
        center(&mut rows, width);
        let total: f64 = rows.iter().map(|value| value * value).sum();
        let share = |variance: f64| match total > 0.0 {
            true => variance / total,
            false => 0.0,
        };
        let (first, a) = component(&rows, width, None);
        let (second, b) = match width {
            1 => (vec![0.0], 0.0),
            _ => component(&rows, width, Some(&first)),
        };
        Self {
            components: [first, second],
            shares: [share(a), share(b)],
        }
    }

    /// Where a normalized state lies.
    pub fn place(&self, state: &[f64]) -> [f64; 2] {
        [0, 1].map(|i| dot(&self.components[i], state))
    }

    /// Names of the axes.
    pub fn labels(&self) -> [String; 2] {
        [0, 1].map(|i| format!("component {} ({:.0} %)", i + 1, 100.0 * self.shares[i]))
    }

    /// What is drawn, in words, with the names of the columns that matter most.
    pub fn explain(&self, names: &[String]) -> String {
        let of = |component: &[f64]| {
            let mut order: Vec<usize> = (0..component.len()).collect();
            order.sort_by(|a, b| component[*b].abs().total_cmp(&component[*a].abs()));
            let named = order
                .iter()
                .take(NAMED)
                .filter_map(|column| Some((names.get(*column)?, component[*column])));
            let named: Vec<String> = named
                .map(|(name, weight)| format!("{name} {weight:+.2}"))
                .collect();
            named.join(", ")
        };
        format!(
            "States in the two main components of the dataset’s (first: {}, …; second: {}, …)",
            of(&self.components[0]),
            of(&self.components[1])
        )
    }
}

fn center(rows: &mut [f64], width: usize) {
    let n = (rows.len() / width).max(1) as f64;
    for column in 0..width {
        let values = rows.iter().skip(column).step_by(width);
        let mean = values.sum::<f64>() / n;
        for value in rows.iter_mut().skip(column).step_by(width) {
            *value -= mean;
        }
    }
}

/// A direction of most variance, at right angles to `other`, and its sum of squares.
fn component(rows: &[f64], width: usize, other: Option<&[f64]>) -> (Vec<f64>, f64) {
    // No column is left out by the start, and no symmetry of the data holds for it.
    let mut direction: Vec<f64> = (0..width).map(|i| 1.0 / (i as f64 + 1.0)).collect();
    let mut variance = 0.0;
    for _ in 0..ROUNDS {
        if let Some(other) = other {
            let along = dot(&direction, other);
            for (value, other) in direction.iter_mut().zip(other) {
                *value -= along * other;
            }
        }
        let length = dot(&direction, &direction).sqrt();
        if length <= f64::MIN_POSITIVE {
            break;
        }
        direction.iter_mut().for_each(|value| *value /= length);
        let mut next = vec![0.0; width];
        variance = 0.0;
        for row in rows.chunks_exact(width) {
            let along = dot(row, &direction);
            variance += along * along;
            for (next, value) in next.iter_mut().zip(row) {
                *next += along * value;
            }
        }
        if variance <= 0.0 {
            break;
        }
        direction = next;
    }
    (unit(direction, other), variance)
}

/// Of length 1, its largest entry positive.
fn unit(mut direction: Vec<f64>, other: Option<&[f64]>) -> Vec<f64> {
    if let Some(other) = other {
        let along = dot(&direction, other);
        for (value, other) in direction.iter_mut().zip(other) {
            *value -= along * other;
        }
    }
    let largest = direction
        .iter()
        .copied()
        .max_by(|a, b| a.abs().total_cmp(&b.abs()))
        .unwrap_or(0.0);
    let length = dot(&direction, &direction).sqrt() * largest.signum();
    if length != 0.0 {
        direction.iter_mut().for_each(|value| *value /= length);
    }
    direction
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

#[cfg(test)]
mod tests {
    use ksim::Trajectories;

    use super::*;

    fn reference(rows: &[[f64; 3]]) -> Reference {
        let mut data = Trajectories::new(3, 1).unwrap();
        let flat: Vec<f64> = rows.iter().flatten().copied().collect();
        data.push(0, &flat, &vec![0.0; rows.len()]).unwrap();
        Reference::new(data).unwrap()
    }

    #[test]
    fn the_first_component_is_what_columns_share_and_the_second_is_what_is_left() {
        // Two columns that move together and one on its own: normalized, variances 2 and 1.
        let rows: Vec<[f64; 3]> = (0..400)
            .map(|i| {
                let (a, b) = ((f64::from(i) * 0.7).sin(), (f64::from(i) * 1.3).cos());
                [a, 10.0 * a, b]
            })
            .collect();
        let projection = Projection::new(&reference(&rows));
        let [first, second] = &projection.components;
        let half = 0.5f64.sqrt();
        for (found, expected) in first.iter().zip([half, half, 0.0]) {
            assert!((found - expected).abs() < 0.01, "{first:?}");
        }
        assert!((second[2] - 1.0).abs() < 0.01, "{second:?}");
        assert!((projection.shares[0] - 2.0 / 3.0).abs() < 0.01);
        let names = ["a", "b", "c"].map(str::to_owned);
        assert!(projection.explain(&names).contains("second: c +1.00"));
        assert_eq!(projection, Projection::new(&reference(&rows)));
    }

    #[test]
    fn states_that_do_not_vary_have_no_components_and_lie_in_one_place() {
        let projection = Projection::new(&reference(&[[1.0; 3]; 4]));
        assert_eq!(projection.shares, [0.0; 2]);
        assert_eq!(projection.place(&[0.0; 3]), [0.0; 2]);
    }
}
