//! The measurements themselves.

use std::time::Instant;

use ksim::{
    KMeans, KSim, KSimParams, MatrixView, NeighborIndex, Neighbors, Report, Search, SearchRequest,
    Trajectories,
};
use rayon::{ThreadPool, ThreadPoolBuilder};

use super::memory::PeakMemory;
use super::report::{Approximation, Measurement, SCHEMA, SearchReport, SourcePart};
use super::source::ReferenceData;
use super::{SearchBenchError, SearchPlan, StepSource};
use crate::stats::{BootstrapOptions, Estimate, bootstrap_mean};

/// Queries that start the threads before the first timed batch.
const WARM_UP: usize = 64;

/// Builds and asks every engine of the plan; `say` is told what is being measured.
///
/// # Errors
/// A plan that does not fit the data, an engine that cannot be built, and an exact engine that is not exact.
pub fn run(
    source: &StepSource,
    about: SourcePart,
    plan: &SearchPlan,
    say: &mut dyn FnMut(&str),
) -> Result<SearchReport, SearchBenchError> {
    source.check()?;
    if let Some(found) = source.state_dim()
        && let Some(&asked) = plan.widths.iter().find(|&&width| width > found)
    {
        return Err(SearchBenchError::Width { asked, found });
    }
    let mut measurements = Vec::new();
    for &width in &plan.widths {
        for &n_rows in &plan.rows {
            say(&format!(
                "{n_rows} rows of {width} columns: reference and oracle"
            ));
            let bench = Bench::new(source, plan, (n_rows, width))?;
            for configuration in configurations(plan, width) {
                say(&format!(
                    "{n_rows} rows of {width} columns: {}",
                    configuration.name()
                ));
                measurements.extend(bench.measure(&configuration, plan)?);
            }
        }
    }
    Ok(SearchReport {
        schema: SCHEMA,
        version: env!("CARGO_PKG_VERSION"),
        source: about,
        n_neighbors: plan.n_neighbors,
        seed: plan.seed,
        n_cores: std::thread::available_parallelism().map_or(1, usize::from),
        measurements,
    })
}

/// One engine on so many threads.
#[derive(Debug)]
struct Configuration {
    search: Search,
    n_clusters: Option<usize>,
    threads: usize,
}

impl Configuration {
    fn name(&self) -> String {
        let clusters = self.n_clusters.map_or(String::new(), |n| format!(" ({n})"));
        format!("{}{clusters}, threads {}", self.search, self.threads)
    }
}

fn configurations(plan: &SearchPlan, width: usize) -> Vec<Configuration> {
    let fits = |search: Search| search != Search::KdTree || width <= ksim::KdTree::MAX_FEATURES;
    let mut all = Vec::new();
    for &search in plan.engines.iter().filter(|&&search| fits(search)) {
        let clusters: Vec<Option<usize>> = match search {
            Search::Clusters => plan.n_clusters.iter().copied().map(Some).collect(),
            _ => vec![None],
        };
        for n_clusters in clusters {
            all.extend(plan.threads.iter().map(|&threads| Configuration {
                search,
                n_clusters,
                threads,
            }));
        }
    }
    all
}

/// One reference, with all queries and the true answers.
struct Bench {
    /// The reference under the oracle, which costs no memory.
    oracle: KSim,
    n_distinct: usize,
    sets: Vec<QuerySet>,
}

/// Queries of one kind.
struct QuerySet {
    name: String,
    data: Trajectories,
    /// Normalized states, row-major.
    states: Vec<f64>,
    /// Which queries the oracle answered.
    checked: Vec<usize>,
    oracle: Neighbors,
    /// Exact answers to all, and the scores that follow.
    exact: Neighbors,
    report: Report,
}

impl Bench {
    fn new(
        source: &StepSource,
        plan: &SearchPlan,
        (n_rows, width): (usize, usize),
    ) -> Result<Self, SearchBenchError> {
        let ReferenceData { data, n_distinct } = source.reference(n_rows, width)?;
        let oracle = params(plan).search(Search::Linear).fit(data)?;
        let exact = oracle.with_search(Search::Auto)?;
        let sets = source.queries(plan.n_queries, width)?;
        let sets = sets
            .into_iter()
            .map(|(name, data)| QuerySet::new(name, data, (&oracle, &exact), plan));
        Ok(Self {
            sets: sets.collect::<Result<_, _>>()?,
            oracle,
            n_distinct,
        })
    }

    /// Builds one engine and asks it with every kind of queries.
    fn measure(
        &self,
        configuration: &Configuration,
        plan: &SearchPlan,
    ) -> Result<Vec<Measurement>, SearchBenchError> {
        let pool = pool(configuration.threads)?;
        let mut params = params(plan).search(configuration.search);
        if let Some(n_clusters) = configuration.n_clusters {
            params = params.kmeans(KMeans::params(n_clusters).seed(plan.seed));
        }
        let memory = PeakMemory::start();
        let started = Instant::now();
        let engine = pool.install(|| self.oracle.with_params(params))?;
        let build_s = started.elapsed().as_secs_f64();
        let mut measurements = Vec::with_capacity(self.sets.len());
        for set in &self.sets {
            let timed = set.time(engine.index(), &pool, plan)?;
            let approximation = set.compare(&engine, &timed.found, plan)?;
            let kmeans = engine.index().kmeans();
            let reference = self.oracle.index();
            measurements.push(Measurement {
                search: configuration.search.name(),
                engine: engine.index().engine(),
                exact: engine.index().is_exact(),
                n_clusters: kmeans.map(KMeans::n_clusters),
                n_rows: reference.n_rows(),
                n_distinct_rows: self.n_distinct,
                n_columns: reference.n_features(),
                threads: configuration.threads,
                queries: set.name.clone(),
                n_queries: timed.found.n_queries(),
                build_s,
                kmeans_iterations: kmeans.and_then(KMeans::n_iterations),
                inertia: kmeans.map(KMeans::inertia),
                reference_bytes: 8 * (reference.n_rows() * reference.n_features()) as u64,
                memory_bytes: memory.as_ref().and_then(PeakMemory::rise),
                query_s: timed.query_s,
                single_query_s: timed.single_query_s,
                n_checked: set.checked.len(),
                k_sim: approximation.map_or(set.report.state_action.pooled, |(k_sim, _)| k_sim),
                approximation: approximation.map(|(_, approximation)| approximation),
            });
        }
        Ok(measurements)
    }
}

/// What the clock said, and the answers.
struct Timed {
    query_s: f64,
    single_query_s: Option<f64>,
    found: Neighbors,
}

impl QuerySet {
    fn new(
        name: String,
        data: Trajectories,
        (oracle, exact): (&KSim, &KSim),
        plan: &SearchPlan,
    ) -> Result<Self, SearchBenchError> {
        let states = normalized_states(&data, oracle);
        let n = data.n_rows();
        let n_checked = plan.n_checked.min(n);
        let checked: Vec<usize> = (0..n_checked).map(|i| i * n / n_checked).collect();
        let width = data.state_dim();
        let row = |query: &usize| &states[query * width..(query + 1) * width];
        let some: Vec<f64> = checked.iter().flat_map(row).copied().collect();
        let ask = |ksim: &KSim, states: &[f64]| {
            let queries = MatrixView::new(states, width)?;
            let request = SearchRequest::new(queries, plan.n_neighbors);
            Ok::<_, SearchBenchError>(ksim.index().search(&request)?)
        };
        let set = Self {
            oracle: ask(oracle, &some)?,
            exact: ask(exact, &states)?,
            report: exact.score(&data)?,
            name,
            data,
            states,
            checked,
        };
        set.check(exact.index(), &set.exact)?;
        Ok(set)
    }

    /// Asks all queries in one batch, and some one at a time.
    fn time(
        &self,
        index: &dyn NeighborIndex,
        pool: &ThreadPool,
        plan: &SearchPlan,
    ) -> Result<Timed, SearchBenchError> {
        let width = index.n_features();
        let request = |states| {
            let queries = MatrixView::new(states, width)?;
            Ok::<_, SearchBenchError>(SearchRequest::new(queries, plan.n_neighbors))
        };
        let n_queries = self.data.n_rows();
        let warm_up = request(&self.states[..WARM_UP.min(n_queries) * width])?;
        let all = request(&self.states)?;
        pool.install(|| index.search(&warm_up))?;
        let mut query_s = f64::INFINITY;
        let mut found = None;
        for _ in 0..plan.repeats.max(1) {
            let started = Instant::now();
            found = Some(pool.install(|| index.search(&all))?);
            query_s = query_s.min(started.elapsed().as_secs_f64() / n_queries as f64);
        }
        let n_single = plan.n_single.min(n_queries);
        let single_query_s = match n_single {
            0 => None,
            _ => {
                let one = self::pool(1)?;
                let started = Instant::now();
                for i in 0..n_single {
                    let query = i * n_queries / n_single;
                    let request = request(&self.states[query * width..(query + 1) * width])?;
                    one.install(|| index.search(&request))?;
                }
                Some(started.elapsed().as_secs_f64() / n_single as f64)
            }
        };
        // There is at least one repeat.
        let found = found.unwrap_or_else(|| self.exact.clone());
        Ok(Timed {
            query_s,
            single_query_s,
            found,
        })
    }

    /// Holds an exact engine to the oracle; tells how far another departs, with its K-Sim.
    fn compare(
        &self,
        engine: &KSim,
        found: &Neighbors,
        plan: &SearchPlan,
    ) -> Result<Option<(f64, Approximation)>, SearchBenchError> {
        if engine.index().is_exact() {
            self.check(engine.index(), found)?;
            return Ok(None);
        }
        let report = engine.score(&self.data)?;
        let pairs = || report.steps.iter().zip(&self.report.steps);
        let n = report.steps.len() as f64;
        let differs = pairs().filter(|(own, exact)| own.reference_row != exact.reference_row);
        let difference =
            |(own, exact): (&ksim::StepScore, &ksim::StepScore)| own.score - exact.score;
        let of_episodes: Vec<f64> = report
            .episodes
            .iter()
            .zip(&self.report.episodes)
            .map(|(own, exact)| own.k_sim - exact.k_sim)
            .collect();
        let options = BootstrapOptions {
            n_resamples: plan.n_resamples,
            seed: plan.seed,
            ..BootstrapOptions::default()
        };
        let nothing = Estimate {
            value: 0.0,
            interval: None,
        };
        let approximation = Approximation {
            recall_at_k: self.recall(found),
            match_differs_share: differs.count() as f64 / n,
            score_difference: bootstrap_mean(&of_episodes, &options).unwrap_or(nothing),
            max_score_difference: pairs().map(difference).map(f64::abs).fold(0.0, f64::max),
        };
        Ok(Some((report.state_action.pooled, approximation)))
    }

    /// Compares rows and distances, bit by bit, with the oracle's.
    fn check(&self, index: &dyn NeighborIndex, found: &Neighbors) -> Result<(), SearchBenchError> {
        let differs = |(at, query): &(usize, &usize)| self.oracle.of(*at) != found.of(**query);
        match self.checked.iter().enumerate().find(differs) {
            None => Ok(()),
            Some((_, &query)) => Err(SearchBenchError::NotExact {
                engine: index.engine(),
                n_rows: index.n_rows(),
                width: index.n_features(),
                queries: self.name.clone(),
                query,
            }),
        }
    }

    /// Mean share of the true nearest rows that were found.
    fn recall(&self, found: &Neighbors) -> f64 {
        let rows = |neighbors: &Neighbors, query| {
            let mut rows: Vec<u32> = neighbors.of(query).iter().map(|one| one.row).collect();
            rows.sort_unstable();
            rows
        };
        let n = found.n_queries();
        let share = |query: usize| {
            let (own, exact) = (rows(found, query), rows(&self.exact, query));
            let hits = own.iter().filter(|row| exact.binary_search(row).is_ok());
            hits.count() as f64 / exact.len().max(1) as f64
        };
        (0..n).map(share).sum::<f64>() / n.max(1) as f64
    }
}

fn params(plan: &SearchPlan) -> KSimParams {
    KSim::params()
        .n_neighbors(plan.n_neighbors)
        .n_queries(plan.n_queries)
        .n_resamples(0)
        .seed(plan.seed)
}

fn pool(n_threads: usize) -> Result<ThreadPool, SearchBenchError> {
    let pool = ThreadPoolBuilder::new().num_threads(n_threads).build();
    pool.map_err(|source| SearchBenchError::Threads { n_threads, source })
}

/// The states in units of the reference's standard deviations, row-major.
fn normalized_states(data: &Trajectories, reference: &KSim) -> Vec<f64> {
    let (normalizer, _) = reference.normalizers();
    let width = data.state_dim();
    let mut action = vec![0.0; data.action_dim()];
    let mut states = vec![0.0; data.n_rows() * width];
    for (row, state) in states.chunks_exact_mut(width).enumerate() {
        data.read_step(row, state, &mut action);
        for (column, value) in state.iter_mut().enumerate() {
            *value = normalizer.normalize(column, *value);
        }
    }
    states
}
