//! The first pass over a recording: when each mapped topic spoke, and what its messages look like.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use super::bind::{ChannelReader, Layout};
use super::mapping::{Clock, EpisodeRule, From, Grid, Mapping, MarkerOn, Recorded};
use super::track::Track;
use super::{
    Channel, Decoder, Extracted, FieldPath, Message, MessageOptions, Metadata, Plan, Recording,
};
use crate::error::{DatasetError, Result};
use crate::source::Warning;

/// Messages of mapped topics in a file, at most: what their times take stays under a few GB.
const MAX_MESSAGES: usize = 200_000_000;

/// What a pass over a file gave.
#[derive(Debug, Default)]
pub(crate) struct Survey {
    /// By topic, for all topics of the mapping.
    pub(crate) tracks: BTreeMap<String, Track>,
    /// By place of the column; `None` if no message had values.
    pub(crate) layouts: Vec<Option<Layout>>,
    /// Marker messages, by time.
    pub(crate) marks: Vec<(i64, Said)>,
    /// Numbers of the rows, for [`Grid::Index`], by time.
    pub(crate) rows: Vec<IndexRow>,
    /// What a topic said of success, by time.
    pub(crate) success: Vec<(i64, Said)>,
    /// What a topic said of the task, by time.
    pub(crate) task: Vec<(i64, Said)>,
    pub(crate) metadata: Vec<Metadata>,
    pub(crate) warnings: Vec<Warning>,
}

/// What a message of a marker topic says.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Said {
    Text(String),
    Number(f64),
    Nothing,
}

/// The numbers of a row.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct IndexRow {
    pub(crate) time: i64,
    pub(crate) episode: i64,
    pub(crate) step: i64,
    pub(crate) t_ns: Option<i64>,
}

impl Survey {
    /// Reads the times of all mapped topics of a recording.
    ///
    /// # Errors
    /// Damage, a mapped topic that cannot be decoded, or a time outside the clock's range.
    pub(crate) fn new(recording: &Recording, mapping: &Mapping) -> Result<Self> {
        let topics: BTreeSet<String> = mapping.topics().into_iter().map(str::to_owned).collect();
        let mut pass = Pass::new(mapping, &topics)?;
        let mut messages = recording.messages(&MessageOptions {
            topics: Some(topics),
        })?;
        let mut n_messages = 0;
        while let Some(message) = messages.next()? {
            n_messages += 1;
            if n_messages > MAX_MESSAGES {
                return Err(DatasetError::Unsupported {
                    what: format!("more than {MAX_MESSAGES} messages of mapped topics in a file"),
                });
            }
            pass.add(&message)?;
        }
        let mut survey = pass.finish();
        check_topics(mapping, messages.channels())?;
        survey.warnings.extend(recording.warnings().iter().cloned());
        survey.warnings.extend(messages.warnings().iter().cloned());
        survey.metadata = recording.metadata()?;
        Ok(survey)
    }
}

/// Every topic that a step waits for must be in the file.
fn check_topics(mapping: &Mapping, channels: &[Arc<Channel>]) -> Result<()> {
    let found: BTreeSet<&str> = channels
        .iter()
        .map(|channel| channel.topic.as_str())
        .collect();
    let optional = |topic: &str| {
        let mut columns = mapping
            .columns
            .iter()
            .filter_map(|column| match &column.from {
                From::Topic(fields) if fields.topic == topic => Some(column.required),
                _ => None,
            });
        let first = columns.next();
        first.is_some_and(|required| !required && !columns.any(|required| required))
    };
    let said_once = [&mapping.success, &mapping.task].into_iter().flatten();
    let said_once: Vec<&str> = said_once
        .filter_map(|recorded| match recorded {
            Recorded::Topic { topic, .. } => Some(topic.as_str()),
            _ => None,
        })
        .collect();
    for topic in mapping.topics() {
        if !found.contains(topic) && !optional(topic) && !said_once.contains(&topic) {
            return Err(DatasetError::MissingKey {
                key: format!("{topic} (a topic of the mapping)"),
                found: found.into_iter().collect::<Vec<_>>().join(", "),
            });
        }
    }
    Ok(())
}

/// The time of a message by a clock; `stamp` is what stands inside it.
pub(crate) fn time_of(
    message: &Message<'_>,
    clock: Clock,
    stamp: Option<i64>,
) -> Result<Option<i64>> {
    let time = match clock {
        Clock::Log => message.log_time,
        Clock::Publish => message.publish_time,
        Clock::Header => return Ok(stamp),
    };
    i64::try_from(time)
        .map(Some)
        .map_err(|_| message.error("a time beyond the year 2262"))
}

/// Something said by a topic beside the columns.
struct Listener {
    topic: String,
    paths: Vec<FieldPath>,
    plans: BTreeMap<u16, Plan>,
    heard: Vec<(i64, Vec<Said>)>,
}

impl Listener {
    fn new(topic: &str, paths: &[&str]) -> Result<Self> {
        Ok(Self {
            topic: topic.to_owned(),
            paths: paths
                .iter()
                .map(|path| path.parse())
                .collect::<Result<_>>()?,
            plans: BTreeMap::new(),
            heard: Vec::new(),
        })
    }

    fn hear(&mut self, message: &Message<'_>, time: i64, scratch: &mut Extracted) -> Result<()> {
        if message.channel.topic != self.topic {
            return Ok(());
        }
        if self.paths.is_empty() {
            self.heard.push((time, Vec::new()));
            return Ok(());
        }
        let plan = match self.plans.entry(message.channel.id) {
            std::collections::btree_map::Entry::Occupied(entry) => entry.into_mut(),
            std::collections::btree_map::Entry::Vacant(entry) => {
                entry.insert(Decoder::new(message.channel)?.plan(&self.paths)?)
            }
        };
        plan.extract(message, scratch)?;
        let said = scratch.slots().iter().map(|slot| {
            let text = slot.texts().next().map(str::to_owned);
            let number = || slot.numbers().first().copied().map(Said::Number);
            text.map(Said::Text)
                .or_else(number)
                .unwrap_or(Said::Nothing)
        });
        self.heard.push((time, said.collect()));
        Ok(())
    }

    /// What was heard, by time, and in file order where times are equal.
    fn sorted(mut self) -> Vec<(i64, Vec<Said>)> {
        self.heard.sort_by_key(|(time, _)| *time);
        self.heard
    }
}

/// The readers of one channel.
struct Source {
    /// Reads whole columns, until their layouts are known.
    columns: ChannelReader,
    /// Reads only the time stamp.
    stamps: Option<ChannelReader>,
}

struct Pass<'m> {
    mapping: &'m Mapping,
    times: BTreeMap<String, Vec<Option<i64>>>,
    sources: BTreeMap<u16, Option<Source>>,
    layouts: Vec<Option<Layout>>,
    marker: Option<Listener>,
    index: Option<Listener>,
    success: Option<Listener>,
    task: Option<Listener>,
    scratch: Extracted,
}

impl<'m> Pass<'m> {
    fn new(mapping: &'m Mapping, topics: &BTreeSet<String>) -> Result<Self> {
        let marker = match &mapping.episodes {
            EpisodeRule::Marker(marker) => {
                let paths = match &marker.on {
                    MarkerOn::Text { field, .. } | MarkerOn::Bool { field } => vec![field.as_str()],
                    MarkerOn::Message => Vec::new(),
                };
                Some(Listener::new(&marker.topic, &paths)?)
            }
            _ => None,
        };
        let index = match &mapping.grid {
            Grid::Index(index) => {
                let mut paths = vec![index.episode.as_str(), index.step.as_str()];
                paths.extend(index.t_ns.as_deref());
                Some(Listener::new(&index.topic, &paths)?)
            }
            _ => None,
        };
        let recorded = |recorded: &Option<Recorded>| match recorded {
            Some(Recorded::Topic { topic, field }) => Listener::new(topic, &[field]).map(Some),
            _ => Ok(None),
        };
        Ok(Self {
            mapping,
            times: topics
                .iter()
                .map(|topic| (topic.clone(), Vec::new()))
                .collect(),
            sources: BTreeMap::new(),
            layouts: vec![None; mapping.columns.len()],
            marker,
            index,
            success: recorded(&mapping.success)?,
            task: recorded(&mapping.task)?,
            scratch: Extracted::default(),
        })
    }

    fn add(&mut self, message: &Message<'_>) -> Result<()> {
        let clock = self.mapping.clock;
        let stamp = self.look(message)?;
        let time = time_of(message, clock, stamp)?;
        if let Some(times) = self.times.get_mut(&message.channel.topic) {
            times.push(time);
        }
        let Some(time) = time else {
            return Ok(());
        };
        let listeners = [
            &mut self.marker,
            &mut self.index,
            &mut self.success,
            &mut self.task,
        ];
        for listener in listeners.into_iter().flatten() {
            listener.hear(message, time, &mut self.scratch)?;
        }
        Ok(())
    }

    /// Learns layouts from a message, and reads its stamp if that is the clock.
    fn look(&mut self, message: &Message<'_>) -> Result<Option<i64>> {
        let by_stamp = self.mapping.clock == Clock::Header;
        let mapping = self.mapping;
        let source = match self.sources.entry(message.channel.id) {
            std::collections::btree_map::Entry::Occupied(entry) => entry.into_mut(),
            std::collections::btree_map::Entry::Vacant(entry) => {
                entry.insert(Source::new(message.channel, mapping)?)
            }
        };
        let Some(source) = source else {
            return Ok(None);
        };
        let is_known = (0..source.columns.n_columns()).all(|at| {
            self.layouts
                .get(source.columns.column(at))
                .is_some_and(Option::is_some)
        });
        if is_known {
            return match &mut source.stamps {
                Some(stamps) if by_stamp => {
                    stamps.load(message)?;
                    Ok(stamps.stamp())
                }
                _ => Ok(None),
            };
        }
        source.columns.load(message)?;
        for at in 0..source.columns.n_columns() {
            let layout = source.columns.layout(at, message)?;
            if let Some(known @ None) = self.layouts.get_mut(source.columns.column(at)) {
                *known = layout;
            }
        }
        Ok(source.columns.stamp())
    }

    fn finish(self) -> Survey {
        let unstamped = self.times.iter().filter_map(|(topic, times)| {
            let n_messages = times.iter().filter(|time| time.is_none()).count() as u64;
            let topic = topic.clone();
            (n_messages > 0).then_some(Warning::NoTimeStamp { topic, n_messages })
        });
        let one = |listener: Option<Listener>| -> Vec<(i64, Said)> {
            let heard = listener.map(Listener::sorted).unwrap_or_default();
            heard
                .into_iter()
                .map(|(time, mut said)| (time, said.pop().unwrap_or(Said::Nothing)))
                .collect()
        };
        let rows = self.index.map(Listener::sorted).unwrap_or_default();
        Survey {
            warnings: unstamped.collect(),
            marks: one(self.marker),
            success: one(self.success),
            task: one(self.task),
            rows: rows
                .iter()
                .filter_map(|(time, said)| IndexRow::new(*time, said))
                .collect(),
            tracks: self
                .times
                .into_iter()
                .map(|(topic, times)| (topic, Track::new(times)))
                .collect(),
            layouts: self.layouts,
            metadata: Vec::new(),
        }
    }
}

impl Source {
    /// `None` if nothing but the message's time is wanted of this channel.
    fn new(channel: &Arc<Channel>, mapping: &Mapping) -> Result<Option<Self>> {
        let columns: Vec<_> = mapping
            .columns
            .iter()
            .enumerate()
            .filter(|(_, column)| matches!(&column.from, From::Topic(fields) if fields.topic == channel.topic))
            .collect();
        let by_stamp = mapping.clock == Clock::Header;
        if columns.is_empty() && !by_stamp {
            return Ok(None);
        }
        let reader = |columns: &[_]| ChannelReader::new(channel, columns, by_stamp);
        let bound = reader(&columns).and_then(|columns| {
            let stamps = by_stamp.then(|| reader(&[])).transpose()?;
            Ok(Some(Self { columns, stamps }))
        });
        bound.map_err(|error| DatasetError::Topic {
            topic: channel.topic.clone(),
            source: Box::new(error),
        })
    }
}

impl IndexRow {
    fn new(time: i64, said: &[Said]) -> Option<Self> {
        // Exact: the decoder refuses integers that f64 cannot hold.
        let number = |at: usize| match said.get(at) {
            Some(Said::Number(number)) => Some(*number as i64),
            _ => None,
        };
        Some(Self {
            time,
            episode: number(0)?,
            step: number(1)?,
            t_ns: number(2),
        })
    }
}
