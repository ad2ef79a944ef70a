//! What the weight of curiosity does, as curves: from the report of `ksim bench lambda`.

use anyhow::{Context as _, Result, bail};
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
    let lambdas = list("lambdas")?.iter().enumerate();
    let names = lambdas.map(|(place, lambda)| {
        let lambda = number(lambda).with_context(|| format!("lambdas[{place}]"))?;
        Ok(lambda_name(lambda))
    });
    let names = names.collect::<Result<Vec<String>>>()?;
    let entries = list("results")?;
    if entries.len() != names.len() {
        bail!(
            "expected one result for each of {} lambdas, found {}",
            names.len(),
            entries.len()
        );
    }
    let text = |value: Option<&Value>| value.and_then(Value::as_str).unwrap_or_default().to_owned();
    let environment = text(entries.first().and_then(|entry| entry.get("environment")));
    let episodes = report.get("episodes").and_then(Value::as_u64).unwrap_or(0);
    let heading = format!(
        "{} in {environment}, {episodes} episodes for each λ",
        text(report.get("suite"))
    );
    let curves = MEASURES
        .into_iter()
        .map(|(title, place)| curve(title, place, entries));
    let curves = curves.collect::<Result<Vec<Option<Curve>>>>()?;
    let curves: Vec<Curve> = curves.into_iter().flatten().collect();
    draw(&heading, "λ", &Across::Names(&names), &curves).context("cannot draw the curves")
}

/// A curve of what is known. Without curiosity a planner knows no novelty: that curve begins with the first weight that
/// has it.
fn curve(title: &str, place: &str, entries: &[Value]) -> Result<Option<Curve>> {
    let mut points = Vec::with_capacity(entries.len());
    for (row, entry) in entries.iter().enumerate() {
        let estimate = entry.pointer(place).filter(|estimate| !estimate.is_null());
        if let Some(estimate) = estimate {
            let point = point(row, estimate);
            points.push(point.with_context(|| format!("results[{row}]{place}"))?);
        }
    }
    Ok((!points.is_empty()).then(|| Curve {
        title: title.to_owned(),
        scale: Scale::Linear,
        points,
    }))
}

fn point(row: usize, estimate: &Value) -> Result<Point> {
    let interval = match &estimate["interval"] {
        Value::Null => None,
        interval => match interval.as_array().map(Vec::as_slice) {
            Some([low, high]) => Some([
                number(low).context("interval[0]")?,
                number(high).context("interval[1]")?,
            ]),
            _ => bail!("interval: expected two numbers, found {}", shown(interval)),
        },
    };
    Ok(Point {
        x: row as f64,
        y: number(&estimate["value"]).context("value")?,
        interval,
    })
}

fn number(value: &Value) -> Result<f64> {
    let number = value.as_f64();
    number.with_context(|| format!("expected a number, found {}", shown(value)))
}

/// The beginning of a value.
fn shown(value: &Value) -> String {
    const LENGTH: usize = 60;
    let text = value.to_string();
    match text.char_indices().nth(LENGTH) {
        Some((end, _)) => format!("{}…", &text[..end]),
        None => text,
    }
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
    #[test]
    fn a_damaged_report_is_refused_at_its_place() {
        let entry = |estimate: Value| json!({ "summary": { "total_return": estimate } });
        let good = || entry(json!({ "value": 1.0, "interval": [0.5, 1.5] }));
        let report =
            |lambdas: Value, results: Vec<Value>| json!({ "lambdas": lambdas, "results": results });
        for (report, expected) in [
            (
                report(json!([0.0, "x"]), vec![good(), good()]),
                "lambdas[1]: expected a number, found \"x\"",
            ),
            (
                report(json!([0.0, 1.0]), vec![good()]),
                "one result for each of 2 lambdas, found 1",
            ),
            (
                report(
                    json!([0.0]),
                    vec![entry(json!({ "value": 1.0, "interval": [0.5, "y"] }))],
                ),
                "results[0]/summary/total_return: interval[1]: expected a number, found \"y\"",
            ),
            (
                report(
                    json!([0.0, 1.0]),
                    vec![good(), entry(json!({ "value": null }))],
                ),
                "results[1]/summary/total_return: value: expected a number, found null",
            ),
        ] {
            let error = format!("{:#}", of_report(&report).unwrap_err());
            assert!(error.contains(expected), "{error}");
        }
    }
}
