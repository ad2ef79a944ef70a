//! Texts of the tasks, by number.

use std::collections::BTreeMap;

use arrow::array::{Array, AsArray};
use arrow::datatypes::{DataType, Int64Type, Schema};
use serde_json::Value;

use super::files;
use super::info::Layout;
use super::root::Root;
use crate::error::{DatasetError, Result};

/// Where the tasks are since v3.0.
pub(super) const TASKS_PATH: &str = "meta/tasks.parquet";
const TASKS_PATH_V2: &str = "meta/tasks.jsonl";
/// Column that pandas gives an index without a name.
const UNNAMED_INDEX: &str = "__index_level_0__";

/// The tasks of a dataset.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(super) struct Tasks(BTreeMap<i64, String>);

impl Tasks {
    /// The file of this layout.
    pub(super) fn path(layout: Layout) -> &'static str {
        match layout {
            Layout::V2 => TASKS_PATH_V2,
            Layout::V3 => TASKS_PATH,
        }
    }

    /// Reads all tasks; they are few.
    ///
    /// # Errors
    /// The file is missing or damaged, or has a number twice; it is named.
    pub(super) fn read(root: &Root, layout: Layout) -> Result<Self> {
        let path = Self::path(layout);
        let read = || match layout {
            Layout::V2 => Self::read_lines(root),
            Layout::V3 => Self::read_table(root),
        };
        read().map_err(|error| error.in_file(&root.join(path)))
    }

    fn read_lines(root: &Root) -> Result<Self> {
        let mut tasks = Self::default();
        files::json_lines(root, TASKS_PATH_V2, |line| {
            let index = line.get("task_index").and_then(Value::as_i64);
            let task = line.get("task").and_then(Value::as_str);
            let (index, task) = index.zip(task).ok_or_else(|| {
                DatasetError::corrupt("a line without \"task_index\" (integer) and \"task\" (text)")
            })?;
            tasks.add(index, task)
        })?;
        Ok(tasks)
    }

    fn read_table(root: &Root) -> Result<Self> {
        let file = files::ParquetFile::open(root, TASKS_PATH)?;
        let text = text_column(file.schema())?;
        let wanted = |name: &str| name == "task_index" || name == text;
        let mut tasks = Self::default();
        for batch in file.read(wanted, 4096)? {
            let batch = batch?;
            let index = files::cast(&batch, "task_index", &DataType::Int64)?;
            let text = files::cast(&batch, &text, &DataType::Utf8)?;
            let (index, text) = (index.as_primitive::<Int64Type>(), text.as_string::<i32>());
            for row in 0..batch.num_rows() {
                if index.is_null(row) || text.is_null(row) {
                    return Err(DatasetError::corrupt(format!("task {row} holds a null")));
                }
                tasks.add(index.value(row), text.value(row))?;
            }
        }
        Ok(tasks)
    }

    fn add(&mut self, index: i64, task: &str) -> Result<()> {
        match self.0.insert(index, task.to_owned()) {
            Some(before) if before != task => Err(DatasetError::corrupt(format!(
                "task {index} is both \"{}\" and \"{}\"",
                before.escape_debug(),
                task.escape_debug()
            ))),
            _ => Ok(()),
        }
    }

    /// The text of a task.
    pub(super) fn text(&self, index: i64) -> Option<&str> {
        self.0.get(&index).map(String::as_str)
    }

    pub(super) fn len(&self) -> usize {
        self.0.len()
    }

    /// Bytes of the longest text.
    pub(super) fn longest(&self) -> usize {
        self.0.values().map(String::len).max().unwrap_or(0)
    }
}

/// The column that pandas has as its index: by its own note, else by the usual names.
fn text_column(schema: &Schema) -> Result<String> {
    let note = schema.metadata().get("pandas");
    let note = note.and_then(|text| serde_json::from_str::<Value>(text).ok());
    let noted = note
        .as_ref()
        .and_then(|note| note["index_columns"][0].as_str());
    let usual = [noted.unwrap_or("task"), "task", UNNAMED_INDEX];
    let found = usual.iter().find(|name| schema.index_of(name).is_ok());
    found
        .map(|name| (*name).to_owned())
        .ok_or_else(|| DatasetError::MissingColumn {
            role: "task",
            name: "\"task\"".to_owned(),
            found: crate::schema::column_names(schema),
        })
}
