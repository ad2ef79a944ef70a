//! A search bench as text for people.

use ksim_bench_harness::search_bench::{Measurement, SearchReport};

use crate::table;

/// The table, and what its columns mean.
pub(super) fn render(report: &SearchReport) -> String {
    let mut rows = vec![
        [
            "engine",
            "rows",
            "columns",
            "threads",
            "queries",
            "n",
            "build",
            "per query",
            "one alone",
            "memory",
            "recall",
            "other match",
            "K-Sim",
            "less exact",
            "95 % interval",
        ]
        .map(str::to_owned)
        .to_vec(),
    ];
    rows.extend(report.measurements.iter().map(row));
    let checked = report
        .measurements
        .iter()
        .map(|one| one.n_checked)
        .min()
        .unwrap_or(0);
    let checked = match checked {
        0 => "not checked (--n-checked 0)".to_owned(),
        n => format!(
            "{n} queries of every kind have the neighbors and distances of the oracle, to the last bit"
        ),
    };
    let reference = match &report.source.dataset {
        Some(dataset) => dataset.clone(),
        None => "generated trajectories".to_owned(),
    };
    let asked = match report.source.rollouts.as_slice() {
        [] if report.source.dataset.is_some() => "held-out episodes".to_owned(),
        [] => "generated trajectories".to_owned(),
        rollouts => rollouts.join(", "),
    };
    let copies = report
        .measurements
        .iter()
        .filter(|one| one.n_distinct_rows < one.n_rows);
    let distinct = copies.map(|one| one.n_distinct_rows).max();
    let distinct = distinct.map_or(String::new(), |n| {
        format!("; rows beyond {n} are jittered copies")
    });
    format!(
        "{}\nreference    {reference}{distinct}\nqueries      {asked}; K {}\n\
         exact        {checked}\n\
         times        best of the repeats, on {} cores; built once; \"one alone\" on one thread\n\
         memory       peak of build and search above the reference, which itself takes 8 bytes a value; of engines\n\
         \x20            after the first only what they take beyond the memory that those before them have freed\n\
         ksim         {}, seed {}\n",
        table::align(&rows),
        report.n_neighbors,
        report.n_cores,
        report.version,
        report.seed,
    )
}

fn row(one: &Measurement) -> Vec<String> {
    let engine = match one.n_clusters {
        Some(n_clusters) => format!("{} ({n_clusters})", one.engine),
        None => one.engine.to_owned(),
    };
    let nothing = || "–".to_owned();
    let of = |value: Option<String>| value.unwrap_or_else(nothing);
    let found = one.approximation;
    let interval = found.and_then(|found| found.score_difference.interval);
    vec![
        engine,
        one.n_rows.to_string(),
        one.n_columns.to_string(),
        one.threads.to_string(),
        one.queries.clone(),
        one.n_queries.to_string(),
        seconds(one.build_s),
        seconds(one.query_s),
        of(one.single_query_s.map(seconds)),
        of(one
            .memory_bytes
            .map(|bytes| format!("{:.1} MB", bytes as f64 / 1e6))),
        of(found.map(|found| format!("{:.3}", found.recall_at_k))),
        of(found.map(|found| format!("{:.1} %", 100.0 * found.match_differs_share))),
        format!("{:.4}", one.k_sim),
        of(found.map(|found| format!("{:+.4}", found.score_difference.value))),
        of(interval.map(|[low, high]| format!("[{low:+.4}, {high:+.4}]"))),
    ]
}

/// Seconds in the unit that leaves few digits.
fn seconds(value: f64) -> String {
    match value {
        v if v >= 1.0 => format!("{v:.2} s"),
        v if v >= 1e-3 => format!("{:.2} ms", v * 1e3),
        v => format!("{:.1} µs", v * 1e6),
    }
}

#[cfg(test)]
mod tests {
    use super::seconds;

    #[test]
    fn times_have_few_digits() {
        assert_eq!(
            [1.234, 0.00234, 0.0000217].map(seconds),
            ["1.23 s", "2.34 ms", "21.7 µs"]
        );
    }
}
