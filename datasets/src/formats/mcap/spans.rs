//! Where episodes begin and end, and what is said of them as a whole.

use super::mapping::{EpisodeRule, Mapping, Marker, MarkerOn, Recorded};
use super::survey::{Said, Survey};

/// A stretch of time that is one episode, or several if samples are missing in it.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Span {
    pub(super) start: i64,
    pub(super) end: i64,
    success: Option<bool>,
}

impl Span {
    fn new(start: i64, end: i64) -> Self {
        Self {
            start,
            end,
            success: None,
        }
    }
}

/// The spans of a recording, in order.
pub(super) fn spans(survey: &Survey, mapping: &Mapping) -> Vec<Span> {
    match &mapping.episodes {
        EpisodeRule::File | EpisodeRule::Index => vec![Span::new(i64::MIN, i64::MAX)],
        EpisodeRule::Gap { topic, gap_ns } => {
            let times = survey.tracks.get(topic).map(|track| track.times.as_slice());
            let runs = times
                .unwrap_or_default()
                .chunk_by(|a, b| a.abs_diff(*b) <= *gap_ns);
            runs.filter_map(|run| Some(Span::new(*run.first()?, *run.last()?)))
                .collect()
        }
        EpisodeRule::Marker(marker) => marked(&survey.marks, marker),
    }
}

/// Spans between marks. What begins without an end ends before the next beginning, or with the recording.
fn marked(marks: &[(i64, Said)], marker: &Marker) -> Vec<Span> {
    let mut spans = Vec::new();
    let mut open: Option<i64> = None;
    for (time, said) in marks {
        let (begins, ends, outcome) = meaning(said, &marker.on, open.is_some());
        if let Some(start) = open.filter(|_| begins || ends) {
            let end = if ends { *time } else { time.saturating_sub(1) };
            let success = outcome;
            spans.push(Span {
                start,
                end,
                success,
            });
            open = None;
        }
        if begins {
            open = Some(*time);
        }
    }
    spans.extend(open.map(|start| Span::new(start, i64::MAX)));
    spans
}

/// Whether a mark begins or ends an episode, and what it says of success.
fn meaning(said: &Said, on: &MarkerOn, is_open: bool) -> (bool, bool, Option<bool>) {
    match (on, said) {
        (MarkerOn::Message, _) => (true, false, None),
        (MarkerOn::Bool { .. }, Said::Number(flag)) => {
            let is_on = *flag != 0.0;
            (is_on && !is_open, !is_on && is_open, None)
        }
        (
            MarkerOn::Text {
                start,
                end,
                success,
                failure,
                ..
            },
            Said::Text(text),
        ) => {
            // The longer one first, as one may begin with the other.
            let ends = end.as_ref().is_some_and(|end| {
                text.starts_with(end.as_str())
                    && (end.len() >= start.len() || !text.starts_with(start.as_str()))
            });
            let outcome = outcome(text, success.as_deref(), failure.as_deref());
            (
                !ends && text.starts_with(start.as_str()),
                ends,
                outcome.filter(|_| ends),
            )
        }
        _ => (false, false, None),
    }
}

/// Whether a text has the word for success or failure; with only one of them, its absence is the other.
fn outcome(text: &str, success: Option<&str>, failure: Option<&str>) -> Option<bool> {
    let has = |word: &str| {
        text.split(|c: char| !c.is_alphanumeric() && c != '_')
            .any(|part| part == word)
    };
    match (success, failure) {
        (Some(success), None) => Some(has(success)),
        (None, Some(failure)) => Some(!has(failure)),
        (Some(success), Some(_)) if has(success) => Some(true),
        (Some(_), Some(failure)) if has(failure) => Some(false),
        _ => None,
    }
}

/// Whether an episode reached its goal, where that is recorded.
pub(super) fn success(survey: &Survey, mapping: &Mapping, span: &Span) -> Option<bool> {
    let recorded = match &mapping.success {
        None => None,
        Some(Recorded::Text(text)) => truth(text),
        Some(Recorded::Metadata { record, key }) => truth(entry(survey, record, key)?),
        Some(Recorded::Topic { .. }) => {
            let mut inside = survey
                .success
                .iter()
                .rev()
                .filter(|(time, _)| (span.start..=span.end).contains(time));
            match &inside.next()?.1 {
                Said::Text(text) => truth(text),
                Said::Number(flag) => Some(*flag != 0.0),
                Said::Nothing => None,
            }
        }
    };
    span.success.or(recorded)
}

/// What people write for yes and no.
fn truth(text: &str) -> Option<bool> {
    match text.trim().to_lowercase().as_str() {
        "true" | "1" | "yes" | "success" | "succeeded" => Some(true),
        "false" | "0" | "no" | "failure" | "failed" => Some(false),
        _ => None,
    }
}

/// What was to be done in an episode that ends at `end`.
pub(super) fn task(survey: &Survey, mapping: &Mapping, end: i64) -> Option<String> {
    match mapping.task.as_ref()? {
        Recorded::Text(text) => Some(text.clone()),
        Recorded::Metadata { record, key } => entry(survey, record, key).map(str::to_owned),
        Recorded::Topic { .. } => {
            let mut before = survey.task.iter().rev().filter(|(time, _)| *time <= end);
            match &before.next()?.1 {
                Said::Text(text) => Some(text.clone()),
                _ => None,
            }
        }
    }
}

fn entry<'s>(survey: &'s Survey, record: &str, key: &str) -> Option<&'s str> {
    let mut records = survey
        .metadata
        .iter()
        .filter(|metadata| metadata.name == record);
    records
        .find_map(|metadata| metadata.entries.get(key))
        .map(String::as_str)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn said(text: &str) -> Said {
        Said::Text(text.to_owned())
    }

    #[test]
    fn texts_begin_and_end_episodes() {
        let marker = Marker {
            topic: String::new(),
            on: MarkerOn::Text {
                field: String::new(),
                start: "start".to_owned(),
                end: Some("end".to_owned()),
                success: Some("success".to_owned()),
                failure: None,
            },
        };
        let texts = [
            "end",
            "start",
            "end success",
            "note",
            "start",
            "start",
            "end unsuccessful",
            "start",
        ];
        let marks: Vec<_> = (10..).zip(texts.map(said)).collect();
        let spans = marked(&marks, &marker);
        let found: Vec<_> = spans
            .iter()
            .map(|span| (span.start, span.end, span.success))
            .collect();
        let expected = [
            (11, 12, Some(true)),
            (14, 14, None),
            (15, 16, Some(false)),
            (17, i64::MAX, None),
        ];
        assert_eq!(found, expected);
    }

    #[test]
    fn flags_and_messages_begin_and_end_episodes() {
        let spans = |on: MarkerOn, marks: &[(i64, Said)]| -> Vec<(i64, i64)> {
            let topic = String::new();
            let spans = marked(marks, &Marker { topic, on });
            spans.iter().map(|span| (span.start, span.end)).collect()
        };
        let field = String::new();
        let flags = [0.0, 1.0, 1.0, 0.0, 0.0, 1.0].map(Said::Number);
        let marks: Vec<_> = (0..).zip(flags).collect();
        assert_eq!(
            spans(MarkerOn::Bool { field }, &marks),
            [(1, 3), (5, i64::MAX)]
        );
        assert_eq!(
            spans(MarkerOn::Message, &marks[..2]),
            [(0, 0), (1, i64::MAX)]
        );
    }
}
