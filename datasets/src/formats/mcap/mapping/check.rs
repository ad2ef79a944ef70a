//! From the TOML file to a mapping that makes sense; every fault is named with its line.

use std::ops::Range;

use serde::de::DeserializeOwned;
use toml::Spanned;

use super::columns::columns;
use super::file::{self, Episodes, Field, Fields, File, On};
use super::{EpisodeRule, Grid, Index, Mapping, Marker, MarkerOn, Recorded};
use crate::error::{DatasetError, Result};
use crate::formats::mcap::align::Pace;

/// Steps per second that a grid may have, at most.
const MAX_RATE_HZ: f64 = 1e6;
/// Seconds of an age or gap, at most: some thirty years.
const MAX_SECONDS: f64 = 1e9;

pub(super) fn parse(text: &str) -> Result<Mapping> {
    let place = Place { text };
    let table: toml::Table = place.read()?;
    // A column has a topic or copies another one; a table of columns has neither.
    let action = table.get("action").and_then(toml::Value::as_table);
    let is_text =
        |key: &str| action.is_some_and(|action| action.get(key).is_some_and(toml::Value::is_str));
    let file: File<Fields> = match is_text("topic") || is_text("next_of") {
        true => place
            .read::<File<Spanned<Field>>>()?
            .map_action(|field| Fields::from([(String::new(), field)])),
        false => place.read()?,
    };
    mapping(&place, file)
}

fn mapping(place: &Place<'_>, file: File<Fields>) -> Result<Mapping> {
    let grid = match (&file.grid, &file.index) {
        (Some(grid), None) => self::grid(place, grid)?,
        (None, Some(index)) => Grid::Index(self::index(place, index, &file)?),
        (Some(_), Some(index)) => {
            return Err(place.fault(index.span(), "[index] and [grid] exclude each other"));
        }
        (None, None) => {
            return Err(place.fault(
                0..0,
                "there is no [grid]: say `rate_hz` (steps per second) or `topic` in it",
            ));
        }
    };
    let episodes = match (&grid, &file.episodes) {
        (Grid::Index(_), _) => EpisodeRule::Index,
        (_, None) => EpisodeRule::File,
        (_, Some(episodes)) => episode_rule(place, episodes)?,
    };
    Ok(Mapping {
        text: place.text.to_owned(),
        clock: file.clock,
        success: recorded(place, file.success.as_ref(), "success")?,
        task: recorded(place, file.task.as_ref(), "task")?,
        columns: columns(place, file, matches!(grid, Grid::Index(_)))?,
        grid,
        episodes,
    })
}

fn grid(place: &Place<'_>, grid: &Spanned<file::Grid>) -> Result<Grid> {
    let fault = |message: &str| Err(place.fault(grid.span(), message));
    match grid.get_ref() {
        file::Grid {
            rate_hz: Some(rate),
            step_ns: None,
            topic: None,
        } => {
            let micro = (rate * 1e6).round();
            if !(1.0..=MAX_RATE_HZ * 1e6).contains(&micro) {
                return fault("`rate_hz` must be from 0.000001 to 1000000");
            }
            // In range: just checked.
            Ok(Grid::Pace(Pace::MicroHertz(micro as u64)))
        }
        file::Grid {
            rate_hz: None,
            step_ns: Some(step),
            topic: None,
        } => match step {
            1_000..=1_000_000_000_000 => Ok(Grid::Pace(Pace::StepNs(*step))),
            _ => fault("`step_ns` must be from 1000 to 10^12"),
        },
        file::Grid {
            rate_hz: None,
            step_ns: None,
            topic: Some(topic),
        } => Ok(Grid::Topic(topic.clone())),
        _ => fault("[grid] needs exactly one of `rate_hz`, `step_ns` and `topic`"),
    }
}

fn index(place: &Place<'_>, index: &Spanned<file::Index>, file: &File<Fields>) -> Result<Index> {
    if let Some(episodes) = &file.episodes {
        return Err(place.fault(
            episodes.span(),
            "[episodes] has no place beside [index], which numbers them",
        ));
    }
    let file::Index {
        topic,
        episode,
        step,
        t_ns,
    } = index.get_ref();
    Ok(Index {
        topic: topic.clone(),
        episode: episode.clone(),
        step: step.clone(),
        t_ns: t_ns.clone(),
    })
}

fn episode_rule(place: &Place<'_>, episodes: &Spanned<Episodes>) -> Result<EpisodeRule> {
    let fault = |message: &str| place.fault(episodes.span(), message);
    match episodes.get_ref() {
        Episodes::File {} => Ok(EpisodeRule::File),
        Episodes::Gap { topic, gap_s } => Ok(EpisodeRule::Gap {
            topic: topic.clone(),
            gap_ns: place.nanoseconds(*gap_s, "gap_s", &episodes.span())?,
        }),
        Episodes::Marker {
            topic,
            on,
            field,
            start,
            end,
            success,
            failure,
        } => {
            let texts = [start, end, success, failure];
            if *on != On::Text && texts.iter().any(|text| text.is_some()) {
                return Err(fault(
                    "`start`, `end`, `success` and `failure` are for `on = \"text\"`",
                ));
            }
            let field = || field.clone().unwrap_or_else(|| "data".to_owned());
            let on = match on {
                On::Message => MarkerOn::Message,
                On::Bool => MarkerOn::Bool { field: field() },
                On::Text => MarkerOn::Text {
                    field: field(),
                    start: start
                        .clone()
                        .ok_or_else(|| fault("a text marker needs `start`"))?,
                    end: end.clone(),
                    success: success.clone(),
                    failure: failure.clone(),
                },
            };
            let topic = topic.clone();
            Ok(EpisodeRule::Marker(Marker { topic, on }))
        }
    }
}

fn recorded(
    place: &Place<'_>,
    recorded: Option<&Spanned<file::Recorded>>,
    what: &str,
) -> Result<Option<Recorded>> {
    let Some(recorded) = recorded else {
        return Ok(None);
    };
    let parts = recorded.get_ref();
    let none = |parts: [&Option<String>; 3]| parts.iter().all(|part| part.is_none());
    match (&parts.metadata, &parts.text, &parts.topic) {
        (Some(record), ..) if none([&parts.text, &parts.topic, &parts.field]) => {
            Ok(Some(Recorded::Metadata {
                record: record.clone(),
                key: parts.key.clone().unwrap_or_else(|| what.to_owned()),
            }))
        }
        (_, Some(text), _) if none([&parts.metadata, &parts.topic, &parts.field]) => {
            Ok(Some(Recorded::Text(text.clone())))
        }
        (_, _, Some(topic)) if none([&parts.metadata, &parts.text, &parts.key]) => {
            Ok(Some(Recorded::Topic {
                topic: topic.clone(),
                field: parts.field.clone().unwrap_or_else(|| "data".to_owned()),
            }))
        }
        _ => Err(place.fault(
            recorded.span(),
            &format!("[{what}] needs `metadata` (and `key`), or `text`, or `topic` (and `field`)"),
        )),
    }
}

/// The text, for messages with lines.
pub(super) struct Place<'t> {
    text: &'t str,
}

impl Place<'_> {
    fn read<T: DeserializeOwned>(&self) -> Result<T> {
        toml::from_str(self.text)
            .map_err(|error| self.fault(error.span().unwrap_or(0..0), error.message()))
    }

    pub(super) fn fault(&self, span: Range<usize>, message: &str) -> DatasetError {
        let before = self.text.get(..span.start).unwrap_or_default();
        DatasetError::Mapping {
            line: before.matches('\n').count() + 1,
            message: message.trim_end().to_owned(),
        }
    }

    /// Seconds as whole nanoseconds.
    pub(super) fn nanoseconds(&self, seconds: f64, key: &str, span: &Range<usize>) -> Result<u64> {
        if !(0.0..=MAX_SECONDS).contains(&seconds) {
            let message = format!("`{key}` must be from 0 to {MAX_SECONDS} seconds");
            return Err(self.fault(span.clone(), &message));
        }
        // In range: just checked.
        Ok((seconds * 1e9).round() as u64)
    }
}
