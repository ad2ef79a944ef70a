//! Shortest paths over cells.

use std::collections::VecDeque;

use super::{Cell, Maze, Tile};

impl Maze {
    /// A shortest path from a cell to another over free cells that share a side, both ends included; `None` if there
    /// is none. Of several, the one whose first differing step leads up, else left, right, down.
    pub fn shortest_path(&self, from: Cell, to: Cell) -> Option<Vec<Cell>> {
        let distances = self.distances_to(to);
        let distance = |(row, column): Cell| distances.get(row)?.get(column).copied().flatten();
        let mut left = distance(from)?;
        let mut path = vec![from];
        let mut cell = from;
        while left > 0 {
            left -= 1;
            cell = neighbors(cell).find(|&next| distance(next) == Some(left))?;
            path.push(cell);
        }
        Some(path)
    }

    /// Steps from every cell to `target`, by row and column; `None` for walls and cut-off cells.
    fn distances_to(&self, target: Cell) -> Vec<Vec<Option<usize>>> {
        let mut distances = vec![vec![None; self.n_columns()]; self.n_rows()];
        let mut reached = VecDeque::from([(target, 0)]);
        while let Some((cell, distance)) = reached.pop_front() {
            if self.tile(cell).is_none_or(|tile| tile == Tile::Wall) {
                continue;
            }
            let known = &mut distances[cell.0][cell.1];
            if known.is_none() {
                *known = Some(distance);
                reached.extend(neighbors(cell).map(|next| (next, distance + 1)));
            }
        }
        distances
    }
}

/// Cells that share a side: up, left, right, down.
fn neighbors((row, column): Cell) -> impl Iterator<Item = Cell> {
    let up = row.checked_sub(1).map(|row| (row, column));
    let left = column.checked_sub(1).map(|column| (row, column));
    let others = [(row, column + 1), (row + 1, column)];
    up.into_iter().chain(left).chain(others)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_equal_paths_the_one_up_and_left_first() {
        let maze = Maze::from_rows(&["11111", "10001", "10001", "10001", "11111"]).expect("a maze");
        let path = maze.shortest_path((3, 3), (1, 1)).expect("a path");
        assert_eq!(path, [(3, 3), (2, 3), (1, 3), (1, 2), (1, 1)]);
        let back = maze.shortest_path((1, 1), (3, 3)).expect("a path");
        assert_eq!(back, [(1, 1), (1, 2), (1, 3), (2, 3), (3, 3)]);
        assert_eq!(maze.shortest_path((2, 2), (2, 2)), Some(vec![(2, 2)]));
    }

    #[test]
    fn walls_are_walked_around_and_may_cut_off() {
        let maze = Maze::from_rows(&["111111", "100101", "101101", "100001", "111111"]);
        let maze = maze.expect("a maze");
        let path = maze.shortest_path((1, 2), (1, 4)).expect("a path");
        assert_eq!(path.len(), 9);
        let split = Maze::from_rows(&["11111", "10101", "11111"]).expect("a maze");
        for to in [(1, 3), (0, 0), (1, 2), (9, 9)] {
            assert_eq!(split.shortest_path((1, 1), to), None, "{to:?}");
            assert_eq!(split.shortest_path(to, (1, 1)), None, "{to:?}");
        }
    }
}
