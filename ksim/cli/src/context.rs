//! What every command shares: threads, what is said on stderr, progress.

use std::num::NonZero;
use std::time::Duration;

use anyhow::{Context as _, Result};
use clap::Args;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

use crate::{atomic, output};

/// Options of every command.
#[derive(Debug, Args)]
#[command(next_help_heading = "Global options")]
pub(crate) struct GlobalArgs {
    /// Threads to compute with; results do not depend on it, except by libtorch [default: all cores]
    #[arg(long, global = true, value_name = "N")]
    threads: Option<NonZero<u16>>,
    /// Neither progress nor warnings on stderr
    #[arg(long, short, global = true)]
    quiet: bool,
}

/// The global options, put to work.
#[derive(Debug)]
pub(crate) struct Context {
    quiet: bool,
}

impl Context {
    /// Starts the thread pool and takes over Ctrl-C.
    pub(crate) fn new(globals: &GlobalArgs) -> Result<Self> {
        if let Some(threads) = globals.threads {
            rayon::ThreadPoolBuilder::new()
                .num_threads(usize::from(threads.get()))
                .build_global()
                .context("cannot start the threads")?;
        }
        atomic::leave_nothing_behind_on_interrupt()?;
        Ok(Self {
            quiet: globals.quiet,
        })
    }

    /// Threads that share the work.
    pub(crate) fn threads(&self) -> usize {
        rayon::current_num_threads()
    }

    /// Says something on stderr that does not stop the work.
    pub(crate) fn warn(&self, message: &str) {
        if !self.quiet {
            output::warning(message);
        }
    }

    /// Says on stderr how the work went.
    pub(crate) fn note(&self, message: &str) {
        if !self.quiet {
            output::note(message);
        }
    }

    /// Progress of something with a known number of parts, on a terminal only.
    pub(crate) fn bar(&self, what: String, len: u64, unit: &str) -> Progress {
        let template = format!("{{msg}} [{{bar:30}}] {{human_pos}}/{{human_len}} {unit} {{eta}}");
        let style = ProgressStyle::with_template(&template)
            .unwrap_or_else(|_| ProgressStyle::default_bar());
        self.progress(
            ProgressBar::with_draw_target(Some(len), self.target()).with_style(style),
            what,
        )
    }

    /// Progress of something without a known end, on a terminal only.
    pub(crate) fn spinner(&self, what: String) -> Progress {
        let style = ProgressStyle::with_template("{spinner} {msg} {human_pos} {elapsed}")
            .unwrap_or_else(|_| ProgressStyle::default_spinner());
        self.progress(
            ProgressBar::with_draw_target(None, self.target()).with_style(style),
            what,
        )
    }

    fn progress(&self, bar: ProgressBar, what: String) -> Progress {
        bar.set_message(what);
        if !bar.is_hidden() {
            bar.enable_steady_tick(Duration::from_millis(200));
        }
        Progress(bar)
    }

    fn target(&self) -> ProgressDrawTarget {
        // indicatif hides it by itself where stderr is no terminal.
        if self.quiet {
            ProgressDrawTarget::hidden()
        } else {
            ProgressDrawTarget::stderr()
        }
    }
}

/// A line of progress; gone from the screen when dropped.
pub(crate) struct Progress(ProgressBar);

impl Progress {
    /// So many parts are done.
    pub(crate) fn set(&self, done: u64) {
        self.0.set_position(done);
    }

    /// What is being done, anew.
    pub(crate) fn say(&self, what: String) {
        self.0.set_message(what);
    }

    /// So many of that many are done.
    pub(crate) fn set_of(&self, done: u64, of: u64) {
        self.0.set_length(of);
        self.0.set_position(done);
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        self.0.finish_and_clear();
    }
}
