//! Where steps are drawn: in their maze, or in the main components of the states.

use anyhow::Result;
use ksim::Trajectories;
use ksim_bench_harness::page::{Density, Kept, Map, Places, Projection, Scored};
use ksim_datasets::DatasetSource;
use ksim_envs::maze::{CELL_SIZE_M, Maze, Tile};

use super::Request;
use crate::load::{self, Columns};
use crate::pairing::{self, Listed};
use crate::scoring::{ScoredRollouts, Session};

/// What the mazes of Gymnasium Robotics observe.
const POSITION: &str = "achieved_goal";
const POSITION_AND_GOAL: &str = "achieved_goal,desired_goal";
/// Share of the dataset beyond the picture of a projection, on each side; the rollouts are always in it.
const BEYOND: f64 = 0.001;
/// Room around a projection.
const ROOM: f64 = 0.03;
/// Height by width of a projection as drawn.
const RATIO: f64 = 0.72;

/// The map, and where all steps lie on it.
pub(super) struct Drawn {
    pub(super) map: Map,
    /// What a reader should know of it.
    pub(super) note: Option<String>,
    /// Per group and row.
    of: Vec<Vec<[f64; 2]>>,
    /// Per row of the dataset.
    of_reference: Vec<[f64; 2]>,
    goals: Option<Vec<Vec<Vec<[f64; 2]>>>>,
}

impl Drawn {
    /// Finds the maze of the dataset and the positions in it; where there are none, projects the states.
    pub(super) fn new(
        request: &Request<'_>,
        (scored, kept): (&[Scored<'_>], &[Kept]),
        rollouts: &[ScoredRollouts],
    ) -> Result<Self> {
        if let Some(maze) = &request.maze
            && let Some(drawn) = in_maze(maze, request, rollouts)?
        {
            return Ok(drawn);
        }
        Ok(projected(request.session, scored, kept))
    }

    /// Where the steps of a group lie.
    pub(super) fn places(&self, group: usize) -> Places<'_> {
        Places {
            of: &self.of[group],
            of_reference: &self.of_reference,
            ranges: [self.map.x, self.map.y],
        }
    }

    /// Goals of the episodes of a group.
    pub(super) fn goals(&self, group: usize) -> Option<Vec<Vec<[f64; 2]>>> {
        Some(self.goals.as_ref()?[group].clone())
    }
}

/// The columns of a position, and of a goal where there is one.
fn position_columns(dataset: &dyn DatasetSource) -> Option<Columns> {
    let wanted = [(POSITION_AND_GOAL, 4), (POSITION, 2)];
    wanted.into_iter().find_map(|(selection, width)| {
        let columns = Columns::select(dataset, Some(selection)).ok()?;
        (columns.indices.len() == width).then_some(columns)
    })
}

/// `None` where positions are not known.
fn in_maze(
    maze: &Maze,
    request: &Request<'_>,
    rollouts: &[ScoredRollouts],
) -> Result<Option<Drawn>> {
    let Request {
        job,
        session,
        context,
        ..
    } = request;
    let Some(columns) = position_columns(session.dataset()) else {
        return Ok(None);
    };
    let listed = Listed::new(&job.rollout_options, &job.dataset_options);
    let mut by_file = Vec::with_capacity(session.files().len());
    for file in session.files() {
        let own = pairing::columns_of(&*file.source, session.dataset(), &columns, listed);
        let Ok(own) = own else {
            return Ok(None); // scored by other columns than these
        };
        by_file.push(load::rollouts(&*file.source, &own, context)?);
    }
    let (reference, _) = load::dataset(session.dataset(), &columns, context)?.into_parts();
    let trajectories = |one: &ScoredRollouts| &by_file[one.file][one.group].trajectories;
    let of_reference = points(&reference, 0);
    let map = maze_map(maze, &of_reference);
    let has_goals = columns.indices.len() == 4;
    Ok(Some(Drawn {
        map,
        note: None,
        of: rollouts
            .iter()
            .map(|one| points(trajectories(one), 0))
            .collect(),
        of_reference,
        goals: has_goals.then(|| {
            rollouts
                .iter()
                .map(|one| goals(trajectories(one)))
                .collect()
        }),
    }))
}

/// Two columns of all rows.
fn points(trajectories: &Trajectories, first: usize) -> Vec<[f64; 2]> {
    let states = trajectories.states();
    (0..states.n_rows())
        .map(|row| [states.value(row, first), states.value(row, first + 1)])
        .collect()
}

/// The goals of every episode that has steps, in the order in which it had them.
fn goals(trajectories: &Trajectories) -> Vec<Vec<[f64; 2]>> {
    let all = points(trajectories, 2);
    let episodes = trajectories.episodes().iter();
    let episodes = episodes.filter(|episode| !episode.rows.is_empty());
    episodes
        .map(|episode| {
            let mut goals = all[episode.rows.clone()].to_vec();
            goals.dedup();
            goals
        })
        .collect()
}

fn maze_map(maze: &Maze, of_reference: &[[f64; 2]]) -> Map {
    let half = [maze.n_columns(), maze.n_rows()].map(|n| n as f64 * CELL_SIZE_M / 2.0);
    let ranges = half.map(|half| [-half, half]);
    let row = |row: usize| -> String {
        let tile = |column| maze.tile((row, column));
        let columns = 0..maze.n_columns();
        columns
            .map(|column| match tile(column) {
                Some(Tile::Wall) => '1',
                _ => '0',
            })
            .collect()
    };
    Map {
        kind: "maze",
        rows: (0..maze.n_rows()).map(row).collect(),
        cell: CELL_SIZE_M,
        x: ranges[0],
        y: ranges[1],
        labels: ["x (m)", "y (m)"].map(str::to_owned),
        explained: String::new(),
        density: Density::new(of_reference.iter().copied(), ranges, half[1] / half[0]),
    }
}

/// States in the two main components of the dataset's.
fn projected(session: &Session, scored: &[Scored<'_>], kept: &[Kept]) -> Drawn {
    let reference = session.ksim().reference();
    let projection = Projection::new(reference);
    let states = reference.states();
    let mut row = vec![0.0; states.n_features()];
    let mut of_reference = Vec::with_capacity(states.n_rows());
    for number in 0..states.n_rows() {
        states.read_row(number, &mut row);
        of_reference.push(projection.place(&row));
    }
    let (normalizer, _) = reference.normalizers();
    let mut place = |one: &Scored<'_>, number: usize| {
        one.trajectories.states().read_row(number, &mut row);
        for (column, value) in row.iter_mut().enumerate() {
            *value = normalizer.normalize(column, *value);
        }
        projection.place(&row)
    };
    let of: Vec<Vec<[f64; 2]>> = scored
        .iter()
        .map(|one| {
            let rows = 0..one.trajectories.n_rows();
            rows.map(|number| place(one, number)).collect()
        })
        .collect();
    let shown = || {
        scored.iter().enumerate().flat_map(|(group, one)| {
            let (of, of_reference) = (&of[group], &of_reference);
            kept[group].rows().iter().flat_map(move |row| {
                let matched = one.report.steps[*row].reference_row as usize;
                [of[*row], of_reference[matched]]
            })
        })
    };
    let ranges = [0, 1].map(|axis| {
        let all = of_reference.iter().map(|point| point[axis]).collect();
        range(all, shown().map(|point| point[axis]))
    });
    Drawn {
        map: Map {
            kind: "projection",
            rows: Vec::new(),
            cell: 0.0,
            x: ranges[0],
            y: ranges[1],
            labels: projection.labels(),
            explained: projection.explain(session.state_names()),
            density: Density::new(of_reference.iter().copied(), ranges, RATIO),
        },
        note: Some(format!(
            "The picture of states leaves out the outermost {} % of the dataset on each side.",
            100.0 * BEYOND
        )),
        of,
        of_reference,
        goals: None,
    }
}

/// All that is shown, most of the dataset, and some room.
fn range(mut all: Vec<f64>, shown: impl Iterator<Item = f64>) -> [f64; 2] {
    all.sort_by(f64::total_cmp);
    let last = all.len().saturating_sub(1);
    let beyond = (BEYOND * last as f64) as usize;
    let ends = [all.get(beyond), all.get(last - beyond)];
    let ends = ends.into_iter().flatten().copied();
    let (low, high) = ends
        .chain(shown)
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| {
            (low.min(value), high.max(value))
        });
    match high > low {
        true => [low - ROOM * (high - low), high + ROOM * (high - low)],
        false => [low - 1.0, low + 1.0],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_range_holds_what_is_shown_and_leaves_out_outliers_of_the_dataset() {
        let mut all: Vec<f64> = (0..2000).map(f64::from).collect();
        all.push(1e9);
        let [low, high] = range(all, [-50.0].into_iter());
        assert!((-120.0..-50.0).contains(&low) && (1990.0..2100.0).contains(&high));
        assert_eq!(range(vec![3.0; 4], [3.0].into_iter()), [2.0, 4.0]);
    }
}
