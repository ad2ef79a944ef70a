//! Archives that NumPy would not write, or not all at once.

use std::fs::File;
use std::io::Write;
use std::path::Path;

use arrow::array::{Array, AsArray, RecordBatch};
use arrow::datatypes::{Float32Type, Float64Type};
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

use crate::episode::EpisodeEnd;
use crate::error::Result;
use crate::format::{OpenOptions, open};
use crate::formats::d4rl::EpisodePolicy;
use crate::source::{DatasetSource, Scan, Warning};

/// A header and values, as `numpy.lib.format` writes them.
fn npy(descr: &str, is_fortran: bool, shape: &str, values: &[u8]) -> Vec<u8> {
    let order = if is_fortran { "True" } else { "False" };
    let text = format!("{{'descr': '{descr}', 'fortran_order': {order}, 'shape': {shape}, }}\n");
    let length = u16::try_from(text.len()).unwrap().to_le_bytes();
    [
        b"\x93NUMPY\x01\x00",
        length.as_slice(),
        text.as_bytes(),
        values,
    ]
    .concat()
}

fn floats(values: &[f32]) -> Vec<u8> {
    values
        .iter()
        .flat_map(|value| value.to_le_bytes())
        .collect()
}

fn column(values: &[f32]) -> Vec<u8> {
    npy(
        "<f4",
        false,
        &format!("({},)", values.len()),
        &floats(values),
    )
}

fn write(path: &Path, method: CompressionMethod, arrays: &[(&str, Vec<u8>)]) {
    let mut zip = ZipWriter::new(File::create(path).unwrap());
    for (key, bytes) in arrays {
        let options = SimpleFileOptions::default().compression_method(method);
        zip.start_file(format!("{key}.npy"), options).unwrap();
        zip.write_all(bytes).unwrap();
    }
    zip.finish().unwrap();
}

/// Six rows: a trajectory of three and of two, and a row that is left.
fn ogbench() -> Vec<(&'static str, Vec<u8>)> {
    vec![
        ("observations", column(&[0.0, 1.0, 2.0, 3.0, 4.0, 5.0])),
        ("actions", column(&[0.5, 1.5, 9.0, 3.5, 9.0, 5.5])),
        ("terminals", column(&[0.0, 0.0, 1.0, 0.0, 1.0, 0.0])),
        ("qpos", column(&[0.0, 1.0, 2.0, 3.0, 4.0, 5.0])),
    ]
}

fn opened(path: &Path) -> Result<Box<dyn DatasetSource>> {
    open(path, &OpenOptions::default())
}

fn rows(source: &dyn DatasetSource) -> Result<RecordBatch> {
    let reader = source.scan(&Scan::default())?;
    let schema = reader.schema();
    let batches: Vec<_> = reader.collect::<Result<_, _>>()?;
    Ok(arrow::compute::concat_batches(&schema, &batches)?)
}

fn values(rows: &RecordBatch, name: &str) -> Vec<Option<f32>> {
    rows[name].as_primitive::<Float32Type>().iter().collect()
}

/// The error of an archive with these arrays, in place of those of the same key or beside them.
fn refused(method: CompressionMethod, changes: &[(&'static str, Vec<u8>)]) -> String {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.npz");
    let mut arrays = ogbench();
    for (key, bytes) in changes {
        arrays.retain(|(other, _)| other != key);
        arrays.push((key, bytes.clone()));
    }
    write(&path, method, &arrays);
    let error = opened(&path)
        .and_then(|source| rows(source.as_ref()))
        .unwrap_err();
    assert!(
        error.to_string().ends_with("a.npz"),
        "{error} names the file"
    );
    error.cause().to_string()
}

#[test]
fn the_last_row_of_a_trajectory_is_no_step() {
    for method in [CompressionMethod::Stored, CompressionMethod::Deflated] {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.npz");
        write(&path, method, &ogbench());
        let source = opened(&path).unwrap();
        crate::conformance::check_source(source.as_ref()).unwrap();
        let rows = rows(source.as_ref()).unwrap();
        let some = |values: [f32; 6]| values.map(Some).to_vec();
        assert_eq!(
            values(&rows, "observation"),
            some([0.0, 1.0, 2.0, 3.0, 4.0, 5.0])
        );
        assert_eq!(
            values(&rows, "info.qpos"),
            some([0.0, 1.0, 2.0, 3.0, 4.0, 5.0])
        );
        let action = values(&rows, "action");
        assert_eq!(
            action,
            [Some(0.5), Some(1.5), None, Some(3.5), None, Some(5.5)]
        );
        let truncated: Vec<_> = rows["truncated"].as_boolean().iter().collect();
        let expected = [Some(false), Some(true), None, Some(true), None, Some(false)];
        assert_eq!(truncated, expected);
        let ends: Vec<_> = source
            .episodes()
            .unwrap()
            .iter()
            .map(|e| (e.length, e.end))
            .collect();
        use EpisodeEnd::{Cut, Truncated};
        assert_eq!(ends, [(2, Truncated), (1, Truncated), (1, Cut)]);
        assert!(
            source
                .info()
                .episode_rule
                .starts_with("OGBench: `terminals`")
        );
    }
}

#[test]
fn compact_archives_mark_two_rows() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.npz");
    let mut arrays = ogbench();
    arrays[2].1 = column(&[0.0, 1.0, 1.0, 1.0, 1.0, 0.0]);
    arrays.push(("valids", column(&[1.0, 1.0, 0.0, 1.0, 0.0, 1.0])));
    write(&path, CompressionMethod::Deflated, &arrays);
    let source = opened(&path).unwrap();
    crate::conformance::check_source(source.as_ref()).unwrap();
    let lengths: Vec<_> = source
        .episodes()
        .unwrap()
        .iter()
        .map(|e| (e.length, e.n_rows))
        .collect();
    assert_eq!(lengths, [(2, 3), (1, 2), (1, 1)]);
    let error = refused(
        CompressionMethod::Stored,
        &[("valids", column(&[1.0, 0.0, 1.0, 1.0, 0.0, 1.0]))],
    );
    assert!(error.contains("row 1 of \"valids\""), "{error}");
}

#[test]
fn rewards_or_timeouts_make_it_d4rl() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.npz");
    let mut arrays = ogbench();
    arrays.push(("rewards", column(&[1.0; 6])));
    arrays.push(("infos/goal", column(&[7.0; 6])));
    write(&path, CompressionMethod::Deflated, &arrays);
    for (policy, lengths) in [
        (None, vec![3, 2, 1]),
        (Some(EpisodePolicy::GoalChange), vec![6]),
    ] {
        let options = OpenOptions {
            episode_policy: policy,
            ..OpenOptions::default()
        };
        let source = open(&path, &options).unwrap();
        crate::conformance::check_source(source.as_ref()).unwrap();
        let found: Vec<_> = source
            .episodes()
            .unwrap()
            .iter()
            .map(|e| e.length)
            .collect();
        assert_eq!(found, lengths);
    }
    // Takes the row after an episode as its final observation, and once more as the next one's first.
    let options = OpenOptions {
        episode_policy: Some(EpisodePolicy::D4rlQlearning),
        max_episode_steps: Some(100),
        ..OpenOptions::default()
    };
    let source = open(&path, &options).unwrap();
    crate::conformance::check_source(source.as_ref()).unwrap();
    let expected = [0.0, 1.0, 2.0, 3.0, 3.0, 4.0, 5.0].map(Some);
    assert_eq!(
        values(&rows(source.as_ref()).unwrap(), "observation"),
        expected
    );
    write(&path, CompressionMethod::Stored, &ogbench());
    let error = open(&path, &options).err().unwrap().cause().to_string();
    assert!(error.contains("OGBench's layout"), "{error}");
}

#[test]
fn orders_and_types_of_values_are_kept() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.npz");
    let mut arrays = ogbench();
    // Row i of 2 × 2 values in Fortran order: the rows count first.
    let fortran: Vec<f32> = (0..4u8)
        .flat_map(|at| (0..6u8).map(move |row| f32::from(row * 10 + at)))
        .collect();
    arrays[0].1 = npy("<f4", true, "(6, 2, 2)", &floats(&fortran));
    let big: Vec<u8> = (0..6u8).flat_map(|i| f64::from(i).to_be_bytes()).collect();
    arrays[1].1 = npy(">f8", false, "(6, 1)", &big);
    let bytes: Vec<u8> = (0..6 * 4).collect();
    arrays[3] = ("button_states", npy("|u1", false, "(6, 4)", &bytes));
    write(&path, CompressionMethod::Deflated, &arrays);
    let source = opened(&path).unwrap();
    crate::conformance::check_source(source.as_ref()).unwrap();
    let rows = rows(source.as_ref()).unwrap();
    let observation = rows["observation"].as_fixed_size_list();
    let second = observation.value(1);
    // Fortran places 0, 2, 1, 3 are (0, 0), (0, 1), (1, 0), (1, 1).
    assert_eq!(
        second.as_primitive::<Float32Type>().values(),
        &[10.0, 12.0, 11.0, 13.0]
    );
    let action = rows["action"].as_fixed_size_list().values().clone();
    assert_eq!(action.as_primitive::<Float64Type>().value(3), 3.0);
    assert_eq!(
        rows["info.button_states"]
            .as_fixed_size_list()
            .value(5)
            .len(),
        4
    );
}

#[test]
fn what_cannot_be_a_column_is_refused_or_told() {
    let stored = CompressionMethod::Stored;
    let objects = refused(
        stored,
        &[("other", npy("|O", false, "(6,)", b"cos\nsystem\n"))],
    );
    assert_eq!(
        objects,
        "not supported yet: \"other\" holds Python objects, which are never unpickled"
    );
    let short = refused(stored, &[("actions", column(&[0.0; 5]))]);
    assert_eq!(short, "\"actions\" has 5 rows, expected 6");
    let text = refused(stored, &[("actions", npy("<U1", false, "(6,)", &[0; 24]))]);
    assert_eq!(
        text,
        "\"actions\" has type '<U1', expected an array of numbers or flags"
    );
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.npz");
    let mut arrays = ogbench();
    arrays.push(("version", npy("<i8", false, "()", &[0; 8])));
    arrays.push(("table", column(&[0.0; 2])));
    write(&path, stored, &arrays);
    let warnings = opened(&path).unwrap().info().warnings.clone();
    assert!(matches!(
        warnings.as_slice(),
        [Warning::ColumnLeftOut { .. }, Warning::ColumnLeftOut { .. }]
    ));
}

#[test]
fn sizes_that_cannot_be_are_refused() {
    let stored = CompressionMethod::Stored;
    let few = refused(
        stored,
        &[(
            "observations",
            npy("<f4", false, "(1000000000, 4096)", &[0; 8]),
        )],
    );
    assert!(
        few.contains("declares 16384000000000 bytes of values, but has 8"),
        "{few}"
    );
    let deep = refused(
        stored,
        &[("observations", npy("<f4", false, &"(".repeat(5000), &[]))],
    );
    assert!(deep.contains("nested too deep"), "{deep}");
    let huge = format!("({0}, {0}, {0})", u64::MAX);
    let huge = refused(stored, &[("observations", npy("<f4", false, &huge, &[]))]);
    assert!(huge.starts_with("corrupt file"), "{huge}");
}

#[test]
fn damage_is_found_by_the_checksum() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.npz");
    write(&path, CompressionMethod::Stored, &ogbench());
    let mut bytes = std::fs::read(&path).unwrap();
    // The action of a last row is no data, but the checksum is that of all bytes.
    let nine = bytes
        .windows(4)
        .position(|four| four == 9f32.to_le_bytes())
        .unwrap();
    bytes[nine] ^= 1;
    std::fs::write(&path, &bytes).unwrap();
    let error = rows(opened(&path).unwrap().as_ref()).unwrap_err();
    assert!(
        error.cause().to_string().contains("checksum"),
        "{}",
        error.cause()
    );
    std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
    let error = opened(&path).err().unwrap();
    assert!(
        error
            .cause()
            .to_string()
            .contains("not a whole zip archive"),
        "{}",
        error.cause()
    );
}
