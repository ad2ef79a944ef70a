//! Mazes of square cells: maps, coordinates, where goals and starts are drawn, and shortest paths.
//!
//! Rules and numbers are those of gymnasium-robotics' maze environments, version 4, at the scale of AntMaze. Rows count
//! from 0 at the top, columns from 0 at the left; x grows with the column, y against the row, and the origin is the
//! center of the maze.

mod maps;
mod parse;
mod path;
mod variant;

use crate::error::EnvironmentError;
use crate::numpy_rng::Generator;

pub use parse::MazeError;
pub(crate) use variant::Variant;

/// Row and column of a cell.
pub type Cell = (usize, usize);

/// Side of a cell, in meters.
pub const CELL_SIZE_M: f64 = 4.0;
/// Height of the walls, in meters.
pub const WALL_HEIGHT_M: f64 = 2.0;
/// A goal is reached within this distance, in meters.
pub const GOAL_RADIUS_M: f64 = 0.45;

/// Goals and starts lie up to this far from their cell's center along x and y, in sides of a cell.
const NOISE: f64 = 0.25;
/// A start is drawn again if its cell's center is this close to the goal, in sides of a cell.
const TOO_CLOSE: f64 = 0.5;

/// What a cell is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Tile {
    /// `1`: a wall.
    Wall,
    /// `0`: free.
    Free,
    /// `r`: starts are drawn here.
    Start,
    /// `g`: goals are drawn here.
    Goal,
    /// `c`: starts and goals are drawn here.
    Either,
}

/// A map and where its goals and starts are drawn.
///
/// ```
/// use ksim_envs::maze::Maze;
///
/// let maze = Maze::published("UMaze").expect("a published name");
/// assert_eq!(maze.center((1, 1)), [-4.0, 4.0]);
/// assert_eq!(maze.shortest_path((1, 1), (3, 1)).map(|path| path.len()), Some(7));
/// ```
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Maze {
    tiles: Vec<Vec<Tile>>,
    goals: Vec<Cell>,
    starts: Vec<Cell>,
}

impl Maze {
    /// Names of the published maps: what stands between `AntMaze_` and the version in an id.
    pub fn names() -> impl Iterator<Item = &'static str> {
        maps::PUBLISHED.iter().map(|(name, _)| *name)
    }

    /// The published map of this name, such as `Medium_Diverse_GR`.
    pub fn published(name: &str) -> Option<Self> {
        Self::named(&maps::PUBLISHED, name)
    }

    /// The map with one start and one goal on which Minari evaluates policies of `UMaze`, `Medium` or `Large`.
    pub fn evaluation(size: &str) -> Option<Self> {
        Self::named(&maps::EVALUATION, size)
    }

    fn named(maps: &[maps::Map], name: &str) -> Option<Self> {
        let (_, rows) = maps.iter().find(|(known, _)| *known == name)?;
        Some(Self::from_rows(rows).expect("a map of ours is one, which a test checks"))
    }

    /// Goals and starts of checked tiles: marked cells; all free cells for what has no mark; `c` cells are both, and
    /// come last. Otherwise row by row.
    fn with_tiles(tiles: Vec<Vec<Tile>>) -> Self {
        let mut maze = Self {
            tiles,
            goals: Vec::new(),
            starts: Vec::new(),
        };
        let either = maze.cells_of(Tile::Either);
        maze.goals = maze.cells_of(Tile::Goal);
        maze.starts = maze.cells_of(Tile::Start);
        if either.is_empty() {
            let free = maze.cells_of(Tile::Free);
            let unmarked = (maze.goals.is_empty(), maze.starts.is_empty());
            if unmarked.0 {
                maze.goals.clone_from(&free);
            }
            if unmarked.1 {
                maze.starts = free;
            }
        }
        maze.goals.extend(&either);
        maze.starts.extend(&either);
        maze
    }

    /// Cells of one kind, row by row.
    fn cells_of(&self, tile: Tile) -> Vec<Cell> {
        let cells = (0..self.n_rows()).flat_map(|i| (0..self.n_columns()).map(move |j| (i, j)));
        cells
            .filter(|&cell| self.tile(cell) == Some(tile))
            .collect()
    }

    /// Number of rows.
    pub fn n_rows(&self) -> usize {
        self.tiles.len()
    }

    /// Number of columns.
    pub fn n_columns(&self) -> usize {
        self.tiles[0].len()
    }

    /// What a cell is; `None` outside.
    pub fn tile(&self, (row, column): Cell) -> Option<Tile> {
        self.tiles.get(row)?.get(column).copied()
    }

    /// Cells in which goals are drawn, each as likely as another.
    pub fn goals(&self) -> &[Cell] {
        &self.goals
    }

    /// Cells in which starts are drawn.
    pub fn starts(&self) -> &[Cell] {
        &self.starts
    }

    /// Wall cells, row by row.
    pub fn walls(&self) -> Vec<Cell> {
        self.cells_of(Tile::Wall)
    }

    /// Center of a cell (x, y), in meters.
    pub fn center(&self, (row, column): Cell) -> [f64; 2] {
        let [half_width, half_height] = self.half_size();
        [
            (column as f64 + 0.5) * CELL_SIZE_M - half_width,
            half_height - (row as f64 + 0.5) * CELL_SIZE_M,
        ]
    }

    /// The cell that a place (x, y) lies in; `None` outside.
    pub fn cell_at(&self, [x, y]: [f64; 2]) -> Option<Cell> {
        let [half_width, half_height] = self.half_size();
        let row = ((half_height - y) / CELL_SIZE_M).floor();
        let column = ((x + half_width) / CELL_SIZE_M).floor();
        let inside = |at: f64, n: usize| (at >= 0.0 && at < n as f64).then_some(at as usize);
        Some((
            inside(row, self.n_rows())?,
            inside(column, self.n_columns())?,
        ))
    }

    /// Half of the maze along x and y, in meters.
    fn half_size(&self) -> [f64; 2] {
        [self.n_columns(), self.n_rows()].map(|n| n as f64 / 2.0 * CELL_SIZE_M)
    }

    /// Draws a goal (x, y): a cell, then noise along x, then along y.
    pub fn draw_goal(&self, generator: &mut Generator) -> [f64; 2] {
        let cell = draw(&self.goals, generator);
        self.near(cell, generator)
    }

    /// Draws a goal that is farther than [`GOAL_RADIUS_M`] from where the robot is. `None`, and no draw, if there is
    /// only one cell for goals.
    pub fn draw_next_goal(&self, from: [f64; 2], generator: &mut Generator) -> Option<[f64; 2]> {
        if self.goals.len() < 2 {
            return None;
        }
        loop {
            let goal = self.draw_goal(generator);
            if distance(from, goal) > GOAL_RADIUS_M {
                return Some(goal);
            }
        }
    }

    /// Draws the goal and the start of an episode, in this order. A given cell replaces the draw of a cell, not that of
    /// the noise; a given start may lie close to the goal.
    ///
    /// # Errors
    /// A given cell that is a wall or outside, or a goal's cell that leaves no cell to start from.
    pub fn draw_episode(
        &self,
        goal_cell: Option<Cell>,
        start_cell: Option<Cell>,
        generator: &mut Generator,
    ) -> Result<Layout, EnvironmentError> {
        for cell in [goal_cell, start_cell].into_iter().flatten() {
            self.check_free(cell)?;
        }
        if let (Some(goal), None) = (goal_cell, start_cell)
            && self.starts == [goal]
        {
            let expected = "a goal elsewhere than the only start, or a start of its own";
            return Err(bad_cell(goal, expected, "the only start"));
        }
        let goal = match goal_cell {
            Some(cell) => self.near(cell, generator),
            None => self.draw_goal(generator),
        };
        let start_cell = start_cell.unwrap_or_else(|| {
            loop {
                let cell = draw(&self.starts, generator);
                if distance(self.center(cell), goal) > TOO_CLOSE * CELL_SIZE_M {
                    break cell;
                }
            }
        });
        let start = self.near(start_cell, generator);
        Ok(Layout { goal, start })
    }

    fn check_free(&self, cell: Cell) -> Result<(), EnvironmentError> {
        match self.tile(cell) {
            Some(Tile::Wall) => Err(bad_cell(cell, "a cell without wall", "a wall")),
            Some(_) => Ok(()),
            None => {
                let expected = format!("one of {} × {} cells", self.n_rows(), self.n_columns());
                Err(bad_cell(cell, &expected, "a place outside the maze"))
            }
        }
    }

    /// A place in a cell: its center with noise, x drawn first.
    fn near(&self, cell: Cell, generator: &mut Generator) -> [f64; 2] {
        (self.center(cell)).map(|center| center + generator.uniform(-NOISE, NOISE) * CELL_SIZE_M)
    }
}

/// Where an episode begins and where it should lead, as (x, y) in meters.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Layout {
    /// The goal.
    pub goal: [f64; 2],
    /// The robot's first place.
    pub start: [f64; 2],
}

/// Distance of two places.
pub fn distance(a: [f64; 2], b: [f64; 2]) -> f64 {
    // Not `hypot`, which rounds otherwise than the published square root of a sum.
    let (dx, dy) = (a[0] - b[0], a[1] - b[1]);
    (dx * dx + dy * dy).sqrt()
}

fn draw(cells: &[Cell], generator: &mut Generator) -> Cell {
    cells[generator.integers(cells.len() as u64) as usize]
}

fn bad_cell((row, column): Cell, expected: &str, found: &str) -> EnvironmentError {
    EnvironmentError::Cell {
        row,
        column,
        expected: expected.to_owned(),
        found: found.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn maze(rows: &[&str]) -> Maze {
        Maze::from_rows(rows).expect("a maze")
    }

    #[test]
    fn every_published_map_is_a_maze_with_a_wall_around() {
        assert_eq!(Maze::names().count(), 10);
        for name in Maze::names() {
            let maze = Maze::published(name).expect("published");
            let goal = maze.goals()[0];
            let start = *maze.starts().last().expect("a start");
            assert!(maze.shortest_path(start, goal).is_some(), "{name}");
        }
        for size in ["UMaze", "Medium", "Large"] {
            let maze = Maze::evaluation(size).expect("known");
            assert_eq!((maze.goals().len(), maze.starts().len()), (1, 1), "{size}");
        }
        assert_eq!(Maze::published("Small"), None);
    }

    #[test]
    fn what_is_unmarked_falls_back_to_free_cells_unless_a_cell_is_for_both() {
        let goals_only = maze(&["11111", "1g001", "11111"]);
        assert_eq!(goals_only.starts(), [(1, 2), (1, 3)]);
        let starts_only = maze(&["11111", "10r01", "11111"]);
        assert_eq!(starts_only.goals(), [(1, 1), (1, 3)]);
        let with_both = maze(&["11111", "1c0g1", "1c001", "11111"]);
        assert_eq!(with_both.starts(), [(1, 1), (2, 1)]);
        assert_eq!(with_both.goals(), [(1, 3), (1, 1), (2, 1)]);
    }

    #[test]
    fn places_outside_lie_in_no_cell() {
        let maze = maze(&["1111", "1001", "1111"]);
        assert_eq!(maze.cell_at([-7.9, 5.9]), Some((0, 0)));
        assert_eq!(maze.cell_at([-8.1, 0.0]), None);
        assert_eq!(maze.cell_at([0.0, -6.1]), None);
        assert_eq!(maze.cell_at([f64::NAN, 0.0]), None);
    }

    #[test]
    fn given_cells_are_kept_to_within_the_noise() {
        let maze = Maze::published("Large").expect("published");
        let mut generator = Generator::new(3);
        for _ in 0..100 {
            let layout = maze
                .draw_episode(Some((1, 1)), Some((1, 1)), &mut generator)
                .expect("free cells");
            assert_eq!(maze.cell_at(layout.goal), Some((1, 1)));
            let center = maze.center((1, 1));
            assert!((layout.start[0] - center[0]).abs() <= 1.0);
            assert!((layout.start[1] - center[1]).abs() <= 1.0);
        }
    }

    #[test]
    fn given_cells_and_next_goals_are_drawn_as_published() {
        // gymnasium-robotics 1.4.2: AntMaze_Medium_Diverse_GR-v4, reset(seed=7, options=…), then update_goal(goal).
        let maze = Maze::published("Medium_Diverse_GR").expect("published");
        for (goal_cell, start_cell, goal, start) in [
            (
                Some((1, 2)),
                Some((6, 5)),
                [-5.749809066790666, 10.794427601939152],
                [6.551371380490387, -10.549585620018817],
            ),
            (
                Some((1, 1)),
                None,
                [-9.749809066790666, 10.794427601939152],
                [-10.549585620018817, -6.39966743017755],
            ),
            (
                None,
                Some((6, 5)),
                [6.794427601939151, -9.448628619509613],
                [5.450414379981184, -10.39966743017755],
            ),
        ] {
            let drawn = maze.draw_episode(goal_cell, start_cell, &mut Generator::new(7));
            assert_eq!(drawn, Ok(Layout { goal, start }));
        }
        let mut generator = Generator::new(7);
        let layout = maze.draw_episode(None, None, &mut generator);
        let mut goal = layout.expect("free cells").goal;
        for next in [
            [9.01053060913115, 6.642456836765533],
            [6.594138857504093, -10.064130094312558],
            [5.556851224201546, -10.49026082469175],
        ] {
            goal = maze
                .draw_next_goal(goal, &mut generator)
                .expect("four cells");
            assert_eq!(goal, next);
        }
    }

    #[test]
    fn walls_places_outside_and_goals_without_a_start_are_refused() {
        let maze = maze(&["11111", "1r001", "11111"]);
        let mut generator = Generator::new(0);
        let mut refused = |goal, start| {
            let error = maze.draw_episode(goal, start, &mut generator);
            error.expect_err("refused").to_string()
        };
        assert_eq!(
            refused(Some((0, 1)), None),
            "cell (0, 1): expected a cell without wall, found a wall"
        );
        assert_eq!(
            refused(None, Some((1, 5))),
            "cell (1, 5): expected one of 3 × 5 cells, found a place outside the maze"
        );
        let error = refused(Some((1, 1)), None);
        assert!(error.contains("the only start"), "{error}");
    }

    #[test]
    fn the_next_goal_is_elsewhere_and_needs_a_second_cell() {
        let mut generator = Generator::new(0);
        let one = maze(&["11111", "1r0g1", "11111"]);
        assert_eq!(one.draw_next_goal([0.0; 2], &mut generator), None);
        let two = maze(&["11111", "1rgg1", "11111"]);
        for _ in 0..1000 {
            let from = two.draw_goal(&mut generator);
            let goal = two.draw_next_goal(from, &mut generator).expect("two cells");
            assert!(distance(from, goal) > GOAL_RADIUS_M);
        }
    }
}
