//! What a score is computed with, and the check of it.

use std::fmt;
use std::str::FromStr;
use std::sync::Arc;

use super::cost::Workload;
use super::{KSim, Reference};
use crate::error::ScoreError;
use crate::kmeans::{KMeans, KMeansParams};
use crate::matrix::Matrix;
use crate::neighbors::{Blocked, Clusters, KdTree, Linear, NeighborIndex, RoundedRows};
use crate::trajectories::Trajectories;

/// Which engine finds the nearest states.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Search {
    /// The exact engine that a cost model expects to take least, by rows, columns and the number of
    /// queries ([`KSimParams::n_queries`]); answers do not depend on the choice.
    #[default]
    Auto,
    /// Exact: every row in f64. The oracle.
    Linear,
    /// Exact: a k-d tree, for 1 to 8 columns.
    KdTree,
    /// Exact: a first pass over rounded rows with a bound, then f64; any width.
    Blocked,
    /// The paper's approximation: only the k-means cluster with the nearest center.
    Clusters,
}

impl Search {
    /// Every choice, in the order of the documentation.
    pub const ALL: [Self; 5] = [
        Self::Auto,
        Self::Linear,
        Self::KdTree,
        Self::Blocked,
        Self::Clusters,
    ];

    /// The name used on the command line and in results.
    pub fn name(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::Linear => "linear",
            Self::KdTree => "kd-tree",
            Self::Blocked => "blocked",
            Self::Clusters => "clusters",
        }
    }
}

impl fmt::Display for Search {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Search {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, Self::Err> {
        Self::ALL
            .into_iter()
            .find(|search| search.name() == name)
            .ok_or_else(|| {
                let names: Vec<_> = Self::ALL.iter().map(|search| search.name()).collect();
                format!(
                    "unknown search {name:?}, expected one of {}",
                    names.join(", ")
                )
            })
    }
}

/// What a search would compute from the states, computed before. What is not given is computed.
#[derive(Debug, Default)]
pub struct Prepared {
    /// Clusters fitted to the states, for [`Search::Clusters`].
    pub clusters: Option<KMeans>,
    /// The states as [`Blocked::rounded`] gives them, or, for [`Search::Clusters`], [`Clusters::rounded`].
    pub rounded: Option<RoundedRows>,
}

/// How to score: setters only store, [`fit`](Self::fit) checks.
///
/// Defaults: γ = 0.5, 50 neighbors, exact search, and for `clusters` 50 k-means clusters, seed 0;
/// 2000 bootstrap resamples.
#[derive(Debug, Clone, PartialEq)]
pub struct KSimParams {
    pub(super) gamma: f64,
    pub(super) n_neighbors: usize,
    pub(super) n_resamples: usize,
    pub(super) seed: u64,
    search: Search,
    n_queries: usize,
    kmeans: KMeansParams,
    centers: Option<Vec<f64>>,
}

impl Default for KSimParams {
    fn default() -> Self {
        Self {
            gamma: 0.5,
            n_neighbors: 50,
            n_resamples: 2000,
            seed: 0,
            search: Search::Auto,
            n_queries: 10_000,
            kmeans: KMeans::params(50),
            centers: None,
        }
    }
}

impl KSimParams {
    /// γ: the distance per √column at which the score leaves 1, in standard deviations; above 0.
    pub fn gamma(mut self, gamma: f64) -> Self {
        self.gamma = gamma;
        self
    }

    /// K: how many nearest states compete by their action; at least 1.
    pub fn n_neighbors(mut self, n_neighbors: usize) -> Self {
        self.n_neighbors = n_neighbors;
        self
    }

    /// Which engine finds the nearest states.
    pub fn search(mut self, search: Search) -> Self {
        self.search = search;
        self
    }

    /// About how many steps will be scored, by which [`Search::Auto`] weighs building against asking;
    /// 10,000 if not said.
    pub fn n_queries(mut self, n_queries: usize) -> Self {
        self.n_queries = n_queries;
        self
    }

    /// How the clusters of [`Search::Clusters`] are fitted; its seed is the one set here.
    pub fn kmeans(mut self, kmeans: KMeansParams) -> Self {
        self.kmeans = kmeans;
        self
    }

    /// Given cluster centers instead of fitted ones: row-major, of the width of a state, in
    /// normalized units.
    pub fn centers(mut self, centers: Vec<f64>) -> Self {
        self.centers = Some(centers);
        self
    }

    /// Resamples of the episode bootstrap.
    pub fn n_resamples(mut self, n_resamples: usize) -> Self {
        self.n_resamples = n_resamples;
        self
    }

    /// Seed of the bootstrap.
    pub fn seed(mut self, seed: u64) -> Self {
        self.seed = seed;
        self
    }

    /// Normalizes the reference, which is consumed, and builds the search over its states.
    ///
    /// # Errors
    /// [`ScoreError::EmptyReference`], [`ScoreError::Gamma`], and what k-means or the search
    /// object to.
    pub fn fit(self, reference: Trajectories) -> Result<KSim, ScoreError> {
        self.check()?;
        self.fit_prepared(Reference::new(reference)?, Prepared::default())
    }

    /// Builds the search over a reference that is normalized already, from what was prepared for its
    /// states.
    ///
    /// # Errors
    /// As [`fit`](Self::fit); [`KMeansError::OtherRows`](crate::KMeansError::OtherRows) and
    /// [`SearchError::RoundedRows`](crate::SearchError::RoundedRows) for what was prepared for other data.
    pub fn fit_prepared(
        self,
        reference: Reference,
        prepared: Prepared,
    ) -> Result<KSim, ScoreError> {
        self.check()?;
        let index = self.build_index(&reference, prepared)?;
        Ok(KSim {
            reference,
            index,
            params: self,
        })
    }

    pub(super) fn check(&self) -> Result<(), ScoreError> {
        if !(self.gamma.is_finite() && self.gamma > 0.0) {
            return Err(ScoreError::Gamma { value: self.gamma });
        }
        if self.n_neighbors == 0 {
            return Err(crate::error::SearchError::NoNeighbors.into());
        }
        Ok(())
    }

    pub(super) fn build_index(
        &self,
        reference: &Reference,
        prepared: Prepared,
    ) -> Result<Box<dyn NeighborIndex>, ScoreError> {
        let states = Arc::clone(&reference.states);
        Ok(match self.engine(&states, &prepared) {
            Search::Linear => Box::new(Linear::new(states)),
            Search::KdTree => Box::new(KdTree::new(states)?),
            Search::Auto | Search::Blocked => match prepared.rounded {
                Some(rounded) => Box::new(Blocked::from_rounded(states, rounded)?),
                None => Box::new(Blocked::new(states)),
            },
            Search::Clusters => {
                let kmeans = match (prepared.clusters, &self.centers) {
                    (Some(kmeans), _) => kmeans.checked_for(&states)?,
                    (None, Some(centers)) => {
                        KMeans::from_centers(centers, states.n_features(), &states)?
                    }
                    (None, None) => self.kmeans.fit(&states)?,
                };
                match prepared.rounded {
                    Some(rounded) => Box::new(Clusters::from_rounded(states, kmeans, rounded)?),
                    None => Box::new(Clusters::new(states, kmeans)),
                }
            }
        })
    }

    /// What [`Search::Auto`] stands for; every other choice as it is.
    fn engine(&self, states: &Matrix, prepared: &Prepared) -> Search {
        if self.search != Search::Auto {
            return self.search;
        }
        let workload = Workload {
            n_rows: states.n_rows(),
            n_features: states.n_features(),
            n_queries: self.n_queries,
            is_rounded: prepared.rounded.is_some(),
        };
        workload.cheapest()
    }
}
