//! Made-up tables written as recordings and read back.
#![cfg(feature = "mcap")]
#![expect(clippy::unwrap_used, reason = "tests")]

#[path = "support/tables.rs"]
#[expect(dead_code, reason = "shared with the tests of other writers")]
mod tables;

use arrow::array::RecordBatch;
use ksim_datasets::{
    DatasetSource, Format, LossEffect, McapEncoding, OpenOptions, Scan, WriteOptions, conformance,
    copy, create, open,
};
use proptest::prelude::*;

fn rows(source: &dyn DatasetSource) -> RecordBatch {
    let reader = source.scan(&Scan::default()).unwrap();
    let schema = reader.schema();
    let batches: Vec<_> = reader.collect::<Result<_, _>>().unwrap();
    arrow::compute::concat_batches(&schema, &batches).unwrap()
}

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
