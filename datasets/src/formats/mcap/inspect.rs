//! What recordings hold: topics, rates, gaps, clocks, fields, metadata.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::{
    AttachmentEntry, Channel, Decoder, Extracted, FieldDescription, FieldKind, MessageOptions,
    Metadata, Plan, Recording,
};
use crate::error::{DatasetError, Result};
use crate::source::Warning;

/// Texts of a topic that are kept, at most.
const MAX_TEXTS: usize = 1000;

/// What a recording, or a folder of them, holds.
#[derive(Debug, Clone)]
pub struct Inspection {
    /// The files, in order.
    pub files: Vec<PathBuf>,
    /// Profile of the first file: `ros2`, `ros1` or nothing, mostly.
    pub profile: String,
    /// The program that wrote the first file.
    pub library: String,
    /// Chunks by compression (`zstd`, `lz4` or nothing), from the chunk indexes.
    pub compression: BTreeMap<String, u64>,
    /// Topics by name.
    pub topics: Vec<TopicInspection>,
    /// Metadata records of all files.
    pub metadata: Vec<Metadata>,
    /// Attachments of all files.
    pub attachments: Vec<AttachmentEntry>,
    /// Earliest and latest log time of a message, in ns; `None` without messages.
    pub span_ns: Option<(u64, u64)>,
    /// What was odd or damaged.
    pub warnings: Vec<Warning>,
}

/// What a topic holds.
#[derive(Debug, Clone)]
pub struct TopicInspection {
    /// Its name.
    pub topic: String,
    /// Name of the message type; empty without a schema.
    pub schema: String,
    /// Encoding of the schema; empty without one.
    pub schema_encoding: String,
    /// Encoding of the messages.
    pub message_encoding: String,
    /// Messages in all files.
    pub n_messages: u64,
    /// Earliest and latest log time, in ns; `None` without messages.
    pub span_ns: Option<(u64, u64)>,
    /// Messages per second: one over the median time between two; `None` for fewer than two messages.
    pub rate_hz: Option<f64>,
    /// Median distance of the times between messages from their median \[ms\].
    pub jitter_ms: Option<f64>,
    /// Longest time between two messages of a file \[s\].
    pub largest_gap_s: Option<f64>,
    /// Median of log time minus the time stamp inside the message \[ms\]; `None` if there is no stamp.
    pub skew_ms: Option<f64>,
    /// The fields of its messages.
    pub fields: Vec<FieldDescription>,
    /// Why its messages cannot be decoded.
    pub undecodable: Option<String>,
    /// Names that the first message lists (joints), for types with such a list.
    pub(crate) names: Vec<String>,
    /// The first texts, for `std_msgs/String` and the like.
    pub(crate) texts: Vec<String>,
    /// Encoding of the first picture.
    pub(crate) picture: Option<String>,
}

impl TopicInspection {
    /// Paths of fields that hold numbers or flags.
    pub fn numeric_fields(&self) -> impl Iterator<Item = &FieldDescription> {
        let is_number = |field: &&FieldDescription| {
            matches!(field.kind, FieldKind::Number(_) | FieldKind::Bool)
        };
        self.fields.iter().filter(is_number)
    }
}

/// Looks at all messages of a recording, or of all recordings of a folder. Memory: 8 bytes for each message.
///
/// # Errors
/// Damage (unless recovering) and what the system refuses; the file is named.
pub fn inspect(path: &Path, recover: bool) -> Result<Inspection> {
    let files = super::opening::files(path).map_err(|error| error.in_file(path))?;
    let mut pass = Pass::default();
    let mut header = None;
    for file in &files {
        let recording = Recording::open(file, recover)?;
        header.get_or_insert_with(|| {
            (
                recording.profile().to_owned(),
                recording.library().to_owned(),
            )
        });
        pass.add(&recording).map_err(|error| error.in_file(file))?;
    }
    let (profile, library) = header.ok_or(DatasetError::Empty.in_file(path))?;
    let topics: Vec<_> = pass.topics.into_values().map(Topic::finish).collect();
    let spans = topics.iter().filter_map(|topic| topic.span_ns);
    Ok(Inspection {
        files,
        profile,
        library,
        compression: pass.compression,
        span_ns: spans.reduce(|a, b| (a.0.min(b.0), a.1.max(b.1))),
        topics,
        metadata: pass.metadata,
        attachments: pass.attachments,
        warnings: pass.warnings,
    })
}

#[derive(Default)]
struct Pass {
    topics: BTreeMap<String, Topic>,
    compression: BTreeMap<String, u64>,
    metadata: Vec<Metadata>,
    attachments: Vec<AttachmentEntry>,
    warnings: Vec<Warning>,
}

impl Pass {
    fn add(&mut self, recording: &Recording) -> Result<()> {
        for chunk in recording
            .summary()
            .map(|summary| &summary.chunks)
            .into_iter()
            .flatten()
        {
            *self
                .compression
                .entry(chunk.compression.clone())
                .or_default() += 1;
        }
        let mut probes: BTreeMap<u16, Option<Probe>> = BTreeMap::new();
        let mut messages = recording.messages(&MessageOptions::default())?;
        while let Some(message) = messages.next()? {
            let channel = message.channel;
            let topic = match self.topics.get_mut(&channel.topic) {
                Some(topic) => topic,
                None => self
                    .topics
                    .entry(channel.topic.clone())
                    .or_insert_with(|| Topic::new(channel)),
            };
            topic.times.push(message.log_time);
            let probe = probes
                .entry(channel.id)
                .or_insert_with(|| Probe::new(channel));
            if let Some(probe) = probe {
                probe.plan.extract(&message, &mut probe.scratch)?;
                topic.note(probe, message.log_time);
            }
        }
        for channel in messages.channels() {
            self.topics
                .entry(channel.topic.clone())
                .or_insert_with(|| Topic::new(channel));
        }
        for topic in self.topics.values_mut() {
            topic.end_file();
        }
        self.warnings.extend(recording.warnings().iter().cloned());
        self.warnings.extend(messages.warnings().iter().cloned());
        self.metadata.extend(recording.metadata()?);
        self.attachments.extend(recording.attachments()?);
        Ok(())
    }
}

/// Reads the few fields that tell more of a topic.
struct Probe {
    plan: Plan,
    scratch: Extracted,
    slots: Vec<What>,
}

#[derive(Clone, Copy, PartialEq)]
enum What {
    Stamp,
    Names,
    Text,
    Encoding,
}

impl Probe {
    /// `None` if there is no such field.
    fn new(channel: &Channel) -> Option<Self> {
        let decoder = Decoder::new(channel).ok()?;
        let fields = decoder.fields();
        let of_kind = |path: &str, kind: FieldKind| {
            fields
                .iter()
                .any(|field| field.path == path && field.kind == kind)
        };
        let candidates = [
            ("header.stamp", FieldKind::Time, What::Stamp),
            ("timestamp", FieldKind::Time, What::Stamp),
            ("name", FieldKind::Text, What::Names),
            ("joints[].name", FieldKind::Text, What::Names),
            ("data", FieldKind::Text, What::Text),
            ("encoding", FieldKind::Text, What::Encoding),
        ];
        let found: Vec<_> = candidates
            .into_iter()
            .filter(|(path, kind, _)| of_kind(path, kind.clone()))
            .collect();
        let paths: Vec<_> = found
            .iter()
            .filter_map(|(path, ..)| path.parse().ok())
            .collect();
        (!paths.is_empty()).then_some(())?;
        Some(Self {
            plan: decoder.plan(&paths).ok()?,
            scratch: Extracted::default(),
            slots: found.into_iter().map(|(.., what)| what).collect(),
        })
    }
}

struct Topic {
    inspection: TopicInspection,
    /// Log times of the file that is read.
    times: Vec<u64>,
    intervals: Vec<u64>,
    skews: Vec<i64>,
}

impl Topic {
    fn new(channel: &Channel) -> Self {
        let decoder = Decoder::new(channel);
        let schema = channel.schema.as_ref();
        Self {
            inspection: TopicInspection {
                topic: channel.topic.clone(),
                schema: schema.map(|schema| schema.name.clone()).unwrap_or_default(),
                schema_encoding: schema
                    .map(|schema| schema.encoding.clone())
                    .unwrap_or_default(),
                message_encoding: channel.message_encoding.clone(),
                n_messages: 0,
                span_ns: None,
                rate_hz: None,
                jitter_ms: None,
                largest_gap_s: None,
                skew_ms: None,
                fields: decoder.as_ref().map(Decoder::fields).unwrap_or_default(),
                undecodable: decoder.err().map(|error| error.to_string()),
                names: Vec::new(),
                texts: Vec::new(),
                picture: None,
            },
            times: Vec::new(),
            intervals: Vec::new(),
            skews: Vec::new(),
        }
    }

    fn note(&mut self, probe: &Probe, log_time: u64) {
        let inspection = &mut self.inspection;
        for (what, slot) in probe.slots.iter().zip(probe.scratch.slots()) {
            let mut texts = slot.texts().map(str::to_owned);
            match what {
                What::Stamp => {
                    let skew = slot.time_ns().zip(i64::try_from(log_time).ok());
                    let skew = skew.and_then(|(stamp, log)| log.checked_sub(stamp));
                    self.skews.extend(skew.filter(|_| slot.present()));
                }
                What::Names if inspection.names.is_empty() => inspection.names = texts.collect(),
                What::Text if inspection.texts.len() < MAX_TEXTS => {
                    inspection.texts.extend(texts.next())
                }
                What::Encoding if inspection.picture.is_none() => inspection.picture = texts.next(),
                _ => {}
            }
        }
    }

    /// Files follow each other in time in no particular way: gaps are inside them only.
    fn end_file(&mut self) {
        let mut times = std::mem::take(&mut self.times);
        times.sort_unstable();
        self.inspection.n_messages += times.len() as u64;
        if let (Some(first), Some(last)) = (times.first(), times.last()) {
            let span = self.inspection.span_ns.get_or_insert((*first, *last));
            *span = (span.0.min(*first), span.1.max(*last));
        }
        self.intervals
            .extend(times.windows(2).map(|pair| pair[1] - pair[0]));
    }

    fn finish(mut self) -> TopicInspection {
        let mut inspection = self.inspection;
        inspection.largest_gap_s = self.intervals.iter().max().map(|gap| *gap as f64 / 1e9);
        if let Some(interval) = median(&mut self.intervals) {
            inspection.rate_hz = (interval > 0).then(|| 1e9 / interval as f64);
            let mut distances: Vec<u64> = self
                .intervals
                .iter()
                .map(|other| other.abs_diff(interval))
                .collect();
            inspection.jitter_ms = median(&mut distances).map(|jitter| jitter as f64 / 1e6);
        }
        inspection.skew_ms = median(&mut self.skews).map(|skew| skew as f64 / 1e6);
        inspection
    }
}

/// The lower median; the order of the values changes.
fn median<T: Ord + Copy>(values: &mut [T]) -> Option<T> {
    let middle = values.len().checked_sub(1)? / 2;
    Some(*values.select_nth_unstable(middle).1)
}
