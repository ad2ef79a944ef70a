//! Results as text for people.

use std::fmt::Write as _;

use crate::document::{Document, RolloutResult, SearchPart};
use crate::settings::Definition;

/// Lines up cells below a header; columns of numbers and of nothing go to the right.
pub(crate) fn align(rows: &[Vec<String>]) -> String {
    let n_columns = rows.iter().map(Vec::len).max().unwrap_or(0);
    let cells = |column: usize| rows.iter().filter_map(move |row| row.get(column));
    let is_text = |cell: &String| cell.starts_with(char::is_alphabetic) && cell != "none";
    let layout: Vec<(usize, bool)> = (0..n_columns)
        .map(|column| {
            let width = cells(column)
                .map(|cell| cell.chars().count())
                .max()
                .unwrap_or(0);
            (width, column == 0 || cells(column).skip(1).any(is_text))
        })
        .collect();
    let mut text = String::new();
    for row in rows {
        let mut line = String::new();
        for (cell, &(width, to_the_left)) in row.iter().zip(&layout) {
            let padding = " ".repeat(width - cell.chars().count());
            match to_the_left {
                true => line.extend([cell.as_str(), &padding, "  "]),
                false => line.extend([padding.as_str(), cell, "  "]),
            }
        }
        text.push_str(line.trim_end());
        text.push('\n');
    }
    text
}

/// A number to four decimals, without those that say nothing.
pub(crate) fn number(value: f64) -> String {
    let text = format!("{value:.4}");
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}

/// A distance to four decimals; one too long to read in full by its power of ten.
pub(crate) fn decimals(value: f64) -> String {
    if is_readable(value) {
        format!("{value:.4}")
    } else {
        format!("{value:.4e}")
    }
}

/// A number in full, or by its power of ten where that would be long.
pub(crate) fn plain(value: f64) -> String {
    if is_readable(value) {
        value.to_string()
    } else {
        format!("{value:e}")
    }
}

fn is_readable(value: f64) -> bool {
    value == 0.0 || (1e-4..1e7).contains(&value.abs())
}

/// Lines up names and what is said of them.
pub(crate) fn properties(rows: &[(&str, String)]) -> String {
    let width = rows
        .iter()
        .map(|(name, _)| name.chars().count())
        .max()
        .unwrap_or(0);
    rows.iter()
        .map(|(name, value)| format!("{name:width$}  {value}\n"))
        .collect()
}

/// The result of `ksim score`.
pub(crate) fn score(document: &Document) -> String {
    let mut text = results(document);
    for result in &document.results {
        if let Some(error) = &result.approximation_error {
            let _ = writeln!(
                text,
                "approximation error of {}: {}",
                result.label(),
                error.describe()
            );
        }
    }
    text.push('\n');
    text.push_str(&provenance(document));
    text
}

/// The table alone: a row per file or planner.
pub(crate) fn results(document: &Document) -> String {
    let by_episode = document.parameters.headline == "k_sim_episode_mean";
    let star =
        |is_headline: bool, name: &str| format!("{name}{}", if is_headline { "*" } else { "" });
    let mut rows = vec![vec![
        "rollouts".to_owned(),
        "episodes".to_owned(),
        "steps".to_owned(),
        star(!by_episode, "K-Sim"),
        star(by_episode, "episode mean"),
        "95 % interval".to_owned(),
        "state".to_owned(),
        "action".to_owned(),
        "saturated".to_owned(),
        "mean d/√d".to_owned(),
        "time".to_owned(),
    ]];
    let labels = labels(&document.results);
    rows.extend(
        document
            .results
            .iter()
            .zip(labels)
            .map(|(result, label)| result_row(result, label)),
    );
    let mut text = align(&rows);
    let _ = writeln!(
        text,
        "* {}; the interval is a bootstrap over episodes of the episode mean",
        headline(document)
    );
    text
}

/// What the starred number is, and how far it follows a published definition.
pub(crate) fn headline(document: &Document) -> String {
    let parameters = &document.parameters;
    let is_paper = parameters.definition == Definition::Paper.name();
    let columns = match (parameters.own_columns, is_paper) {
        (true, true) => "all state columns",
        (true, false) => "the first two state columns",
        (false, _) => "the chosen state columns",
    };
    let (mean, source) = if is_paper {
        ("mean over all steps", "the paper's definition")
    } else {
        (
            "mean of the episodes' own means",
            "as the authors' released script",
        )
    };
    let (n_neighbors, n_clusters) = (parameters.n_neighbors, parameters.n_clusters);
    let as_published = parameters.own_columns
        && !parameters.exclude_same_episode
        && Definition::has_numbers(n_neighbors, parameters.gamma, n_clusters);
    let flags = if as_published {
        ""
    } else {
        " but for the flags given"
    };
    let search = if document.search.exact {
        ", by exact search"
    } else {
        ""
    };
    format!("{columns}, {mean} ({source}{flags}{search})")
}

/// Names of the rows: of a file as much of the end of its path as tells it from the others.
pub(crate) fn labels(results: &[RolloutResult]) -> Vec<String> {
    let files: Vec<&str> = results.iter().map(|result| &*result.file).collect();
    results
        .iter()
        .map(|result| {
            let file = distinct_end(&result.file, &files);
            RolloutResult::label_of(file, result.planner.as_deref())
        })
        .collect()
}

/// The fewest last parts of a path that no other path ends with.
fn distinct_end<'p>(path: &'p str, all: &[&str]) -> &'p str {
    let slashes = path
        .rmatch_indices('/')
        .map(|(place, _)| &path[place + 1..]);
    let is_distinct = |end: &&str| {
        let is_same = |other: &str| {
            other
                .strip_suffix(end)
                .is_some_and(|rest| rest.is_empty() || rest.ends_with('/'))
        };
        all.iter().all(|other| *other == path || !is_same(other))
    };
    let mut ends = slashes.filter(|end| !end.is_empty()).chain([path]);
    ends.find(is_distinct).unwrap_or(path)
}

fn result_row(result: &RolloutResult, label: String) -> Vec<String> {
    let interval = match result.interval_95 {
        Some([low, high]) => format!("[{low:.4}, {high:.4}]"),
        None => "none".to_owned(),
    };
    vec![
        label,
        result.n_episodes.to_string(),
        result.n_steps.to_string(),
        format!("{:.4}", result.k_sim),
        format!("{:.4}", result.k_sim_episode_mean),
        interval,
        format!("{:.4}", result.k_sim_state),
        format!("{:.4}", result.k_sim_action),
        format!("{:.1} %", 100.0 * result.saturated_share),
        decimals(result.mean_scaled_distance),
        format!("{:.2} s", result.elapsed_s),
    ]
}

/// What the scores were computed with.
pub(crate) fn provenance(document: &Document) -> String {
    let (dataset, parameters) = (&document.dataset, &document.parameters);
    let excluded = if parameters.exclude_same_episode {
        ", same episode excluded"
    } else {
        ""
    };
    properties(&[
        (
            "dataset",
            format!(
                "{} ({}, {} episodes, {} steps, fingerprint {})",
                dataset.name,
                dataset.format,
                dataset.n_episodes,
                dataset.n_steps,
                dataset.fingerprint
            ),
        ),
        ("columns", columns(document)),
        ("search", search(&document.search)),
        (
            "parameters",
            format!(
                "γ {}, K {}, seed {}, {} resamples{excluded}",
                plain(parameters.gamma),
                parameters.n_neighbors,
                parameters.seed,
                parameters.n_resamples
            ),
        ),
        (
            "fingerprint",
            format!(
                "{} (ksim {}; compare only results with the same)",
                document.fingerprint, document.version
            ),
        ),
        (
            "time",
            format!(
                "{:.2} s with {} threads",
                document.elapsed_s, document.threads
            ),
        ),
    ])
}

fn columns(document: &Document) -> String {
    let parameters = &document.parameters;
    let chosen = ranges(&parameters.state_columns);
    let names = match parameters.state_column_names.as_slice() {
        few if few.len() <= 4 => format!(" ({})", few.join(", ")),
        _ => String::new(),
    };
    format!(
        "{} of the state: {chosen}{names}; {} of the action",
        parameters.state_dim, parameters.action_dim
    )
}

/// Ascending runs as half-open ranges: `0..2, 5`.
fn ranges(indices: &[usize]) -> String {
    let mut runs: Vec<(usize, usize)> = Vec::new();
    for &index in indices {
        match runs.last_mut() {
            Some((_, end)) if *end == index => *end += 1,
            _ => runs.push((index, index + 1)),
        }
    }
    let text = |&(start, end): &(usize, usize)| match end - start {
        1 => start.to_string(),
        _ => format!("{start}..{end}"),
    };
    runs.iter().map(text).collect::<Vec<_>>().join(", ")
}

fn search(search: &SearchPart) -> String {
    let Some(clusters) = &search.clusters else {
        return format!(
            "exact ({}); for the paper's 50-cluster approximation add --search clusters",
            search.engine
        );
    };
    let centers = match (
        &clusters.centers_file,
        &clusters.centers_tensor,
        clusters.n_iterations,
    ) {
        (Some(file), Some(tensor), _) => format!("centers from {file}:{tensor}"),
        (_, _, Some(n)) => {
            let rest = if clusters.converged == Some(true) {
                ""
            } else {
                ", not converged"
            };
            format!(
                "k-means of {}, {n} iterations{rest}",
                clusters.backend.unwrap_or("?")
            )
        }
        _ => format!("k-means of {}", clusters.backend.unwrap_or("?")),
    };
    format!(
        "approximate: one of {} clusters ({centers}, inertia {:.6e}); exact is --search auto",
        clusters.n_clusters, clusters.inertia
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_line_up_by_characters_not_bytes() {
        let rows = [
            vec!["a".into(), "√d".into()],
            vec!["bcd".into(), "1.25".into()],
        ];
        assert_eq!(align(&rows), "a      √d\nbcd  1.25\n");
        let rows =
            [["a", "note"], ["b", ""], ["c", "text"]].map(|row| row.map(str::to_owned).to_vec());
        assert_eq!(align(&rows), "a  note\nb\nc  text\n");
        assert_eq!(
            (number(1000.0), number(0.12344)),
            ("1000".to_owned(), "0.1234".to_owned())
        );
    }

    #[test]
    fn huge_and_tiny_numbers_are_short() {
        let seen = [0.0, 0.12345, 1e300, 2e-9, f64::INFINITY].map(decimals);
        assert_eq!(seen, ["0.0000", "0.1235", "1.0000e300", "2.0000e-9", "inf"]);
        assert_eq!([0.5, 1e300].map(plain), ["0.5", "1e300"]);
    }

    #[test]
    fn files_of_one_name_are_told_apart_by_as_little_as_possible() {
        let ends = |files: &[&'static str]| -> Vec<&str> {
            files.iter().map(|file| distinct_end(file, files)).collect()
        };
        assert_eq!(
            ends(&["/h/u/a.parquet", "/h/u/ba.parquet"]),
            ["a.parquet", "ba.parquet"]
        );
        assert_eq!(
            ends(&["/h/u/1/r.x", "/h/u/2/r.x", "q.x"]),
            ["1/r.x", "2/r.x", "q.x"]
        );
        assert_eq!(
            ends(&["/h/1/s/r.x", "/h/2/s/r.x", "r.x"]),
            ["1/s/r.x", "2/s/r.x", "r.x"]
        );
        assert_eq!(ends(&["/h/r.x", "/h/r.x", "set/"]), ["r.x", "r.x", "set/"]);
    }

    #[test]
    fn runs_of_columns_become_ranges() {
        assert_eq!(ranges(&[0, 1, 2, 5, 9, 8]), "0..3, 5, 9, 8");
        assert_eq!(ranges(&[]), "");
    }
}
