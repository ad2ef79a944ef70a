//! What a pass over the messages has met, and whether it is what the summary says.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use super::registry::Registry;
use super::types::{AttachmentEntry, Channel, Metadata, Statistics};
use crate::error::{DatasetError, Result};
use crate::source::Warning;

/// Losses listed one by one; of more, the number is told.
const MAX_LOSSES: usize = 1000;

/// The account of a pass.
#[derive(Debug, Default)]
pub(super) struct Ledger {
    registry: Registry,
    topics: Option<BTreeSet<String>>,
    /// Of each channel of the registry, in its order.
    states: Vec<State>,
    recover: bool,
    pub(super) warnings: Vec<Warning>,
    n_losses: usize,
    pub(super) metadata: Vec<Metadata>,
    pub(super) attachments: Vec<AttachmentEntry>,
    n_chunks: u64,
    times: Option<(u64, u64)>,
    schemas_met: BTreeSet<u16>,
    channels_met: BTreeSet<u16>,
    /// Messages of channels that were never announced.
    orphans: BTreeMap<u16, u64>,
    pub(super) n_chunks_passed: u64,
}

#[derive(Debug, Clone, Copy)]
struct State {
    wanted: bool,
    n_messages: u64,
}

impl Ledger {
    /// `known` holds channels that need not be announced before their messages.
    pub(super) fn new(known: Registry, topics: Option<BTreeSet<String>>, recover: bool) -> Self {
        let mut ledger = Self {
            topics,
            recover,
            ..Self::default()
        };
        ledger.states = known
            .channels()
            .iter()
            .map(|channel| ledger.state(channel))
            .collect();
        ledger.registry = known;
        ledger
    }

    fn state(&self, channel: &Channel) -> State {
        let wanted = match &self.topics {
            Some(topics) => topics.contains(&channel.topic),
            None => true,
        };
        State {
            wanted,
            n_messages: 0,
        }
    }

    pub(super) fn channels(&self) -> &[Arc<Channel>] {
        self.registry.channels()
    }

    pub(super) fn recovers(&self) -> bool {
        self.recover
    }

    pub(super) fn has_losses(&self) -> bool {
        self.n_losses > 0
    }

    /// Notes a loss.
    pub(super) fn lose(&mut self, what: String) {
        self.n_losses += 1;
        if self.n_losses <= MAX_LOSSES {
            self.warnings.push(Warning::Lost { what });
        }
    }

    /// Turns damage into a loss, if recovering.
    pub(super) fn survive<T>(&mut self, result: Result<T>) -> Result<Option<T>> {
        match result {
            Ok(value) => Ok(Some(value)),
            Err(DatasetError::Corrupt { what }) if self.recover => {
                self.lose(what);
                Ok(None)
            }
            Err(error) => Err(error),
        }
    }

    pub(super) fn add_schema(&mut self, bytes: &[u8], offset: u64) -> Result<()> {
        let added = self.registry.add_schema(bytes, offset);
        if let Some(id) = self.survive(added)? {
            self.schemas_met.insert(id);
        }
        Ok(())
    }

    pub(super) fn add_channel(&mut self, bytes: &[u8], offset: u64) -> Result<()> {
        let added = self.registry.add_channel(bytes, offset);
        let Some((id, place)) = self.survive(added)? else {
            return Ok(());
        };
        self.channels_met.insert(id);
        let new = place.and_then(|place| Some((place, self.registry.channels().get(place)?)));
        if let Some((place, channel)) = new {
            let state = self.state(channel);
            self.states.insert(place, state);
        }
        Ok(())
    }

    /// Counts a message; the place of its channel if it is wanted.
    pub(super) fn add_message(
        &mut self,
        channel: u16,
        log_time: u64,
        offset: u64,
    ) -> Result<Option<usize>> {
        let (first, last) = self.times.unwrap_or((log_time, log_time));
        self.times = Some((first.min(log_time), last.max(log_time)));
        let place = self.registry.place(channel);
        let Some((place, state)) = place.and_then(|p| Some((p, self.states.get_mut(p)?))) else {
            if self.recover {
                *self.orphans.entry(channel).or_default() += 1;
                return Ok(None);
            }
            return Err(DatasetError::corrupt(format!(
                "a message at or after offset {offset} (log time {log_time} ns) is of channel {channel}, \
                 which is not defined before it"
            )));
        };
        state.n_messages += 1;
        Ok(state.wanted.then_some(place))
    }

    pub(super) fn add_chunk(&mut self) {
        self.n_chunks += 1;
    }

    /// At the end: what is left to tell.
    pub(super) fn finish(&mut self, statistics: Option<&Statistics>) {
        for (channel, n) in std::mem::take(&mut self.orphans) {
            self.lose(format!(
                "{n} messages of channel {channel}, whose definition is missing"
            ));
        }
        if let Some(more) = self.n_losses.checked_sub(MAX_LOSSES).filter(|&n| n > 0) {
            let what = format!("{more} more parts");
            self.warnings.push(Warning::Lost { what });
        }
        if let Some(statistics) = statistics {
            self.compare(statistics);
        }
    }

    fn compare(&mut self, statistics: &Statistics) {
        let mut counts = vec![
            ("chunks", statistics.chunk_count.into(), self.n_chunks),
            (
                "attachments",
                statistics.attachment_count.into(),
                self.attachments.len() as u64,
            ),
            (
                "metadata records",
                statistics.metadata_count.into(),
                self.metadata.len() as u64,
            ),
        ];
        if self.n_chunks_passed == 0 {
            let n_messages = self.states.iter().map(|state| state.n_messages).sum();
            let (first, last) = self.times.unwrap_or_default();
            counts.extend([
                ("messages", statistics.message_count, n_messages),
                (
                    "schemas",
                    statistics.schema_count.into(),
                    self.schemas_met.len() as u64,
                ),
                (
                    "channels",
                    statistics.channel_count.into(),
                    self.channels_met.len() as u64,
                ),
                ("ns as first log time", statistics.message_start_time, first),
                ("ns as last log time", statistics.message_end_time, last),
            ]);
        }
        if self.topics.is_some() && !statistics.channel_message_counts.is_empty() {
            let wanted = self.registry.channels().iter().zip(&self.states);
            let mut sums = (0_u64, 0_u64);
            for (channel, state) in wanted.filter(|(_, state)| state.wanted) {
                let noted = statistics.channel_message_counts.get(&channel.id);
                sums.0 = sums.0.saturating_add(noted.copied().unwrap_or_default());
                sums.1 += state.n_messages;
            }
            counts.push(("messages of the topics read", sums.0, sums.1));
        }
        for (what, recorded, actual) in counts {
            if recorded != actual {
                self.warnings.push(Warning::CountMismatch {
                    what,
                    recorded,
                    actual,
                });
            }
        }
    }
}
