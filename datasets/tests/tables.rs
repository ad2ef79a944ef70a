//! The made-up tables that other tests use keep the contract of a source.
#![expect(clippy::unwrap_used, reason = "tests")]

#[path = "support/tables.rs"]
#[expect(dead_code, reason = "shared with the tests of writers")]
mod tables;

use ksim_datasets::conformance;
use proptest::prelude::*;

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn made_up_tables_are_canonical(table in tables::tables(tables::Allowed::default())) {
        conformance::check_source(&table).unwrap();
        let folder = tempfile::tempdir().unwrap();
        conformance::check_parquet_round_trip(&table, folder.path()).unwrap();
    }
}
