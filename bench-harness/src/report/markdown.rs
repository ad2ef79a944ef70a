//! The report for people.

use std::fmt::Write as _;

use super::{Entry, Report};
use crate::stats::Estimate;

/// How the paper's figures were counted, for whoever compares.
const PAPER_NOTE: &str = "\
Figures of the paper are marked as its own. They are not the same measurement: the released code counts Diffuser's \
success at any step and Curiosity-Diffuser's at the last one, resets without seeds, takes λ as the best of a sweep on \
the tasks it reports, and trains the value of its AntMaze planners with a loss that can only learn its mean. In \
MuJoCo it drops the reward of the step that ends an episode, and adds one of a restarted episode at step 1000; here \
the step that ends an episode counts and nothing after it does.";

/// The report as Markdown.
pub fn markdown(report: &Report) -> String {
    let mut text = format!(
        "# {}\n\n{} of {} episodes each, seeds from {}. Intervals are 95 %: by bootstrap over episodes, of success \
         rates by Wilson.\n",
        report.suite,
        match report.runs {
            1 => "1 run".to_owned(),
            n => format!("{n} runs"),
        },
        report.episodes,
        report.seed
    );
    for entry in report.entries.iter().filter(|entry| !entry.finished) {
        let (planner, environment) = (&entry.planner, &entry.environment);
        let _ = write!(
            text,
            "\n**The training of {planner} in {environment} is not finished.**\n"
        );
    }
    scores(report, &mut text);
    success(report, &mut text);
    k_sim(report, &mut text);
    returns(report, &mut text);
    if report.entries.iter().any(|entry| entry.paper.is_some()) {
        let _ = write!(text, "\n{PAPER_NOTE}\n");
    }
    text
}

/// A table, if it has rows.
fn table(title: &str, note: &str, header: &[&str], rows: Vec<Vec<String>>, text: &mut String) {
    if rows.is_empty() {
        return;
    }
    let _ = write!(text, "\n## {title}\n\n");
    if !note.is_empty() {
        let _ = write!(text, "{note}\n\n");
    }
    let _ = writeln!(text, "| {} |", header.join(" | "));
    let _ = writeln!(text, "|{}", "---|".repeat(header.len()));
    for row in rows {
        let _ = writeln!(text, "| {} |", row.join(" | "));
    }
}

/// Rows of the entries that have what a table shows.
fn rows(report: &Report, cells: impl Fn(&Entry) -> Option<Vec<String>>) -> Vec<Vec<String>> {
    let row = |entry: &Entry| {
        let mut row = vec![entry.environment.clone(), entry.planner.clone()];
        row.extend(cells(entry)?);
        Some(row)
    };
    report.entries.iter().filter_map(row).collect()
}

fn scores(report: &Report, text: &mut String) {
    let cells = |entry: &Entry| {
        let score = entry.summary.normalized_score?;
        Some(vec![
            estimate(&score, 100.0, 1),
            entry.summary.n_episodes.to_string(),
        ])
    };
    table(
        "Normalized scores",
        "100 × (return − random) / (expert − random).",
        &["environment", "planner", "score", "episodes"],
        rows(report, cells),
        text,
    );
}

fn success(report: &Report, text: &mut String) {
    let cells = |entry: &Entry| {
        let success = entry.summary.success?;
        let paper = entry.paper.map_or("–".to_owned(), |paper| {
            let curiosity = paper.curiosity;
            let lambda = curiosity.map_or(String::new(), |lambda| format!(", λ {lambda:e}"));
            let rate = number(100.0 * paper.success, 1);
            format!("paper: {rate} {}{lambda}", paper.rule.describe())
        });
        let steps = success.mean_first_success_step;
        Some(vec![
            estimate(&success.ever, 100.0, 1),
            estimate(&success.at_end, 100.0, 1),
            paper,
            steps.map_or("–".to_owned(), |steps| number(steps, 0)),
        ])
    };
    table(
        "Success, %",
        "By both accounting rules.",
        &[
            "environment",
            "planner",
            "at any step",
            "at the last step",
            "the paper's",
            "steps to the first",
        ],
        rows(report, cells),
        text,
    );
}

fn k_sim(report: &Report, text: &mut String) {
    let cells = |entry: &Entry| {
        let k_sim = entry.k_sim?;
        Some(vec![
            number(k_sim.k_sim, 4),
            estimate(&k_sim.k_sim_episode_mean, 1.0, 4),
            number(100.0 * k_sim.saturated_share, 1),
            number(k_sim.mean_scaled_distance, 4),
        ])
    };
    table(
        "K-Sim",
        "Against the dataset of the environment: all state columns, exact search. Saturated steps, in %, score 1 \
         whatever their distance; the mean of d/√d does not saturate.",
        &[
            "environment",
            "planner",
            "over steps",
            "over episodes",
            "saturated",
            "mean d/√d",
        ],
        rows(report, cells),
        text,
    );
}

fn returns(report: &Report, text: &mut String) {
    let cells = |entry: &Entry| {
        let summary = &entry.summary;
        let novelty = entry.novelty;
        Some(vec![
            estimate(&summary.total_return, 1.0, 2),
            summary
                .iqm_of_runs
                .map_or("–".to_owned(), |iqm| estimate(&iqm, 1.0, 2)),
            number(summary.mean_length, 1),
            novelty.map_or("–".to_owned(), |novelty| estimate(&novelty, 1.0, 5)),
        ])
    };
    table(
        "Returns",
        "",
        &[
            "environment",
            "planner",
            "return",
            "IQM of runs",
            "steps",
            "novelty of plans",
        ],
        rows(report, cells),
        text,
    );
}

/// `57.3 [50.1, 63.2]`.
fn estimate(estimate: &Estimate, scale: f64, decimals: usize) -> String {
    let value = number(scale * estimate.value, decimals);
    match estimate.interval {
        Some([low, high]) => format!(
            "{value} [{}, {}]",
            number(scale * low, decimals),
            number(scale * high, decimals)
        ),
        None => value,
    }
}

/// A number with so many decimals; one that they would not show by its power of ten.
fn number(value: f64, decimals: usize) -> String {
    let places = i32::try_from(decimals).unwrap_or(0);
    match value == 0.0 || value.abs() >= 10f64.powi(-places) {
        true => format!("{value:.decimals$}"),
        false => format!("{value:.2e}"),
    }
}
