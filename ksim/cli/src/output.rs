//! The only place that prints: results to stdout, everything else to stderr.

use std::borrow::Cow;
use std::io::{self, ErrorKind, Write};
use std::process::ExitCode;

use anyhow::{Context as _, Result};
use clap::ValueEnum;
use serde::Serialize;

/// How results are written to stdout.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum OutputFormat {
    /// A table for people
    Text,
    /// A documented, versioned document for programs
    Json,
}

/// Writes a result to stdout.
pub(crate) fn text(text: &str) -> Result<()> {
    send(text).map(|_| ())
}

/// Writes a result to stdout; tells whether anyone still reads there.
pub(crate) fn send(text: &str) -> Result<bool> {
    let mut stdout = io::stdout().lock();
    match stdout
        .write_all(printable(text).as_bytes())
        .and_then(|()| stdout.flush())
    {
        // The reader had enough, as `head` does.
        Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(false),
        result => result.map(|()| true).context("cannot write to stdout"),
    }
}

/// Writes a result to stdout as indented JSON. Numbers that are not finite become `null`.
pub(crate) fn json(document: &impl Serialize) -> Result<()> {
    let mut json =
        serde_json::to_string_pretty(document).context("cannot write the result as JSON")?;
    json.push('\n');
    text(&json)
}

/// Writes a warning to stderr.
pub(crate) fn warning(message: &str) {
    to_stderr(&format!("warning: {message}"));
}

/// Writes to stderr what is worth knowing and neither a result nor a fault.
pub(crate) fn note(message: &str) {
    to_stderr(message);
}

/// Writes what went wrong to stderr, once, and gives the exit code that goes with it.
pub(crate) fn failure(error: &anyhow::Error) -> ExitCode {
    if let Some(usage) = error.downcast_ref::<clap::Error>() {
        // Nothing can be done if stderr is closed.
        let _ = usage.print();
        return ExitCode::from(2);
    }
    to_stderr(&format!("error: {error:#}"));
    ExitCode::FAILURE
}

fn to_stderr(line: &str) {
    // Not `eprintln!`, which panics if stderr is closed.
    let _ = writeln!(io::stderr().lock(), "{}", printable(line));
}

/// The text without control characters: names in other people's files must not steer the terminal.
fn printable(text: &str) -> Cow<'_, str> {
    let steers = |c: char| c.is_control() && c != '\n';
    if !text.contains(steers) {
        return Cow::Borrowed(text);
    }
    let mut clean = String::with_capacity(text.len());
    for c in text.chars() {
        match steers(c) {
            true => clean.extend(c.escape_debug()),
            false => clean.push(c),
        }
    }
    Cow::Owned(clean)
}

#[cfg(test)]
mod tests {
    #[test]
    fn control_characters_are_shown_not_sent() {
        let shown = super::printable("a\u{1b}[31mb\nc");
        assert_eq!(shown, "a\\u{1b}[31mb\nc");
    }
}
