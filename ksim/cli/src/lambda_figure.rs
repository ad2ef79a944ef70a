//! What the weight of curiosity does, as curves: from the report of `ksim bench lambda`.

use anyhow::{Context as _, Result};
use ksim_bench_harness::figure::curve::{Across, Curve, Point, Scale, draw};
use serde_json::Value;

/// Where the numbers of an entry are.
const MEASURES: [(&str, &str); 6] = [
    ("success at any step", "/summary/success/ever"),
    ("success at the last step", "/summary/success/at_end"),
    ("return", "/summary/total_return"),
    ("normalized score", "/summary/normalized_score"),
    ("K-Sim, mean of episodes", "/k_sim/k_sim_episode_mean"),
    ("novelty of the plans", "/novelty"),
];

/// `λ = 1e3`, in a form that is also the name of a file.
pub(crate) fn lambda_name(lambda: f64) -> String {
    match lambda {
        0.0 => "0".to_owned(),
        _ => format!("{lambda:e}"),
    }
}

/// Draws a report, as an SVG document.
///
/// # Errors
/// It is no report of `ksim bench lambda`, or holds numbers that cannot be drawn.
pub(crate) fn of_report(report: &Value) -> Result<String> {
    let list = |name: &str| {
        let list = report.get(name).and_then(Value::as_array);
        list.with_context(|| {
            format!("no list \"{name}\": expected what `ksim bench lambda` writes")
        })
    };
    let lambdas = list("lambdas")?.iter().filter_map(Value::as_f64);
    let names: Vec<String> = lambdas.map(lambda_name).collect();
    let entries = list("results")?;
    let text = |value: Option<&Value>| value.and_then(Value::as_str).unwrap_or_default().to_owned();
    let environment = text(entries.first().and_then(|entry| entry.get("environment")));
    let episodes = report.get("episodes").and_then(Value::as_u64).unwrap_or(0);
    let heading = format!(
        "{} in {environment}, {episodes} episodes for each λ",
        text(report.get("suite"))
    );
    let curves: Vec<Curve> = MEASURES
        .into_iter()
        .filter_map(|(title, place)| curve(title, place, entries))
        .collect();
    draw(&heading, "λ", &Across::Names(&names), &curves).context("cannot draw the curves")
}

/// A curve of what is known. Without curiosity a planner knows no novelty: that curve begins with the first weight that
/// has it.
fn curve(title: &str, place: &str, entries: &[Value]) -> Option<Curve> {
    let points = entries.iter().enumerate().filter_map(|(number, entry)| {
        let estimate = entry.pointer(place)?;
        let interval = estimate.get("interval").and_then(Value::as_array);
        let ends = interval.map(|ends| [ends.first(), ends.get(1)]);
        Some(Point {
            x: number as f64,
            y: estimate.get("value")?.as_f64()?,
            interval: match ends {
                Some([Some(low), Some(high)]) => Some([low.as_f64()?, high.as_f64()?]),
                _ => None,
            },
        })
    });
    let points: Vec<Point> = points.collect();
    (!points.is_empty()).then(|| Curve {
        title: title.to_owned(),
        scale: Scale::Linear,
        points,
    })
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn what_is_known_is_drawn_and_what_is_no_report_is_refused() {
        let entry = |value: f64| json!({ "environment": "maze", "summary": { "total_return": { "value": value, "interval": [value - 1.0, value + 1.0] } }, "k_sim": null });
        let report = json!({ "suite": "s", "episodes": 4, "lambdas": [0.0, 1e3], "results": [entry(1.0), entry(2.0)] });
        let svg = of_report(&report).unwrap();
        assert!(
            svg.contains("1e3") && svg.contains("s in maze, 4 episodes"),
            "{svg}"
        );
        assert!(svg.contains("return") && !svg.contains("novelty"), "{svg}");
        let error = of_report(&json!({})).unwrap_err().to_string();
        assert!(error.contains("no list \"lambdas\""), "{error}");
    }
}
