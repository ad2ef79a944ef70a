//! The measurements themselves.

use std::time::Instant;

use ksim::{
    ApproximationError, KMeans, KSim, KSimParams, MatrixView, NeighborIndex, Neighbors, Report,
    Search, SearchRequest, Trajectories,
};
use rayon::{ThreadPool, ThreadPoolBuilder};

use super::memory::PeakMemory;
use super::report::{Approximation, Measurement, SCHEMA, SearchReport, SourcePart};
use super::source::ReferenceData;
use super::{SearchBenchError, SearchPlan, StepSource};
use crate::stats::{BootstrapOptions, Estimate, bootstrap_pooled};

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
    let is_measured = |width: &usize| !configurations(plan, *width).is_empty();
    if plan.rows.is_empty() || !plan.widths.iter().any(is_measured) {
        let engines: Vec<String> = plan.engines.iter().map(ToString::to_string).collect();
        let widths: Vec<String> = plan.widths.iter().map(ToString::to_string).collect();
        return Err(SearchBenchError::EmptyPlan {
            engines: engines.join(", "),
            widths: widths.join(", "),
        });
    }
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
        let built = memory.and_then(|memory| Some([memory.rise()?, memory.kept()?]));
        let mut measurements = Vec::with_capacity(self.sets.len());
        for set in &self.sets {
            let searching = PeakMemory::start();
            let timed = set.time(engine.index(), &pool, plan)?;
            // Before the comparison, which takes memory that is not the engine's.
            let searching = searching.and_then(|memory| memory.rise());
            let memory = built.zip(searching);
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
                memory_bytes: memory.map(|([peak, kept], rise)| peak.max(kept + rise)),
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
        let states = oracle
            .normalizers()
            .0
            .normalized_rows(data.states(), 0..data.n_rows());
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
        // There is at least one repeat.
        let found = found.unwrap_or_else(|| self.exact.clone());
        Ok(Timed {
            query_s,
            single_query_s: self.time_single(index, plan)?,
            found,
        })
    }

    /// Asks some queries one at a time, on one thread: seconds per query.
    fn time_single(
        &self,
        index: &dyn NeighborIndex,
        plan: &SearchPlan,
    ) -> Result<Option<f64>, SearchBenchError> {
        let (n_queries, width) = (self.data.n_rows(), index.n_features());
        let n_single = plan.n_single.min(n_queries);
        if n_single == 0 {
            return Ok(None);
        }
        let ask = |i: usize| {
            let query = i * n_queries / n_single;
            let states = &self.states[query * width..(query + 1) * width];
            let request = SearchRequest::new(MatrixView::new(states, width)?, plan.n_neighbors);
            index.search(&request)?;
            Ok::<_, SearchBenchError>(())
        };
        // All of it on the thread: handing every query over would take longer than some searches.
        self::pool(1)?.install(|| {
            ask(0)?;
            let mut best = f64::INFINITY;
            for _ in 0..plan.repeats.max(1) {
                let started = Instant::now();
                (0..n_single).try_for_each(ask)?;
                best = best.min(started.elapsed().as_secs_f64() / n_single as f64);
            }
            Ok(Some(best))
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
        let error = ApproximationError::between((found, &report), (&self.exact, &self.report));
        let episodes = report.episodes.iter().zip(&self.report.episodes);
        let differences: Vec<(f64, usize)> = episodes
            .map(|(own, exact)| {
                let difference = own.k_sim - exact.k_sim;
                (difference * exact.n_steps as f64, exact.n_steps)
            })
            .collect();
        let options = BootstrapOptions {
            n_resamples: plan.n_resamples,
            seed: plan.seed,
            ..BootstrapOptions::default()
        };
        let pooled = bootstrap_pooled(&differences, &options);
        let approximation = Approximation {
            recall_at_k: error.recall,
            match_differs_share: error.match_differs_share,
            score_difference: Estimate {
                value: error.mean_score_difference,
                interval: pooled.and_then(|pooled| pooled.interval),
            },
            max_score_difference: error.max_score_difference,
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
