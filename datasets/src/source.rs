//! What every reader offers.

use std::fmt;
use std::path::PathBuf;

use arrow::array::RecordBatchReader;
use arrow::datatypes::SchemaRef;
use serde_json::{Map, Value};

use crate::episode::{EpisodeRecord, derive_episodes};
use crate::error::Result;
use crate::format::Format;
use crate::spec::LeafSpec;

/// A dataset in the canonical columnar layout ([`crate::schema`]).
///
/// Contract: every batch has exactly the reader's schema, which is [`Self::schema`] cut to the columns of the
/// scan; an episode's rows are contiguous and in step order; an episode may span batches.
pub trait DatasetSource: Send + Sync {
    /// Known without reading rows: id, format, leaves, counts where the format records them.
    fn info(&self) -> &DatasetInfo;

    /// The columns of a scan of everything.
    fn schema(&self) -> SchemaRef;

    /// A fresh pass over the columns and episodes chosen by `scan`; memory is O(one batch).
    ///
    /// # Errors
    /// A column that does not exist, or what the file does not hold up to. Faults in the rows come from the
    /// reader, as `ArrowError::ExternalError` around a [`crate::DatasetError`].
    fn scan(&self, scan: &Scan) -> Result<Box<dyn RecordBatchReader + Send + '_>>;

    /// The episodes, from one pass over reward, flags and `info.success`.
    ///
    /// # Errors
    /// Those of [`Self::scan`] and of its reader.
    fn episodes(&self) -> Result<Vec<EpisodeRecord>>;
}

impl dyn DatasetSource + '_ {
    /// What [`DatasetSource::episodes`] is for a source that records nothing else about its episodes.
    pub(crate) fn derived_episodes(&self) -> Result<Vec<EpisodeRecord>> {
        derive_episodes(self)
    }
}

/// Which part of a dataset to read.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Scan {
    /// Names of the columns to read; `None` reads all. Others are not touched on disk.
    pub columns: Option<Vec<String>>,
    /// Episode numbers to read, in the dataset's order whatever their order here; `None` reads all.
    pub episodes: Option<Vec<i64>>,
    /// Rows of a batch, at most; at least 1.
    pub batch_rows: usize,
}

impl Default for Scan {
    fn default() -> Self {
        Self {
            columns: None,
            episodes: None,
            batch_rows: 16_384,
        }
    }
}

/// What is known about a dataset once it is open.
#[derive(Debug, Clone)]
pub struct DatasetInfo {
    /// Id as the dataset gives it, else the file name without its suffix.
    pub id: String,
    /// The format.
    pub format: Format,
    /// The file or dataset folder.
    pub path: PathBuf,
    /// Number of episodes, where known without reading rows.
    pub n_episodes: Option<u64>,
    /// Number of steps (final-observation rows not counted), where known without reading rows.
    pub n_steps: Option<u64>,
    /// Leaves of the observation, in schema order.
    pub observation: Vec<LeafSpec>,
    /// Leaves of the action, in schema order.
    pub action: Vec<LeafSpec>,
    /// How the rows were cut into episodes, in words.
    pub episode_rule: String,
    /// Whether episode ends were inferred and not recorded.
    pub boundaries_inferred: bool,
    /// Specification of the environment, where recorded.
    pub env_spec: Option<Value>,
    /// Everything else the source records about itself. Infinities and NaN are strings.
    pub metadata: Map<String, Value>,
    /// Reference score that counts as 0, where recorded; for a D4RL file, where its name is known
    /// ([`crate::registry`]).
    pub ref_min_score: Option<f64>,
    /// Reference score that counts as 1, as above.
    pub ref_max_score: Option<f64>,
    /// What was odd about the dataset while opening it.
    pub warnings: Vec<Warning>,
}

impl DatasetInfo {
    /// Width of the state: values of all numeric observation leaves.
    pub fn observation_width(&self) -> usize {
        self.observation
            .iter()
            .filter(|leaf| leaf.is_numeric())
            .map(LeafSpec::width)
            .sum()
    }

    /// Values of all numeric action leaves.
    pub fn action_width(&self) -> usize {
        self.action
            .iter()
            .filter(|leaf| leaf.is_numeric())
            .map(LeafSpec::width)
            .sum()
    }

    pub(crate) fn new(id: String, format: Format, path: PathBuf) -> Self {
        Self {
            id,
            format,
            path,
            n_episodes: None,
            n_steps: None,
            observation: Vec::new(),
            action: Vec::new(),
            episode_rule: String::new(),
            boundaries_inferred: false,
            env_spec: None,
            metadata: Map::new(),
            ref_min_score: None,
            ref_max_score: None,
            warnings: Vec::new(),
        }
    }
}

/// Something odd that did not stop the reading.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum Warning {
    /// A Parquet file without an episode column is taken as one episode.
    NoEpisodeColumn,
    /// The episode policy was chosen by the file name.
    PolicyByName {
        /// The policy.
        policy: &'static str,
        /// Why.
        reason: &'static str,
    },
    /// Episode ends are not recorded.
    NoEpisodeEnds {
        /// What is done instead.
        instead: &'static str,
    },
    /// The D4RL file's recorded time-outs are known to be wrong.
    UnreliableTimeouts,
    /// A Minari version between those this crate was checked with.
    UncheckedVersion {
        /// The recorded version.
        found: String,
    },
    /// A version that is newer than those this crate was checked with.
    NewerVersion {
        /// The recorded version.
        found: String,
    },
    /// Metadata that this crate does not know and passes over.
    UnknownKeys {
        /// The file, inside the dataset folder.
        file: &'static str,
        /// Its unknown keys.
        keys: String,
    },
    /// A column has another type than its metadata say; it is read as it is.
    DtypeMismatch {
        /// The column or feature.
        column: String,
        /// The type in the metadata.
        declared: String,
        /// The type in the data.
        actual: String,
    },
    /// A count of the metadata differs from the data, which is believed.
    CountMismatch {
        /// What is counted.
        what: &'static str,
        /// Count in the metadata.
        recorded: u64,
        /// Count in the data.
        actual: u64,
    },
    /// Episodes without a step are left out.
    EmptyEpisodes {
        /// How many.
        n_episodes: u64,
    },
    /// Episodes without a final observation in a format that has them.
    NoFinalObservation {
        /// How many.
        n_episodes: u64,
    },
    /// The space in the metadata does not fit the data, which is believed.
    SpaceMismatch {
        /// The leaf.
        column: String,
    },
    /// A column that cannot be represented is left out.
    ColumnLeftOut {
        /// The column or key.
        column: String,
        /// Why.
        reason: &'static str,
    },
    /// The dataset has no description of its spaces: kinds are inferred from shapes.
    NoSpace,
    /// Recorded next observations are not the observations of the next rows: both are kept.
    NextObservationDiffers {
        /// The column of the recorded ones.
        column: String,
        /// In how many episodes.
        n_episodes: u64,
    },
    /// Messages without a time stamp of their own are left out.
    NoTimeStamp {
        /// Their topic.
        topic: String,
        /// How many.
        n_messages: u64,
    },
    /// Steps are left out because a column has no sample for them.
    StepsLeftOut {
        /// How many.
        n_steps: u64,
        /// Whether the episode was cut there.
        split: bool,
    },
    /// Part of a damaged file could not be recovered.
    Lost {
        /// What is lost, and where.
        what: String,
    },
}

impl fmt::Display for Warning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NoEpisodeColumn => {
                f.write_str("no episode column: the file is taken as one episode")
            }
            Self::PolicyByName { policy, reason } => {
                write!(
                    f,
                    "episode policy `{policy}` was chosen by the file name: {reason}"
                )
            }
            Self::NoEpisodeEnds { instead } => {
                write!(f, "episode ends are not recorded: {instead}")
            }
            Self::UnreliableTimeouts => f.write_str(
                "the time-outs of this antmaze version are known not to match the real resets",
            ),
            Self::UncheckedVersion { found } => {
                write!(
                    f,
                    "written by Minari {found}, which this reader was not checked with"
                )
            }
            Self::NewerVersion { found } => {
                write!(f, "version {found} is newer than this reader")
            }
            Self::UnknownKeys { file, keys } => write!(f, "{file} has unknown keys: {keys}"),
            Self::DtypeMismatch {
                column,
                declared,
                actual,
            } => {
                write!(
                    f,
                    "\"{column}\" is declared as {declared} but holds {actual}; the data is believed"
                )
            }
            Self::CountMismatch {
                what,
                recorded,
                actual,
            } => {
                write!(f, "metadata says {recorded} {what}, the data has {actual}")
            }
            Self::EmptyEpisodes { n_episodes } => {
                write!(f, "{n_episodes} episodes without a step are left out")
            }
            Self::NoFinalObservation { n_episodes } => {
                write!(
                    f,
                    "{n_episodes} episodes lack the observation after their last step"
                )
            }
            Self::SpaceMismatch { column } => {
                write!(
                    f,
                    "\"{column}\" does not have the shape its space declares; the data is believed"
                )
            }
            Self::ColumnLeftOut { column, reason } => {
                write!(f, "\"{column}\" is left out: {reason}")
            }
            Self::NextObservationDiffers { column, n_episodes } => {
                write!(
                    f,
                    "in {n_episodes} episodes \"{column}\" is not the observation of the next row; it is kept"
                )
            }
            Self::NoTimeStamp { topic, n_messages } => {
                write!(
                    f,
                    "{n_messages} messages of \"{topic}\" without a time stamp are left out"
                )
            }
            Self::StepsLeftOut { n_steps, split } => {
                let then = if *split {
                    ", where episodes are cut"
                } else {
                    ""
                };
                write!(
                    f,
                    "{n_steps} steps without a sample of every column are left out{then}"
                )
            }
            Self::Lost { what } => write!(f, "lost: {what}"),
            Self::NoSpace => f.write_str("no space is recorded: kinds are inferred from shapes"),
        }
    }
}
