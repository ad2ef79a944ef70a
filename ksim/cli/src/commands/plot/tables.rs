//! `ksim plot tables`: the table of scores for a paper.

use std::path::{Path, PathBuf};

use anyhow::{Result, bail};
use clap::Args;

use crate::atomic;
use crate::context::Context;
use crate::document::{Document, RolloutResult};
use crate::outcome::CommandOutcome;
use crate::scoring::{Job, Session};
use crate::scoring_args::ScoringArgs;
use crate::table;

/// Write the table of scores as Markdown, LaTeX or CSV
///
/// A row per file or planner. Markdown and LaTeX have numbers to read, CSV those of `ksim score --format json`.
#[derive(Debug, Clone, Args)]
pub(crate) struct TablesArgs {
    /// Rollouts: Parquet files with an observation and an action column, or any dataset
    #[arg(required = true, value_name = "ROLLOUTS")]
    rollouts: Vec<String>,
    /// The table to write; its ending says how
    #[arg(short, long, value_name = "FILE.md|.tex|.csv")]
    output: PathBuf,
    #[command(flatten)]
    scoring: ScoringArgs,
}

/// How a table is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Style {
    Markdown,
    Latex,
    Csv,
}

/// Scores and writes.
pub(super) fn run(args: &TablesArgs, context: &Context) -> Result<CommandOutcome> {
    let style = Style::of(&args.output)?;
    let job = Job {
        output: Some(args.output.clone()),
        ..args.scoring.job(&args.rollouts)?
    };
    let session = Session::open(&job, context)?;
    let results = session.score(&job, context, &mut |_| Ok(()))?;
    let text = style.write(&session.document(results, context));
    atomic::write(&args.output, text.as_bytes())?;
    Ok(session.outcome())
}

/// What a row says, in the order of the columns.
const COLUMNS: [&str; 11] = [
    "rollouts",
    "episodes",
    "steps",
    "k_sim",
    "k_sim_episode_mean",
    "low_95",
    "high_95",
    "k_sim_state",
    "k_sim_action",
    "saturated_share",
    "mean_scaled_distance",
];

impl Style {
    fn of(path: &Path) -> Result<Self> {
        match path.extension().and_then(|ending| ending.to_str()) {
            Some("md") => Ok(Self::Markdown),
            Some("tex") => Ok(Self::Latex),
            Some("csv") => Ok(Self::Csv),
            _ => bail!(
                "{}: expected a name that ends in .md, .tex or .csv",
                path.display()
            ),
        }
    }

    fn write(self, document: &Document) -> String {
        let rows = || {
            table::labels(&document.results)
                .into_iter()
                .zip(&document.results)
        };
        match self {
            Self::Csv => {
                let mut text = COLUMNS.join(",") + "\n";
                for (label, result) in rows() {
                    text += &(csv_row(&label, result).join(",") + "\n");
                }
                text
            }
            Self::Markdown => {
                let head = head(document).map(|name| markdown(&name));
                let mut text = format!(
                    "| {} |\n|---|{}\n",
                    head.join(" | "),
                    "---:|".repeat(head.len() - 1)
                );
                for (label, result) in rows() {
                    text += &format!("| {} |\n", read_row(&markdown(&label), result).join(" | "));
                }
                for line in caption(document) {
                    text += &format!("\n{}\n", markdown(&line));
                }
                text
            }
            Self::Latex => {
                let head = head(document).map(|name| name.replace("d/√d", "$d/\\sqrt{d}$"));
                let mut text = String::new();
                for line in caption(document) {
                    text += &format!("% {}\n", one_line(&line));
                }
                text += &format!(
                    "% Needs booktabs.\n\\begin{{tabular}}{{l{}}}\n\\toprule\n{} \\\\\n\\midrule\n",
                    "r".repeat(head.len() - 1),
                    head.join(" & ")
                );
                for (label, result) in rows() {
                    let row = read_row(&latex(&label), result);
                    text += &format!("{} \\\\\n", row.join(" & ").replace(" %", "\\,\\%"));
                }
                text + "\\bottomrule\n\\end{tabular}\n"
            }
        }
    }
}

/// Columns to read, with a star at the one that the definition calls K-Sim.
fn head(document: &Document) -> [String; 9] {
    let by_episode = document.parameters.headline == "k_sim_episode_mean";
    [
        "rollouts",
        "episodes",
        "steps",
        if by_episode { "K-Sim" } else { "K-Sim*" },
        if by_episode {
            "mean of episodes*"
        } else {
            "mean of episodes"
        },
        "state",
        "action",
        "saturated",
        "mean d/√d",
    ]
    .map(str::to_owned)
}

/// What the numbers are, and what they were computed with.
fn caption(document: &Document) -> [String; 2] {
    let parameters = &document.parameters;
    let search = match &document.search.clusters {
        Some(clusters) => format!("search in one of {} clusters", clusters.n_clusters),
        None => "exact search".to_owned(),
    };
    [
        format!(
            "* {}; in brackets 95 % intervals of the mean of episodes, by a bootstrap over episodes.",
            table::headline(document)
        ),
        format!(
            "Against {}; γ {}, K {}, {search}; fingerprint {}.",
            document.dataset.public_name(),
            table::plain(parameters.gamma),
            parameters.n_neighbors,
            document.fingerprint
        ),
    ]
}

fn read_row(label: &str, result: &RolloutResult) -> Vec<String> {
    let mean = match result.interval_95 {
        Some([low, high]) => format!("{:.3} [{low:.3}, {high:.3}]", result.k_sim_episode_mean),
        None => format!("{:.3}", result.k_sim_episode_mean),
    };
    vec![
        label.to_owned(),
        result.n_episodes.to_string(),
        result.n_steps.to_string(),
        format!("{:.3}", result.k_sim),
        mean,
        format!("{:.3}", result.k_sim_state),
        format!("{:.3}", result.k_sim_action),
        format!("{:.1} %", 100.0 * result.saturated_share),
        table::decimals(result.mean_scaled_distance),
    ]
}

fn csv_row(label: &str, result: &RolloutResult) -> Vec<String> {
    let [low, high] = match result.interval_95 {
        Some(ends) => ends.map(|end| end.to_string()),
        None => [String::new(), String::new()],
    };
    let quoted = format!("\"{}\"", label.replace('"', "\"\""));
    vec![
        quoted,
        result.n_episodes.to_string(),
        result.n_steps.to_string(),
        result.k_sim.to_string(),
        result.k_sim_episode_mean.to_string(),
        low,
        high,
        result.k_sim_state.to_string(),
        result.k_sim_action.to_string(),
        result.saturated_share.to_string(),
        result.mean_scaled_distance.to_string(),
    ]
}

/// Text as Markdown shows it: nothing in it is markup or HTML, and it stays in its cell.
fn markdown(text: &str) -> String {
    let mut safe = String::with_capacity(text.len());
    for c in one_line(text).chars() {
        if "\\`*_[]<>&|~$!:@".contains(c) {
            safe.push('\\');
        }
        safe.push(c);
    }
    safe
}

/// Text as LaTeX prints it.
fn latex(text: &str) -> String {
    let mut safe = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '\\' => safe.push_str("\\textbackslash{}"),
            '~' => safe.push_str("\\textasciitilde{}"),
            '^' => safe.push_str("\\textasciicircum{}"),
            '·' => safe.push_str("\\textperiodcentered{}"),
            '#' | '$' | '%' | '&' | '_' | '{' | '}' => safe.extend(['\\', c]),
            c if c.is_control() => safe.push(' '),
            c => safe.push(c),
        }
    }
    safe
}

/// Rows and comments end with their line.
fn one_line(text: &str) -> String {
    text.chars()
        .map(|c| if c.is_control() { ' ' } else { c })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_is_text_in_latex() {
        assert_eq!(latex("a_b\\c{%}"), "a\\_b\\textbackslash{}c\\{\\%\\}");
        assert_eq!(one_line("a\n\\evil"), "a \\evil");
    }

    #[test]
    fn text_is_text_in_markdown() {
        assert_eq!(
            markdown("<img src=x onerror=\"y\">|[a](b)&amp;`c`\n*d_e*"),
            "\\<img src=x onerror=\"y\"\\>\\|\\[a\\](b)\\&amp;\\`c\\` \\*d\\_e\\*"
        );
        assert_eq!(markdown("https://x\\"), "https\\://x\\\\");
    }

    #[test]
    fn the_ending_says_how() {
        assert_eq!(Style::of(Path::new("a.tex")).unwrap(), Style::Latex);
        assert!(Style::of(Path::new("a.png")).is_err());
    }
}
