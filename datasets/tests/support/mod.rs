//! Golden files, and tables of rows to compare with them.

use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::{Path, PathBuf};

use arrow::array::{Array, ArrayRef, AsArray};
use arrow::datatypes::{DataType, Field, Float16Type, Float64Type};
use ksim_datasets::{DatasetSource, Scan, schema};
use serde_json::Value;
use sha2::{Digest, Sha256};

/// A place in the golden folder.
pub(crate) fn golden(place: &str) -> PathBuf {
    let root = match std::env::var_os("KSIM_GOLDEN") {
        Some(root) => PathBuf::from(root),
        None => Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/fixtures/golden"),
    };
    root.join(place)
}

/// All files under a folder whose name ends so, in order.
pub(crate) fn files(folder: &Path, ending: &str) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder).into_iter().flatten().flatten() {
            let path = entry.path();
            if path.is_dir() {
                folders.push(path);
            } else if path.to_string_lossy().ends_with(ending) {
                found.push(path);
            }
        }
    }
    found.sort();
    found
}

/// A JSON file; Python's `NaN` and infinities inside become null (they are checked by hash).
pub(crate) fn read_json(path: &Path) -> Value {
    let text = std::fs::read_to_string(path).unwrap();
    let text = text
        .replace("-Infinity", "null")
        .replace("Infinity", "null")
        .replace("NaN", "null");
    serde_json::from_str(&text).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// SHA-256 of little-endian 64-bit integers, in hex.
pub(crate) fn sha256_i64(values: &[i64]) -> String {
    let bytes: Vec<u8> = values
        .iter()
        .flat_map(|value| value.to_le_bytes())
        .collect();
    hex(&bytes)
}

pub(crate) fn hex(bytes: &[u8]) -> String {
    Sha256::digest(bytes)
        .iter()
        .fold(String::new(), |mut text, byte| {
            let _ = write!(text, "{byte:02x}");
            text
        })
}

/// Rows of a scan, column by column.
pub(crate) struct Table {
    leaves: BTreeMap<String, Leaf>,
}

/// One column.
#[derive(Clone)]
pub(crate) struct Leaf {
    field: Field,
    array: ArrayRef,
}

impl Table {
    pub(crate) fn read_all(source: &dyn DatasetSource) -> Self {
        Self::scan(
            source,
            &Scan {
                batch_rows: 7,
                ..Scan::default()
            },
        )
    }

    pub(crate) fn read(source: &dyn DatasetSource, columns: &[&str]) -> Self {
        let columns = columns.iter().map(|&name| name.to_owned()).collect();
        Self::scan(
            source,
            &Scan {
                columns: Some(columns),
                ..Scan::default()
            },
        )
    }

    pub(crate) fn read_episode(source: &dyn DatasetSource, episode: i64) -> Self {
        Self::scan(
            source,
            &Scan {
                episodes: Some(vec![episode]),
                batch_rows: 5,
                ..Scan::default()
            },
        )
    }

    fn scan(source: &dyn DatasetSource, scan: &Scan) -> Self {
        let reader = source.scan(scan).unwrap();
        let schema = reader.schema();
        let batches: Vec<_> = reader.collect::<Result<_, _>>().unwrap();
        let whole = arrow::compute::concat_batches(&schema, &batches).unwrap();
        let leaf = |i: usize| Leaf {
            field: schema.field(i).clone(),
            array: whole.column(i).clone(),
        };
        let leaves = (0..schema.fields().len())
            .map(|i| (schema.field(i).name().clone(), leaf(i)))
            .collect();
        Self { leaves }
    }

    pub(crate) fn leaf(&self, column: &str) -> &Leaf {
        self.leaves
            .get(column)
            .unwrap_or_else(|| panic!("no column {column}"))
    }

    /// The rows of a numeric column as floats.
    pub(crate) fn row_bytes(&self, column: &str) -> Vec<Vec<f64>> {
        let leaf = self.leaf(column);
        let width = leaf.shape().iter().product::<usize>();
        let values = arrow::compute::cast(&leaf.values(), &DataType::Float64).unwrap();
        values
            .as_primitive::<Float64Type>()
            .values()
            .chunks_exact(width)
            .map(<[f64]>::to_vec)
            .collect()
    }
}

impl Leaf {
    /// Without null rows.
    pub(crate) fn steps(&self) -> Self {
        let keep = arrow::compute::is_not_null(&self.array).unwrap();
        Self {
            field: self.field.clone(),
            array: arrow::compute::filter(&self.array, &keep).unwrap(),
        }
    }

    fn shape(&self) -> Vec<usize> {
        match schema::row_shape(&self.field) {
            Some((_, shape)) => shape,
            None => match self.field.data_type() {
                DataType::FixedSizeList(_, n) => vec![usize::try_from(*n).unwrap()],
                _ => vec![],
            },
        }
    }

    fn values(&self) -> ArrayRef {
        match self.array.data_type() {
            DataType::FixedSizeList(_, width) => {
                let list = self.array.as_fixed_size_list();
                let start = usize::try_from(list.value_offset(0)).unwrap();
                list.values()
                    .slice(start, list.len() * usize::try_from(*width).unwrap())
            }
            _ => self.array.clone(),
        }
    }

    /// Compares with what the recording says: shape, type, hash of the bytes, first and last row.
    pub(crate) fn assert_is(&self, expected: &Value, place: &str) {
        if let Some(len) = expected["len"].as_u64() {
            let text = self.array.as_string::<i32>();
            assert_eq!(text.len() as u64, len, "{place}");
            assert_eq!(Some(text.value(0)), expected["first"].as_str(), "{place}");
            assert_eq!(
                Some(text.value(text.len() - 1)),
                expected["last"].as_str(),
                "{place}"
            );
            return;
        }
        let shape: Vec<usize> = serde_json::from_value(expected["shape"].clone()).unwrap();
        assert_eq!(self.array.len(), shape[0], "{place}: rows");
        if *self.field.data_type() == DataType::Binary {
            // Pictures are hashed after decoding, which this crate leaves to others.
            assert_eq!(self.shape(), shape[1..], "{place}");
            return;
        }
        let dtype = expected["dtype"].as_str().unwrap();
        let squeezed = shape[1..] == [1] && self.shape().is_empty();
        assert!(
            self.shape() == shape[1..] || squeezed,
            "{place}: {:?}",
            self.shape()
        );
        if let Some(sha) = expected["sha256_c_order"].as_str() {
            assert_eq!(hex(&bytes(&self.values(), dtype)), sha, "{place}");
        }
        let width = shape[1..].iter().product::<usize>();
        for (key, start) in [("first", 0), ("last", (shape[0] - 1) * width)] {
            let mut flat = Vec::new();
            flatten(&expected[key], &mut flat);
            let found = arrow::compute::cast(&self.values(), &DataType::Float64).unwrap();
            let found = found.as_primitive::<Float64Type>();
            for (i, value) in flat
                .iter()
                .enumerate()
                .filter_map(|(i, value)| Some((i, (*value)?)))
            {
                assert_eq!(found.value(start + i), value, "{place}: {key} value {i}");
            }
        }
    }
}

fn flatten(value: &Value, flat: &mut Vec<Option<f64>>) {
    match value {
        Value::Array(items) => items.iter().for_each(|item| flatten(item, flat)),
        Value::Bool(flag) => flat.push(Some(f64::from(u8::from(*flag)))),
        other => flat.push(other.as_f64()),
    }
}

/// The bytes NumPy has for these values in this type.
fn bytes(values: &ArrayRef, dtype: &str) -> Vec<u8> {
    // Big-endian arrays are hashed in their own byte order.
    let (dtype, swap) = match dtype.strip_prefix('>') {
        Some("f8") => ("float64", true),
        Some("f4") => ("float32", true),
        Some(other) => panic!("type >{other}"),
        None => (dtype, false),
    };
    let target = match dtype {
        "bool" | "uint8" => DataType::UInt8,
        "int8" => DataType::Int8,
        "int32" => DataType::Int32,
        "int64" => DataType::Int64,
        "float16" => DataType::Float16,
        "float32" => DataType::Float32,
        "float64" => DataType::Float64,
        other => panic!("type {other}"),
    };
    if values.data_type().is_numeric() && dtype != "bool" {
        assert_eq!(*values.data_type(), target, "the source's type is kept");
    }
    let cast = arrow::compute::cast(values, &target).unwrap();
    if target == DataType::Float16 {
        return cast
            .as_primitive::<Float16Type>()
            .values()
            .iter()
            .flat_map(|v| v.to_le_bytes())
            .collect();
    }
    let data = cast.to_data();
    let width = target.primitive_width().unwrap();
    let start = data.offset() * width;
    let mut bytes = data.buffers()[0].as_slice()[start..start + data.len() * width].to_vec();
    if swap {
        bytes.chunks_exact_mut(width).for_each(<[u8]>::reverse);
    }
    bytes
}
