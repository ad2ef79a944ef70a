//! A pass over a recording that emits rows as soon as all their samples were read.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use arrow::array::{ArrayRef, Int64Array, RecordBatch, RecordBatchOptions};
use arrow::datatypes::SchemaRef;

use super::align::Pick;
use super::bind::{ChannelReader, Layout};
use super::feeds::{Feed, Store, Window, add_picks, numbers, ranks};
use super::mapping::{Clock, Column, From, Mapping};
use super::plan::Episode;
use super::rows::{self, Rows};
use super::survey::time_of;
use super::track::Track;
use super::{Channel, MessageOptions, Messages, Recording};
use crate::error::{DatasetError, Result};
use crate::schema;

/// Bytes of samples and rows after which a batch is handed out though it could have more rows.
const BATCH_BYTES: usize = 64 << 20;
/// Bytes of samples that may wait for others: only recordings far out of order need as much.
const MAX_WAITING_BYTES: usize = 1 << 30;

/// One file and what is known of it.
pub(crate) struct FileInput<'a> {
    pub(crate) recording: &'a Recording,
    pub(crate) mapping: &'a Mapping,
    pub(crate) tracks: &'a BTreeMap<String, Track>,
    pub(crate) layouts: &'a [Layout],
    /// The wanted episodes with their numbers.
    pub(crate) episodes: Vec<(i64, &'a Episode)>,
}

/// A pass over one file.
pub(crate) struct FileScan<'a> {
    input: FileInput<'a>,
    schema: SchemaRef,
    batch_rows: usize,
    messages: Option<Messages>,
    channels: BTreeMap<u16, (usize, ChannelReader)>,
    topics: Vec<Topic<'a>>,
    stores: Vec<Store>,
    feeds: Vec<Feed>,
    /// Numbers of every row: episode, step, time.
    numbers: Vec<(i64, i64, Option<i64>)>,
    n_emitted: usize,
    held: usize,
}

/// A topic with the stores its messages go to.
struct Topic<'a> {
    name: String,
    track: &'a Track,
    stores: Vec<usize>,
    n_seen: usize,
}

impl<'a> FileScan<'a> {
    /// Starts a pass for the columns of `schema`.
    ///
    /// # Errors
    /// The file cannot be opened.
    pub(crate) fn new(input: FileInput<'a>, schema: &SchemaRef, batch_rows: usize) -> Result<Self> {
        let mut scan = Self {
            schema: Arc::clone(schema),
            batch_rows,
            messages: None,
            channels: BTreeMap::new(),
            topics: Vec::new(),
            stores: Vec::new(),
            feeds: Vec::new(),
            numbers: input
                .episodes
                .iter()
                .flat_map(|(number, episode)| numbers(*number, episode))
                .collect(),
            n_emitted: 0,
            held: 0,
            input,
        };
        for (place, column) in scan.input.mapping.columns.iter().enumerate() {
            if let Ok(field) = schema.index_of(&column.name) {
                scan.add_feed(field, place, column);
            }
        }
        let topics: BTreeSet<String> = scan.topics.iter().map(|topic| topic.name.clone()).collect();
        if !topics.is_empty() {
            let options = MessageOptions {
                topics: Some(topics),
            };
            scan.messages = Some(scan.input.recording.messages(&options)?);
        }
        Ok(scan)
    }

    fn add_feed(&mut self, field: usize, place: usize, column: &Column) {
        let mapping = self.input.mapping;
        let (base, shift) = match column.from {
            From::NextOf(base) => (base, 1),
            From::Topic(_) => (place, 0),
        };
        let Some(From::Topic(fields)) = mapping.columns.get(base).map(|column| &column.from) else {
            return;
        };
        let Some((name, track)) = self.input.tracks.get_key_value(&fields.topic) else {
            return;
        };
        let store = match self.stores.iter().position(|store| store.column == base) {
            Some(store) => store,
            None => {
                self.stores.push(Store {
                    column: base,
                    samples: Window::default(),
                    last_use: vec![0; track.times.len()],
                });
                let store = self.stores.len() - 1;
                match self.topics.iter_mut().find(|topic| topic.name == *name) {
                    Some(topic) => topic.stores.push(store),
                    None => self.topics.push(Topic {
                        name: name.clone(),
                        track,
                        stores: vec![store],
                        n_seen: 0,
                    }),
                }
                store
            }
        };
        let mut picks = Vec::with_capacity(self.numbers.len());
        for (_, episode) in &self.input.episodes {
            let base = mapping.columns.get(base).unwrap_or(column);
            add_picks(episode, (base, column.role, shift), track, &mut picks);
        }
        if let Some(store) = self.stores.get_mut(store) {
            store.need(&picks);
        }
        self.feeds.push(Feed {
            field,
            column: place,
            store,
            picks,
            ready: 0,
        });
    }

    /// The next rows, or `None` at the end.
    ///
    /// # Errors
    /// Damage, messages that do not fit their type or the columns.
    pub(crate) fn next_batch(&mut self) -> Result<Option<RecordBatch>> {
        let n_rows = self.numbers.len();
        let first_rows = self.advance(None);
        let mut ready = first_rows;
        while ready < n_rows && ready - self.n_emitted < self.batch_rows {
            if self.held > BATCH_BYTES && ready > self.n_emitted {
                break;
            }
            if self.held > MAX_WAITING_BYTES {
                return Err(DatasetError::Unsupported {
                    what: format!(
                        "a recording so far out of order that over {MAX_WAITING_BYTES} bytes wait for other messages"
                    ),
                });
            }
            match self.read_message()? {
                Some(topic) => ready = self.advance(Some(topic)),
                None => {
                    return Err(DatasetError::corrupt(
                        "messages are missing that were there when the recording was opened",
                    ));
                }
            }
        }
        if ready == self.n_emitted {
            return Ok(None);
        }
        self.emit(ready).map(Some)
    }

    /// Reads one message into the stores; gives its topic, or `None` at the end.
    fn read_message(&mut self) -> Result<Option<usize>> {
        let Some(messages) = &mut self.messages else {
            return Ok(None);
        };
        let Some(message) = messages.next()? else {
            return Ok(None);
        };
        let entry = match self.channels.entry(message.channel.id) {
            std::collections::btree_map::Entry::Occupied(entry) => entry.into_mut(),
            std::collections::btree_map::Entry::Vacant(entry) => entry.insert(bind(
                message.channel,
                &self.topics,
                &self.stores,
                self.input.mapping,
            )?),
        };
        let (topic_index, reader) = entry;
        let Some(topic) = self.topics.get_mut(*topic_index) else {
            return Ok(Some(*topic_index));
        };
        let rank = topic.track.rank(topic.n_seen);
        topic.n_seen += 1;
        let Some(rank) = rank else {
            return Ok(Some(*topic_index));
        };
        // Ranks are places in the file: were one message more or less delivered now, all after it would be taken
        // for their neighbors.
        let clock = self.input.mapping.clock;
        if clock != Clock::Header
            && time_of(&message, clock, None)? != topic.track.times.get(rank).copied()
        {
            return Err(message.error("it was not here when the recording was opened"));
        }
        let mut is_loaded = false;
        for (at, store) in topic.stores.iter().enumerate() {
            let Some(store) = self.stores.get_mut(*store) else {
                continue;
            };
            let last_use = store.last_use.get(rank).copied().unwrap_or(0) as usize;
            if last_use <= self.n_emitted {
                continue;
            }
            if !is_loaded {
                reader.load(&message)?;
                is_loaded = true;
            }
            let mut bytes = Vec::new();
            let layout = self.input.layouts.get(store.column);
            let is_there = match layout {
                Some(layout) => reader.read(at, layout, &message, &mut bytes)?,
                None => false,
            };
            self.held += bytes.len();
            store.samples.insert(rank, is_there.then_some(bytes));
        }
        Ok(Some(*topic_index))
    }

    /// Counts the rows that are ready, after a message of a topic (or of any).
    fn advance(&mut self, topic: Option<usize>) -> usize {
        let stores = topic
            .and_then(|topic| self.topics.get(topic))
            .map(|topic| &topic.stores);
        for feed in &mut self.feeds {
            if stores.is_some_and(|stores| !stores.contains(&feed.store)) {
                continue;
            }
            let Some(store) = self.stores.get(feed.store) else {
                continue;
            };
            let is_there = |pick: &Option<Pick>| {
                pick.iter()
                    .flat_map(ranks)
                    .all(|rank| store.samples.get(rank).is_some())
            };
            while feed.picks.get(feed.ready).is_some_and(is_there) {
                feed.ready += 1;
            }
        }
        let ready = self.feeds.iter().map(|feed| feed.ready).min();
        ready.unwrap_or(self.numbers.len())
    }

    /// Builds a batch of rows up to `ready`, and lets go of the samples that no other row needs.
    fn emit(&mut self, ready: usize) -> Result<RecordBatch> {
        let start = self.n_emitted;
        let limit = ready.min(start + self.batch_rows);
        let mut columns: Vec<Rows> = Vec::with_capacity(self.feeds.len());
        for feed in &self.feeds {
            let field = self.schema.fields().get(feed.field);
            let layout = self.input.layouts.get(feed.column);
            let (Some(field), Some(layout)) = (field, layout) else {
                return Err(DatasetError::corrupt("a column vanished"));
            };
            columns.push(Rows::new(field, layout));
        }
        let mut end = start;
        while end < limit {
            let mut size = 0;
            for (feed, rows) in self.feeds.iter().zip(&mut columns) {
                self.push_row(feed, end, rows)?;
                size += rows.size();
            }
            end += 1;
            if size > BATCH_BYTES {
                break;
            }
        }
        self.n_emitted = end;
        for store in &mut self.stores {
            self.held = self.held.saturating_sub(store.release(end));
        }
        self.batch(start..end, columns)
    }

    fn push_row(&self, feed: &Feed, row: usize, out: &mut Rows) -> Result<()> {
        let Some(Some(pick)) = feed.picks.get(row) else {
            return out.push(None);
        };
        let samples = self.stores.get(feed.store).map(|store| &store.samples);
        let sample = |rank: usize| samples.and_then(|samples| samples.get(rank)?.as_deref());
        let first = sample(pick.first);
        let Some((second, weight)) = pick.second else {
            return out.push(first);
        };
        let (Some(before), Some(after)) = (first, sample(second)) else {
            return out.push(None);
        };
        let (layout, column) = (
            self.input.layouts.get(feed.column),
            self.input.mapping.columns.get(feed.column),
        );
        let kind = column.and_then(|column| column.kind);
        match layout {
            Some(layout) => out.push(Some(&rows::mix((before, after), weight, layout, kind)?)),
            None => out.push(None),
        }
    }

    fn batch(&self, rows: std::ops::Range<usize>, columns: Vec<Rows>) -> Result<RecordBatch> {
        let numbers = self.numbers.get(rows.clone()).unwrap_or_default();
        let mut built: BTreeMap<usize, ArrayRef> = BTreeMap::new();
        for (feed, rows) in self.feeds.iter().zip(columns) {
            built.insert(feed.field, rows.finish()?);
        }
        let mut arrays: Vec<ArrayRef> = Vec::with_capacity(self.schema.fields().len());
        for (place, field) in self.schema.fields().iter().enumerate() {
            arrays.push(match field.name().as_str() {
                schema::EPISODE_INDEX => {
                    Arc::new(Int64Array::from_iter_values(numbers.iter().map(|n| n.0)))
                }
                schema::STEP_INDEX => {
                    Arc::new(Int64Array::from_iter_values(numbers.iter().map(|n| n.1)))
                }
                schema::T_NS => Arc::new(numbers.iter().map(|n| n.2).collect::<Int64Array>()),
                _ => built
                    .remove(&place)
                    .ok_or_else(|| DatasetError::corrupt("a column vanished"))?,
            });
        }
        let options = RecordBatchOptions::new().with_row_count(Some(rows.len()));
        RecordBatch::try_new_with_options(Arc::clone(&self.schema), arrays, &options)
            .map_err(DatasetError::arrow("build a batch"))
    }
}

/// Binds the columns that go to the stores of a channel's topic.
fn bind(
    channel: &Channel,
    topics: &[Topic<'_>],
    stores: &[Store],
    mapping: &Mapping,
) -> Result<(usize, ChannelReader)> {
    let place = topics.iter().position(|topic| topic.name == channel.topic);
    let place = place.unwrap_or(usize::MAX);
    let wanted = topics
        .get(place)
        .map(|topic| topic.stores.as_slice())
        .unwrap_or_default();
    let columns: Vec<(usize, &Column)> = wanted
        .iter()
        .filter_map(|store| {
            let column = stores.get(*store)?.column;
            Some((column, mapping.columns.get(column)?))
        })
        .collect();
    Ok((place, ChannelReader::new(channel, &columns, false)?))
}
