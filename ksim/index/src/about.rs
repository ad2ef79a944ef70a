//! What an index was made from: its section `about`, as JSON.

use serde::{Deserialize, Serialize};

/// What an index was made from.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct About {
    /// Version of the ksim that built it.
    pub ksim: String,
    /// The dataset.
    pub dataset: AboutDataset,
    /// Places of the state columns in the dataset's observation.
    pub state_columns: Vec<usize>,
    /// A name for each.
    pub state_column_names: Vec<String>,
    /// Width of an action.
    pub action_dim: usize,
    /// The clusters, if it has any.
    pub clusters: Option<AboutClusters>,
}

/// The dataset behind an index.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct AboutDataset {
    /// Its name, as given or resolved.
    pub name: String,
    /// Where it was.
    pub path: String,
    /// Its format.
    pub format: String,
    /// Episodes.
    pub n_episodes: usize,
    /// Steps.
    pub n_steps: usize,
    /// [`ksim::Trajectories::fingerprint`] of the columns in use.
    pub fingerprint: String,
    /// A hash over how its files looked from outside (names, lengths, times) and how they were read. Where it is
    /// the same, the content need not be compared.
    pub stamp: String,
}

/// The clusters in an index.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AboutClusters {
    /// The k-means that fitted them; `None` for given centers.
    pub backend: Option<String>,
    /// Seed of the fit.
    pub seed: u64,
    /// How many.
    pub n_clusters: usize,
    /// Iterations of the fit on all rows, where they are known.
    pub n_iterations: Option<usize>,
    /// Whether the fit came to rest, where that is known.
    pub converged: Option<bool>,
}
