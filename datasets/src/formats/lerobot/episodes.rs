//! Where each episode's rows are, and what is recorded about it.

use std::collections::BTreeMap;

use arrow::array::{Array, AsArray, RecordBatch};
use arrow::datatypes::{DataType, Int64Type};
use serde_json::{Map, Value};

use super::attributes;
use super::files::{self, ParquetFile};
use super::info::{Info, Layout};
use super::root::Root;
use crate::error::{DatasetError, Result};
use crate::schema;

/// Folder of the episodes' descriptions since v3.0, and the file of them before.
pub(super) const EPISODES_FOLDER: &str = "meta/episodes";
const EPISODES_PATH_V2: &str = "meta/episodes.jsonl";

/// One episode's place.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Place {
    /// Its number.
    pub(super) number: i64,
    /// Steps; at least 1.
    pub(super) length: u64,
    /// Place of its file among [`Episodes::files`].
    pub(super) file: usize,
    /// Its first row in that file.
    pub(super) first_row: u64,
    /// `index` of its first step: the row in the whole dataset.
    pub(super) first_index: i64,
}

/// One data file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct DataFile {
    /// Path inside the folder.
    pub(super) path: String,
    /// Rows it must have.
    pub(super) n_rows: u64,
}

/// All episodes of a dataset, in order.
#[derive(Debug, Default)]
pub(super) struct Episodes {
    pub(super) files: Vec<DataFile>,
    pub(super) places: Vec<Place>,
    /// Episodes without a step, which are left out.
    pub(super) n_empty: u64,
    next_index: i64,
}

/// What a description says of one episode.
struct Described {
    number: i64,
    length: i64,
    /// `data/chunk_index`, `data/file_index`, `dataset_from_index`, `dataset_to_index`, since v3.0.
    placed: Option<[i64; 4]>,
}

impl Episodes {
    /// Reads the descriptions, without attributes and statistics. Memory: 40 bytes an episode, and the names
    /// of the files.
    ///
    /// # Errors
    /// A file is missing or damaged, or the episodes do not follow each other without gaps; it is named.
    pub(super) fn read(root: &Root, info: &Info) -> Result<Self> {
        let mut episodes = Self::default();
        match info.layout {
            Layout::V2 => files::json_lines(root, EPISODES_PATH_V2, |line| {
                episodes.add(&of_line(&line)?, info)
            })?,
            Layout::V3 => {
                for path in description_files(root, info)? {
                    episodes
                        .read_table(root, &path, info)
                        .map_err(|error| error.in_file(&root.join(&path)))?;
                }
            }
        }
        Ok(episodes)
    }

    fn read_table(&mut self, root: &Root, path: &str, info: &Info) -> Result<()> {
        const COLUMNS: [&str; 6] = [
            schema::EPISODE_INDEX,
            "length",
            "data/chunk_index",
            "data/file_index",
            "dataset_from_index",
            "dataset_to_index",
        ];
        let file = ParquetFile::open(root, path)?;
        for batch in file.read(|name| COLUMNS.contains(&name), 4096)? {
            let batch = batch?;
            let mut columns = Vec::with_capacity(COLUMNS.len());
            for name in COLUMNS {
                columns.push(integers(&batch, name)?);
            }
            for row in 0..batch.num_rows() {
                let value = |column: usize| columns.get(column).map_or(0, |c: &Vec<i64>| c[row]);
                let described = Described {
                    number: value(0),
                    length: value(1),
                    placed: Some([value(2), value(3), value(4), value(5)]),
                };
                self.add(&described, info)?;
            }
        }
        Ok(())
    }

    fn add(&mut self, described: &Described, info: &Info) -> Result<()> {
        let number = described.number;
        let wrong = |what: String| DatasetError::corrupt(format!("episode {number}: {what}"));
        let last = self.places.last().map_or(-1, |place| place.number);
        if number <= last {
            return Err(wrong(format!("it comes after episode {last}")));
        }
        let length = u64::try_from(described.length)
            .map_err(|_| wrong(format!("length {}", described.length)))?;
        let first_index = self.next_index;
        let after = first_index
            .checked_add(described.length)
            .ok_or_else(|| wrong(format!("length {length}")))?;
        let path = match described.placed {
            None => info.data_path.path(&[number / info.chunks_size, number]),
            Some([chunk, file, from, to]) => {
                if (from, to) != (first_index, after) {
                    let expected = format!("expected {first_index}..{after}");
                    return Err(wrong(format!(
                        "it is rows {from}..{to} of the dataset, {expected}"
                    )));
                }
                if chunk < 0 || file < 0 {
                    return Err(wrong(format!("it is in file {file} of chunk {chunk}")));
                }
                info.data_path.path(&[chunk, file])
            }
        };
        if length == 0 {
            self.n_empty += 1;
            return Ok(());
        }
        let first_row = self.extend_file(path, length).map_err(wrong)?;
        self.next_index = after;
        self.places.push(Place {
            number,
            length,
            file: self.files.len() - 1,
            first_row,
            first_index,
        });
        Ok(())
    }

    /// Adds rows to the last file, or starts the next one; gives the first of them.
    fn extend_file(&mut self, path: String, length: u64) -> Result<u64, String> {
        match self.files.last_mut() {
            Some(last) if last.path == path => {
                let first_row = last.n_rows;
                last.n_rows = first_row.saturating_add(length);
                Ok(first_row)
            }
            _ => {
                self.files.push(DataFile {
                    path,
                    n_rows: length,
                });
                Ok(0)
            }
        }
    }

    pub(super) fn n_steps(&self) -> u64 {
        self.places.iter().map(|place| place.length).sum()
    }
}

/// Where a layout describes its episodes.
pub(super) fn path(layout: Layout) -> &'static str {
    match layout {
        Layout::V2 => EPISODES_PATH_V2,
        Layout::V3 => EPISODES_FOLDER,
    }
}

fn of_line(line: &Map<String, Value>) -> Result<Described> {
    let integer = |key: &str| {
        line.get(key)
            .and_then(Value::as_i64)
            .filter(|value| *value >= 0)
            .ok_or_else(|| {
                DatasetError::corrupt(format!("a line without \"{key}\", a count from 0"))
            })
    };
    Ok(Described {
        number: integer(schema::EPISODE_INDEX)?,
        length: integer("length")?,
        placed: None,
    })
}

/// An integer column without nulls.
fn integers(batch: &RecordBatch, name: &str) -> Result<Vec<i64>> {
    let array = files::cast(batch, name, &DataType::Int64)?;
    let array = array.as_primitive::<Int64Type>();
    match (0..array.len()).find(|&row| array.is_null(row)) {
        Some(row) => Err(DatasetError::NullValue {
            column: name.to_owned(),
            row: row as u64,
        }),
        None => Ok(array.values().to_vec()),
    }
}

/// A dataset without episodes may lack the folder.
fn description_files(root: &Root, info: &Info) -> Result<Vec<String>> {
    if info.count("total_episodes") == Some(0) && !root.has(EPISODES_FOLDER) {
        return Ok(Vec::new());
    }
    let files = root.parquet_files(EPISODES_FOLDER)?;
    if files.is_empty() && info.count("total_episodes") != Some(0) {
        let error = DatasetError::NotADataset {
            expected: "chunk-000/file-000.parquet with the episodes",
            found: "no such file".to_owned(),
        };
        return Err(error.in_file(&root.join(EPISODES_FOLDER)));
    }
    Ok(files)
}

/// Everything else that is recorded about the episodes, by number.
///
/// # Errors
/// A file is missing or damaged; it is named.
pub(super) fn attributes(root: &Root, info: &Info) -> Result<BTreeMap<i64, Map<String, Value>>> {
    let mut all = BTreeMap::new();
    match info.layout {
        Layout::V2 => files::json_lines(root, EPISODES_PATH_V2, |mut line| {
            if let Some(number) = line.get(schema::EPISODE_INDEX).and_then(Value::as_i64) {
                line.retain(|key, value| attributes::is_attribute(key) && !value.is_null());
                all.insert(number, line);
            }
            Ok(())
        })?,
        Layout::V3 => {
            for path in description_files(root, info)? {
                let mut read = || -> Result<()> {
                    let file = ParquetFile::open(root, &path)?;
                    let wanted = |name: &str| {
                        name == schema::EPISODE_INDEX || attributes::is_attribute(name)
                    };
                    for batch in file.read(wanted, 1024)? {
                        let batch = batch?;
                        let numbers = integers(&batch, schema::EPISODE_INDEX)?;
                        let rows = numbers.into_iter().enumerate();
                        all.extend(rows.map(|(row, n)| (n, attributes::of_row(&batch, row))));
                    }
                    Ok(())
                };
                read().map_err(|error| error.in_file(&root.join(&path)))?;
            }
        }
    }
    Ok(all)
}
