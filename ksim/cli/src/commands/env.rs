//! `ksim env`: which environments there are, and what one is like.

use anyhow::Result;
use clap::{Args, Subcommand};
use ksim_envs::maze::{Maze, Tile};
use ksim_envs::registry::{self, EnvironmentInfo, EnvironmentRequest};
use ksim_envs::{EnvironmentError, EnvironmentSpec, Part};
use serde_json::{Value, json};

use crate::outcome::CommandOutcome;
use crate::output::{self, OutputFormat};
use crate::table;

/// Name and version of the schema of `ksim env list --format json`.
const LIST_SCHEMA: &str = "ksim.env-list/1";
/// Name and version of the schema of `ksim env info --format json`.
const INFO_SCHEMA: &str = "ksim.env-info/1";

/// Show the environments that policies can be played in
#[derive(Debug, Clone, Args)]
pub(crate) struct EnvArgs {
    #[command(subcommand)]
    command: EnvCommand,
}

#[derive(Debug, Clone, Subcommand)]
enum EnvCommand {
    /// List all environments, and whether this build can run them
    List {
        /// How to print the list
        #[arg(long, value_enum, default_value_t = OutputFormat::Text)]
        format: OutputFormat,
    },
    /// Describe an environment: observation, action, time limit, reference scores, maze
    Info {
        /// Its id, such as AntMaze_Large-v4
        #[arg(value_name = "ID")]
        id: String,
        /// How to print the description
        #[arg(long, value_enum, default_value_t = OutputFormat::Text)]
        format: OutputFormat,
    },
}

/// Runs the subcommand.
pub(crate) fn run(args: &EnvArgs) -> Result<CommandOutcome> {
    match &args.command {
        EnvCommand::List { format } => list(*format)?,
        EnvCommand::Info { id, format } => info(id, *format)?,
    }
    Ok(CommandOutcome::Done)
}

/// Whether this build can make it.
fn runs_here(info: &EnvironmentInfo) -> bool {
    cfg!(feature = "mujoco") || !info.needs_mujoco
}

fn list(format: OutputFormat) -> Result<()> {
    let all: Vec<EnvironmentInfo> = registry::all().collect();
    if format == OutputFormat::Json {
        let environments = all.iter().map(|info| {
            json!({
                "id": info.id,
                "description": info.description,
                "max_episode_steps": info.max_episode_steps,
                "runs_here": runs_here(info),
            })
        });
        let environments: Vec<Value> = environments.collect();
        return output::json(&json!({ "schema": LIST_SCHEMA, "environments": environments }));
    }
    let header = ["environment", "steps", "runs here", "what"].map(str::to_owned);
    let rows = all.iter().map(|info| {
        let runs = if runs_here(info) { "yes" } else { "no" };
        vec![
            info.id.clone(),
            info.max_episode_steps.to_string(),
            runs.to_owned(),
            info.description.clone(),
        ]
    });
    let rows: Vec<_> = [header.to_vec()].into_iter().chain(rows).collect();
    let mut text = table::align(&rows);
    if !all.iter().all(runs_here) {
        text += "\nWhat does not run here needs MuJoCo: build ksim with `--features mujoco`.\n";
    }
    output::text(&text)
}

fn info(id: &str, format: OutputFormat) -> Result<()> {
    let info = registry::find(id)?;
    let spec = match registry::make(&EnvironmentRequest::of_id(&info.id)) {
        Ok(environment) => Some(environment.spec().clone()),
        Err(EnvironmentError::MissingFeature { .. }) => None,
        Err(error) => return Err(error.into()),
    };
    let maze = info
        .kwargs
        .get("maze_map")
        .map(Maze::from_json)
        .transpose()?;
    match format {
        OutputFormat::Text => output::text(&info_text(&info, spec.as_ref(), maze.as_ref())),
        OutputFormat::Json => output::json(&info_json(&info, spec.as_ref())),
    }
}

fn info_json(info: &EnvironmentInfo, spec: Option<&EnvironmentSpec>) -> Value {
    let parts = |parts: &[Part]| -> Vec<Value> {
        let parts = parts.iter();
        parts
            .map(|part| json!({"name": part.name, "width": part.width}))
            .collect()
    };
    json!({
        "schema": INFO_SCHEMA,
        "id": info.id,
        "description": info.description,
        "max_episode_steps": info.max_episode_steps,
        "kwargs": info.kwargs,
        "reference": info.family.reference_scores().map(|(low, high)| [low, high]),
        "runs_here": runs_here(info),
        "observation": spec.map(|spec| parts(&spec.observation)),
        "action_low": spec.map(|spec| &spec.action_low),
        "action_high": spec.map(|spec| &spec.action_high),
        "info": spec.map(|spec| parts(&spec.info)),
        "dt_s": spec.map(|spec| spec.dt_s),
        "reports_success": spec.map(|spec| spec.reports_success),
    })
}

fn info_text(
    info: &EnvironmentInfo,
    spec: Option<&EnvironmentSpec>,
    maze: Option<&Maze>,
) -> String {
    let reference = match info.family.reference_scores() {
        Some((low, high)) => format!("returns of {low} and {high} count as 0 and 1 (D4RL's)"),
        None => "none; datasets may record some".to_owned(),
    };
    let mut rows = vec![
        ("environment", info.id.clone()),
        ("what", info.description.clone()),
        ("time limit", format!("{} steps", info.max_episode_steps)),
        ("reference scores", reference),
    ];
    match spec {
        Some(spec) => rows.extend([
            ("observation", parts(&spec.observation)),
            ("action", action(spec)),
            ("recorded state", parts(&spec.info)),
            ("control step", format!("{} s", spec.dt_s)),
        ]),
        None => rows.push((
            "runs here",
            "no: it needs MuJoCo, build ksim with `--features mujoco`".to_owned(),
        )),
    }
    let given = info.kwargs.iter().filter(|(name, _)| *name != "maze_map");
    let given: Vec<String> = given
        .map(|(name, value)| format!("{name}={value}"))
        .collect();
    let arguments = match given.as_slice() {
        [] => "those of Gymnasium's constructor (--env-arg)".to_owned(),
        given => format!(
            "{}, and those of Gymnasium's constructor (--env-arg)",
            given.join(" ")
        ),
    };
    if info.needs_mujoco {
        rows.push(("arguments", arguments));
    }
    let mut text = table::properties(&rows);
    if let Some(maze) = maze {
        text += "\n";
        text += &drawn(maze);
    }
    text
}

/// `achieved_goal 2 + observation 27`.
fn parts(parts: &[Part]) -> String {
    let one = |part: &Part| match part.name {
        "" => part.width.to_string(),
        name => format!("{name} {}", part.width),
    };
    let all: Vec<String> = parts.iter().map(one).collect();
    all.join(" + ")
}

fn action(spec: &EnvironmentSpec) -> String {
    let bounds = |bounds: &[f64]| match bounds.split_first() {
        Some((first, rest)) if rest.iter().all(|other| other == first) => first.to_string(),
        _ => format!("{bounds:?}"),
    };
    let (low, high) = (bounds(&spec.action_low), bounds(&spec.action_high));
    format!("{} numbers from {low} to {high}", spec.action_dim())
}

/// A maze as text, two characters for a cell so that it looks square.
fn drawn(maze: &Maze) -> String {
    let mut text = String::new();
    for row in 0..maze.n_rows() {
        let cells = (0..maze.n_columns()).map(|column| match maze.tile((row, column)) {
            Some(Tile::Wall) | None => "██",
            Some(Tile::Free) => "  ",
            Some(Tile::Start) => "r ",
            Some(Tile::Goal) => "g ",
            Some(Tile::Either) => "c ",
        });
        text.extend(cells);
        text.push('\n');
    }
    let marked = |tile| {
        (0..maze.n_rows()).any(|i| (0..maze.n_columns()).any(|j| maze.tile((i, j)) == Some(tile)))
    };
    let legend = [
        (Tile::Start, "r: starts are drawn here"),
        (Tile::Goal, "g: goals are drawn here"),
        (Tile::Either, "c: both are drawn here"),
    ];
    let legend: Vec<&str> = legend
        .into_iter()
        .filter(|(tile, _)| marked(*tile))
        .map(|(_, what)| what)
        .collect();
    match legend.as_slice() {
        [] => text += "starts and goals are drawn in all free cells\n",
        legend => text += &format!("{}\n", legend.join("; ")),
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mazes_are_drawn_from_the_top() {
        let maze = Maze::from_rows(&["1111", "1r01", "11g1", "1111"]).unwrap();
        assert_eq!(
            drawn(&maze),
            "████████\n██r   ██\n████g ██\n████████\nr: starts are drawn here; g: goals are drawn here\n"
        );
    }
}
