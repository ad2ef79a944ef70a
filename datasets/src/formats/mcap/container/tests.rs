use std::collections::{BTreeMap, BTreeSet};
use std::io::Cursor;
use std::path::PathBuf;

use ::mcap::records::{MessageHeader, op};
use ::mcap::{Compression, WriteOptions, Writer};

use super::frames::MAGIC;
use super::{MessageOptions, Recording};
use crate::error::{DatasetError, Result};
use crate::source::Warning;

/// A file made of these bytes.
struct File {
    _dir: tempfile::TempDir,
    path: PathBuf,
}

fn file(bytes: &[u8]) -> File {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.mcap");
    std::fs::write(&path, bytes).unwrap();
    File { _dir: dir, path }
}

/// What a pass found: the log times, the warnings.
fn read(file: &File, recover: bool, topics: Option<&[&str]>) -> Result<(Vec<u64>, Vec<Warning>)> {
    let recording = Recording::open(&file.path, recover)?;
    let topics = topics.map(|topics| topics.iter().map(ToString::to_string).collect());
    let mut messages = recording.messages(&MessageOptions { topics })?;
    let mut times = Vec::new();
    while let Some(message) = messages.next()? {
        times.push(message.log_time);
    }
    Ok((times, messages.warnings().to_vec()))
}

fn error_of(file: &File) -> String {
    let error = read(file, false, None).unwrap_err();
    assert!(
        matches!(error.cause(), DatasetError::Corrupt { .. }),
        "{error:?}"
    );
    error.cause().to_string()
}

fn losses(warnings: &[Warning]) -> Vec<&str> {
    let losses = warnings.iter().filter_map(|warning| match warning {
        Warning::Lost { what } => Some(what.as_str()),
        _ => None,
    });
    losses.collect()
}

fn record(opcode: u8, body: &[u8]) -> Vec<u8> {
    let length = u64::try_from(body.len()).unwrap().to_le_bytes();
    [&[opcode][..], &length, body].concat()
}

fn text(text: &str) -> Vec<u8> {
    let length = u32::try_from(text.len()).unwrap().to_le_bytes();
    [&length[..], text.as_bytes()].concat()
}

fn channel(id: u16, schema: u16, topic: &str) -> Vec<u8> {
    let ids = [id.to_le_bytes(), schema.to_le_bytes()].concat();
    record(
        op::CHANNEL,
        &[ids, text(topic), text("json"), vec![0; 4]].concat(),
    )
}

fn schema(id: u16, name: &str) -> Vec<u8> {
    let body = [
        id.to_le_bytes().to_vec(),
        text(name),
        text("e"),
        text("data"),
    ]
    .concat();
    record(op::SCHEMA, &body)
}

fn message(channel: u16, log_time: u64) -> Vec<u8> {
    let time = log_time.to_le_bytes();
    let body = [&channel.to_le_bytes()[..], &[0; 4], &time, &time, b"{}"].concat();
    record(op::MESSAGE, &body)
}

/// A file without a summary, closed.
fn plain(records: &[Vec<u8>]) -> File {
    let start = [MAGIC.to_vec(), record(op::HEADER, &[0; 8])].concat();
    let end = [
        record(op::DATA_END, &[0; 4]),
        record(op::FOOTER, &[0; 20]),
        MAGIC.to_vec(),
    ];
    file(&[start, records.concat(), end.concat()].concat())
}

#[test]
fn a_message_needs_its_channel_and_a_channel_its_schema() {
    let good = plain(&[channel(3, 0, "a"), message(3, 7), message(3, 5)]);
    assert_eq!(read(&good, false, None).unwrap(), (vec![7, 5], vec![]));
    let orphan = plain(&[
        channel(3, 0, "a"),
        message(4, 7),
        message(3, 5),
        message(4, 8),
    ]);
    assert!(error_of(&orphan).contains("channel 4"));
    let (times, warnings) = read(&orphan, true, None).unwrap();
    assert_eq!(times, [5]);
    assert_eq!(
        losses(&warnings),
        ["2 messages of channel 4, whose definition is missing"]
    );
    assert!(error_of(&plain(&[channel(3, 9, "a")])).contains("schema 9"));
    assert!(error_of(&plain(&[schema(0, "s")])).contains("id 0"));
}

#[test]
fn definitions_may_be_repeated_but_not_changed() {
    let good = [
        schema(1, "s"),
        channel(3, 1, "a"),
        schema(1, "s"),
        channel(3, 1, "a"),
    ];
    assert!(read(&plain(&good), false, None).is_ok());
    let other = plain(&[
        channel(3, 0, "a"),
        message(3, 1),
        channel(3, 0, "b"),
        message(3, 2),
    ]);
    assert!(error_of(&other).contains("defined again"));
    let (times, warnings) = read(&other, true, None).unwrap();
    assert_eq!((times.len(), losses(&warnings).len()), (2, 1));
    assert!(error_of(&plain(&[schema(1, "s"), schema(1, "t")])).contains("defined again"));
}

#[test]
fn records_that_are_not_known_are_passed_over_and_short_ones_are_damage() {
    let odd = plain(&[
        record(0x7E, b"?"),
        record(0xF0, &[]),
        channel(1, 0, "a"),
        message(1, 2),
    ]);
    assert_eq!(read(&odd, false, None).unwrap(), (vec![2], vec![]));
    let short = plain(&[
        channel(1, 0, "a"),
        record(op::MESSAGE, &[1, 0]),
        message(1, 2),
    ]);
    assert!(error_of(&short).contains("4 are expected"));
    assert_eq!(read(&short, true, None).unwrap().0, [2]);
    // A declared length beyond the file, of a record that is not a chunk.
    let mut bytes = std::fs::read(&odd.path).unwrap();
    bytes[8 + 17 + 1..][..8].copy_from_slice(&u64::MAX.to_le_bytes());
    let long = file(&bytes);
    assert!(error_of(&long).contains("cut off or damaged"));
    assert_eq!(losses(&read(&long, true, None).unwrap().1).len(), 1);
}

#[test]
fn a_file_that_was_not_closed_is_read_with_a_warning() {
    let whole = plain(&[channel(1, 0, "a"), message(1, 2)]);
    let bytes = std::fs::read(&whole.path).unwrap();
    let end = 13 + 29 + 8;
    let open = file(&bytes[..bytes.len() - end]);
    assert_eq!(read(&open, false, None).unwrap().0, [2]);
    let recording = Recording::open(&open.path, false).unwrap();
    assert_eq!(losses(recording.warnings()).len(), 1);
    assert_eq!(
        losses(Recording::open(&whole.path, false).unwrap().warnings()).len(),
        0
    );
}

/// Two topics, each in a chunk of its own; `change` is made to the finished bytes.
fn two_chunks(compression: Option<Compression>) -> Vec<u8> {
    let options = WriteOptions::new().compression(compression);
    write_two(options, |writer| {
        writer.flush().unwrap();
    })
}

fn write_two(options: WriteOptions, between: impl Fn(&mut Writer<Cursor<Vec<u8>>>)) -> Vec<u8> {
    let mut writer = options.create(Cursor::new(Vec::new())).unwrap();
    for (n, topic) in ["a", "b"].into_iter().enumerate() {
        let id = writer
            .add_channel(0, topic, "json", &BTreeMap::new())
            .unwrap();
        for i in 0..50 {
            let time = n as u64 * 1000 + i;
            let header = MessageHeader {
                channel_id: id,
                sequence: 0,
                log_time: time,
                publish_time: time,
            };
            writer.write_to_known_channel(&header, &[b' '; 40]).unwrap();
        }
        between(&mut writer);
    }
    writer.finish().unwrap();
    writer.into_inner().into_inner()
}

#[test]
fn chunks_without_a_wanted_topic_are_not_touched() {
    for compression in [None, Some(Compression::Zstd), Some(Compression::Lz4)] {
        let mut bytes = two_chunks(compression);
        let good = file(&bytes);
        let summary = Recording::open(&good.path, false).unwrap();
        let chunks = &summary.summary().unwrap().chunks;
        let first = usize::try_from(chunks[0].offset).unwrap();
        assert_eq!(chunks.len(), 2);
        let both = read(&good, false, Some(&["a", "b"])).unwrap();
        assert_eq!(both.0.len(), 100);
        assert_eq!(both.1, []);
        bytes[first + 80] ^= 1;
        let bad = file(&bytes);
        let (times, warnings) = read(&bad, false, Some(&["b"])).unwrap();
        assert_eq!((times.first(), times.len()), (Some(&1000), 50));
        assert_eq!(warnings, []);
        assert!(read(&bad, false, Some(&["a"])).is_err());
        let (times, warnings) = read(&bad, true, None).unwrap();
        assert_eq!((times.first(), times.len()), (Some(&1000), 50));
        let place = format!("offset {first} (log times 0 to 49 ns)");
        assert!(losses(&warnings)[0].contains(&place), "{warnings:?}");
    }
}

#[test]
fn the_whole_messages_of_a_cut_chunk_are_recovered() {
    let bytes = two_chunks(None);
    let recording = file(&bytes);
    let recording = Recording::open(&recording.path, false).unwrap();
    let second = &recording.summary().unwrap().chunks[1];
    let cut = usize::try_from(second.offset + second.length / 2).unwrap();
    let cut = file(&bytes[..cut]);
    assert!(error_of(&cut).contains("cut off or damaged"));
    let (times, warnings) = read(&cut, true, None).unwrap();
    assert!((60..90).contains(&times.len()), "{}", times.len());
    assert!(times.is_sorted());
    assert_eq!(losses(&warnings).len(), 1);
}

#[test]
fn the_checksum_of_the_data_finds_damage_between_the_chunks() {
    let options = WriteOptions::new()
        .use_chunks(false)
        .calculate_data_section_crc(true);
    let mut bytes = write_two(options, |_| {});
    assert_eq!(read(&file(&bytes), false, None).unwrap().1, []);
    let at = bytes
        .windows(40)
        .position(|part| part == [b' '; 40])
        .unwrap();
    bytes[at + 3] = b'x';
    let bad = file(&bytes);
    assert!(error_of(&bad).contains("data section is damaged"));
    let (times, warnings) = read(&bad, true, None).unwrap();
    assert_eq!((times.len(), losses(&warnings).len()), (100, 1));
}

#[test]
fn counts_of_the_summary_that_are_wrong_are_told() {
    let options = WriteOptions::new()
        .compression(None)
        .calculate_summary_section_crc(false);
    let mut bytes = write_two(options, |_| {});
    let count = 100_u64.to_le_bytes();
    let at = bytes.windows(8).rposition(|part| part == count).unwrap();
    bytes[at] = 99;
    let (times, warnings) = read(&file(&bytes), false, None).unwrap();
    assert_eq!(times.len(), 100);
    let expected = Warning::CountMismatch {
        what: "messages",
        recorded: 99,
        actual: 100,
    };
    assert_eq!(warnings, [expected]);
}

#[test]
fn a_damaged_summary_is_an_error_or_a_loss() {
    let mut bytes = two_chunks(None);
    let at = bytes.len() - 60;
    bytes[at] ^= 0xFF;
    let bad = file(&bytes);
    assert!(error_of(&bad).contains("summary"));
    let recording = Recording::open(&bad.path, true).unwrap();
    assert_eq!(losses(recording.warnings()).len(), 1);
    assert!(recording.summary().is_none());
    assert_eq!(read(&bad, true, None).unwrap().0.len(), 100);
    let topics: BTreeSet<_> = recording
        .channels()
        .unwrap()
        .iter()
        .map(|c| c.topic.clone())
        .collect();
    assert_eq!(topics, BTreeSet::from(["a".to_owned(), "b".to_owned()]));
}
