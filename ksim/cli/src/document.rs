//! The result of `ksim score` as a document: `ksim.score/1`, described in `docs/score-json.md`.
//!
//! The order of the fields here is the order in the JSON.

use std::path::Path;

use ksim::{ApproximationError, KSim, Report};
use ksim_datasets::DatasetInfo;
use serde::Serialize;

use crate::centers::Centers;
use crate::load::Columns;
use crate::settings::Settings;

/// Name and version of the schema. A change that could break a reader changes the number.
pub(crate) const SCHEMA: &str = "ksim.score/1";

/// Everything `ksim score` found out.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct Document {
    pub(crate) schema: &'static str,
    pub(crate) version: &'static str,
    pub(crate) results: Vec<RolloutResult>,
    pub(crate) dataset: DatasetPart,
    pub(crate) parameters: Parameters,
    pub(crate) search: SearchPart,
    pub(crate) fingerprint: String,
    pub(crate) threads: usize,
    pub(crate) elapsed_s: f64,
}

/// One rollout file, or one planner of it.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct RolloutResult {
    pub(crate) file: String,
    pub(crate) planner: Option<String>,
    pub(crate) n_episodes: usize,
    pub(crate) n_steps: usize,
    pub(crate) k_sim: f64,
    pub(crate) k_sim_episode_mean: f64,
    pub(crate) interval_95: Option<[f64; 2]>,
    pub(crate) k_sim_state: f64,
    pub(crate) k_sim_state_episode_mean: f64,
    pub(crate) k_sim_action: f64,
    pub(crate) k_sim_action_episode_mean: f64,
    pub(crate) saturated_share: f64,
    pub(crate) mean_scaled_distance: f64,
    pub(crate) scaled_distance_quantiles: Quantiles,
    pub(crate) approximation_error: Option<ApproximationPart>,
    pub(crate) episodes: Vec<EpisodePart>,
    pub(crate) warnings: Vec<String>,
    pub(crate) elapsed_s: f64,
}

/// Quantiles of distance / √d.
#[derive(Debug, Clone, Copy, Serialize)]
pub(crate) struct Quantiles {
    q05: f64,
    q25: f64,
    q50: f64,
    q75: f64,
    q95: f64,
}

/// One episode of the rollouts.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct EpisodePart {
    episode_index: i64,
    n_steps: usize,
    k_sim: f64,
    k_sim_state: f64,
    k_sim_action: f64,
    saturated_share: f64,
    mean_scaled_distance: f64,
}

/// What the approximate search costs.
#[derive(Debug, Clone, Copy, Serialize)]
pub(crate) struct ApproximationPart {
    recall_at_k: f64,
    match_differs_share: f64,
    mean_score_difference: f64,
    max_score_difference: f64,
}

/// The reference.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct DatasetPart {
    pub(crate) name: String,
    pub(crate) path: String,
    pub(crate) format: &'static str,
    pub(crate) n_episodes: usize,
    pub(crate) n_steps: usize,
    pub(crate) fingerprint: String,
    pub(crate) episode_rule: String,
    pub(crate) warnings: Vec<String>,
}

/// What the scores were computed with.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct Parameters {
    pub(crate) definition: &'static str,
    pub(crate) headline: &'static str,
    pub(crate) gamma: f64,
    pub(crate) n_neighbors: usize,
    pub(crate) n_clusters: Option<usize>,
    pub(crate) state_columns: Vec<usize>,
    pub(crate) state_column_names: Vec<String>,
    pub(crate) state_dim: usize,
    pub(crate) action_dim: usize,
    pub(crate) seed: u64,
    pub(crate) n_resamples: usize,
    pub(crate) exclude_same_episode: bool,
    /// Whether the state columns are the definition's own; for the words of the table.
    #[serde(skip)]
    pub(crate) own_columns: bool,
}

/// The search that found the nearest states.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct SearchPart {
    pub(crate) requested: &'static str,
    pub(crate) engine: &'static str,
    pub(crate) exact: bool,
    /// The saved index that took the place of reading the dataset.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub(crate) index: Option<String>,
    pub(crate) clusters: Option<ClustersPart>,
}

/// The clusters of a search that has them.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct ClustersPart {
    pub(crate) backend: Option<&'static str>,
    pub(crate) centers_file: Option<String>,
    pub(crate) centers_tensor: Option<String>,
    pub(crate) n_clusters: usize,
    pub(crate) inertia: f64,
    pub(crate) n_iterations: Option<usize>,
    pub(crate) converged: Option<bool>,
}

impl RolloutResult {
    /// The aggregates of one report.
    pub(crate) fn new(file: &str, planner: Option<String>, report: &Report) -> Self {
        let [q05, q25, q50, q75, q95] = report.scaled_distance_quantiles;
        let episodes = report.episodes.iter().map(|episode| EpisodePart {
            episode_index: episode.episode_index,
            n_steps: episode.n_steps,
            k_sim: episode.k_sim,
            k_sim_state: episode.k_sim_state,
            k_sim_action: episode.k_sim_action,
            saturated_share: episode.saturated_share,
            mean_scaled_distance: episode.mean_scaled_distance,
        });
        Self {
            file: file.to_owned(),
            planner,
            n_episodes: report.episodes.len(),
            n_steps: report.steps.len(),
            k_sim: report.state_action.pooled,
            k_sim_episode_mean: report.state_action.episode_mean,
            interval_95: report.state_action.interval_95,
            k_sim_state: report.state.pooled,
            k_sim_state_episode_mean: report.state.episode_mean,
            k_sim_action: report.action.pooled,
            k_sim_action_episode_mean: report.action.episode_mean,
            saturated_share: report.saturated_share,
            mean_scaled_distance: report.mean_scaled_distance,
            scaled_distance_quantiles: Quantiles {
                q05,
                q25,
                q50,
                q75,
                q95,
            },
            approximation_error: None,
            episodes: episodes.collect(),
            warnings: Vec::new(),
            elapsed_s: 0.0,
        }
    }

    /// Name of its row: the file, and the planner where the file names planners.
    pub(crate) fn label(&self) -> String {
        Self::label_of(&self.file, self.planner.as_deref())
    }

    /// The same for a file named in another way.
    pub(crate) fn label_of(file: &str, planner: Option<&str>) -> String {
        match planner {
            Some(planner) => format!("{file} · {planner}"),
            None => file.to_owned(),
        }
    }
}

impl From<ApproximationError> for ApproximationPart {
    fn from(error: ApproximationError) -> Self {
        Self {
            recall_at_k: error.recall,
            match_differs_share: error.match_differs_share,
            mean_score_difference: error.mean_score_difference,
            max_score_difference: error.max_score_difference,
        }
    }
}

impl ApproximationPart {
    /// In words.
    pub(crate) fn describe(&self) -> String {
        format!(
            "recall {:.3}, {:.1} % of the matches differ, score difference {:+.4} in the mean and \
             {:.4} at most",
            self.recall_at_k,
            100.0 * self.match_differs_share,
            self.mean_score_difference,
            self.max_score_difference
        )
    }
}

impl DatasetPart {
    /// What is known before reading; `name` is the resolved name.
    pub(crate) fn new(name: &str, info: &DatasetInfo) -> Self {
        Self {
            name: name.to_owned(),
            path: info.path.display().to_string(),
            format: info.format.name(),
            n_episodes: 0,
            n_steps: 0,
            fingerprint: String::new(),
            episode_rule: info.episode_rule.clone(),
            warnings: info.warnings.iter().map(ToString::to_string).collect(),
        }
    }

    /// The name for others to read: of a dataset that was given by its path only the last part.
    pub(crate) fn public_name(&self) -> String {
        let is_path = self.name == self.path || self.name.starts_with(['/', '.', '~']);
        let last = Path::new(&self.name).file_name().filter(|_| is_path);
        last.map_or_else(
            || self.name.clone(),
            |last| last.to_string_lossy().into_owned(),
        )
    }
}

impl Parameters {
    /// The parameters of a score.
    pub(crate) fn new(settings: &Settings, columns: &Columns, action_dim: usize) -> Self {
        Self {
            definition: settings.definition.name(),
            headline: settings.definition.headline(),
            gamma: settings.gamma,
            n_neighbors: settings.n_neighbors,
            n_clusters: None,
            state_columns: columns.indices.clone(),
            state_column_names: columns.names.clone(),
            state_dim: columns.indices.len(),
            action_dim,
            seed: settings.seed,
            n_resamples: settings.n_resamples,
            exclude_same_episode: settings.exclude_same_episode,
            own_columns: settings.has_own_columns(),
        }
    }
}

impl SearchPart {
    /// The search of a fitted engine.
    pub(crate) fn new(settings: &Settings, centers: Option<&Centers>, ksim: &KSim) -> Self {
        let index = ksim.index();
        let clusters = index.kmeans().map(|kmeans| {
            let fitted = centers.is_none();
            let file = settings
                .centers
                .as_ref()
                .map(|file| file.path.display().to_string());
            ClustersPart {
                backend: fitted.then(|| settings.backend_name()),
                centers_file: file,
                centers_tensor: centers.map(|centers| centers.tensor.clone()),
                n_clusters: kmeans.n_clusters(),
                inertia: kmeans.inertia(),
                n_iterations: kmeans.n_iterations(),
                converged: kmeans.converged(),
            }
        });
        Self {
            requested: settings.search.name(),
            engine: index.engine(),
            exact: index.is_exact(),
            index: None,
            clusters,
        }
    }
}

/// A hash over everything the scores depend on beside the rollouts: the dataset as read, columns,
/// parameters, whether the search was exact, or else by which clusters, and the version. Exact engines
/// agree to the last bit, so which of them ran does not matter, nor do threads and preset names.
pub(crate) fn fingerprint(
    dataset: &DatasetPart,
    parameters: &Parameters,
    search: &SearchPart,
    centers: Option<&Centers>,
) -> String {
    let clusters = search
        .clusters
        .as_ref()
        .map(|clusters| (clusters.backend, clusters.n_clusters));
    let given: Option<Vec<u64>> =
        centers.map(|centers| centers.values.iter().map(|value| value.to_bits()).collect());
    // Bits, not decimals: they say exactly which number it was.
    let all = (
        (
            SCHEMA,
            env!("CARGO_PKG_VERSION"),
            &dataset.fingerprint,
            &parameters.state_columns,
        ),
        (
            parameters.gamma.to_bits(),
            parameters.n_neighbors,
            parameters.seed,
            parameters.n_resamples,
        ),
        (
            parameters.exclude_same_episode,
            search.exact,
            clusters,
            given,
        ),
    );
    let text = serde_json::to_string(&all).unwrap_or_else(|error| error.to_string());
    blake3::hash(text.as_bytes()).to_hex()[..16].to_owned()
}
