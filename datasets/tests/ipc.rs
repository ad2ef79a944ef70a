//! Arrow IPC files: round trips, files of other tools, faults.
#![expect(clippy::unwrap_used, reason = "tests")]

#[path = "support/tables.rs"]
#[expect(dead_code, reason = "shared with the tests of writers")]
mod tables;

use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use arrow::array::{
    ArrayRef, AsArray, DictionaryArray, FixedSizeListArray, Int64Array, ListArray, RecordBatch,
    RecordBatchReader,
};
use arrow::datatypes::{Float32Type, Float64Type, Int8Type, Int32Type, Int64Type};
use arrow::ipc::CompressionType;
use arrow::ipc::reader::FileReader;
use arrow::ipc::writer::{FileWriter, IpcWriteOptions};
use ksim_datasets::{
    DatasetError, DatasetSource, EpisodeEnd, Format, OpenOptions, Result, Scan, Warning,
    WriteOptions, conformance, copy, create, open, schema,
};
use proptest::prelude::*;

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn made_up_tables_survive(table in tables::tables(tables::Allowed::default())) {
        let folder = tempfile::tempdir().unwrap();
        conformance::check_round_trip(&table, folder.path(), Format::ArrowIpc).unwrap();
        let path = folder.path().join("again.arrow");
        write_all(&table, &path);
        let source = opened(&path);
        conformance::check_source(source.as_ref()).unwrap();
        let (before, after) = (table.episodes().unwrap(), source.episodes().unwrap());
        prop_assert_eq!(before.len(), after.len());
        for (before, after) in before.iter().zip(&after) {
            prop_assert_eq!(&before.attributes, &after.attributes);
            prop_assert_eq!((before.seed, before.n_rows), (after.seed, after.n_rows));
        }
    }
}

fn write_all(source: &dyn DatasetSource, path: &Path) {
    let (schema, episodes) = (source.schema(), source.episodes().unwrap());
    let input = ksim_datasets::SinkInput {
        schema: &schema,
        info: source.info(),
        episodes: &episodes,
    };
    let mut sink = create(path, Format::ArrowIpc, &input, &WriteOptions::default()).unwrap();
    copy(source, sink.as_mut()).unwrap();
    sink.finish().unwrap();
}

fn opened(path: &Path) -> Box<dyn DatasetSource> {
    open(path, &OpenOptions::default()).unwrap()
}

fn recovered(path: &Path) -> Box<dyn DatasetSource> {
    let options = OpenOptions {
        recover: true,
        ..OpenOptions::default()
    };
    open(path, &options).unwrap()
}

fn read(source: &dyn DatasetSource, episodes: Option<Vec<i64>>) -> Result<RecordBatch> {
    let reader = source.scan(&Scan {
        episodes,
        ..Scan::default()
    })?;
    let schema = reader.schema();
    let batches: Vec<_> = reader.collect::<Result<_, _>>()?;
    Ok(arrow::compute::concat_batches(&schema, &batches)?)
}

fn integers(values: impl IntoIterator<Item = i64>) -> ArrayRef {
    Arc::new(Int64Array::from_iter_values(values))
}

fn vectors(n: usize, width: usize) -> ArrayRef {
    // Neighbors differ, so that a mix-up of rows shows.
    let value = |row: usize, i: usize| f64::from(u32::try_from(row * 7 + i).unwrap()).sqrt();
    let row = |row| {
        Some(
            (0..width)
                .map(move |i| Some(value(row, i)))
                .collect::<Vec<_>>(),
        )
    };
    let width_i32 = i32::try_from(width).unwrap();
    Arc::new(
        FixedSizeListArray::from_iter_primitive::<Float64Type, _, _>((0..n).map(row), width_i32),
    )
}

/// Two record batches of two episodes each: 10 rows an episode.
fn batches() -> Vec<RecordBatch> {
    let part = |first: i64| {
        RecordBatch::try_from_iter([
            ("episode", integers((0..20).map(|row| first + row / 10))),
            ("obs", vectors(20, 6)),
            ("act", vectors(20, 2)),
        ])
        .unwrap()
    };
    vec![part(0), part(2)]
}

fn write(path: &Path, batches: &[RecordBatch], packing: Option<CompressionType>) {
    let options = IpcWriteOptions::default()
        .try_with_compression(packing)
        .unwrap();
    let file = File::create(path).unwrap();
    let mut writer = FileWriter::try_new_with_options(file, &batches[0].schema(), options).unwrap();
    for batch in batches {
        writer.write(batch).unwrap();
    }
    writer.finish().unwrap();
}

fn cause(result: Result<impl Sized>) -> String {
    result.err().unwrap().cause().to_string()
}

#[test]
fn batches_end_with_episodes() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("many.arrow");
    // 400 episodes of 100 rows, which come in batches of 16,384.
    let n = 40_000;
    let batch = RecordBatch::try_from_iter([
        ("episode", integers((0..n).map(|row| row / 100))),
        ("obs", vectors(usize::try_from(n).unwrap(), 1)),
        ("act", vectors(usize::try_from(n).unwrap(), 1)),
    ]);
    write(&path, &[batch.unwrap()], None);
    let target = folder.path().join("cut.arrow");
    write_all(opened(&path).as_ref(), &target);
    let file = FileReader::try_new(File::open(&target).unwrap(), None).unwrap();
    let batches: Vec<_> = file.map(|batch| batch.unwrap()).collect();
    let lengths: Vec<_> = batches.iter().map(RecordBatch::num_rows).collect();
    assert_eq!(lengths, [16_400, 16_400, 7_200]);
    let before = read(opened(&path).as_ref(), None).unwrap();
    let after = read(opened(&target).as_ref(), None).unwrap();
    assert_eq!(before.columns(), after.columns());
}

#[test]
fn files_of_other_tools_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    write(&path("plain.arrow"), &batches(), None);
    let plain = read(opened(&path("plain.arrow")).as_ref(), None).unwrap();
    assert_eq!(plain.num_rows(), 40);
    for packing in [CompressionType::LZ4_FRAME, CompressionType::ZSTD] {
        write(&path("packed.arrow"), &batches(), Some(packing));
        let source = opened(&path("packed.arrow"));
        conformance::check_source(source.as_ref()).unwrap();
        assert_eq!(
            read(source.as_ref(), None).unwrap().columns(),
            plain.columns()
        );
    }
    // Lists of no fixed length in their type, and text through a dictionary.
    let rows = |n: i32, width: i16| {
        let row = |row| {
            Some(
                (0..width)
                    .map(|i| Some(f32::from(i) + row as f32))
                    .collect::<Vec<_>>(),
            )
        };
        Arc::new(ListArray::from_iter_primitive::<Float32Type, _, _>(
            (0..n).map(row),
        )) as ArrayRef
    };
    let names: DictionaryArray<Int8Type> = ["b", "b", "a", "a", "c"].into_iter().collect();
    let batch = RecordBatch::try_from_iter([
        ("episode_id", Arc::new(names) as ArrayRef),
        ("observations", rows(5, 3)),
        ("actions", rows(5, 2)),
    ]);
    write(
        &path("lists.arrow"),
        &[batch.unwrap()],
        Some(CompressionType::ZSTD),
    );
    let source = opened(&path("lists.arrow"));
    conformance::check_source(source.as_ref()).unwrap();
    let table = read(source.as_ref(), None).unwrap();
    let episodes = table[schema::EPISODE_INDEX].as_primitive::<Int64Type>();
    assert_eq!(episodes.values(), &[0, 0, 1, 1, 2]);
    let names = table["info.episode_id"].as_string::<i32>();
    assert_eq!(
        names.iter().flatten().collect::<Vec<_>>(),
        ["b", "b", "a", "a", "c"]
    );
}

#[test]
fn batches_without_a_wanted_episode_are_not_unpacked() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("packed.arrow");
    write(&path, &batches(), Some(CompressionType::LZ4_FRAME));
    let whole = read(opened(&path).as_ref(), None).unwrap();
    // The observations of the first record batch, whatever they hold, are no business of episode 3.
    let mut bytes = std::fs::read(&path).unwrap();
    let frames = positions(&bytes, &LZ4_START);
    damage(&mut bytes[frames[1] + 8..frames[1] + 24]);
    std::fs::write(&path, bytes).unwrap();
    assert!(read(opened(&path).as_ref(), None).is_err());
    assert!(read(opened(&path).as_ref(), Some(vec![1])).is_err());
    let one = read(opened(&path).as_ref(), Some(vec![3])).unwrap();
    assert_eq!(one, whole.slice(30, 10));
}

/// Start of a packed buffer: 8 bytes of length come before it.
const LZ4_START: [u8; 4] = 0x184D_2204_u32.to_le_bytes();

fn positions(bytes: &[u8], pattern: &[u8]) -> Vec<usize> {
    let starts = 0..bytes.len() - pattern.len();
    starts
        .filter(|&at| bytes[at..].starts_with(pattern))
        .collect()
}

fn damage(bytes: &mut [u8]) {
    bytes.iter_mut().for_each(|byte| *byte ^= 0xA5);
}

#[test]
fn a_length_that_cannot_be_is_refused_before_it_is_believed() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bomb.arrow");
    write(&path, &batches(), Some(CompressionType::LZ4_FRAME));
    let whole = std::fs::read(&path).unwrap();
    let at = positions(&whole, &LZ4_START)[1] - 8;
    for (length, expected) in [
        (1_i64 << 60, "claims to unpack"),
        (-7, "does not fit"),
        (1, "does not fit"),
    ] {
        let mut bytes = whole.clone();
        bytes[at..at + 8].copy_from_slice(&length.to_le_bytes());
        std::fs::write(&path, bytes).unwrap();
        let error = cause(read(opened(&path).as_ref(), None));
        assert!(error.contains(expected), "{length}: {error}");
    }
}

#[test]
fn a_dictionary_does_not_blow_up_a_column() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("long.arrow");
    let long = "x".repeat(1 << 20);
    let names: DictionaryArray<Int32Type> = (0..3000).map(|_| long.as_str()).collect();
    let batch = RecordBatch::try_from_iter([
        ("note", Arc::new(names) as ArrayRef),
        ("obs", vectors(3000, 1)),
        ("act", vectors(3000, 1)),
    ]);
    write(&path, &[batch.unwrap()], None);
    let error = cause(read(opened(&path).as_ref(), None));
    assert!(error.contains("\"note\" takes more than"), "{error}");
}

#[test]
fn a_file_that_is_cut_off_gives_its_whole_batches_when_told_to() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("cut.arrow");
    write(&path, &batches(), None);
    let whole = read(opened(&path).as_ref(), None).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    assert!(recovered(&path).info().warnings.is_empty());
    // Without the footer, and inside the second record batch.
    for (length, n_rows) in [(bytes.len() - 8, 40), (bytes.len() * 6 / 10, 20)] {
        let cut: PathBuf = folder.path().join("shorter.arrow");
        std::fs::write(&cut, &bytes[..length]).unwrap();
        let error = cause(open(&cut, &OpenOptions::default()));
        assert!(error.contains("cut off"), "{error}");
        let source = recovered(&cut);
        conformance::check_source(source.as_ref()).unwrap();
        let warnings = &source.info().warnings;
        assert!(
            matches!(warnings.as_slice(), [Warning::Lost { .. }]),
            "{warnings:?}"
        );
        let rows = read(source.as_ref(), None).unwrap();
        assert_eq!(rows.columns(), whole.slice(0, n_rows).columns());
        let ends: Vec<_> = source.episodes().unwrap().iter().map(|e| e.end).collect();
        assert_eq!(ends, vec![EpisodeEnd::Unknown; n_rows / 10]);
    }
    std::fs::write(&path, &bytes[..100]).unwrap();
    let options = OpenOptions {
        recover: true,
        ..OpenOptions::default()
    };
    assert!(matches!(
        open(&path, &options).err().unwrap().cause(),
        DatasetError::Corrupt { .. }
    ));
}

#[test]
fn recovery_stops_at_the_first_damage() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("packed.arrow");
    let [a, b]: [RecordBatch; 2] = batches().try_into().unwrap();
    let third = a.clone();
    let episodes = integers((0..20).map(|row| 4 + row / 10));
    let mut columns = third.columns().to_vec();
    columns[0] = episodes;
    let third = RecordBatch::try_new(third.schema(), columns).unwrap();
    write(&path, &[a, b, third], Some(CompressionType::LZ4_FRAME));
    let mut bytes = std::fs::read(&path).unwrap();
    let frames = positions(&bytes, &LZ4_START);
    let second = frames[frames.len() / 3 + 1];
    damage(&mut bytes[second + 8..second + 24]);
    std::fs::write(&path, bytes).unwrap();
    let source = recovered(&path);
    assert_eq!(read(source.as_ref(), None).unwrap().num_rows(), 20);
    let lost = source.info().warnings[0].to_string();
    assert!(lost.contains("record batches 1 to 2"), "{lost}");
}
