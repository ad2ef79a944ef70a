//! Maps from text and JSON, and back.

use serde_json::Value;

use super::{Cell, Maze, Tile};

/// Why a map is not a maze.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum MazeError {
    /// Not a list of rows.
    #[error("expected a list of rows, found {found}")]
    NotRows {
        /// What stands there.
        found: String,
    },
    /// A row of another length than the first.
    #[error("row {row} has {found} cells, expected {expected}")]
    Ragged {
        /// Which row.
        row: usize,
        /// Cells of the first row.
        expected: usize,
        /// Cells of this row.
        found: usize,
    },
    /// Something that is no kind of cell.
    #[error("cell ({row}, {column}): expected 0, 1, \"r\", \"g\" or \"c\", found {found}")]
    Tile {
        /// Row, from 0 at the top.
        row: usize,
        /// Column, from 0 at the left.
        column: usize,
        /// What stands there.
        found: String,
    },
    /// The robot could walk out.
    #[error("cell ({row}, {column}) at the border: expected a wall")]
    OpenBorder {
        /// Row, from 0 at the top.
        row: usize,
        /// Column, from 0 at the left.
        column: usize,
    },
    /// No cell for goals or starts.
    #[error("no cell for a {what}: expected \"{mark}\", \"c\" or free cells")]
    NoCell {
        /// `goal` or `start`.
        what: &'static str,
        /// Its mark.
        mark: char,
    },
    /// A goal from which no start is far enough.
    #[error(
        "the only start ({row}, {column}) is a goal too: expected a start and a goal in different cells"
    )]
    StartIsGoal {
        /// Row, from 0 at the top.
        row: usize,
        /// Column, from 0 at the left.
        column: usize,
    },
}

impl Maze {
    /// A map of rows such as `1r01`: `1` wall, `0` free, `r` start, `g` goal, `c` either.
    ///
    /// # Errors
    /// Rows of different lengths, another character, a border that is not all wall, no cell for a goal or a start, or
    /// a single cell for both.
    pub fn from_rows(rows: &[&str]) -> Result<Self, MazeError> {
        let rows = rows.iter().map(|row| row.chars());
        let tiles = rows.enumerate().map(|(i, row)| {
            let tile = |(j, mark)| tile_of(mark).ok_or_else(|| bad_tile((i, j), mark.to_string()));
            row.enumerate().map(tile).collect()
        });
        Self::checked(tiles.collect::<Result<_, _>>()?)
    }

    /// A map as Gymnasium's `maze_map` argument has it: a list of rows, each a list of 0, 1, `"r"`, `"g"` and `"c"`.
    ///
    /// # Errors
    /// Another shape, or as [`Maze::from_rows`].
    pub fn from_json(map: &Value) -> Result<Self, MazeError> {
        let list = |value: &Value| match value {
            Value::Array(items) => Ok(items.clone()),
            other => Err(MazeError::NotRows {
                found: other.to_string(),
            }),
        };
        let mut tiles = Vec::new();
        for (i, row) in list(map)?.iter().enumerate() {
            let cells = list(row)?.into_iter().enumerate();
            let row = cells.map(|(j, cell)| {
                json_tile(&cell).ok_or_else(|| bad_tile((i, j), cell.to_string()))
            });
            tiles.push(row.collect::<Result<_, _>>()?);
        }
        Self::checked(tiles)
    }

    /// The map as Gymnasium's `maze_map` argument.
    pub fn to_json(&self) -> Value {
        let cell = |tile: &Tile| match tile {
            Tile::Wall => Value::from(1),
            Tile::Free => Value::from(0),
            Tile::Start => Value::from("r"),
            Tile::Goal => Value::from("g"),
            Tile::Either => Value::from("c"),
        };
        let rows = self.tiles.iter();
        rows.map(|row| row.iter().map(cell).collect::<Value>())
            .collect()
    }

    fn checked(tiles: Vec<Vec<Tile>>) -> Result<Self, MazeError> {
        let expected = tiles.first().map_or(0, Vec::len);
        let ragged = tiles.iter().position(|row| row.len() != expected);
        if let Some(row) = ragged {
            let found = tiles[row].len();
            return Err(MazeError::Ragged {
                row,
                expected,
                found,
            });
        }
        if expected == 0 {
            return Err(MazeError::NotRows {
                found: "no cells".to_owned(),
            });
        }
        check_border(&tiles)?;
        let maze = Self::with_tiles(tiles);
        match (maze.goals(), maze.starts()) {
            ([], _) => Err(MazeError::NoCell {
                what: "goal",
                mark: 'g',
            }),
            (_, []) => Err(MazeError::NoCell {
                what: "start",
                mark: 'r',
            }),
            (goals, &[(row, column)]) if goals.contains(&(row, column)) => {
                Err(MazeError::StartIsGoal { row, column })
            }
            _ => Ok(maze),
        }
    }
}

fn check_border(tiles: &[Vec<Tile>]) -> Result<(), MazeError> {
    for (i, row) in tiles.iter().enumerate() {
        for (j, &tile) in row.iter().enumerate() {
            let border = i == 0 || j == 0 || i + 1 == tiles.len() || j + 1 == row.len();
            if border && tile != Tile::Wall {
                return Err(MazeError::OpenBorder { row: i, column: j });
            }
        }
    }
    Ok(())
}

fn json_tile(cell: &Value) -> Option<Tile> {
    match cell {
        Value::String(mark) => match mark.as_str() {
            "r" => Some(Tile::Start),
            "g" => Some(Tile::Goal),
            "c" => Some(Tile::Either),
            _ => None,
        },
        number => match number.as_u64() {
            Some(0) => Some(Tile::Free),
            Some(1) => Some(Tile::Wall),
            _ => None,
        },
    }
}

fn tile_of(mark: char) -> Option<Tile> {
    match mark {
        '1' => Some(Tile::Wall),
        '0' => Some(Tile::Free),
        'r' => Some(Tile::Start),
        'g' => Some(Tile::Goal),
        'c' => Some(Tile::Either),
        _ => None,
    }
}

fn bad_tile((row, column): Cell, found: String) -> MazeError {
    MazeError::Tile { row, column, found }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn refused(map: &Value) -> String {
        let error = Maze::from_json(map).expect_err("refused");
        error.to_string()
    }

    #[test]
    fn json_and_text_say_the_same() {
        let json = json!([[1, 1, 1, 1], [1, "r", "g", 1], [1, 0, "c", 1], [1, 1, 1, 1]]);
        let maze = Maze::from_json(&json).expect("a maze");
        assert_eq!(
            Maze::from_rows(&["1111", "1rg1", "10c1", "1111"]),
            Ok(maze.clone())
        );
        assert_eq!(maze.to_json(), json);
    }

    #[test]
    fn maps_that_are_no_maze_say_where() {
        let cases = [
            (json!("UMaze"), "expected a list of rows, found \"UMaze\""),
            (json!([1, 1]), "expected a list of rows, found 1"),
            (json!([]), "expected a list of rows, found no cells"),
            (json!([[], []]), "expected a list of rows, found no cells"),
            (
                json!([[1, 1, 1], [1, 0, 1, 1], [1, 1, 1]]),
                "row 1 has 4 cells, expected 3",
            ),
            (
                json!([[1, 1, 1], [1, "x", 1], [1, 1, 1]]),
                "cell (1, 1): expected 0, 1, \"r\", \"g\" or \"c\", found \"x\"",
            ),
            (
                json!([[1, 1, 1], [1, 2, 1], [1, 1, 1]]),
                "cell (1, 1): expected 0, 1, \"r\", \"g\" or \"c\", found 2",
            ),
            (
                json!([[1, 1, 1], [1, 0, 0], [1, 1, 1]]),
                "cell (1, 2) at the border: expected a wall",
            ),
            (
                json!([[1, 1, 1], [1, 1, 1], [1, 1, 1]]),
                "no cell for a goal: expected \"g\", \"c\" or free cells",
            ),
            (
                json!([[1, 1, 1, 1], [1, "g", "g", 1], [1, 1, 1, 1]]),
                "no cell for a start: expected \"r\", \"c\" or free cells",
            ),
            (
                json!([[1, 1, 1, 1], [1, "c", "g", 1], [1, 1, 1, 1]]),
                "the only start (1, 1) is a goal too: expected a start and a goal in different cells",
            ),
        ];
        for (map, expected) in cases {
            assert_eq!(refused(&map), expected);
        }
    }
}
