//! `ksim bench planners`: planners on tasks.

use std::num::NonZero;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::{Context as _, Result};
use clap::Args;
use ksim_bench_harness::report::{Report, json, markdown};
use ksim_bench_harness::rollout::Continue;
use ksim_bench_harness::run_dir::RunDir;
use ksim_bench_harness::suite::{CellName, Played, Suite, SuiteObserver, play};
use ksim_planners::Registry;

use crate::atomic;
use crate::context::{Context, Progress};
use crate::outcome::CommandOutcome;
use crate::output::{self, OutputFormat};

/// Environments of a thread, as in `ksim rollout`.
const ENVIRONMENTS_PER_THREAD: usize = 8;

/// Play planners × environments × runs of a TOML file and report
///
/// Writes a row per episode (episodes.parquet), the tables (report.md, report.json) and what they were made with
/// (manifest.json). What is done is kept: after Ctrl-C, the same command goes on with the cells that are missing.
#[derive(Debug, Clone, Args)]
pub(crate) struct PlannersBenchArgs {
    /// The suite (see docs/planners-cli.md)
    #[arg(value_name = "SUITE.toml")]
    suite: PathBuf,
    /// The folder of the results
    #[arg(short, long, value_name = "RUN_DIR")]
    output: PathBuf,
    /// Environments that are stepped together; results do not depend on it, except with planners by libtorch [default: 8 per thread]
    #[arg(long, value_name = "N")]
    parallel: Option<NonZero<u16>>,
    /// How to print the report
    #[arg(long, value_enum, default_value_t = OutputFormat::Text)]
    format: OutputFormat,
}

/// Plays, writes and prints.
pub(super) fn run(args: &PlannersBenchArgs, context: &Context) -> Result<CommandOutcome> {
    let suite = Suite::read(&args.suite)?;
    let run_dir = RunDir::open(&args.output)?;
    let _cooperative = atomic::Cooperative::begin();
    let Some(played) = played(&suite, &run_dir, args.parallel, context)? else {
        return Ok(CommandOutcome::Done);
    };
    let report = Report::new(&suite, &played);
    let (text, document) = (markdown(&report), json(&report, &played));
    run_dir.write_text("report.md", &text)?;
    let pretty = serde_json::to_string_pretty(&document).context("cannot write the report")?;
    run_dir.write_text("report.json", &(pretty + "\n"))?;
    match args.format {
        OutputFormat::Text => output::text(&text)?,
        OutputFormat::Json => output::json(&document)?,
    }
    Ok(CommandOutcome::Done)
}

/// Plays what is missing; `None` after an interrupt, which it tells of.
pub(super) fn played(
    suite: &Suite,
    run_dir: &RunDir,
    parallel: Option<NonZero<u16>>,
    context: &Context,
) -> Result<Option<Played>> {
    let n_slots = parallel.map_or(context.threads() * ENVIRONMENTS_PER_THREAD, |n| {
        usize::from(n.get())
    });
    let n_slots = NonZero::new(n_slots).unwrap_or(NonZero::<usize>::MIN);
    let mut watcher = Watcher {
        context,
        n_episodes: suite.episodes,
        what: String::new(),
        progress: None,
        started: Instant::now(),
        told: Instant::now(),
        n_done: 0,
        n_cells: 0,
    };
    let played = play(suite, &Registry::builtin(), run_dir, n_slots, &mut watcher)?;
    let Watcher {
        n_done, n_cells, ..
    } = watcher;
    if n_done > 0 {
        context.note(&format!("{n_done} of {n_cells} cells were done before"));
    }
    if !played.finished {
        context.note(&format!(
            "interrupted; {} keeps what is done, and the same command goes on from there",
            run_dir.path().display()
        ));
        return Ok(None);
    }
    Ok(Some(played))
}

/// Shows how far it is.
struct Watcher<'a> {
    context: &'a Context,
    n_episodes: usize,
    what: String,
    progress: Option<Progress>,
    started: Instant,
    told: Instant,
    n_done: usize,
    n_cells: usize,
}

impl SuiteObserver for Watcher<'_> {
    fn cell(&mut self, cell: &CellName<'_>, number: usize, of: usize, is_done: bool) {
        self.n_cells = of;
        self.n_done += usize::from(is_done);
        self.what = format!("{number}/{of} {cell}");
        self.started = Instant::now();
        let bar = self
            .context
            .bar(self.what.clone(), self.n_episodes as u64, "episodes");
        self.progress = Some(bar);
    }

    fn progress(&mut self, n_episodes: usize, n_steps: u64) -> Continue {
        if self.told.elapsed() > Duration::from_millis(200) {
            self.told = Instant::now();
            if let Some(progress) = &self.progress {
                let rate = n_steps as f64 / self.started.elapsed().as_secs_f64();
                progress.say(format!("{}: {rate:.0} steps/s", self.what));
                progress.set(n_episodes as u64);
            }
        }
        match atomic::is_interrupted() {
            true => Continue::Stop,
            false => Continue::Yes,
        }
    }

    fn note(&mut self, message: &str) {
        self.context.warn(message);
    }
}
