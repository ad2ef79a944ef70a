//! The MCAP reader against recordings by the official writers.
//!
//! The folder is `$KSIM_GOLDEN`, by default a small part of it in the repository. Whatever is found there is
//! checked: other recordings with other values must pass as well.
#![cfg(feature = "mcap")]
#![expect(clippy::unwrap_used, reason = "tests")]

#[path = "support/mod.rs"]
#[expect(dead_code, reason = "shared with the tests of other formats")]
mod support;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use ksim_datasets::mcap::{
    Channel, Decoder, Extracted, FieldDescription, FieldKind, FieldLength, FieldPath, Message,
    MessageOptions, Messages, Plan, Recording, Slot, Value,
};
use ksim_datasets::{DatasetError, Warning};
use serde_json::Value as Json;
use support::{files, golden, hex, read_json};

/// A recording and what is expected of it.
struct Sample {
    path: PathBuf,
    expected: Json,
}

impl Sample {
    fn name(&self) -> &str {
        self.expected["file"].as_str().unwrap()
    }

    /// Whether the file must be refused.
    fn is_bad(&self) -> bool {
        self.expected["must"].is_string()
    }

    fn has_bad_chunk(&self) -> bool {
        self.expected["bad_chunk"].is_number()
    }

    fn is_cut(&self) -> bool {
        self.expected["cut_at_byte"].is_number()
    }

    fn is_whole(&self) -> bool {
        !self.is_bad() && !self.has_bad_chunk() && !self.is_cut()
    }

    fn open(&self, recover: bool) -> Recording {
        Recording::open(&self.path, recover).unwrap()
    }

    fn topics(&self) -> impl Iterator<Item = (&String, &Json)> {
        self.expected["topics"].as_object().unwrap().iter()
    }
}

fn samples() -> Vec<Sample> {
    let folder = golden("formats/mcap");
    let samples: Vec<Sample> = files(&folder, ".mcap.expected.json")
        .iter()
        .map(|path| {
            let expected = read_json(path);
            let path = folder.join(expected["file"].as_str().unwrap());
            Sample { path, expected }
        })
        .collect();
    assert!(samples.len() >= 5, "only {} samples found", samples.len());
    samples
}

/// A message that was read.
#[derive(Debug, Clone, PartialEq)]
struct Read {
    channel: Channel,
    log_time: u64,
    publish_time: u64,
    sequence: u32,
    data: Vec<u8>,
}

impl Read {
    fn of(message: &Message<'_>) -> Self {
        Self {
            channel: Channel::clone(message.channel),
            log_time: message.log_time,
            publish_time: message.publish_time,
            sequence: message.sequence,
            data: message.data.to_vec(),
        }
    }

    fn with<T>(&self, act: impl FnOnce(&Message<'_>) -> T) -> T {
        let channel = std::sync::Arc::new(self.channel.clone());
        act(&Message {
            channel: &channel,
            sequence: self.sequence,
            log_time: self.log_time,
            publish_time: self.publish_time,
            data: &self.data,
        })
    }
}

/// Reads until the end or an error.
fn read_on(messages: &mut Messages) -> (Vec<Read>, Option<DatasetError>) {
    let mut found = Vec::new();
    loop {
        match messages.next() {
            Ok(Some(message)) => found.push(Read::of(&message)),
            Ok(None) => return (found, None),
            Err(error) => return (found, Some(error)),
        }
    }
}

fn read_whole(sample: &Sample) -> Vec<Read> {
    let recording = sample.open(false);
    let mut messages = recording.messages(&MessageOptions::default()).unwrap();
    let (found, error) = read_on(&mut messages);
    assert!(error.is_none(), "{}: {error:?}", sample.name());
    assert_eq!(messages.warnings(), [], "{}", sample.name());
    found
}

/// In the order the recording's values are listed in: by log time, or as they are in the file.
fn by_topic<'a>(sample: &Sample, found: &'a [Read]) -> BTreeMap<&'a str, Vec<&'a Read>> {
    let mut topics: BTreeMap<&str, Vec<&Read>> = BTreeMap::new();
    for message in found {
        topics
            .entry(&message.channel.topic)
            .or_default()
            .push(message);
    }
    if sample.expected["read_mode"] == "seek" {
        for messages in topics.values_mut() {
            messages.sort_by_key(|message| message.log_time);
        }
    }
    topics
}

#[test]
fn golden_mcap_header_summary_metadata_attachments() {
    for sample in samples().iter().filter(|sample| !sample.is_bad()) {
        let (name, expected) = (sample.name(), &sample.expected);
        let recording = sample.open(false);
        if let Some(profile) = expected["profile"].as_str() {
            assert_eq!(recording.profile(), profile, "{name}");
        }
        if let Some(library) = expected["library"].as_str() {
            assert_eq!(recording.library(), library, "{name}");
        }
        if let Some(has_summary) = expected["has_summary"].as_bool() {
            assert_eq!(recording.summary().is_some(), has_summary, "{name}");
        }
        let summary = recording.summary();
        if let Some(counts) = expected["statistics"].as_object() {
            let found = summary.unwrap().statistics.as_ref().unwrap();
            let found = BTreeMap::from([
                ("message_count", found.message_count),
                ("schema_count", found.schema_count.into()),
                ("channel_count", found.channel_count.into()),
                ("attachment_count", found.attachment_count.into()),
                ("metadata_count", found.metadata_count.into()),
                ("chunk_count", found.chunk_count.into()),
                ("message_start_time", found.message_start_time),
                ("message_end_time", found.message_end_time),
            ]);
            for (key, count) in counts {
                assert_eq!(
                    found.get(key.as_str()).copied(),
                    count.as_u64(),
                    "{name} {key}"
                );
            }
        }
        if let Some(compression) = expected["chunk_compression"].as_array() {
            let chunks = &summary.unwrap().chunks;
            let found: BTreeSet<&str> = chunks.iter().map(|c| c.compression.as_str()).collect();
            let wanted: BTreeSet<&str> = compression.iter().filter_map(Json::as_str).collect();
            assert_eq!(found, wanted, "{name}");
        }
        check_extras(sample, &recording);
    }
}

/// Metadata and attachments, as the index lists them and as a pass meets them.
fn check_extras(sample: &Sample, recording: &Recording) {
    let (name, expected) = (sample.name(), &sample.expected);
    if !expected["metadata"].is_array() {
        return;
    }
    let metadata = recording.metadata().unwrap();
    let as_json = |name: &str, entries: &BTreeMap<String, String>| serde_json::json!({"name": name, "data": entries});
    let found: Vec<Json> = metadata
        .iter()
        .map(|m| as_json(&m.name, &m.entries))
        .collect();
    assert_eq!(Json::Array(found), sorted(&expected["metadata"]), "{name}");
    let attachments = recording.attachments().unwrap();
    let found: Vec<Json> = attachments
        .iter()
        .map(|entry| {
            let data = recording.attachment_data(entry).unwrap();
            assert_eq!(entry.size, data.len() as u64);
            serde_json::json!({
                "name": entry.name, "media_type": entry.media_type, "size": entry.size,
                "sha256": hex(&data),
            })
        })
        .collect();
    assert_eq!(Json::Array(found), expected["attachments"], "{name}");
    if sample.is_whole() {
        let mut messages = recording.messages(&MessageOptions::default()).unwrap();
        read_on(&mut messages);
        assert_eq!(messages.metadata(), metadata, "{name}");
        assert_eq!(messages.attachments(), attachments, "{name}");
    }
}

fn sorted(value: &Json) -> Json {
    match value {
        Json::Object(map) => {
            let map: BTreeMap<_, _> = map.iter().map(|(k, v)| (k.clone(), sorted(v))).collect();
            // `name` stands before `data` in what is compared; the order of keys is no part of a map.
            serde_json::to_value(map).unwrap()
        }
        Json::Array(items) => items.iter().map(sorted).collect(),
        other => other.clone(),
    }
}

#[test]
fn golden_mcap_values() {
    let mut n_decoded = 0;
    for sample in samples().iter().filter(|sample| sample.is_whole()) {
        let name = sample.name();
        let found = read_whole(sample);
        let total = sample.expected["total_messages_read"].as_u64();
        assert_eq!(Some(found.len() as u64), total, "{name}");
        let topics = by_topic(sample, &found);
        assert_eq!(topics.len(), sample.topics().count(), "{name}");
        for (topic, expected) in sample.topics() {
            let messages = &topics[topic.as_str()];
            let place = format!("{name} {topic}");
            n_decoded += check_topic(messages, expected, &place);
        }
    }
    assert!(n_decoded >= 3, "only {n_decoded} topics decoded");
}

/// Compares a topic with what is expected; 1 if it could be decoded.
fn check_topic(messages: &[&Read], expected: &Json, place: &str) -> usize {
    let channel = &messages[0].channel;
    let schema = channel.schema.as_ref();
    assert_eq!(
        schema.map(|s| s.name.as_str()),
        expected["schema_name"].as_str(),
        "{place}"
    );
    assert_eq!(
        schema.map(|s| s.encoding.as_str()),
        expected["schema_encoding"].as_str(),
        "{place}"
    );
    assert_eq!(
        Some(channel.message_encoding.as_str()),
        expected["message_encoding"].as_str(),
        "{place}"
    );
    let metadata = serde_json::to_value(&channel.metadata).unwrap();
    assert_eq!(metadata, expected["channel_metadata"], "{place}");
    assert_eq!(
        Some(messages.len() as u64),
        expected["count"].as_u64(),
        "{place}"
    );
    let decoder = Decoder::new(channel);
    for (key, message) in [
        ("first", messages[0]),
        ("last", messages[messages.len() - 1]),
    ] {
        let expected = &expected[key];
        let place = format!("{place} {key}");
        for (what, found) in [
            ("log_time", message.log_time),
            ("publish_time", message.publish_time),
            ("sequence", message.sequence.into()),
        ] {
            assert_eq!(Some(found), expected[what].as_u64(), "{place} {what}");
        }
        let value = &expected["value"];
        if let Some(length) = value["__undecoded_len"].as_u64() {
            let error = decoder.as_ref().unwrap_err();
            assert!(
                matches!(error, DatasetError::Unsupported { .. }),
                "{place}: {error:?}"
            );
            assert_eq!(message.data.len() as u64, length, "{place}");
            assert_eq!(
                Some(&*hex(&message.data)),
                value["sha256"].as_str(),
                "{place}"
            );
        } else {
            let decoder = decoder.as_ref().unwrap();
            let found = message.with(|message| decoder.decode(message)).unwrap();
            check_value(&found, value, &place);
        }
    }
    let Ok(decoder) = decoder else { return 0 };
    check_plan(&decoder, messages, place);
    1
}

fn check_value(found: &Value, expected: &Json, place: &str) {
    match (found, expected) {
        (Value::Bytes(bytes), expected) => {
            assert_eq!(
                Some(bytes.len() as u64),
                expected["__bytes_len"].as_u64(),
                "{place}"
            );
            assert_eq!(Some(&*hex(bytes)), expected["sha256"].as_str(), "{place}");
        }
        (Value::Struct(members), Json::Object(map)) => {
            assert_eq!(members.len(), map.len(), "{place}: {found:?}");
            for (key, expected) in map {
                let place = format!("{place}.{key}");
                let member = found
                    .member(key)
                    .unwrap_or_else(|| panic!("{place} is missing"));
                check_value(member, expected, &place);
            }
        }
        (Value::List(items), Json::Array(expected)) => {
            assert_eq!(items.len(), expected.len(), "{place}");
            for (i, (item, expected)) in items.iter().zip(expected).enumerate() {
                check_value(item, expected, &format!("{place}[{i}]"));
            }
        }
        (Value::Text(text), expected) => assert_eq!(Some(&**text), expected.as_str(), "{place}"),
        (Value::Bool(flag), expected) => assert_eq!(Some(*flag), expected.as_bool(), "{place}"),
        (Value::Int(value), expected) => assert_eq!(Some(*value), expected.as_i64(), "{place}"),
        (Value::Uint(value), expected) => assert_eq!(Some(*value), expected.as_u64(), "{place}"),
        (Value::Float32(value), expected) => {
            assert_eq!(Some(f64::from(*value)), expected.as_f64(), "{place}");
        }
        (Value::Float64(value), expected) => assert_eq!(Some(*value), expected.as_f64(), "{place}"),
        // The official reader shows the default for what is unset.
        (Value::Null, expected) => assert!(is_default(expected), "{place}: {expected}"),
        (found, expected) => panic!("{place}: {found:?}, expected {expected}"),
    }
}

fn is_default(value: &Json) -> bool {
    match value {
        Json::Null => true,
        Json::Bool(flag) => !flag,
        Json::Number(number) => number.as_f64() == Some(0.0),
        Json::String(text) => text.is_empty(),
        Json::Array(items) => items.is_empty(),
        Json::Object(map) => {
            map.get("__bytes_len").is_some_and(|n| n == 0) || map.values().all(is_default)
        }
    }
}

/// Every field taken by a plan is what the whole decoded message has there.
fn check_plan(decoder: &Decoder, messages: &[&Read], place: &str) {
    let fields = decoder.fields();
    let paths: Vec<FieldPath> = fields.iter().map(|f| f.path.parse().unwrap()).collect();
    let plan: Plan = decoder.plan(&paths).unwrap();
    let mut all = Extracted::default();
    let mut one = Extracted::default();
    let singles: Vec<Plan> = paths
        .iter()
        .map(|path| decoder.plan(std::slice::from_ref(path)).unwrap())
        .collect();
    for message in messages {
        message.with(|message| {
            let tree = decoder.decode(message).unwrap();
            plan.extract(message, &mut all).unwrap();
            assert_eq!(all.slots().len(), paths.len());
            for ((field, slot), single) in fields.iter().zip(all.slots()).zip(&singles) {
                let place = format!("{place} {}", field.path);
                check_slot(field, slot, &tree, &place);
                single.extract(message, &mut one).unwrap();
                assert_eq!(
                    format!("{slot:?}"),
                    format!("{:?}", one.slots()[0]),
                    "{place}"
                );
            }
        });
    }
}

fn check_slot(field: &FieldDescription, slot: &Slot, tree: &Value, place: &str) {
    let mut values = vec![tree];
    for part in field.path.split('.') {
        let (name, each) = match part.strip_suffix("[]") {
            Some(name) => (name, true),
            None => (part, false),
        };
        values = values
            .iter()
            .filter_map(|value| value.member(name))
            .collect();
        if each {
            values = values.into_iter().flat_map(items).collect();
        }
    }
    if !field.path.contains("[]") && values.iter().all(|value| **value == Value::Null) {
        assert!(!slot.present(), "{place}");
        return;
    }
    match &field.kind {
        FieldKind::Time => {
            let [Value::Struct(members)] = values[..] else {
                panic!("{place}: {values:?}")
            };
            let seconds = number(&members[0].1) as i64;
            let ns = seconds * 1_000_000_000 + number(&members[1].1) as i64;
            assert_eq!(slot.time_ns(), (ns != 0).then_some(ns), "{place}");
            assert_eq!(slot.present(), ns != 0, "{place}");
        }
        FieldKind::Bytes => assert!(
            matches!(values[..], [Value::Bytes(bytes)] if bytes == slot.bytes()),
            "{place}"
        ),
        FieldKind::Text => {
            let expected: Vec<&str> = values.iter().flat_map(|v| items(v)).map(text).collect();
            assert_eq!(slot.texts().collect::<Vec<_>>(), expected, "{place}");
            assert!(slot.present(), "{place}");
        }
        _ => {
            let expected: Vec<u64> = values
                .iter()
                .flat_map(|v| items(v))
                .map(|v| number(v).to_bits())
                .collect();
            let found: Vec<u64> = slot.numbers().iter().map(|v| v.to_bits()).collect();
            assert_eq!(found, expected, "{place}");
            assert!(slot.present(), "{place}");
            if field.length == FieldLength::One {
                assert_eq!(found.len(), 1, "{place}");
            }
        }
    }
}

fn items(value: &Value) -> Vec<&Value> {
    match value {
        Value::List(items) => items.iter().collect(),
        other => vec![other],
    }
}

fn text(value: &Value) -> &str {
    match value {
        Value::Text(text) => text,
        other => panic!("{other:?}"),
    }
}

fn number(value: &Value) -> f64 {
    match value {
        Value::Bool(flag) => f64::from(u8::from(*flag)),
        Value::Int(value) => *value as f64,
        Value::Uint(value) => *value as f64,
        Value::Float32(value) => f64::from(*value),
        Value::Float64(value) => *value,
        Value::Null => f64::NAN,
        other => panic!("{other:?}"),
    }
}

#[test]
fn golden_mcap_reading_some_topics() {
    for sample in samples().iter().filter(|sample| sample.is_whole()) {
        let all = read_whole(sample);
        for (topic, _) in sample.topics() {
            let options = MessageOptions {
                topics: Some(BTreeSet::from([topic.clone()])),
            };
            let mut messages = sample.open(false).messages(&options).unwrap();
            let (found, error) = read_on(&mut messages);
            assert!(error.is_none(), "{}: {error:?}", sample.name());
            assert_eq!(messages.warnings(), [], "{} {topic}", sample.name());
            let expected: Vec<Read> = all
                .iter()
                .filter(|read| read.channel.topic == *topic)
                .cloned()
                .collect();
            assert_eq!(found, expected, "{} {topic}", sample.name());
        }
    }
}

#[test]
fn golden_mcap_bad_files_are_refused() {
    for sample in samples().iter().filter(|sample| sample.is_bad()) {
        let result = Recording::open(&sample.path, false)
            .and_then(|recording| recording.messages(&MessageOptions::default()))
            .map(|mut messages| read_on(&mut messages).1);
        let error = match result {
            Ok(error) => error.unwrap_or_else(|| panic!("{} was read", sample.name())),
            Err(error) => error,
        };
        assert!(
            matches!(error.cause(), DatasetError::Corrupt { .. }),
            "{}: {error:?}",
            sample.name()
        );
        // Recovering may find something, or not; what it does not find it tells.
        if let Ok(recording) = Recording::open(&sample.path, true) {
            let mut messages = recording.messages(&MessageOptions::default()).unwrap();
            assert!(read_on(&mut messages).1.is_none(), "{}", sample.name());
            assert!(has_losses(messages.warnings()), "{}", sample.name());
        }
    }
}

fn has_losses(warnings: &[Warning]) -> bool {
    warnings
        .iter()
        .any(|warning| matches!(warning, Warning::Lost { .. }))
}

#[test]
fn golden_mcap_bad_chunks() {
    for sample in samples().iter().filter(|sample| sample.has_bad_chunk()) {
        let name = sample.name();
        let recording = sample.open(true);
        let mut messages = recording.messages(&MessageOptions::default()).unwrap();
        let mut found = Vec::new();
        let mut n_before = None;
        loop {
            let message = messages.next().unwrap().map(|message| Read::of(&message));
            if n_before.is_none() && has_losses(messages.warnings()) {
                n_before = Some(found.len());
            }
            let Some(message) = message else { break };
            found.push(message);
        }
        let skipped = sample.expected["topics_if_bad_chunk_skipped"]
            .as_object()
            .unwrap();
        let mut topics: BTreeMap<&str, Vec<u64>> = BTreeMap::new();
        for read in &found {
            let times = topics.entry(&read.channel.topic).or_default();
            times.push(read.log_time);
        }
        assert_eq!(topics.len(), skipped.len(), "{name}");
        for (topic, expected) in skipped {
            let times = &topics[topic.as_str()];
            let place = format!("{name} {topic}");
            assert_eq!(
                Some(times.len() as u64),
                expected["count"].as_u64(),
                "{place}"
            );
            assert_eq!(
                Some(times[0]),
                expected["first_log_time"].as_u64(),
                "{place}"
            );
            assert_eq!(
                times.last().copied(),
                expected["last_log_time"].as_u64(),
                "{place}"
            );
        }
        // Strictly, what comes before the bad chunk, and then nothing but the error.
        let mut messages = sample
            .open(false)
            .messages(&MessageOptions::default())
            .unwrap();
        let (strict, error) = read_on(&mut messages);
        let error = error.unwrap_or_else(|| panic!("{name} was read"));
        assert!(
            matches!(error.cause(), DatasetError::Corrupt { .. }),
            "{name}: {error:?}"
        );
        assert_eq!(Some(strict.len()), n_before, "{name}");
        assert_eq!(strict, found[..strict.len()], "{name}");
        assert!(messages.next().is_err(), "{name}: read on after an error");
    }
}

#[test]
fn golden_mcap_cut_files() {
    for sample in samples().iter().filter(|sample| sample.is_cut()) {
        let name = sample.name();
        let options = MessageOptions::default();
        let (strict, error) = read_on(&mut sample.open(false).messages(&options).unwrap());
        assert!(
            matches!(error.unwrap().cause(), DatasetError::Corrupt { .. }),
            "{name}"
        );
        let total = sample.expected["total_messages_read"].as_u64();
        assert_eq!(Some(strict.len() as u64), total, "{name}");
        let topics = by_topic(sample, &strict);
        for (topic, expected) in sample.topics() {
            check_topic(
                &topics[topic.as_str()],
                expected,
                &format!("{name} {topic}"),
            );
        }
        let mut messages = sample.open(true).messages(&options).unwrap();
        let (found, error) = read_on(&mut messages);
        assert!(error.is_none(), "{name}: {error:?}");
        assert!(has_losses(messages.warnings()), "{name}");
        assert_eq!(found[..strict.len()], strict, "{name}");
    }
}

/// Bytes flipped and files cut here and there: no panic, no message that was not there, and nothing lost
/// without a word (as far as the recording has checksums and counts).
#[test]
fn golden_mcap_damage_is_found() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("damaged.mcap");
    for sample in samples().iter().filter(|sample| sample.is_whole()) {
        let bytes = std::fs::read(&sample.path).unwrap();
        if bytes.len() > 100_000 {
            continue;
        }
        let whole = read_whole(sample);
        let recording = sample.open(false);
        let chunks = recording.summary().map(|summary| summary.chunks.len());
        let is_checked = chunks.is_some_and(|n| n > 0);
        let step = (bytes.len() / 97).max(1);
        for at in (8..bytes.len()).step_by(step) {
            let mut damaged = bytes.clone();
            damaged[at] ^= 0x55;
            for damaged in [&damaged[..], &bytes[..at]] {
                std::fs::write(&path, damaged).unwrap();
                let place = format!("{} at {at}", sample.name());
                read_damaged(&path, is_checked.then_some(&whole), &place);
            }
        }
    }
}

/// Strictly and recovering, both to the end, with all that can be decoded.
fn read_damaged(path: &Path, whole: Option<&Vec<Read>>, place: &str) {
    for recover in [false, true] {
        let Ok(recording) = Recording::open(path, recover) else {
            continue;
        };
        let Ok(mut messages) = recording.messages(&MessageOptions::default()) else {
            continue;
        };
        let (found, error) = read_on(&mut messages);
        assert!(!recover || error.is_none(), "{place}: {error:?}");
        if let Some(whole) = whole {
            let mut left = whole.iter();
            let is_part = found.iter().all(|read| left.any(|other| other == read));
            assert!(is_part, "{place}: a message that was not there");
            let is_silent = messages.warnings().is_empty() && recording.warnings().is_empty();
            if error.is_none() && is_silent {
                assert_eq!(found.len(), whole.len(), "{place}: lost without a word");
            }
        }
        let mut decoders: BTreeMap<u16, Option<Decoder>> = BTreeMap::new();
        for read in found {
            let decoder = decoders
                .entry(read.channel.id)
                .or_insert_with(|| Decoder::new(&read.channel).ok());
            if let Some(decoder) = decoder {
                let _ = read.with(|message| decoder.decode(message));
            }
        }
        let _ = (recording.metadata(), recording.attachments());
    }
}
