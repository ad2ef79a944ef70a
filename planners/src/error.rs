//! What can go wrong.

use std::path::{Path, PathBuf};

use crate::baselines::BaselineError;
use crate::process::ProcessError;

/// A planner or one of its networks cannot do what was asked.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PlannerError {
    /// A slice has another length than its shape says.
    #[error("{what} has {found} numbers, expected {expected}")]
    Length {
        /// Which array.
        what: &'static str,
        /// Numbers that its shape asks for.
        expected: usize,
        /// Numbers that it has.
        found: usize,
    },
    /// A tensor is missing from a set of weights.
    #[error("tensor \"{name}\" is missing")]
    MissingTensor {
        /// Its name.
        name: String,
    },
    /// A tensor has another shape than the network asks for.
    #[error("tensor \"{name}\" has the shape {found:?}, expected {expected:?}")]
    TensorShape {
        /// Its name.
        name: String,
        /// Shape of the network.
        expected: Vec<usize>,
        /// Shape that was found.
        found: Vec<usize>,
    },
    /// A tensor that the network does not have.
    #[error("tensor \"{name}\" is not known to the network")]
    UnknownTensor {
        /// Its name.
        name: String,
    },
    /// A weight that is infinite or not a number.
    #[error("number {index} of tensor \"{name}\" is {found}, expected a finite number")]
    WeightNotFinite {
        /// The tensor's name.
        name: String,
        /// Which number, counted from 0.
        index: usize,
        /// What it is.
        found: f32,
    },
    /// A gradient or an update was asked for out of order.
    #[error("{asked} was asked for, but there was no {missing} before")]
    Order {
        /// What was asked for.
        asked: &'static str,
        /// What has to come first.
        missing: &'static str,
    },
    /// A network that cannot be built.
    #[error("{what} is {found}, expected {expected}")]
    Architecture {
        /// Which setting.
        what: &'static str,
        /// What is possible.
        expected: &'static str,
        /// What was asked for.
        found: String,
    },
    /// A second family of the same id.
    #[error("there is a planner \"{id}\" already")]
    DuplicateFamily {
        /// The id.
        id: &'static str,
    },
    /// A family that this build does not have.
    #[error("there is no planner \"{id}\"; this build has {}", known.join(", "))]
    UnknownFamily {
        /// The id that was asked for.
        id: String,
        /// The ids there are.
        known: Vec<String>,
    },
    /// A preset that the family does not have.
    #[error("{family} has no preset \"{name}\"; there are {}", known.join(", "))]
    UnknownPreset {
        /// Id of the family.
        family: &'static str,
        /// The name that was asked for.
        name: String,
        /// The names there are.
        known: Vec<&'static str>,
    },
    /// A setting that the configuration does not have.
    #[error("there is no setting \"{name}\"; here are {}", known.join(", "))]
    UnknownSetting {
        /// Its name, with the tables it stands in.
        name: String,
        /// The settings of the innermost table.
        known: Vec<String>,
    },
    /// A setting whose value is impossible.
    #[error("setting \"{name}\" is {found}, expected {expected}")]
    Setting {
        /// Its name, with the tables it stands in.
        name: String,
        /// What is possible.
        expected: String,
        /// What was found.
        found: String,
    },
    /// A backend or device that this build does not have.
    #[error("there is no {what} \"{name}\"; this build has {}", known.join(", "))]
    UnknownBackend {
        /// `backend` or `device`.
        what: &'static str,
        /// The name that was asked for.
        name: String,
        /// The names there are.
        known: Vec<&'static str>,
    },
    /// A checkpoint of the reference implementation could not be read.
    #[error(transparent)]
    Import(#[from] crate::import::ImportError),
    /// A backend cannot compute.
    #[error("{backend} backend: {problem}")]
    Backend {
        /// Its name.
        backend: &'static str,
        /// What it says.
        problem: String,
    },
    /// A dataset could not be read.
    #[error(transparent)]
    Dataset(#[from] ksim_datasets::DatasetError),
    /// A dataset that does not fit what is to be trained on it.
    #[error("the dataset does not fit: {what} is {found}, expected {expected}")]
    DatasetFit {
        /// Which property.
        what: &'static str,
        /// What is asked for.
        expected: String,
        /// What the dataset has.
        found: String,
    },
    /// A file could not be read or written.
    #[error("{}: cannot {action}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// What was tried.
        action: &'static str,
        /// Why it failed.
        source: std::io::Error,
    },
    /// A file that is no safetensors file, or a damaged one.
    #[error("{}: damaged or no safetensors file", path.display())]
    Safetensors {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        source: safetensors::SafeTensorError,
    },
    /// A file of a run whose text is not what it ought to be.
    #[error("{}: its JSON is not what is expected", path.display())]
    Json {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        source: serde_json::Error,
    },
    /// Something in a file that does not fit.
    #[error("{}{}", path.display(), of_network(network.as_deref()))]
    InFile {
        /// The file.
        path: PathBuf,
        /// The network, if it is about one.
        network: Option<String>,
        /// What does not fit.
        source: Box<PlannerError>,
    },
    /// A file of another run, family, preset or version.
    #[error("{}: {what} is {found}, expected {expected}", path.display())]
    Mismatch {
        /// The file.
        path: PathBuf,
        /// Which property.
        what: String,
        /// What is asked for.
        expected: String,
        /// What the file has.
        found: String,
    },
    /// A loss or a plan that is no finite number any more.
    #[error("{what} is not finite {place}{}", kept(checkpoint.as_deref()))]
    NotFinite {
        /// Which number.
        what: String,
        /// Where it happened, such as `in update 1200`.
        place: String,
        /// The last good checkpoint, if there is one.
        checkpoint: Option<PathBuf>,
    },
    /// A request that does not fit the planner.
    #[error("{what} is {found}, expected {expected}")]
    Request {
        /// Which part of the request.
        what: &'static str,
        /// What is possible.
        expected: String,
        /// What was asked for.
        found: String,
    },
    /// A plan that is none.
    #[error("a plan has {what} of {found}, expected {expected}")]
    Plan {
        /// Which field of [`crate::Candidates`].
        what: &'static str,
        /// What is possible.
        expected: String,
        /// What it holds.
        found: String,
    },
    /// A planner without a network.
    #[error(transparent)]
    Baseline(#[from] BaselineError),
    /// A planner in a process of its own.
    #[error(transparent)]
    Process(Box<ProcessError>),
}

impl From<ProcessError> for PlannerError {
    fn from(error: ProcessError) -> Self {
        Self::Process(Box::new(error))
    }
}

impl PlannerError {
    /// The same with the file that it is about, and the network.
    pub(crate) fn in_file(self, path: &Path, network: Option<&str>) -> Self {
        Self::InFile {
            path: path.to_owned(),
            network: network.map(str::to_owned),
            source: Box::new(self),
        }
    }

    /// A folder in which something is that stays.
    pub(crate) fn occupied(run: &Path, expected: &str, found: String) -> Self {
        Self::Mismatch {
            path: run.to_owned(),
            what: "the run folder".to_owned(),
            expected: expected.to_owned(),
            found,
        }
    }
}

/// Which network of a file.
fn of_network(network: Option<&str>) -> String {
    network.map_or(String::new(), |network| format!(": network \"{network}\""))
}

/// The end of a message about numbers that are not finite.
fn kept(checkpoint: Option<&Path>) -> String {
    match checkpoint {
        Some(path) => format!("; the checkpoint before it is kept in {}", path.display()),
        None => String::new(),
    }
}
