//! What can go wrong while finding, opening or reading a dataset.

use std::ops::Range;
use std::path::{Path, PathBuf};

use arrow::error::ArrowError;
use parquet::errors::ParquetError;

/// Result of this crate's operations.
pub type Result<T, E = DatasetError> = std::result::Result<T, E>;

/// What a C library said, as text: its error objects hold handles that should not outlive the call.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct LibraryMessage(pub(crate) String);

/// Why a dataset could not be found, opened or read.
///
/// A variant holds the place inside the file; [`DatasetError::InFile`] adds the path, once. The messages do
/// not repeat their `source`: print the whole chain (anyhow's `{:#}` does).
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum DatasetError {
    /// The file in which the `source` happened.
    #[error("{}", path.display())]
    InFile {
        /// The file or dataset folder.
        path: PathBuf,
        /// What went wrong in it.
        source: Box<DatasetError>,
    },
    /// The operating system refused.
    #[error("cannot {operation}")]
    Io {
        /// What was tried, such as `open`.
        operation: &'static str,
        /// The system's error.
        source: std::io::Error,
    },
    /// The bytes are not what the format promises: cut off, damaged, or another kind of file.
    #[error("corrupt file: {what}")]
    Corrupt {
        /// What is wrong, and at which offset where that is known.
        what: String,
    },
    /// A path that holds no dataset.
    #[error("not a dataset: expected {expected}, found {found}")]
    NotADataset {
        /// What would have been accepted.
        expected: &'static str,
        /// What is there.
        found: String,
    },
    /// The dataset is fine but this build cannot read it.
    #[error("reading {what} needs feature `{feature}`, which this build lacks")]
    MissingFeature {
        /// What was to be read.
        what: &'static str,
        /// The Cargo feature to turn on.
        feature: &'static str,
    },
    /// A known format that is not read yet.
    #[error("not supported yet: {what}")]
    Unsupported {
        /// The part that is not supported.
        what: String,
    },
    /// A Minari version this crate does not know.
    #[error("written by Minari {found}, expected 0.4.x or 0.5.x (open with `force` to try anyway)")]
    UnknownVersion {
        /// The recorded version.
        found: String,
    },
    /// A key that must be there is not.
    #[error("no key \"{key}\"; found {found}")]
    MissingKey {
        /// The missing key.
        key: String,
        /// The keys that are there.
        found: String,
    },
    /// A column that was asked for is not there.
    #[error("no {role} column {name}; columns are {found}")]
    MissingColumn {
        /// What the column is for.
        role: &'static str,
        /// The name asked for, or the names tried.
        name: String,
        /// The columns that are there.
        found: String,
    },
    /// Two arrays of one dataset differ in length.
    #[error("\"{key}\" has {actual} rows, expected {expected}")]
    LengthMismatch {
        /// The key of the array.
        key: String,
        /// Its number of rows.
        actual: u64,
        /// The number of rows it should have.
        expected: u64,
    },
    /// The rows of an array have another shape than expected.
    #[error("\"{key}\" has rows of shape {actual:?}, expected {expected}")]
    ShapeMismatch {
        /// The key of the array.
        key: String,
        /// Shape of one row.
        actual: Vec<usize>,
        /// What was expected.
        expected: String,
    },
    /// A type that cannot stand in that place.
    #[error("\"{key}\" has type {actual}, expected {expected}")]
    WrongType {
        /// The key or column.
        key: String,
        /// Its type.
        actual: String,
        /// What was expected.
        expected: &'static str,
    },
    /// A list column whose rows have different lengths.
    #[error("row {row} of column \"{column}\" has {actual} values, expected {expected}")]
    RaggedList {
        /// The column.
        column: String,
        /// Row in the file, from 0.
        row: u64,
        /// Values in that row.
        actual: usize,
        /// Values in the rows before.
        expected: usize,
    },
    /// A null where a value must be.
    #[error("row {row} of column \"{column}\" is null or holds a null")]
    NullValue {
        /// The column.
        column: String,
        /// Row in the file, from 0.
        row: u64,
    },
    /// A flag that is NaN is neither true nor false.
    #[error("row {row} of \"{column}\" is NaN, expected a flag")]
    NanFlag {
        /// The column.
        column: String,
        /// Row in the file, from 0.
        row: u64,
    },
    /// An integer that no `f64` can hold.
    #[error("row {row} of \"{column}\" holds an integer that f64 cannot represent")]
    InexactInteger {
        /// The column.
        column: String,
        /// Row of the scan, from 0.
        row: u64,
    },
    /// An episode's rows are not next to each other.
    #[error("row {row}: episode {episode} in column \"{column}\" comes back after other episodes")]
    NonContiguousEpisode {
        /// The episode column.
        column: String,
        /// Row in the file, from 0.
        row: u64,
        /// The episode that comes back.
        episode: i64,
    },
    /// The steps of an episode are not in order.
    #[error(
        "row {row}: step {actual} in column \"{column}\" follows step {previous} of the same episode"
    )]
    StepOrder {
        /// The step column.
        column: String,
        /// Row in the file, from 0.
        row: u64,
        /// The step before.
        previous: i64,
        /// The step found.
        actual: i64,
    },
    /// Something is already where a dataset should be written.
    #[error("there is something already; choose another name or remove it")]
    AlreadyExists,
    /// The caller broke the work off.
    #[error("interrupted; nothing was written")]
    Interrupted,
    /// Episodes that are not there.
    #[error("no episode in {}..{}; there are {found}", wanted.start, wanted.end)]
    NoSuchEpisode {
        /// The range asked for.
        wanted: Range<i64>,
        /// What there is.
        found: String,
    },
    /// A number that another type cannot hold.
    #[error("row {row} (episode {episode}) of \"{column}\" is {value}, which no {to} can hold")]
    DoesNotFit {
        /// The column.
        column: String,
        /// Its episode.
        episode: i64,
        /// Row of the scan, from 0.
        row: u64,
        /// The value.
        value: f64,
        /// The type.
        to: String,
    },
    /// A file without rows, where the format needs one to know the widths.
    #[error("no rows")]
    Empty,
    /// An array declares more data than its file can hold.
    #[error(
        "\"{key}\" declares {declared} bytes in a file of {file_size}: over {max_ratio} times its size"
    )]
    DeclaredSize {
        /// The key of the array.
        key: String,
        /// Bytes the array would take in memory.
        declared: u128,
        /// Bytes of the file.
        file_size: u64,
        /// The largest ratio that is believed.
        max_ratio: u64,
    },
    /// An HDF5 array is packed with a filter this build does not have.
    #[error("\"{key}\" is packed with HDF5 filter {filter}{}", filter_name(*filter))]
    UnknownFilter {
        /// The key of the array.
        key: String,
        /// Registered number of the filter.
        filter: i32,
    },
    /// The HDF5 library reported an error.
    #[error("HDF5 cannot {operation} \"{key}\"")]
    Hdf5 {
        /// What was tried.
        operation: &'static str,
        /// The object in the file.
        key: String,
        /// The library's message.
        source: LibraryMessage,
    },
    /// Text that is not JSON.
    #[error("{what} is not valid JSON")]
    Json {
        /// The file or field.
        what: String,
        /// The parser's message with line and column.
        source: serde_json::Error,
    },
    /// A field of a metadata file has the wrong type or a value out of range.
    #[error("metadata field \"{field}\" is {actual}, expected {expected}")]
    Metadata {
        /// The field.
        field: String,
        /// What it is.
        actual: String,
        /// What it should be.
        expected: &'static str,
    },
    /// A message of a recording that does not fit its type, or cannot be represented.
    #[error("message of \"{topic}\" at log time {log_time} ns: {what}")]
    Message {
        /// The topic.
        topic: String,
        /// When it was recorded, in ns.
        log_time: u64,
        /// What is wrong with it.
        what: String,
    },
    /// A topic of a recording that cannot be what the mapping says.
    #[error("topic \"{topic}\"")]
    Topic {
        /// The topic.
        topic: String,
        /// Why not.
        source: Box<DatasetError>,
    },
    /// A step of a recording for which a column has no sample.
    #[error("\"{column}\" has no sample for the step at {time_ns} ns")]
    NoSample {
        /// The column.
        column: String,
        /// Time of the step by the mapping's clock, in ns.
        time_ns: i64,
    },
    /// A recording without a mapping: nothing says which fields are observation and action.
    #[error(
        "a recording needs a mapping of its fields to observation and action: \
         `ksim dataset inspect FILE.mcap --propose mapping.toml` writes one to start from, \
         `--mapping mapping.toml` uses it"
    )]
    NoMapping,
    /// A mapping file that makes no sense.
    #[error("line {line}: {message}")]
    Mapping {
        /// Line in the file, from 1.
        line: usize,
        /// What is wrong.
        message: String,
    },
    /// A dataset id that is not allowed.
    #[error("dataset id \"{}\" is refused: {reason}", id.escape_debug())]
    BadId {
        /// The id as given.
        id: String,
        /// Why it is refused.
        reason: &'static str,
    },
    /// A name that is nowhere on disk.
    #[error(
        "dataset \"{name}\" is not on this machine\nlooked for:{}\n{help}",
        bullet_list(looked_at)
    )]
    NotFound {
        /// The name as given.
        name: String,
        /// Every path that was tried.
        looked_at: Vec<PathBuf>,
        /// How to get it.
        help: String,
    },
    /// A selection of state columns that fits nothing.
    #[error("state column \"{item}\": {reason}; columns are {available}")]
    BadSelection {
        /// The part of the selection that does not fit.
        item: String,
        /// Why.
        reason: &'static str,
        /// What there is.
        available: String,
    },
    /// An episode policy that needs something the file does not have.
    #[error("episode policy `{policy}` needs {needs}")]
    PolicyNeeds {
        /// The policy.
        policy: &'static str,
        /// What is missing.
        needs: &'static str,
    },
    /// An unknown name of an episode policy.
    #[error("unknown episode policy \"{name}\", expected one of {expected}")]
    UnknownPolicy {
        /// The name given.
        name: String,
        /// All names.
        expected: String,
    },
    /// A dataset could not be fetched.
    #[cfg(feature = "download")]
    #[error("cannot download {what}")]
    Download {
        /// The address, or the name if it leads to none.
        what: String,
        /// Why not.
        source: crate::download::DownloadError,
    },
    /// Arrow could not build or convert an array.
    #[error("cannot {operation}")]
    Arrow {
        /// What was tried.
        operation: &'static str,
        /// Arrow's error.
        source: ArrowError,
    },
    /// The Parquet library reported an error.
    #[error("cannot {operation}")]
    Parquet {
        /// What was tried.
        operation: &'static str,
        /// Parquet's error.
        source: ParquetError,
    },
}

impl DatasetError {
    /// Adds the path of the file, unless one is there already.
    #[must_use]
    pub fn in_file(self, path: &Path) -> Self {
        match self {
            Self::InFile { .. } | Self::NotFound { .. } => self,
            other => Self::InFile {
                path: path.to_owned(),
                source: Box::new(other),
            },
        }
    }

    /// The error without the path: the variant that says what went wrong.
    pub fn cause(&self) -> &Self {
        match self {
            Self::InFile { source, .. } => source.cause(),
            other => other,
        }
    }

    pub(crate) fn corrupt(what: impl Into<String>) -> Self {
        Self::Corrupt { what: what.into() }
    }

    pub(crate) fn io(operation: &'static str, source: std::io::Error) -> Self {
        Self::Io { operation, source }
    }

    pub(crate) fn arrow(operation: &'static str) -> impl Fn(ArrowError) -> Self {
        move |source| match source {
            // A scan hands its errors through Arrow's reader trait: take the typed one out again.
            ArrowError::ExternalError(inner) => match inner.downcast::<Self>() {
                Ok(own) => *own,
                Err(inner) => Self::Arrow {
                    operation,
                    source: ArrowError::ExternalError(inner),
                },
            },
            source => Self::Arrow { operation, source },
        }
    }

    pub(crate) fn parquet(operation: &'static str) -> impl Fn(ParquetError) -> Self {
        move |source| Self::Parquet { operation, source }
    }
}

/// For `RecordBatchReader`, whose error type is Arrow's; [`DatasetError::from`] takes it out again.
impl From<DatasetError> for ArrowError {
    fn from(error: DatasetError) -> Self {
        Self::ExternalError(Box::new(error))
    }
}

impl From<ArrowError> for DatasetError {
    fn from(error: ArrowError) -> Self {
        Self::arrow("read a record batch")(error)
    }
}

/// Names of the filters met in the wild that are no part of this build.
fn filter_name(filter: i32) -> &'static str {
    match filter {
        4 => " (szip), which this build does not have",
        32001 => " (blosc), which this build does not have",
        32004 => " (lz4), which this build does not have",
        32008 => " (bitshuffle), which this build does not have",
        32015 => " (zstd), which this build does not have",
        _ => ", which this build does not have",
    }
}

fn bullet_list(paths: &[PathBuf]) -> String {
    if paths.is_empty() {
        return " nowhere (no folder for datasets is known)".to_owned();
    }
    paths
        .iter()
        .map(|path| format!("\n  {}", path.display()))
        .collect()
}

#[cfg(test)]
mod tests {
    use std::error::Error;

    use super::*;

    #[test]
    fn the_path_is_added_once() {
        let error = DatasetError::Empty
            .in_file(Path::new("a"))
            .in_file(Path::new("b"));
        assert_eq!(error.to_string(), "a");
        assert_eq!(
            error.source().map(ToString::to_string),
            Some("no rows".to_owned())
        );
        assert!(matches!(error.cause(), DatasetError::Empty));
    }

    #[test]
    fn a_typed_error_survives_the_arrow_reader_trait() {
        let arrow: ArrowError = DatasetError::Empty.into();
        assert!(matches!(DatasetError::from(arrow), DatasetError::Empty));
    }
}
