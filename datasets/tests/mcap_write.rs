//! Made-up tables written as recordings and read back.
#![cfg(feature = "mcap")]
#![expect(clippy::unwrap_used, reason = "tests")]

#[path = "support/tables.rs"]
#[expect(dead_code, reason = "shared with the tests of other writers")]
mod tables;
#[path = "support/writing.rs"]
#[expect(dead_code, reason = "shared with the tests of other writers")]
mod writing;

use std::sync::Arc;

use arrow::array::{ArrayRef, FixedSizeListArray, Int64Array, RecordBatch};
use arrow::datatypes::Float64Type;
use ksim_datasets::{
    DatasetSource, Format, LossEffect, McapEncoding, OpenOptions, WriteOptions, conformance, copy,
    create, open,
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
    let parquet = folder.path().join("in.parquet");
    let file = std::fs::File::create(&parquet).unwrap();
    let mut writer = parquet::arrow::ArrowWriter::try_new(file, batch.schema(), None).unwrap();
    writer.write(&batch).unwrap();
    writer.close().unwrap();
    let source = open(&parquet, &OpenOptions::default()).unwrap();
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
