//! Running the built command, and small files for it.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output};
use std::sync::Arc;
use std::time::{Duration, Instant};

use arrow::array::{ArrayRef, FixedSizeListArray, Float32Array, Int64Array, RecordBatch};
use arrow::datatypes::{DataType, Field, Schema};
use parquet::arrow::ArrowWriter;
use serde_json::Value;

/// Waits until a process listens to signals, where the system says so, and gives it time to get to work.
pub(crate) fn wait_until_at_work(child: &Child) {
    /// However busy the machine is.
    const LONGEST: Duration = Duration::from_secs(60);
    let started = Instant::now();
    let status = format!("/proc/{}/status", child.id());
    let listens = || {
        let status = std::fs::read_to_string(&status).unwrap_or_default();
        let caught = status.lines().find_map(|line| line.strip_prefix("SigCgt:"));
        let Some(caught) = caught.and_then(|bits| u64::from_str_radix(bits.trim(), 16).ok()) else {
            return true;
        };
        caught & 0b10 != 0
    };
    while !listens() && started.elapsed() < LONGEST {
        std::thread::sleep(Duration::from_millis(20));
    }
    std::thread::sleep(Duration::from_millis(700));
}

/// What a run of `ksim` left behind.
pub(crate) struct Run {
    /// The exit code.
    pub(crate) code: i32,
    /// All of stdout.
    pub(crate) stdout: String,
    /// All of stderr.
    pub(crate) stderr: String,
}

impl Run {
    /// The result as JSON, of a run that must have been fine.
    #[track_caller]
    pub(crate) fn json(&self) -> Value {
        assert_eq!(self.code, 0, "{}", self.stderr);
        serde_json::from_str(&self.stdout).expect("stdout is JSON and nothing else")
    }

    /// A failure: this exit code, nothing on stdout, one message that holds every part.
    #[track_caller]
    pub(crate) fn failed(&self, code: i32, parts: &[&str]) {
        assert_eq!(
            self.code, code,
            "stdout: {}\nstderr: {}",
            self.stdout, self.stderr
        );
        assert_eq!(self.stdout, "");
        for part in parts {
            assert!(
                self.stderr.contains(part),
                "no {part:?} in {:?}",
                self.stderr
            );
        }
        assert!(!self.stderr.contains("panicked"), "{}", self.stderr);
    }
}

/// The command, in a world without datasets.
pub(crate) fn command() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_ksim"));
    for variable in [
        "MINARI_DATASETS_PATH",
        "D4RL_DATASET_DIR",
        "HF_ENDPOINT",
        "HOME",
        "NO_COLOR",
        // Nothing here leaves this machine.
        "ALL_PROXY",
        "HTTPS_PROXY",
        "HTTP_PROXY",
        "all_proxy",
        "https_proxy",
        "http_proxy",
    ] {
        command.env_remove(variable);
    }
    command
}

/// Runs it to the end.
pub(crate) fn ksim<A: AsRef<std::ffi::OsStr>>(arguments: impl IntoIterator<Item = A>) -> Run {
    finished(&command().args(arguments).output().expect("the binary runs"))
}

/// What an ended process left.
pub(crate) fn finished(output: &Output) -> Run {
    Run {
        code: output.status.code().unwrap_or(-1),
        stdout: String::from_utf8(output.stdout.clone()).expect("stdout is text"),
        stderr: String::from_utf8(output.stderr.clone()).expect("stderr is text"),
    }
}

/// A folder with the files of `ksim demo --export`.
pub(crate) struct Demo {
    folder: tempfile::TempDir,
}

impl Demo {
    /// Exports them.
    pub(crate) fn new() -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        let run = ksim(["demo", "--export", path(folder.path())]);
        assert_eq!(run.code, 0, "{}", run.stderr);
        Self { folder }
    }

    /// Path of a file in the folder.
    pub(crate) fn at(&self, name: &str) -> String {
        path(&self.folder.path().join(name)).to_owned()
    }

    /// `ksim score` of some of the files against the demo's dataset.
    pub(crate) fn score(&self, rollouts: &[&str], flags: &[&str]) -> Run {
        let dataset = self.at("dataset.parquet");
        let rollouts: Vec<String> = rollouts.iter().map(|name| self.at(name)).collect();
        let mut arguments = vec!["score", "--dataset", &dataset];
        arguments.extend(rollouts.iter().map(String::as_str));
        arguments.extend(flags);
        ksim(arguments)
    }

    /// The files in the folder that the demo did not bring.
    pub(crate) fn others(&self) -> Vec<PathBuf> {
        let known = [
            "dataset.parquet",
            "good.parquet",
            "noisy.parquet",
            "random.parquet",
        ];
        let entries = std::fs::read_dir(self.folder.path()).expect("the folder is there");
        let names = entries.map(|entry| PathBuf::from(entry.expect("an entry").file_name()));
        names
            .filter(|name| !known.iter().any(|known| name == Path::new(known)))
            .collect()
    }
}

fn path(path: &Path) -> &str {
    path.to_str().expect("a path in UTF-8")
}

/// Rollouts to be written.
pub(crate) struct Rollouts {
    /// Number of each row's episode.
    pub(crate) episodes: Vec<i64>,
    /// Observation columns and action columns.
    pub(crate) widths: [usize; 2],
    /// Row-major.
    pub(crate) observations: Vec<f32>,
    /// Row-major.
    pub(crate) actions: Vec<f32>,
    /// Planner of each row.
    pub(crate) planners: Option<ArrayRef>,
    /// Names of the three columns.
    pub(crate) names: [&'static str; 3],
}

impl Rollouts {
    /// Rows that differ from each other, one episode for each number.
    pub(crate) fn new(episodes: &[i64], widths: [usize; 2]) -> Self {
        let values = |n: usize| (0..n).map(|i| (i as f32 * 0.7).sin()).collect::<Vec<_>>();
        Self {
            episodes: episodes.to_vec(),
            widths,
            observations: values(episodes.len() * widths[0]),
            actions: values(episodes.len() * widths[1]),
            planners: None,
            names: ["episode_index", "observation", "action"],
        }
    }

    /// Writes them as Parquet.
    pub(crate) fn write(&self, path: impl AsRef<Path>) {
        let mut columns: Vec<(&str, ArrayRef)> = vec![
            (
                self.names[0],
                Arc::new(Int64Array::from(self.episodes.clone())),
            ),
            (self.names[1], list(self.widths[0], &self.observations)),
            (self.names[2], list(self.widths[1], &self.actions)),
        ];
        if let Some(planners) = &self.planners {
            columns.push(("planner", Arc::clone(planners)));
        }
        write_parquet(path, columns);
    }
}

/// Fixed-size lists, row-major.
pub(crate) fn list(width: usize, values: &[f32]) -> ArrayRef {
    let item = Arc::new(Field::new("item", DataType::Float32, false));
    let values = Arc::new(Float32Array::from(values.to_vec()));
    let width = i32::try_from(width).expect("a small width");
    Arc::new(FixedSizeListArray::new(item, width, values, None))
}

/// Writes columns as Parquet.
pub(crate) fn write_parquet(path: impl AsRef<Path>, columns: Vec<(&str, ArrayRef)>) {
    let fields: Vec<Field> = columns
        .iter()
        .map(|(name, array)| Field::new(*name, array.data_type().clone(), array.null_count() > 0))
        .collect();
    let schema = Arc::new(Schema::new(fields));
    let arrays = columns.into_iter().map(|(_, array)| array).collect();
    let batch = RecordBatch::try_new(Arc::clone(&schema), arrays).expect("a batch");
    let file = std::fs::File::create(path).expect("a file");
    let mut writer = ArrowWriter::try_new(file, schema, None).expect("a writer");
    writer.write(&batch).expect("rows are written");
    writer.close().expect("the file is complete");
}

/// One column of a `--per-step` file, as numbers; nulls are NaN.
pub(crate) fn column(path: &str, name: &str) -> Vec<f64> {
    use arrow::array::AsArray;
    use arrow::datatypes::Float64Type;
    let batches = batches(path);
    let mut values = Vec::new();
    for batch in batches {
        let array = batch.column_by_name(name).expect("the column is there");
        let array = arrow::compute::cast(array, &DataType::Float64).expect("numbers");
        let array = array.as_primitive::<Float64Type>();
        values.extend(array.iter().map(|value| value.unwrap_or(f64::NAN)));
    }
    values
}

/// Everything in a Parquet file.
pub(crate) fn batches(path: &str) -> Vec<RecordBatch> {
    use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
    let file = std::fs::File::open(path).expect("the file is there");
    let reader = ParquetRecordBatchReaderBuilder::try_new(file).expect("it is Parquet");
    let reader = reader.build().expect("a reader");
    reader.collect::<Result<_, _>>().expect("it reads")
}
