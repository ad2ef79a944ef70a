//! Mazes: a box for every wall, and the goal's mark.

use super::numbers;
use crate::maze::{CELL_SIZE_M, Maze, WALL_HEIGHT_M};

/// Radius of the goal's mark, in m. It is only to look at, and stays at the origin: what moves does not depend on it.
const MARK_RADIUS_M: f64 = 0.8;

/// What a maze adds to a robot's world, in the published order.
pub(crate) fn world(maze: &Maze) -> String {
    let half_side = CELL_SIZE_M / 2.0;
    let half_height = WALL_HEIGHT_M / 2.0;
    let size = numbers([half_side, half_side, half_height]);
    let wall = |(row, column)| {
        let [x, y] = maze.center((row, column));
        let pos = numbers([x, y, half_height]);
        format!(
            r#"<geom name="block_{row}_{column}" type="box" pos="{pos}" size="{size}" contype="1" conaffinity="1"
            rgba="0.7 0.5 0.3 1"/>
        "#
        )
    };
    let walls: String = maze.walls().into_iter().map(wall).collect();
    let pos = numbers([0.0, 0.0, half_height]);
    format!(
        r#"{walls}<site name="target" type="sphere" pos="{pos}" size="{MARK_RADIUS_M}" rgba="1 0 0 0.7"/>"#
    )
}
