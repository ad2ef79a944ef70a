//! `ksim train`: a planner from a dataset.

use std::fs::File;
use std::io::{BufRead as _, BufReader, IsTerminal as _};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result, bail};
use clap::Args;
use ksim_bench_harness::figure::curve::{Across, Curve, Point, Scale, draw};
use ksim_datasets::OpenOptions;
use ksim_planners::{
    Registry, TrainControl, TrainObserver, TrainProgress, TrainRequest, TrainSummary,
};
use serde_json::{Map, Value};

use crate::atomic;
use crate::context::{Context, Progress};
use crate::data_args;
use crate::outcome::CommandOutcome;
use crate::output;
use crate::table;

/// Losses that a run records, and the figure that is made of them.
const LOSSES: &str = "losses.csv";
const FIGURE: &str = "losses.svg";

/// Train a planner on a dataset
///
/// Writes a run folder that `ksim rollout --planner` plays. Checkpoints are written on the way; after Ctrl-C, one more,
/// and the same command with --resume goes on from it with the numbers it would have had without the break.
#[derive(Debug, Clone, Args)]
pub(crate) struct TrainArgs {
    /// What to train: diffuser, rediffuser, curiosity-diffuser, … (see `ksim planner list`)
    #[arg(value_name = "PLANNER")]
    planner: String,
    /// The dataset: a file, a folder, or a name such as hopper-medium-expert-v2
    #[arg(long, value_name = "NAME|PATH")]
    dataset: String,
    /// The run folder
    #[arg(short, long, value_name = "RUN")]
    output: PathBuf,
    /// Named settings (see `ksim planner list`) [default: by the dataset]
    #[arg(long, value_name = "NAME")]
    preset: Option<String>,
    /// A setting in place of the preset's, by its name in the run's manifest.json, such as diffusion.n_updates=20000
    #[arg(long = "set", value_name = "KEY=VALUE", value_parser = setting)]
    settings: Vec<(String, Value)>,
    /// Go on with the run in the folder
    #[arg(long)]
    resume: bool,
    /// A finished run on the same dataset whose networks are taken over: a Diffuser for the other two planners
    #[arg(long, value_name = "RUN")]
    base: Option<PathBuf>,
    /// Seed of weights, batches and noise
    #[arg(long, value_name = "S", default_value_t = 0)]
    seed: u64,
    /// Who computes the networks: native or torch [default: the first that this build has]
    #[arg(long, value_name = "NAME")]
    backend: Option<String>,
    /// Where: cpu or cuda
    #[arg(long, value_name = "DEVICE")]
    device: Option<String>,
    /// Updates between two checkpoints [default: the preset's]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    checkpoint_interval: Option<u64>,
}

/// A name and its value, which is text where it is no JSON.
fn setting(text: &str) -> Result<(String, Value)> {
    let (name, value) = text.split_once('=').context("expected KEY=VALUE")?;
    if name.split('.').any(str::is_empty) {
        bail!("expected KEY=VALUE with a name such as diffusion.n_updates");
    }
    let value = serde_json::from_str(value).unwrap_or_else(|_| Value::from(value));
    Ok((name.to_owned(), value))
}

/// Settings as nested tables.
fn nested(settings: &[(String, Value)]) -> Result<Map<String, Value>> {
    let mut tables = Map::new();
    for (name, value) in settings {
        let mut table = &mut tables;
        let mut parts = name.split('.').peekable();
        while let Some(part) = parts.next() {
            if parts.peek().is_none() {
                if table.insert(part.to_owned(), value.clone()).is_some() {
                    bail!("--set {name} is given twice");
                }
                break;
            }
            let inner = table
                .entry(part)
                .or_insert_with(|| Value::Object(Map::new()));
            let Value::Object(inner) = inner else {
                bail!("--set {name}: {part} is set to a value as well");
            };
            table = inner;
        }
    }
    Ok(tables)
}

/// Trains.
pub(crate) fn run(args: &TrainArgs, context: &Context) -> Result<CommandOutcome> {
    let registry = Registry::builtin();
    let family = registry.family(&args.planner)?;
    let request = TrainRequest {
        preset: args.preset.clone(),
        overrides: nested(&args.settings)?,
        seed: args.seed,
        backend: args.backend.clone(),
        device: args.device.clone(),
        n_threads: Some(context.threads()),
        base: args.base.clone(),
        resume: args.resume,
        checkpoint_interval: args.checkpoint_interval,
    };
    let (_, source) = data_args::open(&args.dataset, &OpenOptions::default())?;
    for warning in &source.info().warnings {
        context.warn(&format!("{}: {warning}", source.info().path.display()));
    }
    let _cooperative = atomic::Cooperative::begin();
    let mut watcher = Watcher::new(&args.planner, context);
    let summary = family.train(&request, &*source, &args.output, &mut watcher)?;
    drop(watcher);
    let figure = draw_losses(&args.output)?;
    output::text(&report(args, &summary, figure.as_deref()))?;
    Ok(CommandOutcome::of([source.info()]))
}

/// What came of it.
fn report(args: &TrainArgs, summary: &TrainSummary, figure: Option<&Path>) -> String {
    let run = args.output.display();
    let updates = match summary.finished {
        true if summary.total_updates == 0 => "none needed".to_owned(),
        true => format!("all {} done", summary.total_updates),
        false => format!("{} of {} done", summary.total_update, summary.total_updates),
    };
    let mut rows = vec![
        ("planner", args.planner.clone()),
        ("run", run.to_string()),
        ("seed", args.seed.to_string()),
        ("updates", updates),
    ];
    let losses: Vec<(String, f64)> = summary.final_losses.clone();
    let named: Vec<(String, String)> = losses
        .into_iter()
        .map(|(name, loss)| (format!("loss of {name}"), table::decimals(loss)))
        .collect();
    rows.extend(
        named
            .iter()
            .map(|(name, loss)| (name.as_str(), loss.clone())),
    );
    if let Some(figure) = figure {
        rows.push(("loss curve", figure.display().to_string()));
    }
    let next = match summary.finished {
        true => format!(
            "ksim rollout --planner {run} --dataset {} --episodes 20",
            args.dataset
        ),
        false => "the same command with --resume goes on from here".to_owned(),
    };
    rows.push(("next", next));
    table::properties(&rows)
}

/// Shows how far it is.
struct Watcher<'a> {
    context: &'a Context,
    planner: &'a str,
    progress: Option<Progress>,
    /// When and where this session began.
    started: Option<(Instant, u64)>,
    told: Instant,
    /// Moving average of the loss of the phase.
    phase: String,
    loss: f64,
    is_terminal: bool,
}

impl<'a> Watcher<'a> {
    fn new(planner: &'a str, context: &'a Context) -> Self {
        Self {
            context,
            planner,
            progress: None,
            started: None,
            told: Instant::now(),
            phase: String::new(),
            loss: 0.0,
            is_terminal: std::io::stderr().is_terminal(),
        }
    }

    /// Updates per second in this session, once there are some.
    fn rate(&self, total_update: u64) -> Option<f64> {
        let (started, first) = self.started?;
        let n_updates = total_update.saturating_sub(first);
        let elapsed_s = started.elapsed().as_secs_f64();
        (n_updates > 0 && elapsed_s > 0.0).then(|| n_updates as f64 / elapsed_s)
    }
}

impl TrainObserver for Watcher<'_> {
    fn progress(&mut self, progress: &TrainProgress<'_>) -> TrainControl {
        /// Share of the newest loss in what is shown.
        const NEWEST: f64 = 0.02;
        if self.phase == progress.phase {
            self.loss += NEWEST * (progress.loss - self.loss);
        } else {
            self.phase = progress.phase.to_owned();
            self.loss = progress.loss;
        }
        let total = progress.total_updates;
        if self.progress.is_none() {
            let bar = self
                .context
                .bar(self.planner.to_owned(), total, "updates, ETA");
            self.progress = Some(bar);
            self.started = Some((Instant::now(), progress.total_update));
        }
        if self.told.elapsed() > Duration::from_millis(200) {
            self.told = Instant::now();
            let rate = self.rate(progress.total_update);
            let rate = rate.map_or(String::new(), |rate| format!(", {rate:.1} updates/s"));
            let what = format!(
                "{}, {}: loss {}{rate}",
                self.planner,
                progress.phase,
                table::decimals(self.loss)
            );
            if let Some(bar) = &self.progress {
                bar.say(what);
                bar.set(progress.total_update);
            }
        }
        match atomic::is_interrupted() {
            true => TrainControl::Stop,
            false => TrainControl::Continue,
        }
    }

    fn preparing(&mut self, what: &str, done: u64, of: u64) -> TrainControl {
        if let Some(bar) = &self.progress {
            bar.say(format!("{}: {what}, {done} of {of}", self.planner));
        }
        match atomic::is_interrupted() {
            true => TrainControl::Stop,
            false => TrainControl::Continue,
        }
    }

    fn checkpoint(&mut self, _path: &Path, total_update: u64) {
        // A log that somebody reads later; on a terminal the line above says more.
        if !self.is_terminal {
            let rate = self.rate(total_update).unwrap_or(0.0);
            self.context.note(&format!(
                "{}: checkpoint after {total_update} updates, {}: loss {}, {rate:.1} updates/s",
                self.planner,
                self.phase,
                table::decimals(self.loss)
            ));
        }
    }

    fn notice(&mut self, message: &str) {
        self.context.warn(message);
    }
}

/// Draws the losses that a run recorded, if it did, and says where.
fn draw_losses(run: &Path) -> Result<Option<PathBuf>> {
    let path = run.join(LOSSES);
    if !path.is_file() {
        return Ok(None);
    }
    let curves = read_losses(&path).with_context(|| path.display().to_string())?;
    if curves.is_empty() {
        return Ok(None);
    }
    let heading = format!("Losses of {}", run.display());
    let svg = draw(&heading, "updates", &Across::Numbers, &curves)
        .with_context(|| path.display().to_string())?;
    let figure = run.join(FIGURE);
    atomic::write(&figure, svg.as_bytes())?;
    Ok(Some(figure))
}

/// The curve of every network, in the order in which they come.
fn read_losses(path: &Path) -> Result<Vec<Curve>> {
    let mut lines = BufReader::new(File::open(path)?).lines();
    let header = lines.next().context("it is empty")??;
    let place = |name: &str| {
        let place = header.split(',').position(|column| column == name);
        place.with_context(|| format!("no column \"{name}\" in \"{header}\""))
    };
    let (network, update, loss) = (place("network")?, place("update")?, place("loss")?);
    let mut curves: Vec<Curve> = Vec::new();
    for (number, line) in lines.enumerate() {
        let line = line?;
        let cells: Vec<&str> = line.split(',').collect();
        let cell = |place: usize| {
            let cell = cells.get(place).copied();
            cell.with_context(|| format!("line {}: \"{line}\"", number + 2))
        };
        let parsed = |place: usize| -> Result<f64> {
            let text = cell(place)?;
            let number = text.parse();
            number.with_context(|| format!("\"{text}\" is no number"))
        };
        let point = Point {
            x: parsed(update)?,
            y: parsed(loss)?,
            interval: None,
        };
        let name = cell(network)?;
        match curves.iter_mut().find(|curve| curve.title == name) {
            Some(curve) => curve.points.push(point),
            None => curves.push(Curve {
                title: name.to_owned(),
                scale: Scale::Logarithmic,
                points: vec![point],
            }),
        }
    }
    for curve in &mut curves {
        // A loss of 0 has no place on a logarithmic axis.
        if curve.points.iter().any(|point| point.y <= 0.0) {
            curve.scale = Scale::Linear;
        }
    }
    Ok(curves)
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn settings_are_nested_by_their_dots() {
        let settings = ["a.b=1", "a.c.d=\"x\"", "e=text", "f=[1, 2]"];
        let settings: Vec<_> = settings.iter().map(|text| setting(text).unwrap()).collect();
        let tables = Value::Object(nested(&settings).unwrap());
        let expected = json!({"a": {"b": 1, "c": {"d": "x"}}, "e": "text", "f": [1, 2]});
        assert_eq!(tables, expected);
        for wrong in ["a", "=1", "a..b=1", ".a=1"] {
            assert!(setting(wrong).is_err(), "{wrong}");
        }
        for wrong in [["a=1", "a=2"], ["a=1", "a.b=2"]] {
            let settings: Vec<_> = wrong.iter().map(|text| setting(text).unwrap()).collect();
            assert!(nested(&settings).is_err(), "{wrong:?}");
        }
    }

    #[test]
    fn losses_become_a_curve_per_network() {
        let run = tempfile::tempdir().unwrap();
        assert_eq!(draw_losses(run.path()).unwrap(), None);
        let rows = "phase,network,update,loss\na,x,100,2.5\na,y,100,0\na,x,200,0.25\n";
        std::fs::write(run.path().join(LOSSES), rows).unwrap();
        let curves = read_losses(&run.path().join(LOSSES)).unwrap();
        assert_eq!(curves.len(), 2);
        assert_eq!(
            (curves[0].points.len(), curves[0].scale),
            (2, Scale::Logarithmic)
        );
        assert_eq!(curves[1].scale, Scale::Linear);
        let figure = draw_losses(run.path()).unwrap().unwrap();
        assert!(std::fs::read_to_string(figure).unwrap().contains("<svg"));
        std::fs::write(run.path().join(LOSSES), "phase,loss\n").unwrap();
        assert!(draw_losses(run.path()).is_err());
    }
}
