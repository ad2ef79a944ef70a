//! Figures of a search bench: time against size, and what clusters cost against their number.

use svg::node::element::Group;

use super::chart::{Across, Chart, Series, Stroke};
use super::curve::{Point, Scale};
use super::{document, px};
use crate::search_bench::{Measurement, SearchReport};

/// Pixels of the part of a panel that has the lines.
const SIZE: [f64; 2] = [300.0, 210.0];
/// Rows and clusters are spread over orders of magnitude.
const COUNTS: Across = Across::Numbers {
    scale: Scale::Logarithmic,
    ends: None,
};
/// Pixels above the panels.
const HEAD: f64 = 26.0;

/// Draws what a bench measured, as an SVG document. Panels appear where there is something to draw in them: time per
/// query over rows, for several sizes; K-Sim, its difference from exact search, and time, over the number of clusters,
/// for several numbers of clusters. `None` if there are neither.
pub fn draw(heading: &str, report: &SearchReport) -> Option<String> {
    let all = &report.measurements;
    let sizes = distinct(all.iter().map(|one| one.n_rows));
    let mut charts = Vec::new();
    if sizes.len() > 1 {
        charts.push(time_over_rows(all));
    }
    if distinct(all.iter().filter_map(|one| one.n_clusters)).len() > 1 {
        // Over clusters, one reference at a time: the largest and widest.
        let (rows, columns) = largest(all)?;
        let threads = all.iter().map(|one| one.threads).max()?;
        let shown: Vec<&Measurement> = all
            .iter()
            .filter(|one| (one.n_rows, one.n_columns, one.threads) == (rows, columns, threads))
            .collect();
        charts.extend(over_clusters(&shown));
    }
    if charts.is_empty() {
        return None;
    }
    let panel_height = charts[0].outer_size()[1];
    let widths = charts.iter().map(|chart| chart.outer_size()[0]);
    let panel_width = widths.fold(0.0, f64::max);
    let (width, height) = (panel_width * charts.len() as f64, HEAD + panel_height);
    let mut panels = Group::new();
    for (place, chart) in charts.iter().enumerate() {
        let at = format!("translate({} {HEAD})", px(place as f64 * panel_width));
        panels = panels.add(chart.draw().set("transform", at));
    }
    let document = document([width, height], heading).add(panels);
    Some(format!("{document}\n"))
}

fn largest(all: &[Measurement]) -> Option<(usize, usize)> {
    all.iter().map(|one| (one.n_rows, one.n_columns)).max()
}

/// Values in the order of their first appearance.
fn distinct<T: PartialEq>(values: impl Iterator<Item = T>) -> Vec<T> {
    let mut found = Vec::new();
    for value in values {
        if !found.contains(&value) {
            found.push(value);
        }
    }
    found
}

fn engine_name(one: &Measurement) -> String {
    match one.n_clusters {
        Some(n_clusters) => format!("{} ({n_clusters})", one.engine),
        None => one.engine.to_owned(),
    }
}

/// Time per query of the first kind of queries, on the most threads.
fn time_over_rows(all: &[Measurement]) -> Chart {
    let kind = all.first().map_or("", |one| &one.queries);
    let threads = all.iter().map(|one| one.threads).max().unwrap_or(1);
    let shown: Vec<&Measurement> = all
        .iter()
        .filter(|one| one.queries == kind && one.threads == threads)
        .collect();
    let key = |one: &Measurement| (engine_name(one), one.n_columns);
    let lines = distinct(shown.iter().map(|one| key(one)));
    let series = lines.into_iter().enumerate().map(|(color, line)| {
        let points = shown
            .iter()
            .filter(|one| key(one) == line)
            .map(|one| Point {
                x: one.n_rows as f64,
                y: one.query_s * 1e6,
                interval: None,
            });
        Series {
            name: format!("{}, {} columns", line.0, line.1),
            color,
            stroke: Stroke::Dotted,
            points: points.collect(),
        }
    });
    Chart {
        title: format!("{kind}, threads: {threads}"),
        x_label: "reference rows".to_owned(),
        across: COUNTS,
        y_label: "µs per query",
        y_scale: Scale::Logarithmic,
        mark: None,
        series: series.collect(),
        size: SIZE,
    }
}

/// K-Sim, its difference, and time; exact search as dashed lines.
fn over_clusters(shown: &[&Measurement]) -> Vec<Chart> {
    let kinds = distinct(shown.iter().map(|one| one.queries.as_str()));
    let of_clusters: Vec<&Measurement> = shown
        .iter()
        .copied()
        .filter(|one| one.n_clusters.is_some())
        .collect();
    let counts = of_clusters.iter().filter_map(|one| one.n_clusters);
    let ends = [counts.clone().min(), counts.max()].map(|n| n.unwrap_or(1) as f64);
    let exact = |kind: &str| {
        shown
            .iter()
            .copied()
            .find(|one| one.exact && one.queries == kind)
    };
    let lines = |value: &dyn Fn(&Measurement) -> Option<Point>,
                 truth: &dyn Fn(&Measurement) -> f64| {
        let mut series = Vec::new();
        for (color, kind) in kinds.iter().enumerate() {
            let own = of_clusters.iter().filter(|one| one.queries == *kind);
            series.push(Series {
                name: (*kind).to_owned(),
                color,
                stroke: Stroke::Dotted,
                points: own.filter_map(|one| value(one)).collect(),
            });
            if let Some(exact) = exact(kind) {
                let y = truth(exact);
                let end = |x| Point {
                    x,
                    y,
                    interval: None,
                };
                series.push(Series {
                    name: format!("{kind}, exact"),
                    color,
                    stroke: Stroke::Dashed,
                    points: ends.map(end).to_vec(),
                });
            }
        }
        series
    };
    let point = |one: &Measurement, y: f64, interval| {
        let x = one.n_clusters? as f64;
        Some(Point { x, y, interval })
    };
    let chart = |title: &str, y_label, y_scale, series| Chart {
        title: title.to_owned(),
        x_label: "clusters".to_owned(),
        across: COUNTS,
        y_label,
        y_scale,
        mark: None,
        series,
        size: SIZE,
    };
    let k_sim = lines(&|one| point(one, one.k_sim, None), &|exact| exact.k_sim);
    let mut difference = lines(
        &|one| {
            let found = one.approximation?.score_difference;
            point(one, found.value, found.interval)
        },
        &|_| 0.0,
    );
    difference.retain(|one| one.stroke != Stroke::Dashed);
    let time = lines(&|one| point(one, one.query_s * 1e6, None), &|exact| {
        exact.query_s * 1e6
    });
    vec![
        chart("K-Sim", "K-Sim", Scale::Linear, k_sim),
        chart(
            "Clusters less exact",
            "difference in K-Sim",
            Scale::Linear,
            difference,
        ),
        chart("Time", "µs per query", Scale::Logarithmic, time),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::search_bench::{Approximation, SourcePart};
    use crate::stats::Estimate;

    fn measurement(engine: &'static str, n_clusters: Option<usize>, n_rows: usize) -> Measurement {
        let approximation = n_clusters.map(|_| Approximation {
            recall_at_k: 0.8,
            match_differs_share: 0.3,
            score_difference: Estimate {
                value: -0.03,
                interval: Some([-0.04, -0.02]),
            },
            max_score_difference: 0.2,
        });
        Measurement {
            search: engine,
            engine,
            exact: n_clusters.is_none(),
            n_clusters,
            n_rows,
            n_distinct_rows: n_rows,
            n_columns: 31,
            threads: 1,
            queries: "in-distribution".to_owned(),
            n_queries: 10,
            build_s: 0.1,
            kmeans_iterations: None,
            inertia: None,
            reference_bytes: 1,
            memory_bytes: None,
            query_s: 1e-5 * n_rows as f64,
            single_query_s: None,
            n_checked: 1,
            k_sim: 0.7,
            approximation,
        }
    }

    fn report(measurements: Vec<Measurement>) -> SearchReport {
        SearchReport {
            schema: crate::search_bench::SCHEMA,
            version: "0",
            source: SourcePart {
                dataset: None,
                rollouts: Vec::new(),
            },
            n_neighbors: 50,
            seed: 0,
            n_cores: 2,
            measurements,
        }
    }

    #[test]
    fn panels_appear_where_there_is_something_to_compare() {
        let exact = |rows| measurement("blocked", None, rows);
        let clusters = |n| measurement("clusters", Some(n), 100);
        assert_eq!(draw("h", &report(vec![exact(100)])), None);
        let svg = draw("h", &report(vec![exact(100), exact(1000)])).unwrap();
        assert!(svg.contains("reference rows") && !svg.contains("difference in K-Sim"));
        let all = vec![exact(100), clusters(10), clusters(50)];
        let svg = draw("a<b", &report(all.clone())).unwrap();
        for part in [
            "difference in K-Sim",
            "in-distribution, exact",
            "a&lt;b",
            "stroke-dasharray",
        ] {
            assert!(svg.contains(part), "{part}");
        }
        assert!(!svg.contains("reference rows"));
        assert_eq!(svg, draw("a<b", &report(all)).unwrap());
    }
}
