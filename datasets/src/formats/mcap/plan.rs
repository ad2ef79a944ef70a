//! From the times of a recording to episodes and their steps.

use serde_json::Value;

use super::Metadata;
use super::align::pick;
use super::mapping::{Column, From, Grid, Mapping, OnMiss};
use super::numbered;
use super::spans::{Span, spans, success, task};
use super::survey::Survey;
use super::track::Track;
use crate::error::{DatasetError, Result};
use crate::source::Warning;

/// Rows of a recording, at most: six days at 30 Hz.
const MAX_ROWS: u64 = 16_000_000;

/// One episode.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct Episode {
    /// The number it has in the recording, if it has one.
    pub(crate) number: Option<i64>,
    /// Samples outside are never used.
    pub(crate) start: i64,
    pub(crate) end: i64,
    /// Times of the rows.
    pub(crate) rows: Vec<i64>,
    /// Whether the last row is only the observation after the last step.
    pub(crate) has_final: bool,
    /// Recorded step numbers and times, for rows that have them.
    pub(crate) recorded: Option<Vec<(i64, Option<i64>)>>,
    pub(crate) success: Option<bool>,
    pub(crate) task: Option<String>,
}

impl Episode {
    pub(crate) fn n_steps(&self) -> u64 {
        (self.rows.len() as u64).saturating_sub(u64::from(self.has_final))
    }
}

/// The episodes of a recording.
#[derive(Debug, Default)]
pub(crate) struct Episodes {
    pub(crate) episodes: Vec<Episode>,
    /// Spans without a step, which are left out.
    pub(crate) n_empty: u64,
    /// Steps left out because a column had no sample.
    pub(crate) n_dropped: u64,
    /// Steps at which an episode was cut because a column had no sample.
    pub(crate) n_split: u64,
    /// Numbered episodes left out because rows of them are lost.
    pub(crate) lost: Vec<Warning>,
}

/// Cuts a recording into episodes. With `recover`, numbered ones that are not whole are left out.
///
/// # Errors
/// A step without a sample in a column whose `on_miss` is an error, numbers that come back, too many rows.
pub(crate) fn episodes(survey: &Survey, mapping: &Mapping, recover: bool) -> Result<Episodes> {
    if let Grid::Index(index) = &mapping.grid {
        return numbered::episodes(survey, mapping, index, recover);
    }
    let mut out = Episodes::default();
    let ends_with_observation = mapping
        .columns
        .iter()
        .any(|column| matches!(column.from, From::NextOf(_)));
    let mut n_rows = 0;
    for span in spans(survey, mapping) {
        let Some((start, end)) = common_time(survey, mapping, &span) else {
            out.n_empty += 1;
            continue;
        };
        let times = grid(survey, mapping, start, end)?;
        n_rows += times.len() as u64;
        if n_rows > MAX_ROWS {
            return Err(too_many());
        }
        let before = out.episodes.len();
        add_pieces(survey, mapping, (&span, times), &mut out)?;
        for piece in out.episodes.iter_mut().skip(before) {
            piece.has_final = ends_with_observation;
            piece.task = task(survey, mapping, piece.end);
        }
        // Only the end of what was cut can have reached the goal; of the rest nothing is known.
        if let Some(last) = out.episodes.iter_mut().skip(before).next_back() {
            last.success = success(survey, mapping, &span);
        }
    }
    let found = out.episodes.len();
    out.episodes.retain(|episode| episode.n_steps() > 0);
    out.n_empty += (found - out.episodes.len()) as u64;
    Ok(out)
}

fn too_many() -> DatasetError {
    DatasetError::Unsupported {
        what: format!("more than {MAX_ROWS} steps in a recording"),
    }
}

/// From the latest first sample to the earliest last one of the required topics.
fn common_time(survey: &Survey, mapping: &Mapping, span: &Span) -> Option<(i64, i64)> {
    let (mut start, mut end) = (i64::MIN, i64::MAX);
    let grid = match &mapping.grid {
        Grid::Topic(topic) => Some(topic),
        _ => None,
    };
    let required = mapping.columns.iter().filter(|column| column.required);
    let topics = required.filter_map(|column| match &column.from {
        From::Topic(fields) => Some(&fields.topic),
        From::NextOf(_) => None,
    });
    for topic in grid.into_iter().chain(topics) {
        let track = survey.tracks.get(topic)?;
        let samples = track.times.get(track.range(span.start, span.end))?;
        start = start.max(*samples.first()?);
        end = end.min(*samples.last()?);
    }
    (start <= end && start != i64::MIN).then_some((start, end))
}

fn grid(survey: &Survey, mapping: &Mapping, start: i64, end: i64) -> Result<Vec<i64>> {
    match &mapping.grid {
        Grid::Pace(pace) => {
            let n = pace.count(start, end);
            if n > MAX_ROWS {
                return Err(too_many());
            }
            Ok((0..n).filter_map(|i| pace.time(start, i)).collect())
        }
        Grid::Topic(topic) => {
            let track = survey.tracks.get(topic);
            let times = track.and_then(|track| track.times.get(track.range(start, end)));
            let mut times = times.unwrap_or_default().to_vec();
            times.dedup();
            Ok(times)
        }
        Grid::Index(_) => Ok(Vec::new()),
    }
}

/// The steps of a span, cut where samples are missing.
fn add_pieces(
    survey: &Survey,
    mapping: &Mapping,
    (span, times): (&Span, Vec<i64>),
    out: &mut Episodes,
) -> Result<()> {
    let columns: Vec<_> = mapping
        .columns
        .iter()
        .filter(|column| column.on_miss != OnMiss::Null)
        .filter_map(|column| Some((column, samples(survey, column, span.start, span.end)?)))
        .collect();
    let mut piece = Vec::new();
    let mut close = |piece: &mut Vec<i64>| {
        if !piece.is_empty() {
            out.episodes.push(Episode {
                start: span.start,
                end: span.end,
                rows: std::mem::take(piece),
                ..Episode::default()
            });
        }
    };
    let (mut n_dropped, mut n_split) = (0, 0);
    for time in times {
        let missed = columns
            .iter()
            .filter(|(column, samples)| pick(samples, time, column.align, column.reach).is_none());
        match missed
            .map(|(column, _)| (worst(column.on_miss), *column))
            .max_by_key(|(rank, _)| *rank)
        {
            None => piece.push(time),
            Some((_, column)) if column.on_miss == OnMiss::Error => {
                return Err(DatasetError::NoSample {
                    column: column.name.clone(),
                    time_ns: time,
                });
            }
            Some((_, column)) if column.on_miss == OnMiss::Split => {
                n_split += 1;
                close(&mut piece);
            }
            Some(_) => n_dropped += 1,
        }
    }
    close(&mut piece);
    out.n_dropped += n_dropped;
    out.n_split += n_split;
    Ok(())
}

fn worst(on_miss: OnMiss) -> u8 {
    match on_miss {
        OnMiss::Null => 0,
        OnMiss::Drop => 1,
        OnMiss::Split => 2,
        OnMiss::Error => 3,
    }
}

/// The times of a column's samples in a span.
fn samples<'s>(survey: &'s Survey, column: &Column, start: i64, end: i64) -> Option<&'s [i64]> {
    let From::Topic(fields) = &column.from else {
        return None;
    };
    let track: &Track = survey.tracks.get(&fields.topic)?;
    track.times.get(track.range(start, end))
}

/// The metadata records of a file, as JSON.
pub(crate) fn metadata_json(survey: &Survey) -> Value {
    // The list of a written recording's episodes is no fact about any of them.
    let told = |record: &&Metadata| record.name != numbered::EPISODES_RECORD;
    let records = survey.metadata.iter().filter(told);
    let records = records
        .map(|metadata| serde_json::json!({ "name": metadata.name, "entries": metadata.entries }));
    Value::Array(records.collect())
}
