//! `ksim watch`.

use std::io::ErrorKind;
use std::thread::sleep;
use std::time::Duration;

use anyhow::Result;
use clap::Args;
use ksim_datasets::{DatasetError, OpenOptions, SearchRoots};

use crate::atomic::{self, Cooperative};
use crate::context::Context;
use crate::indexed::look;
use crate::load::NoSteps;
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
/// there yet, or not whole because it is just being written, is waited for; other faults, such as columns that do not
/// fit, end it, as do Ctrl-C and a reader that goes away.
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
    let roots = SearchRoots::from_env();
    let mut seen = None;
    let mut waiting = String::new();
    while !atomic::is_interrupted() {
        // Before it is read: what changes meanwhile is seen at the next look.
        let now = seen_from_outside(&args.rollouts, &roots, &job.rollout_options);
        if now.is_none() || now != seen {
            match update(args, &job, (&session, &mut watched), context) {
                Ok(lines) => {
                    seen = now;
                    waiting.clear();
                    if !output::send(&lines)? {
                        return Ok(CommandOutcome::Done);
                    }
                }
                Err(error) if may_pass(&error) => {
                    wait_for(&format!("{error:#}"), &mut waiting, context);
                }
                Err(error) => return Err(error),
            }
        }
        pause(args.interval);
    }
    output::text(&watched.total())?;
    Ok(CommandOutcome::Done)
}

/// How the files look, where they are there: those of a dataset's name, too.
fn seen_from_outside(rollouts: &str, roots: &SearchRoots, options: &OpenOptions) -> Option<String> {
    let resolved = ksim_datasets::resolve(rollouts, roots).ok()?;
    look(&resolved.path, options.mapping.as_deref()).ok()
}

fn update(
    args: &WatchArgs,
    job: &Job,
    (session, watched): (&Session, &mut Watched<'_>),
    context: &Context,
) -> Result<String> {
    let file = session.open_rollouts(&args.rollouts, job)?;
    watched.update(&file, context)
}

/// Whether files that are not there yet, or not whole yet, give such an error.
fn may_pass(error: &anyhow::Error) -> bool {
    if error.downcast_ref::<NoSteps>().is_some() {
        return true;
    }
    let mut causes = error.chain();
    match causes.find_map(|cause| Some(cause.downcast_ref::<DatasetError>()?.cause())) {
        Some(DatasetError::Io { source, .. }) => {
            matches!(
                source.kind(),
                ErrorKind::NotFound | ErrorKind::UnexpectedEof
            )
        }
        Some(
            DatasetError::NotFound { .. }
            | DatasetError::NotADataset { .. }
            | DatasetError::Empty
            | DatasetError::Corrupt { .. }
            | DatasetError::DeclaredSize { .. }
            | DatasetError::LengthMismatch { .. }
            | DatasetError::NoSample { .. }
            | DatasetError::Arrow { .. }
            | DatasetError::Parquet { .. }
            | DatasetError::Hdf5 { .. }
            | DatasetError::Json { .. },
        ) => true,
        _ => false,
    }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_named_dataset_looks_the_same_until_it_changes() {
        let folder = tempfile::tempdir().unwrap();
        let roots = SearchRoots {
            d4rl: Some(folder.path().to_owned()),
            ..SearchRoots::default()
        };
        let look = || seen_from_outside("hopper-medium-v2", &roots, &OpenOptions::default());
        assert_eq!(look(), None);
        let file = folder.path().join("hopper_medium-v2.hdf5");
        std::fs::write(&file, "short").unwrap();
        let first = look();
        assert!(first.is_some());
        assert_eq!(look(), first);
        std::fs::write(&file, "longer").unwrap();
        assert_ne!(look(), first);
    }

    #[test]
    fn only_what_is_missing_or_unfinished_may_pass() {
        let of = |error: DatasetError| may_pass(&anyhow::Error::from(error).context("reading"));
        assert!(of(DatasetError::Corrupt {
            what: String::new()
        }));
        assert!(of(DatasetError::Empty.in_file(std::path::Path::new("a"))));
        assert!(!of(DatasetError::NoMapping));
        assert!(!may_pass(&anyhow::anyhow!("observations have 3 columns")));
    }
}
