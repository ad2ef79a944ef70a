//! Where steps are drawn: in their maze, or in the main components of the states.

use std::path::PathBuf;

use anyhow::{Context as _, Result, anyhow, bail};
use ksim_bench_harness::page::{Density, Goals, Kept, Map, Places, Projection, Scored};
use ksim_datasets::DatasetSource;
use ksim_envs::maze::{CELL_SIZE_M, Maze, Tile};

use super::Request;
use crate::pairing::Listed;
use crate::positions::{self, Pair, Track};
use crate::scoring::{ScoredRollouts, Session};

/// Share of the dataset beyond the picture of a projection, on each side; the rollouts are always in it.
const BEYOND: f64 = 0.001;
/// Room around a projection.
const ROOM: f64 = 0.03;
/// Numbers are the same up to this share of them.
const SAME: f64 = 1e-9;
/// Height by width of a projection as drawn.
const RATIO: f64 = 0.72;

/// The map, and where all steps lie on it.
pub(super) struct Drawn {
    pub(super) map: Map,
    /// What a reader should know of it.
    pub(super) notes: Vec<String>,
    /// Per group and row.
    of: Vec<Vec<[f64; 2]>>,
    /// Per row of the dataset.
    of_reference: Vec<[f64; 2]>,
    /// Per group and episode.
    goals: Option<Vec<Vec<Vec<[f64; 2]>>>>,
}

/// Why nothing can be drawn in a maze.
pub(super) struct Fault {
    /// The file.
    path: PathBuf,
    what: String,
}

impl Fault {
    fn new(source: &dyn DatasetSource, what: String) -> Self {
        let path = source.info().path.clone();
        Self { path, what }
    }

    /// For whoever ran the command.
    pub(super) fn in_full(self) -> anyhow::Error {
        anyhow!("{}: {}", self.path.display(), self.what)
    }

    /// For the page, which others read.
    fn for_others(&self) -> String {
        format!("{}: {}", super::last_part(&self.path), self.what)
    }
}

/// [`positions::of`] beside a dataset.
pub(super) fn positions_of(
    source: &dyn DatasetSource,
    paired: (&dyn DatasetSource, Listed),
) -> Result<(Pair, Option<Pair>), Fault> {
    positions::of(source, Some(paired)).map_err(|what| Fault::new(source, what))
}

impl Drawn {
    /// Draws in the maze; where there is none, or positions are not known, projects the states.
    pub(super) fn new(
        request: &Request<'_>,
        (scored, kept): (&[Scored<'_>], &[Kept]),
        rollouts: &[ScoredRollouts],
    ) -> Result<Self> {
        let Some(maze) = &request.maze else {
            return Ok(projected(request.session, scored, kept));
        };
        match in_maze(maze, request, rollouts, kept)? {
            Ok(drawn) => Ok(drawn),
            Err(fault) if request.needs_positions => Err(fault.in_full()),
            Err(fault) => {
                let mut drawn = projected(request.session, scored, kept);
                drawn.notes.push(format!(
                    "The dataset has a maze, in which nothing is drawn. {}.",
                    fault.for_others()
                ));
                Ok(drawn)
            }
        }
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
    pub(super) fn goals(&self, group: usize) -> Option<Goals> {
        let episodes = &self.goals.as_ref()?[group];
        Some(Goals::new(episodes, [self.map.x, self.map.y]))
    }
}

fn in_maze(
    maze: &Maze,
    request: &Request<'_>,
    rollouts: &[ScoredRollouts],
    kept: &[Kept],
) -> Result<Result<Drawn, Fault>> {
    let session = request.session;
    let listed = Listed::new(&request.job.rollout_options, &request.job.dataset_options);
    let paired = (session.dataset(), listed);
    let read = |source: &dyn DatasetSource, by_planner: bool| {
        Ok::<_, anyhow::Error>(match positions_of(source, paired) {
            Ok((position, goal)) => {
                let tracks = positions::read(source, (&position, goal.as_ref()), by_planner);
                let path = || source.info().path.display().to_string();
                Ok((position.column, tracks.with_context(path)?))
            }
            Err(fault) => Err(fault),
        })
    };
    let mut by_file = Vec::with_capacity(session.files().len());
    for file in session.files() {
        match read(&*file.source, true)? {
            Ok(found) => by_file.push(found),
            Err(fault) => return Ok(Err(fault)),
        }
    }
    let (column, mut tracks) = match read(session.dataset(), false)? {
        Ok(found) => found,
        Err(fault) => return Ok(Err(fault)),
    };
    let reference = tracks.remove(&None).unwrap_or_default();
    let n_rows = session.ksim().n_reference_steps();
    let place = |row: usize| {
        let (episode, position) = session.ksim().reference_step(row as u32);
        (episode, session.reference_numbers().number(row, position))
    };
    if let Some(fault) = fault(
        session.dataset(),
        (&column, &reference.positions),
        n_rows,
        &place,
    )? {
        return Ok(Err(fault));
    }
    let mut drawn = Drawn {
        map: maze_map(maze, &reference.positions),
        notes: Vec::new(),
        of: Vec::with_capacity(rollouts.len()),
        of_reference: reference.positions,
        goals: None,
    };
    let mut goals = Vec::with_capacity(rollouts.len());
    let mut n_without = 0;
    for (one, kept) in rollouts.iter().zip(kept) {
        let source = &*session.files()[one.file].source;
        let (column, tracks) = &mut by_file[one.file];
        let track = tracks.remove(&one.steps.planner).unwrap_or_default();
        let place = |row: usize| step(one, row);
        let n_rows = one.steps.trajectories.n_rows();
        if let Some(fault) = fault(source, (column, &track.positions), n_rows, &place)? {
            return Ok(Err(fault));
        }
        let own = goals_of(&track, kept);
        let has_goals = !track.goals.is_empty();
        n_without += own
            .iter()
            .filter(|goals| has_goals && goals.is_empty())
            .count();
        goals.push(own);
        drawn.of.push(track.positions);
    }
    if n_without > 0 {
        drawn.notes.push(format!(
            "Goals are missing of {n_without} episodes: the files hold no finite numbers for them."
        ));
    }
    let any = goals.iter().flatten().any(|goals| !goals.is_empty());
    drawn.goals = any.then_some(goals);
    Ok(Ok(drawn))
}

/// Episode and step number of a row of rollouts.
fn step(one: &ScoredRollouts, row: usize) -> (i64, i64) {
    let mut episodes = one.steps.trajectories.episodes().iter();
    let episode = episodes.find(|episode| episode.rows.contains(&row));
    episode.map_or((0, row as i64), |episode| {
        let number = one.steps.number(row, row - episode.rows.start);
        (episode.episode_index, number)
    })
}

/// A step without a position, if there is one.
fn fault(
    source: &dyn DatasetSource,
    (column, positions): (&str, &[[f64; 2]]),
    n_rows: usize,
    place: &dyn Fn(usize) -> (i64, i64),
) -> Result<Option<Fault>> {
    if positions.len() != n_rows {
        bail!(
            "{}: column \"{column}\" has {} steps, expected {n_rows} as in the states",
            source.info().path.display(),
            positions.len()
        );
    }
    let is_missing = |at: &[f64; 2]| at.iter().any(|value| !value.is_finite());
    Ok(positions.iter().position(is_missing).map(|row| {
        let (episode, number) = place(row);
        let what = format!(
            "episode {episode}, step {number}: column \"{column}\" holds {:?}, expected finite positions",
            positions[row]
        );
        Fault::new(source, what)
    }))
}

/// The goals of every episode in the order in which it had them: those of the steps on the page, which are as many
/// at most.
fn goals_of(track: &Track, kept: &Kept) -> Vec<Vec<[f64; 2]>> {
    let of_episode = |rows: &[usize]| {
        let goals = rows.iter().filter_map(|row| track.goals.get(*row).copied());
        let mut goals: Vec<[f64; 2]> = goals
            .filter(|goal| goal.iter().all(|value| value.is_finite()))
            .collect();
        goals.dedup();
        goals
    };
    kept.by_episode().map(of_episode).collect()
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
        notes: vec![format!(
            "The picture of states leaves out the outermost {} % of the dataset on each side.",
            100.0 * BEYOND
        )],
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
    // States that are the same but for rounding have no range of their own.
    match high - low > SAME * low.abs().max(high.abs()) {
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
        let [low, high] = range(vec![3.0; 4], [3.0f64.next_up()].into_iter());
        assert!(low <= 2.0 && high >= 4.0, "{low} {high}");
    }
}
