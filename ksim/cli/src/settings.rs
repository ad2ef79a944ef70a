//! What a score is computed with: flags and presets, resolved once.

use clap::error::ErrorKind;
use clap::{Args, CommandFactory, ValueEnum};
use ksim::{KMeans, KMeansBackend, KMeansParams, KSim, KSimParams, Search};

use crate::centers::CentersFile;

/// The paper's numbers of clusters and of neighbors.
const PAPER_CLUSTERS: usize = 50;
const PAPER_NEIGHBORS: usize = 50;

/// The paper's γ.
const PAPER_GAMMA: f64 = 0.5;

/// Which of the published definitions decides what no flag says.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Definition {
    /// The paper's text: all state columns, mean over all steps
    Paper,
    /// The authors' AntMaze script: state columns 0..2, mean of the episodes' means
    Released,
}

impl Definition {
    /// Whether K, γ and the number of clusters, if there are any, are the paper's, which the script shares.
    pub(crate) fn has_numbers(n_neighbors: usize, gamma: f64, n_clusters: Option<usize>) -> bool {
        let clusters = n_clusters.is_none_or(|n_clusters| n_clusters == PAPER_CLUSTERS);
        n_neighbors == PAPER_NEIGHBORS && gamma == PAPER_GAMMA && clusters
    }

    /// Its name on the command line and in results.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Paper => "paper",
            Self::Released => "released",
        }
    }

    /// The aggregate it calls K-Sim, by the name of the result's field.
    pub(crate) fn headline(self) -> &'static str {
        match self {
            Self::Paper => "k_sim",
            Self::Released => "k_sim_episode_mean",
        }
    }

    /// The state columns it chooses; `None` for all.
    pub(crate) fn state_columns(self) -> Option<&'static str> {
        match self {
            Self::Paper => None,
            Self::Released => Some("0..2"),
        }
    }
}

/// The metric.
#[derive(Debug, Clone, Args)]
#[command(next_help_heading = "Metric")]
pub(crate) struct MetricArgs {
    /// Preset; explicit flags win over it
    #[arg(long, value_enum, default_value_t = Definition::Paper)]
    definition: Definition,
    /// State columns: numbers, ranges such as 0..2, names such as achieved_goal or observation[3..7], or
    /// `all`; of the dataset's observation, and what goes with it by name in the rollouts', or by number where
    /// one of the two is a single vector [default: by definition]
    #[arg(long, value_name = "COLUMNS")]
    state_columns: Option<String>,
    /// K: how many nearest states compete by their action
    #[arg(long, value_name = "K", default_value_t = PAPER_NEIGHBORS, value_parser = parse_count,
        allow_negative_numbers = true)]
    n_neighbors: usize,
    /// γ: the distance per √column at which a step's score leaves 1
    #[arg(long, default_value_t = PAPER_GAMMA, value_parser = parse_gamma, allow_negative_numbers = true)]
    gamma: f64,
    /// Seed of the bootstrap and of k-means
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Resamples of the bootstrap over episodes
    #[arg(long, value_name = "N", default_value_t = 2000, value_parser = parse_resamples,
        allow_negative_numbers = true)]
    n_resamples: usize,
    /// Match no step with its own episode: for scoring a dataset against itself
    #[arg(long)]
    exclude_same_episode: bool,
}

/// The search.
#[derive(Debug, Clone, Args)]
#[command(next_help_heading = "Search")]
pub(crate) struct SearchArgs {
    /// How the nearest states are found; all but `clusters` are exact and agree to the last bit
    #[arg(long, value_enum, default_value_t = SearchName::Auto)]
    search: SearchName,
    /// Clusters of `--search clusters` [default: 50]
    #[arg(long, value_name = "M", value_parser = parse_count, allow_negative_numbers = true)]
    n_clusters: Option<usize>,
    /// k-means behind `--search clusters`
    #[arg(long, value_enum, default_value_t = BackendName::Ksim)]
    k_means: BackendName,
    /// Cluster centers to use instead of fitted ones, in normalized units; a name after the file chooses
    /// the tensor. Implies `--search clusters`
    #[arg(long, value_name = "FILE.safetensors[:TENSOR]")]
    centers: Option<String>,
    /// Also measure what the approximate search costs against an exact one
    #[arg(long)]
    approximation_error: bool,
}

/// A search as the command line has it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum SearchName {
    /// An exact one, the cheapest by what the job is expected to cost
    Auto,
    /// Exact: compares with every row; slow, for checking
    Linear,
    /// Exact: a k-d tree, for up to 8 state columns
    KdTree,
    /// Exact: for any number of state columns
    Blocked,
    /// The paper's approximation: only the k-means cluster nearest to the state
    Clusters,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum BackendName {
    /// Our own
    Ksim,
    /// linfa's, as an independent reference
    Linfa,
}

/// Everything a score depends on beside the data.
#[derive(Debug, Clone)]
pub(crate) struct Settings {
    /// The preset.
    pub(crate) definition: Definition,
    /// The selection of state columns; `None` takes all.
    pub(crate) state_columns: Option<String>,
    /// K.
    pub(crate) n_neighbors: usize,
    /// γ.
    pub(crate) gamma: f64,
    /// Seed of bootstrap and k-means.
    pub(crate) seed: u64,
    /// Bootstrap resamples.
    pub(crate) n_resamples: usize,
    /// Match no step with its own episode.
    pub(crate) exclude_same_episode: bool,
    /// The search asked for.
    pub(crate) search: Search,
    /// Clusters, where the search has them: asked for, or the paper's number.
    pub(crate) n_clusters: usize,
    /// Whether the number of clusters was asked for.
    pub(crate) n_clusters_given: bool,
    /// The k-means backend.
    pub(crate) backend: KMeansBackend,
    /// Given centers.
    pub(crate) centers: Option<CentersFile>,
    /// Measure the approximation error.
    pub(crate) approximation_error: bool,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            definition: Definition::Paper,
            state_columns: None,
            n_neighbors: PAPER_NEIGHBORS,
            gamma: PAPER_GAMMA,
            seed: 0,
            n_resamples: 2000,
            exclude_same_episode: false,
            search: Search::Auto,
            n_clusters: PAPER_CLUSTERS,
            n_clusters_given: false,
            backend: KMeansBackend::Ksim,
            centers: None,
            approximation_error: false,
        }
    }
}

impl Settings {
    /// Resolves flags and preset.
    ///
    /// # Errors
    /// Flags that contradict each other: a wrong usage.
    pub(crate) fn resolve(metric: &MetricArgs, search: &SearchArgs) -> Result<Self, clap::Error> {
        let centers = search.centers.as_deref().map(CentersFile::parse);
        let engine = match (search.search, &centers) {
            (SearchName::Auto | SearchName::Clusters, Some(_)) => Search::Clusters,
            (other, Some(_)) => {
                let message = format!(
                    "--centers is for --search clusters, but --search {} was asked for",
                    other.engine()
                );
                return Err(usage(ErrorKind::ArgumentConflict, message));
            }
            (search, None) => search.engine(),
        };
        if search.approximation_error && engine != Search::Clusters {
            let message = format!(
                "--approximation-error is for --search clusters: --search {engine} is exact"
            );
            return Err(usage(ErrorKind::ArgumentConflict, message));
        }
        let state_columns = match metric.state_columns.as_deref() {
            Some("all") => None,
            Some(columns) => Some(columns),
            None => metric.definition.state_columns(),
        };
        Ok(Self {
            definition: metric.definition,
            state_columns: state_columns.map(str::to_owned),
            n_neighbors: metric.n_neighbors,
            gamma: metric.gamma,
            seed: metric.seed,
            n_resamples: metric.n_resamples,
            exclude_same_episode: metric.exclude_same_episode,
            search: engine,
            n_clusters: search.n_clusters.unwrap_or(PAPER_CLUSTERS),
            n_clusters_given: search.n_clusters.is_some(),
            backend: search.k_means.backend()?,
            centers,
            approximation_error: search.approximation_error,
        })
    }

    /// What was asked for and has no effect.
    pub(crate) fn idle_flags(&self) -> Vec<String> {
        let exact = self.search != Search::Clusters;
        let flags = [
            ("--n-clusters", self.n_clusters_given),
            ("--k-means linfa", self.backend != KMeansBackend::Ksim),
        ];
        let idle = flags.into_iter().filter(|&(_, given)| given && exact);
        let said = idle.map(|(flag, _)| {
            format!(
                "{flag} has no effect: the search is exact; for the paper's clusters add \
                 --search clusters"
            )
        });
        said.collect()
    }

    /// Whether the state columns are those of the definition.
    pub(crate) fn has_own_columns(&self) -> bool {
        self.state_columns.as_deref() == self.definition.state_columns()
    }

    /// The engine's parameters; given centers are `centers`.
    pub(crate) fn params(&self, centers: Option<Vec<f64>>) -> KSimParams {
        let kmeans = self.clusters().params();
        let params = KSim::params()
            .gamma(self.gamma)
            .n_neighbors(self.n_neighbors)
            .n_resamples(self.n_resamples)
            .seed(self.seed)
            .search(self.search)
            .kmeans(kmeans);
        match centers {
            Some(centers) => params.centers(centers),
            None => params,
        }
    }

    /// The name of the k-means backend.
    pub(crate) fn backend_name(&self) -> &'static str {
        self.clusters().backend_name()
    }

    fn clusters(&self) -> ClusterSettings {
        ClusterSettings {
            n_clusters: self.n_clusters,
            seed: self.seed,
            backend: self.backend,
        }
    }
}

/// How clusters are fitted.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ClusterSettings {
    n_clusters: usize,
    seed: u64,
    backend: KMeansBackend,
}

impl ClusterSettings {
    /// Of flags; the paper's number where none is given.
    pub(crate) fn new(
        n_clusters: Option<usize>,
        seed: u64,
        backend: BackendName,
    ) -> Result<Self, clap::Error> {
        Ok(Self {
            n_clusters: n_clusters.unwrap_or(PAPER_CLUSTERS),
            seed,
            backend: backend.backend()?,
        })
    }

    /// The engine's parameters.
    pub(crate) fn params(&self) -> KMeansParams {
        KMeans::params(self.n_clusters)
            .seed(self.seed)
            .backend(self.backend)
    }

    /// The name of the k-means.
    pub(crate) fn backend_name(&self) -> &'static str {
        match self.backend {
            KMeansBackend::Ksim => "ksim",
            #[cfg(feature = "linfa")]
            KMeansBackend::Linfa => "linfa",
        }
    }
}

impl SearchName {
    /// The engine of that name.
    pub(crate) fn engine(self) -> Search {
        match self {
            Self::Auto => Search::Auto,
            Self::Linear => Search::Linear,
            Self::KdTree => Search::KdTree,
            Self::Blocked => Search::Blocked,
            Self::Clusters => Search::Clusters,
        }
    }
}

impl BackendName {
    fn backend(self) -> Result<KMeansBackend, clap::Error> {
        match self {
            Self::Ksim => Ok(KMeansBackend::Ksim),
            #[cfg(feature = "linfa")]
            Self::Linfa => Ok(KMeansBackend::Linfa),
            #[cfg(not(feature = "linfa"))]
            Self::Linfa => Err(usage(
                ErrorKind::InvalidValue,
                "--k-means linfa needs feature `linfa`, which this build lacks".to_owned(),
            )),
        }
    }
}

fn usage(kind: ErrorKind, message: String) -> clap::Error {
    crate::cli::Cli::command().error(kind, message)
}

/// Rows are numbered by 32 bits, so no larger count means anything.
pub(crate) fn parse_count(text: &str) -> Result<usize, String> {
    parse_within(text, 1, u32::MAX as usize)
}

/// The bootstrap keeps one mean per resample.
fn parse_resamples(text: &str) -> Result<usize, String> {
    parse_within(text, 0, 10_000_000)
}

fn parse_within(text: &str, least: usize, most: usize) -> Result<usize, String> {
    match text.parse() {
        Ok(count) if (least..=most).contains(&count) => Ok(count),
        _ => Err(format!("expected a whole number from {least} to {most}")),
    }
}

fn parse_gamma(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(gamma) if gamma.is_finite() && gamma > 0.0 => Ok(gamma),
        _ => Err("expected a finite number above 0".to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Parser)]
    struct Flags {
        #[command(flatten)]
        metric: MetricArgs,
        #[command(flatten)]
        search: SearchArgs,
    }

    fn resolve(flags: &[&str]) -> Result<Settings, clap::Error> {
        let flags = Flags::try_parse_from([&["ksim"], flags].concat())?;
        Settings::resolve(&flags.metric, &flags.search)
    }

    #[test]
    fn a_preset_yields_to_flags() {
        assert_eq!(resolve(&[]).unwrap().state_columns, None);
        let released = resolve(&["--definition", "released"]).unwrap();
        assert_eq!(released.state_columns.as_deref(), Some("0..2"));
        assert_eq!(released.definition.headline(), "k_sim_episode_mean");
        let own = resolve(&["--definition=released", "--state-columns=all"]).unwrap();
        assert_eq!(own.state_columns, None);
    }

    #[test]
    fn centers_imply_clusters_and_contradict_exact_searches() {
        assert_eq!(
            resolve(&["--centers=c.safetensors"]).unwrap().search,
            Search::Clusters
        );
        let error = resolve(&["--centers=c.safetensors", "--search=linear"]).unwrap_err();
        assert_eq!(error.kind(), ErrorKind::ArgumentConflict);
        let error = resolve(&["--approximation-error"]).unwrap_err();
        assert_eq!(error.kind(), ErrorKind::ArgumentConflict);
    }

    #[test]
    fn numbers_out_of_range_are_wrong_usage() {
        for flag in [
            "--gamma=0",
            "--gamma=nan",
            "--n-neighbors=0",
            "--n-clusters=0",
            "--seed=-1",
        ] {
            assert!(resolve(&[flag]).is_err(), "{flag}");
        }
        for flags in [&["--n-neighbors", "-1"], &["--gamma", "-1"]] {
            let error = resolve(flags).unwrap_err();
            assert_eq!(error.kind(), ErrorKind::ValueValidation, "{error}");
        }
    }

    #[test]
    fn flags_of_clusters_are_idle_without_them() {
        let idle = |flags: &[&str]| resolve(flags).unwrap().idle_flags().len();
        assert_eq!(idle(&["--n-clusters=7"]), 1);
        assert_eq!(idle(&["--n-clusters=7", "--search=clusters"]), 0);
        #[cfg(feature = "linfa")]
        assert_eq!(idle(&["--n-clusters=7", "--k-means=linfa"]), 2);
    }

    #[test]
    fn own_columns_are_told_from_chosen_ones() {
        let own = |flags: &[&str]| resolve(flags).unwrap().has_own_columns();
        assert!(own(&[]) && own(&["--state-columns=all"]) && own(&["--definition=released"]));
        assert!(!own(&["--state-columns=0..2"]));
        assert!(!own(&["--definition=released", "--state-columns=all"]));
    }
}
