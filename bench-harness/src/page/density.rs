//! Where many points are: counts on a grid, as levels of gray.

use serde::Serialize;

use super::pack::Column;

/// Cells along the longer side.
const CELLS: f64 = 64.0;

/// Levels of a grid, row by row from the lower left corner: 0 where there is nothing, 255 where there is most, by the
/// logarithm of the count.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Density {
    n: [usize; 2],
    levels: Column,
}

impl Density {
    /// Counts the points that lie within the ranges, on cells of equal size. `ratio` is height by width as drawn.
    pub fn new(points: impl Iterator<Item = [f64; 2]>, [x, y]: [[f64; 2]; 2], ratio: f64) -> Self {
        let n = [1.0 / ratio, ratio].map(|side| (CELLS * side.clamp(0.1, 1.0)).round() as usize);
        let mut counts = vec![0u64; n[0] * n[1]];
        for [a, b] in points {
            let column = cell(a, x, n[0]);
            let row = cell(b, y, n[1]);
            if let (Some(column), Some(row)) = (column, row) {
                counts[row * n[0] + column] += 1;
            }
        }
        let most = counts.iter().copied().max().unwrap_or(0).max(1);
        let level = |count: &u64| {
            let share = (1.0 + *count as f64).ln() / (1.0 + most as f64).ln();
            // A single step shows, too.
            match count {
                0 => 0,
                _ => ((255.0 * share).round() as u8).max(1),
            }
        };
        let levels: Vec<u8> = counts.iter().map(level).collect();
        Self {
            n,
            levels: Column::u8(&levels),
        }
    }
}

fn cell(value: f64, [low, high]: [f64; 2], n: usize) -> Option<usize> {
    let share = (value - low) / (high - low);
    (0.0..=1.0)
        .contains(&share)
        .then(|| ((share * n as f64) as usize).min(n - 1))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_grid_has_the_form_of_its_picture_and_counts_what_is_inside() {
        let ranges = [[0.0, 2.0], [0.0, 1.0]];
        let of = |points: &[[f64; 2]]| Density::new(points.iter().copied(), ranges, 0.5);
        let empty = of(&[[3.0, 0.5], [0.5, -0.1]]);
        assert_eq!(empty.n, [64, 32]);
        assert_eq!(empty, of(&[]));
        // Both corners belong to the grid.
        let mut levels = vec![0; 64 * 32];
        levels[0] = 255;
        *levels.last_mut().unwrap() = 255;
        let corners = of(&[[0.0, 0.0], [2.0, 1.0]]);
        assert_eq!(corners.levels, Column::u8(&levels));
    }
}
