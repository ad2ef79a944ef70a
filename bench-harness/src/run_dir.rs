//! The folder of a benchmark: `manifest.json`, a Parquet file per cell in `cells/`, and `episodes.parquet` of all.
//!
//! A cell's file appears when the cell is complete and says in its metadata what it was played with. A cell that is
//! there is not played again; one that was played with other settings is an error, never mixed in.

use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use arrow::array::{
    Array as _, ArrayRef, AsArray as _, BooleanArray, Float64Array, RecordBatch, StringArray,
    UInt64Array,
};
use arrow::datatypes::{Float64Type, UInt64Type};
use arrow::error::ArrowError;
use parquet::arrow::ArrowWriter;
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
use parquet::errors::ParquetError;
use parquet::file::metadata::KeyValue;
use parquet::file::properties::WriterProperties;
use serde_json::Value;
use tempfile::NamedTempFile;

use crate::k_sim::EpisodeKSim;
use crate::record::EpisodeRecord;

/// Key of what a cell was played with, in the metadata of its file.
const CELL_KEY: &str = "ksim.cell";

/// One episode of a benchmark.
#[derive(Debug, Clone, PartialEq)]
pub struct EpisodeRow {
    /// Name of the planner.
    pub planner: String,
    /// Name of the environment.
    pub environment: String,
    /// Its numbers; `run` and `episode` count in the benchmark and in the run.
    pub record: EpisodeRecord,
    /// K-Sim, where it is measured.
    pub k_sim: Option<EpisodeKSim>,
    /// Mean over its steps of the novelty of the plan under way, where the planner knows it.
    pub mean_novelty: Option<f64>,
}

/// Why the folder cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RunDirError {
    /// A file or folder that cannot be read or written.
    #[error("{}: cannot {action}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What was tried.
        action: &'static str,
        /// What the system says.
        source: io::Error,
    },
    /// A file that is no Parquet file of ours.
    #[error("{}", path.display())]
    Parquet {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        source: ParquetError,
    },
    /// Rows that cannot be made or read.
    #[error("{}", path.display())]
    Arrow {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        source: ArrowError,
    },
    /// A file with other columns.
    #[error("{}: column \"{column}\" is missing or of another type", path.display())]
    Column {
        /// The file.
        path: PathBuf,
        /// The column.
        column: &'static str,
    },
    /// A cell that was played with something else.
    #[error(
        "{}: it was played with {key} {found}, not with {expected}; remove it, or write to another folder", path.display()
    )]
    OtherSettings {
        /// The file.
        path: PathBuf,
        /// The first setting that differs.
        key: String,
        /// What is asked for.
        expected: String,
        /// What it was played with.
        found: String,
    },
}

/// A folder of results.
#[derive(Debug, Clone)]
pub struct RunDir {
    path: PathBuf,
}

impl RunDir {
    /// Makes the folder, if it is not there.
    ///
    /// # Errors
    /// It cannot be made.
    pub fn open(path: &Path) -> Result<Self, RunDirError> {
        let cells = path.join("cells");
        fs::create_dir_all(&cells).map_err(|source| RunDirError::Io {
            path: cells,
            action: "make the folder",
            source,
        })?;
        Ok(Self {
            path: path.to_owned(),
        })
    }

    /// The folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Writes a file of text; it appears whole or not at all.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn write_text(&self, name: &str, text: &str) -> Result<PathBuf, RunDirError> {
        let path = self.path.join(name);
        atomically(&path, |file| io::Write::write_all(file, text.as_bytes()))?;
        Ok(path)
    }

    fn cell_path(&self, cell: &str) -> PathBuf {
        self.path.join("cells").join(format!("{cell}.parquet"))
    }

    /// The episodes of a cell that was played with these settings; `None` if it was not played.
    ///
    /// # Errors
    /// Its file cannot be read, or was played with other settings.
    pub fn read_cell(
        &self,
        cell: &str,
        settings: &Value,
    ) -> Result<Option<Vec<EpisodeRow>>, RunDirError> {
        let path = self.cell_path(cell);
        let file = match File::open(&path) {
            Ok(file) => file,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(source) => {
                return Err(RunDirError::Io {
                    path,
                    action: "read",
                    source,
                });
            }
        };
        let parquet = |source| RunDirError::Parquet {
            path: path.clone(),
            source,
        };
        let reader = ParquetRecordBatchReaderBuilder::try_new(file).map_err(parquet)?;
        let metadata = reader.metadata().file_metadata().key_value_metadata();
        let found = metadata
            .into_iter()
            .flatten()
            .find(|entry| entry.key == CELL_KEY);
        let found = found.and_then(|entry| entry.value.as_deref());
        let found = found.and_then(|text| serde_json::from_str(text).ok());
        check_settings(&path, settings, &found.unwrap_or(Value::Null))?;
        let mut rows = Vec::new();
        for batch in reader.build().map_err(parquet)? {
            let batch = batch.map_err(|source| RunDirError::Arrow {
                path: path.clone(),
                source,
            })?;
            read_rows(&batch, &mut rows).map_err(|column| RunDirError::Column {
                path: path.clone(),
                column,
            })?;
        }
        Ok(Some(rows))
    }

    /// Writes the episodes of a cell.
    ///
    /// # Errors
    /// They cannot be written.
    pub fn write_cell(
        &self,
        cell: &str,
        settings: &Value,
        rows: &[EpisodeRow],
    ) -> Result<(), RunDirError> {
        write_rows(&self.cell_path(cell), rows, Some(settings))
    }

    /// Writes `episodes.parquet`: a row per episode of all cells.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn write_episodes(&self, rows: &[EpisodeRow]) -> Result<PathBuf, RunDirError> {
        let path = self.path.join("episodes.parquet");
        write_rows(&path, rows, None)?;
        Ok(path)
    }
}

/// Names the first difference.
fn check_settings(path: &Path, expected: &Value, found: &Value) -> Result<(), RunDirError> {
    if expected == found {
        return Ok(());
    }
    let mut keys: Vec<&String> = [expected, found]
        .iter()
        .filter_map(|value| value.as_object())
        .flat_map(|table| table.keys())
        .collect();
    keys.sort_unstable();
    let differs = keys
        .into_iter()
        .find(|key| expected.get(*key) != found.get(*key));
    let (key, expected, found) = match differs {
        Some(key) => (key.as_str(), expected.get(key), found.get(key)),
        None => ("settings", Some(expected), Some(found)),
    };
    let text = |value: Option<&Value>| value.map_or("nothing".to_owned(), ToString::to_string);
    Err(RunDirError::OtherSettings {
        path: path.to_owned(),
        key: key.to_owned(),
        expected: text(expected),
        found: text(found),
    })
}

/// Writes a file beside its place and puts it there when it is complete.
fn atomically(
    path: &Path,
    write: impl FnOnce(&mut File) -> io::Result<()>,
) -> Result<(), RunDirError> {
    let failed = |source| RunDirError::Io {
        path: path.to_owned(),
        action: "write",
        source,
    };
    let folder = path.parent().unwrap_or(Path::new("."));
    let mut builder = tempfile::Builder::new();
    builder.prefix(".ksim-").suffix(".unfinished");
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    let mut file: NamedTempFile = builder.tempfile_in(folder).map_err(failed)?;
    write(file.as_file_mut()).map_err(failed)?;
    file.persist(path).map_err(|error| failed(error.error))?;
    Ok(())
}

fn write_rows(
    path: &Path,
    rows: &[EpisodeRow],
    settings: Option<&Value>,
) -> Result<(), RunDirError> {
    let batch = batch_of(rows).map_err(|source| RunDirError::Arrow {
        path: path.to_owned(),
        source,
    })?;
    let metadata =
        settings.map(|settings| vec![KeyValue::new(CELL_KEY.to_owned(), settings.to_string())]);
    let properties = WriterProperties::builder()
        .set_key_value_metadata(metadata)
        .build();
    atomically(path, |file| {
        let mut writer = ArrowWriter::try_new(file, batch.schema(), Some(properties))?;
        writer.write(&batch)?;
        writer.close()?;
        Ok(())
    })
}

fn batch_of(rows: &[EpisodeRow]) -> Result<RecordBatch, ArrowError> {
    let text = |value: fn(&EpisodeRow) -> &str| -> ArrayRef {
        Arc::new(
            rows.iter()
                .map(|row| Some(value(row)))
                .collect::<StringArray>(),
        )
    };
    let count = |value: fn(&EpisodeRow) -> Option<usize>| -> ArrayRef {
        let values = rows.iter().map(|row| value(row).map(|n| n as u64));
        Arc::new(values.collect::<UInt64Array>())
    };
    let number = |value: fn(&EpisodeRow) -> Option<f64>| -> ArrayRef {
        Arc::new(rows.iter().map(value).collect::<Float64Array>())
    };
    let flag = |value: fn(&EpisodeRow) -> Option<bool>| -> ArrayRef {
        Arc::new(rows.iter().map(value).collect::<BooleanArray>())
    };
    let seeds = rows.iter().map(|row| Some(row.record.seed));
    RecordBatch::try_from_iter_with_nullable([
        ("planner", text(|row| &row.planner), false),
        ("environment", text(|row| &row.environment), false),
        ("run", count(|row| Some(row.record.run)), false),
        (
            "episode_index",
            count(|row| Some(row.record.episode)),
            false,
        ),
        (
            "seed",
            Arc::new(seeds.collect::<UInt64Array>()) as ArrayRef,
            false,
        ),
        ("length", count(|row| Some(row.record.length)), false),
        ("return", number(|row| Some(row.record.total_return)), false),
        (
            "discounted_return",
            number(|row| Some(row.record.discounted_return)),
            false,
        ),
        (
            "normalized_score",
            number(|row| row.record.normalized_score),
            true,
        ),
        ("terminated", flag(|row| Some(row.record.terminated)), false),
        ("truncated", flag(|row| Some(row.record.truncated)), false),
        ("success", flag(|row| row.record.success), true),
        (
            "success_at_end",
            flag(|row| row.record.success_at_end),
            true,
        ),
        (
            "first_success_step",
            count(|row| row.record.first_success_step),
            true,
        ),
        (
            "k_sim",
            number(|row| row.k_sim.map(|k_sim| k_sim.k_sim)),
            true,
        ),
        (
            "saturated_share",
            number(|row| row.k_sim.map(|k_sim| k_sim.saturated_share)),
            true,
        ),
        (
            "mean_scaled_distance",
            number(|row| row.k_sim.map(|k_sim| k_sim.mean_scaled_distance)),
            true,
        ),
        ("mean_novelty", number(|row| row.mean_novelty), true),
    ])
}

/// Adds the rows of a batch, or names the column that is not as it should be.
fn read_rows(batch: &RecordBatch, rows: &mut Vec<EpisodeRow>) -> Result<(), &'static str> {
    let column = |name: &'static str| batch.column_by_name(name).ok_or(name);
    let texts = |name| column(name)?.as_string_opt::<i32>().ok_or(name);
    let counts = |name| column(name)?.as_primitive_opt::<UInt64Type>().ok_or(name);
    let numbers = |name| column(name)?.as_primitive_opt::<Float64Type>().ok_or(name);
    let flags = |name| column(name)?.as_boolean_opt().ok_or(name);
    let (planner, environment) = (texts("planner")?, texts("environment")?);
    let (run, episode) = (counts("run")?, counts("episode_index")?);
    let (seed, length) = (counts("seed")?, counts("length")?);
    let first_success = counts("first_success_step")?;
    let (returns, discounted) = (numbers("return")?, numbers("discounted_return")?);
    let score = numbers("normalized_score")?;
    let (terminated, truncated) = (flags("terminated")?, flags("truncated")?);
    let (success, at_end) = (flags("success")?, flags("success_at_end")?);
    let (k_sim, saturated) = (numbers("k_sim")?, numbers("saturated_share")?);
    let (distance, novelty) = (numbers("mean_scaled_distance")?, numbers("mean_novelty")?);
    let size = |value: u64| usize::try_from(value).unwrap_or(usize::MAX);
    for row in 0..batch.num_rows() {
        let number = |column: &Float64Array| column.is_valid(row).then(|| column.value(row));
        let flag = |column: &BooleanArray| column.is_valid(row).then(|| column.value(row));
        let n_steps = size(length.value(row));
        rows.push(EpisodeRow {
            planner: planner.value(row).to_owned(),
            environment: environment.value(row).to_owned(),
            record: EpisodeRecord {
                episode: size(episode.value(row)),
                run: size(run.value(row)),
                seed: seed.value(row),
                length: n_steps,
                total_return: returns.value(row),
                discounted_return: discounted.value(row),
                terminated: terminated.value(row),
                truncated: truncated.value(row),
                success: flag(success),
                success_at_end: flag(at_end),
                first_success_step: first_success
                    .is_valid(row)
                    .then(|| size(first_success.value(row))),
                normalized_score: number(score),
            },
            k_sim: number(k_sim).map(|k_sim| EpisodeKSim {
                k_sim,
                n_steps,
                saturated_share: number(saturated).unwrap_or(f64::NAN),
                mean_scaled_distance: number(distance).unwrap_or(f64::NAN),
            }),
            mean_novelty: number(novelty),
        });
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn row(episode: usize, known: bool) -> EpisodeRow {
        EpisodeRow {
            planner: "a".to_owned(),
            environment: "maze".to_owned(),
            record: EpisodeRecord {
                episode,
                run: 1,
                seed: u64::MAX - 3,
                length: 7,
                total_return: 0.1,
                discounted_return: 0.05,
                terminated: true,
                truncated: false,
                success: known.then_some(true),
                success_at_end: known.then_some(false),
                first_success_step: known.then_some(3),
                normalized_score: known.then_some(0.5),
            },
            k_sim: known.then_some(EpisodeKSim {
                k_sim: 0.75,
                n_steps: 7,
                saturated_share: 0.25,
                mean_scaled_distance: 1.5,
            }),
            mean_novelty: known.then_some(0.125),
        }
    }

    #[test]
    fn a_cell_comes_back_as_it_was_written() {
        let folder = tempfile::tempdir().unwrap();
        let run_dir = RunDir::open(&folder.path().join("new/results")).unwrap();
        let settings = json!({"seed": 3, "planner": {"source": "random"}});
        assert_eq!(run_dir.read_cell("a", &settings).unwrap(), None);
        let rows = [row(0, true), row(1, false)];
        run_dir.write_cell("a", &settings, &rows).unwrap();
        assert_eq!(run_dir.read_cell("a", &settings).unwrap().unwrap(), rows);
        let names: Vec<_> = fs::read_dir(run_dir.path().join("cells"))
            .unwrap()
            .collect();
        assert_eq!(names.len(), 1);
    }

    #[test]
    fn other_settings_and_other_files_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let run_dir = RunDir::open(folder.path()).unwrap();
        run_dir
            .write_cell("a", &json!({"seed": 3, "episodes": 2}), &[row(0, true)])
            .unwrap();
        let asked = json!({"seed": 4, "episodes": 2});
        let error = run_dir.read_cell("a", &asked).unwrap_err().to_string();
        assert!(
            error.contains("it was played with seed 3, not with 4"),
            "{error}"
        );
        fs::write(run_dir.cell_path("b"), "nothing").unwrap();
        assert!(
            run_dir
                .read_cell("b", &asked)
                .unwrap_err()
                .to_string()
                .contains("b.parquet")
        );
        let whole = fs::read(run_dir.cell_path("a")).unwrap();
        fs::write(run_dir.cell_path("c"), &whole[..whole.len() / 2]).unwrap();
        assert!(run_dir.read_cell("c", &asked).is_err());
    }
}
