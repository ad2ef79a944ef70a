//! Made-up tables written as recordings and read back.
#![cfg(feature = "mcap")]
#![expect(clippy::unwrap_used, reason = "tests")]

#[path = "support/tables.rs"]
#[expect(dead_code, reason = "shared with the tests of other writers")]
mod tables;
#[path = "support/writing.rs"]
#[expect(dead_code, reason = "shared with the tests of other writers")]
mod writing;

use std::collections::BTreeSet;
use std::fs::File;
use std::path::Path;
use std::sync::Arc;

use arrow::array::{ArrayRef, FixedSizeListArray, Float64Array, Int64Array, RecordBatch};
use arrow::datatypes::Float64Type;
use ksim_datasets::mcap::Recording;
use ksim_datasets::{
    DatasetSource, Format, LossEffect, McapEncoding, OpenOptions, Scan, Warning, WriteOptions,
    conformance, copy, create, open,
};
use proptest::prelude::*;
use serde_json::json;
use writing::{python, rows};

/// Bits of all values, with those of nulls left out.
fn same(a: &RecordBatch, b: &RecordBatch) {
    assert_eq!(a.num_rows(), b.num_rows());
    assert_eq!(a.num_columns(), b.num_columns());
    for (place, field) in a.schema().fields().iter().enumerate() {
        let other = b
            .column_by_name(field.name())
            .unwrap_or_else(|| panic!("no {}", field.name()));
        assert_eq!(
            a.column(place).data_type(),
            other.data_type(),
            "{}",
            field.name()
        );
        assert_eq!(
            a.column(place).to_data(),
            other.to_data(),
            "{}",
            field.name()
        );
        let schema = b.schema();
        let back = schema.field_with_name(field.name()).unwrap();
        assert_eq!(field.metadata(), back.metadata(), "{}", field.name());
    }
}

fn round_trip(table: &tables::MemorySource, encoding: McapEncoding) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("out.mcap");
    let schema = table.schema();
    let options = WriteOptions {
        mcap_encoding: encoding,
        ..WriteOptions::default()
    };
    let mut sink = create(&path, Format::Mcap, &table.input(&schema), &options).unwrap();
    copy(table, sink.as_mut()).unwrap();
    assert!(
        !path.exists(),
        "nothing is visible before the sink finishes"
    );
    let written = sink.finish().unwrap();
    let dropped = |effect: LossEffect| effect == LossEffect::Dropped;
    assert!(
        !written.losses.iter().any(|loss| dropped(loss.effect)),
        "{:?}",
        written.losses
    );
    let back = open(&path, &OpenOptions::default()).unwrap();
    same(&rows(table), &rows(back.as_ref()));
    assert_eq!(table.episodes().unwrap(), back.episodes().unwrap());
    assert_eq!(
        back.info().n_steps,
        Some(table.episodes().unwrap().iter().map(|e| e.length).sum())
    );
    conformance::check_source(back.as_ref()).unwrap();
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(32))]

    #[test]
    fn protobuf_recordings_are_read_back_bit_by_bit(table in tables::tables(tables::Allowed::default())) {
        round_trip(&table, McapEncoding::Protobuf);
    }

    #[test]
    fn json_recordings_are_read_back_bit_by_bit(table in tables::tables(tables::Allowed::default())) {
        round_trip(&table, McapEncoding::Json);
    }
}

/// The rows as a dataset of their own.
fn source(batch: &RecordBatch, folder: &Path) -> Box<dyn DatasetSource> {
    let path = folder.join("in.parquet");
    let file = File::create(&path).unwrap();
    let mut writer = parquet::arrow::ArrowWriter::try_new(file, batch.schema(), None).unwrap();
    writer.write(batch).unwrap();
    writer.close().unwrap();
    open(&path, &OpenOptions::default()).unwrap()
}

#[test]
fn written_recordings_are_read_by_the_official_library() {
    let folder = tempfile::tempdir().unwrap();
    let list = |row: i64| Some([row as f64 + 0.1, -1e300].map(Some));
    let lists = FixedSizeListArray::from_iter_primitive::<Float64Type, _, _>((0..5).map(list), 2);
    let lists: ArrayRef = Arc::new(lists);
    let columns: [(&str, ArrayRef); 3] = [
        (
            "episode_index",
            Arc::new(Int64Array::from(vec![0, 0, 0, 4, 4])),
        ),
        ("observation", Arc::clone(&lists)),
        ("action", lists),
    ];
    let batch = RecordBatch::try_from_iter(columns).unwrap();
    let source = source(&batch, folder.path());
    let path = folder.path().join("out.mcap");
    let options = WriteOptions::default();
    writing::round_trip(source.as_ref(), &path, Format::Mcap, &options);

    let modules = "mcap, mcap_protobuf";
    let Some(read) = python("check_mcap.py", modules, &[&path]) else {
        return;
    };
    let (topics, messages) = (&read[0]["topics"], &read[0]["messages"]);
    for topic in ["/observation", "/action", "/step"] {
        assert_eq!(topics[topic], 5, "{topics}");
    }
    for row in 0..5_usize {
        let values = json!([row as f64 + 0.1, -1e300]);
        assert_eq!(messages["/observation"][row]["observation"], values);
        assert_eq!(messages["/action"][row]["action"], values);
        let times = [
            &messages["/step"][row]["log_time"],
            &messages["/action"][row]["log_time"],
        ];
        assert_eq!(times[0], times[1]);
    }
    assert_eq!(messages["/step"][3]["episode_index"], 4);
}

/// Rows of an episode of the recordings below.
const ROWS: i64 = 97;
const N_EPISODES: i64 = 40;

/// Some chunks of rows that no compression makes smaller.
fn long_recording(folder: &Path) -> Box<dyn DatasetSource> {
    let mut state = 1u64;
    let mut noise = move || {
        state = state
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1);
        f64::from_bits(state >> 12 | 0x3FF0_0000_0000_0000)
    };
    let mut lists = |width: i32| -> ArrayRef {
        let rows = (0..ROWS * N_EPISODES)
            .map(|_| Some((0..width).map(|_| Some(noise())).collect::<Vec<_>>()));
        let rows: Vec<_> = rows.collect();
        Arc::new(FixedSizeListArray::from_iter_primitive::<Float64Type, _, _>(rows, width))
    };
    let (observation, action) = (lists(80), lists(7));
    let rewards = (0..ROWS * N_EPISODES).map(|row| (row % 13) as f64);
    let columns: [(&str, ArrayRef); 4] = [
        (
            "episode_index",
            Arc::new(Int64Array::from_iter_values(
                (0..ROWS * N_EPISODES).map(|row| row / ROWS),
            )),
        ),
        ("observation", observation),
        ("action", action),
        ("reward", Arc::new(Float64Array::from_iter_values(rewards))),
    ];
    source(&RecordBatch::try_from_iter(columns).unwrap(), folder)
}

fn recovered(path: &Path) -> Box<dyn DatasetSource> {
    let options = OpenOptions {
        recover: true,
        ..OpenOptions::default()
    };
    open(path, &options).unwrap()
}

/// The episodes that are read back are those that were written; gives their numbers.
fn check_recovered(original: &dyn DatasetSource, back: &dyn DatasetSource) -> BTreeSet<i64> {
    let written = original.episodes().unwrap();
    let found = back.episodes().unwrap();
    for episode in &found {
        let number = episode.episode_index;
        let same = written
            .iter()
            .find(|other| other.episode_index == number)
            .unwrap();
        assert_eq!(
            (episode.length, episode.n_rows),
            (same.length, same.n_rows),
            "episode {number}"
        );
        assert_eq!(episode.total_return, same.total_return, "episode {number}");
        let rows = |source: &dyn DatasetSource| {
            let scan = Scan {
                episodes: Some(vec![number]),
                ..Scan::default()
            };
            let batches: Vec<_> = source.scan(&scan).unwrap().map(Result::unwrap).collect();
            arrow::compute::concat_batches(&batches[0].schema(), &batches).unwrap()
        };
        let (a, b) = (rows(original), rows(back));
        for name in [
            "episode_index",
            "step_index",
            "observation",
            "action",
            "reward",
        ] {
            assert_eq!(
                a.column_by_name(name),
                b.column_by_name(name),
                "{name} of episode {number}"
            );
        }
    }
    found.iter().map(|episode| episode.episode_index).collect()
}

fn losses(source: &dyn DatasetSource) -> String {
    let lost = source
        .info()
        .warnings
        .iter()
        .filter_map(|warning| match warning {
            Warning::Lost { what } => Some(format!("{what}\n")),
            _ => None,
        });
    lost.collect()
}

#[test]
fn of_a_damaged_recording_only_whole_episodes_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let original = long_recording(folder.path());
    let path = folder.path().join("whole.mcap");
    let options = WriteOptions::default();
    writing::round_trip(original.as_ref(), &path, Format::Mcap, &options);
    let all: BTreeSet<i64> = (0..N_EPISODES).collect();
    assert_eq!(
        check_recovered(original.as_ref(), recovered(&path).as_ref()),
        all
    );
    let bytes = std::fs::read(&path).unwrap();
    let recording = Recording::open(&path, false).unwrap();
    // The first holds nothing but definitions.
    let chunks = &recording.summary().unwrap().chunks[1..];
    assert!(chunks.len() >= 3, "{} chunks", chunks.len());
    let damaged = folder.path().join("damaged.mcap");
    for chunk in chunks {
        let mut bytes = bytes.clone();
        let middle = usize::try_from(chunk.offset + chunk.length / 2).unwrap();
        bytes[middle] ^= 0x55;
        std::fs::write(&damaged, bytes).unwrap();
        assert!(open(&damaged, &OpenOptions::default()).is_err());
        let back = recovered(&damaged);
        let kept = check_recovered(original.as_ref(), back.as_ref());
        assert!(!kept.is_empty() && kept != all, "{kept:?}");
        let losses = losses(back.as_ref());
        for number in all.difference(&kept) {
            assert!(
                losses.contains(&format!("episode {number}: ")),
                "{number} in {losses}"
            );
        }
        for number in &kept {
            assert!(
                !losses.contains(&format!("episode {number}: ")),
                "{number} in {losses}"
            );
        }
    }
    // Cut off: the last episodes are not there, or not whole.
    std::fs::write(&damaged, &bytes[..bytes.len() / 2]).unwrap();
    let back = recovered(&damaged);
    let kept = check_recovered(original.as_ref(), back.as_ref());
    assert!(!kept.is_empty() && kept.len() < all.len(), "{kept:?}");
    let last = format!("episode {}: 0 of {ROWS} rows", N_EPISODES - 1);
    assert!(
        losses(back.as_ref()).contains(&last),
        "{}",
        losses(back.as_ref())
    );
}

#[test]
fn without_the_list_of_episodes_only_those_without_gaps_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let original = long_recording(folder.path());
    let path = folder.path().join("whole.mcap");
    writing::round_trip(
        original.as_ref(),
        &path,
        Format::Mcap,
        &WriteOptions::default(),
    );
    let mut bytes = std::fs::read(&path).unwrap();
    let recording = Recording::open(&path, false).unwrap();
    let chunk = &recording.summary().unwrap().chunks[2];
    let middle = usize::try_from(chunk.offset + chunk.length / 2).unwrap();
    bytes[middle] ^= 0x55;
    let name = b"ksim.episodes";
    let at = bytes
        .windows(name.len())
        .position(|window| window == name)
        .unwrap();
    bytes[at] = b'K';
    std::fs::write(&path, bytes).unwrap();
    let back = recovered(&path);
    let kept = check_recovered(original.as_ref(), back.as_ref());
    assert!(
        kept.contains(&0) && kept.contains(&(N_EPISODES - 2)),
        "{kept:?}"
    );
    assert!(!kept.contains(&(N_EPISODES - 1)), "its end is not known");
    let losses = losses(back.as_ref());
    assert!(losses.contains("does not say how many rows"), "{losses}");
}

#[test]
fn rows_that_were_not_promised_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let original = long_recording(folder.path());
    writing::check_atomic(original.as_ref(), folder.path(), Format::Mcap);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(16))]

    #[test]
    fn tables_without_actions_have_their_episodes(mut table in tables::tables(tables::Allowed::default())) {
        let schema = table.schema();
        let is_kept = |name: &str| name != "action" && !name.starts_with("action.") && !name.starts_with("action[");
        let kept: Vec<usize> = (0..schema.fields().len()).filter(|&place| is_kept(schema.field(place).name())).collect();
        table.rows = table.rows.project(&kept).unwrap();
        table.info.action.clear();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("out.mcap");
        let schema = table.schema();
        let mut sink = create(&path, Format::Mcap, &table.input(&schema), &WriteOptions::default()).unwrap();
        copy(&table, sink.as_mut()).unwrap();
        sink.finish().unwrap();
        let back = open(&path, &OpenOptions::default()).unwrap();
        prop_assert_eq!(table.episodes().unwrap(), back.episodes().unwrap());
        prop_assert_eq!(back.info().n_steps, table.info.n_steps);
        same(&rows(&table), &rows(back.as_ref()));
    }
}
