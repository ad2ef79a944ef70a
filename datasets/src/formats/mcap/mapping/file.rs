//! The mapping as it stands in the TOML file; `check` turns it into the [`super::Mapping`] that is used.

use std::collections::BTreeMap;

use serde::Deserialize;
use toml::Spanned;

use super::{Clock, Dtype, Kind, Missing, OnMiss};
use crate::formats::mcap::align::Align;

/// Named columns under one root; the order in the file is found again by the spans.
pub(super) type Fields = BTreeMap<String, Spanned<Field>>;

/// The file. `A` is how `[action]` is written: one column, or a table of named ones.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct File<A> {
    #[serde(default)]
    pub(super) clock: Clock,
    pub(super) grid: Option<Spanned<Grid>>,
    pub(super) index: Option<Spanned<Index>>,
    pub(super) episodes: Option<Spanned<Episodes>>,
    #[serde(default)]
    pub(super) observation: Fields,
    pub(super) action: Option<A>,
    pub(super) reward: Option<Spanned<Field>>,
    pub(super) terminated: Option<Spanned<Field>>,
    pub(super) truncated: Option<Spanned<Field>>,
    #[serde(default)]
    pub(super) next_observation: Fields,
    #[serde(default)]
    pub(super) info: Fields,
    pub(super) success: Option<Spanned<Recorded>>,
    pub(super) task: Option<Spanned<Recorded>>,
}

/// The moments at which there is a step.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Grid {
    pub(super) rate_hz: Option<f64>,
    pub(super) step_ns: Option<u64>,
    pub(super) topic: Option<String>,
}

/// A topic whose messages are the rows, with their numbers.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Index {
    pub(super) topic: String,
    pub(super) episode: String,
    pub(super) step: String,
    pub(super) t_ns: Option<String>,
}

/// Where episodes begin and end.
#[derive(Debug, Deserialize)]
#[serde(tag = "by", rename_all = "snake_case", deny_unknown_fields)]
pub(super) enum Episodes {
    File {},
    Gap {
        topic: String,
        gap_s: f64,
    },
    Marker {
        topic: String,
        #[serde(default)]
        on: On,
        field: Option<String>,
        start: Option<String>,
        end: Option<String>,
        success: Option<String>,
        failure: Option<String>,
    },
}

/// What a marker message says.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum On {
    #[default]
    Text,
    Bool,
    Message,
}

/// One column.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Field {
    pub(super) topic: Option<String>,
    pub(super) field: Option<Paths>,
    pub(super) next_of: Option<String>,
    pub(super) names: Option<Vec<String>>,
    pub(super) names_field: Option<String>,
    #[serde(default)]
    pub(super) missing: Missing,
    pub(super) dtype: Option<Dtype>,
    pub(super) shape: Option<Vec<usize>>,
    pub(super) unit: Option<String>,
    pub(super) kind: Option<Kind>,
    pub(super) align: Option<Align>,
    pub(super) max_age_s: Option<f64>,
    pub(super) max_gap_s: Option<f64>,
    pub(super) on_miss: Option<OnMiss>,
    pub(super) required: Option<bool>,
    #[serde(default)]
    pub(super) metadata: BTreeMap<String, String>,
}

/// One path inside a message, or several whose values are joined.
#[derive(Debug, Deserialize)]
#[serde(untagged)]
pub(super) enum Paths {
    One(String),
    Several(Vec<String>),
}

/// Something said once per recording or episode.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Recorded {
    pub(super) metadata: Option<String>,
    pub(super) key: Option<String>,
    pub(super) text: Option<String>,
    pub(super) topic: Option<String>,
    pub(super) field: Option<String>,
}

impl<A> File<A> {
    /// The same file with `[action]` written another way.
    pub(super) fn map_action<B>(self, map: impl FnOnce(A) -> B) -> File<B> {
        File {
            clock: self.clock,
            grid: self.grid,
            index: self.index,
            episodes: self.episodes,
            observation: self.observation,
            action: self.action.map(map),
            reward: self.reward,
            terminated: self.terminated,
            truncated: self.truncated,
            next_observation: self.next_observation,
            info: self.info,
            success: self.success,
            task: self.task,
        }
    }
}
