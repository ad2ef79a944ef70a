//! `ksim watch`.

use std::path::Path;
use std::thread::sleep;
use std::time::Duration;

use anyhow::Result;
use clap::Args;

use crate::atomic::{self, Cooperative};
use crate::context::Context;
use crate::indexed::look;
use crate::outcome::CommandOutcome;
use crate::output;
use crate::scoring::{Job, Session};
use crate::scoring_args::ScoringArgs;
use crate::watching::Watched;

/// How often Ctrl-C is looked for.
const NAP: Duration = Duration::from_millis(100);

/// Follow a file of rollouts that grows, and score what is new in it
///
/// The file is read again whenever its length or time of change differs; steps that were scored before are not
/// scored again. A line is printed for every episode that is new or has grown, and one for all. A file that is not
/// there yet, or cannot be read because it is just being written, is waited for. Ctrl-C ends it.
#[derive(Debug, Clone, Args)]
pub(crate) struct WatchArgs {
    /// Rollouts: a Parquet file that is replaced as it grows, a recording, or any dataset
    #[arg(value_name = "FILE")]
    rollouts: String,
    /// Seconds between two looks at the file
    #[arg(long, value_name = "SECONDS", default_value = "1", value_parser = seconds)]
    interval: Duration,
    /// Read what is there, print it and end
    #[arg(long)]
    once: bool,
    #[command(flatten)]
    scoring: ScoringArgs,
}

fn seconds(text: &str) -> Result<Duration, String> {
    let seconds = text.parse::<f64>().ok();
    let seconds = seconds.filter(|seconds| (0.1..=86_400.0).contains(seconds));
    let seconds = seconds.ok_or("expected a number from 0.1 to 86400")?;
    Ok(Duration::from_secs_f64(seconds))
}

/// Looks, scores and prints until Ctrl-C.
pub(crate) fn run(args: &WatchArgs, context: &Context) -> Result<CommandOutcome> {
    let job = args.scoring.job(&[])?;
    let session = Session::open(&job, context)?;
    let mut watched = Watched::new(&session, &job);
    if args.once {
        let file = session.open_rollouts(&args.rollouts, &job)?;
        output::text(&watched.update(&file, context)?)?;
        return Ok(CommandOutcome::of([
            file.source.info(),
            session.dataset().info(),
        ]));
    }
    let _cooperative = Cooperative::begin();
    let mut seen = None;
    let mut waiting = String::new();
    while !atomic::is_interrupted() {
        // Before it is read: what changes meanwhile is seen at the next look.
        let now = look(Path::new(&args.rollouts), None).ok();
        if now.is_none() || now != seen {
            match update(args, &job, (&session, &mut watched), context) {
                Ok(()) => seen = now,
                Err(error) => wait_for(&format!("{error:#}"), &mut waiting, context),
            }
        }
        pause(args.interval);
    }
    output::text(&watched.total())?;
    Ok(CommandOutcome::Done)
}

fn update(
    args: &WatchArgs,
    job: &Job,
    (session, watched): (&Session, &mut Watched<'_>),
    context: &Context,
) -> Result<()> {
    let file = session.open_rollouts(&args.rollouts, job)?;
    output::text(&watched.update(&file, context)?)
}

/// Says why nothing can be read, once.
fn wait_for(reason: &str, said: &mut String, context: &Context) {
    if reason != said {
        context.note(&format!("waiting: {reason}"));
        reason.clone_into(said);
    }
}

fn pause(interval: Duration) {
    let mut left = interval;
    while !left.is_zero() && !atomic::is_interrupted() {
        let nap = left.min(NAP);
        sleep(nap);
        left -= nap;
    }
}
