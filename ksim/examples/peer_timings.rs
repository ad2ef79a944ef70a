//! Times the engine on arrays that another program timed too: the Rust half of
//! `bench-harness/benches/compare_search.py`.
//!
//! `peer_timings REFERENCE.f32 WIDTH N_CLUSTERS N_NEIGHBORS N_SINGLE ENGINES QUERIES.f32…` reads raw
//! little-endian row-major f32 and prints one JSON line: for every engine of the comma-separated list
//! seconds to build, and for every file of queries seconds per query in one batch and, of `N_SINGLE`
//! queries, one at a time; for `clusters` k-means alone too; and the peak resident memory in bytes.
//! Threads are those of `RAYON_NUM_THREADS`.

use std::error::Error;
use std::fmt::Write as _;
use std::io::Write as _;
use std::sync::Arc;
use std::time::Instant;

use ksim::{
    Blocked, Clusters, KMeans, KdTree, Linear, Matrix, MatrixView, NeighborIndex, SearchRequest,
};

/// Timed batches, of which the best counts.
const REPEATS: usize = 3;

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [
        reference,
        width,
        n_clusters,
        n_neighbors,
        n_single,
        engines,
        queries @ ..,
    ] = args.as_slice()
    else {
        return Err(
            "usage: peer_timings REFERENCE WIDTH N_CLUSTERS N_NEIGHBORS N_SINGLE ENGINES QUERIES…"
                .into(),
        );
    };
    let width: usize = width.parse()?;
    let (n_neighbors, n_single) = (n_neighbors.parse()?, n_single.parse()?);
    let data = Arc::new(Matrix::from_f32(read_f32(reference)?, width)?);
    let sets: Vec<Vec<f64>> = queries
        .iter()
        .map(|path| Ok(read_f32(path)?.into_iter().map(f64::from).collect()))
        .collect::<Result<_, Box<dyn Error>>>()?;
    let mut fields = vec![format!("\"rows\": {}", data.n_rows())];
    for engine in engines.split(',') {
        let start = Instant::now();
        let index: Box<dyn NeighborIndex> = match engine {
            "linear" => Box::new(Linear::new(Arc::clone(&data))),
            "blocked" => Box::new(Blocked::new(Arc::clone(&data))),
            "kd-tree" => Box::new(KdTree::new(Arc::clone(&data))?),
            "clusters" => {
                let kmeans = KMeans::params(n_clusters.parse()?).fit(&data)?;
                fields.push(format!(
                    "\"kmeans\": {{\"s\": {}, \"iterations\": {}, \"inertia\": {}}}",
                    start.elapsed().as_secs_f64(),
                    kmeans.n_iterations().unwrap_or(0),
                    kmeans.inertia()
                ));
                Box::new(Clusters::new(Arc::clone(&data), kmeans))
            }
            other => return Err(format!("unknown engine {other:?}").into()),
        };
        let mut field = format!(
            "\"{engine}\": {{\"build_s\": {}, \"queries\": [",
            start.elapsed().as_secs_f64()
        );
        for (at, values) in sets.iter().enumerate() {
            let timed = time(&*index, values, n_neighbors, n_single)?;
            write!(field, "{}{timed}", if at == 0 { "" } else { ", " })?;
        }
        fields.push(field + "]}");
    }
    fields.push(format!("\"peak_bytes\": {}", peak_bytes()?));
    writeln!(std::io::stdout(), "{{{}}}", fields.join(", "))?;
    Ok(())
}

/// One set of queries: in one batch, and some one at a time.
fn time(
    index: &dyn NeighborIndex,
    values: &[f64],
    n_neighbors: usize,
    n_single: usize,
) -> Result<String, Box<dyn Error>> {
    let width = index.n_features();
    let queries = MatrixView::new(values, width)?;
    let request = SearchRequest::new(queries, n_neighbors);
    // After a warm-up: the peers' threads run already when they are timed.
    let warm_up = MatrixView::new(&values[..width * queries.n_rows().min(64)], width)?;
    index.search(&SearchRequest::new(warm_up, n_neighbors))?;
    let mut query_s = f64::INFINITY;
    let mut sum = 0.0;
    for _ in 0..REPEATS {
        let start = Instant::now();
        let found = index.search(&request)?;
        query_s = query_s.min(start.elapsed().as_secs_f64() / queries.n_rows() as f64);
        sum = (0..found.n_queries())
            .filter_map(|query| found.of(query).last())
            .map(|last| last.distance)
            .sum();
    }
    let n_single = n_single.min(queries.n_rows());
    let start = Instant::now();
    for i in 0..n_single {
        let query = i * queries.n_rows() / n_single;
        let one = MatrixView::new(&values[query * width..(query + 1) * width], width)?;
        index.search(&SearchRequest::new(one, n_neighbors))?;
    }
    let single_s = start.elapsed().as_secs_f64() / n_single.max(1) as f64;
    // The sum of the K-th distances, by which the peer sees that the same was computed.
    Ok(format!(
        "{{\"query_s\": {query_s}, \"single_s\": {single_s}, \"sum\": {sum}}}"
    ))
}

fn read_f32(path: &str) -> Result<Vec<f32>, Box<dyn Error>> {
    use std::io::Read;
    let file = std::fs::File::open(path)?;
    let n = file.metadata()?.len() as usize / 4;
    let mut reader = std::io::BufReader::with_capacity(1 << 20, file);
    let mut values = Vec::with_capacity(n);
    let mut bytes = [0; 4];
    for _ in 0..n {
        reader.read_exact(&mut bytes)?;
        values.push(f32::from_le_bytes(bytes));
    }
    Ok(values)
}

/// `VmHWM` of this process.
fn peak_bytes() -> Result<u64, Box<dyn Error>> {
    let status = std::fs::read_to_string("/proc/self/status")?;
    let line = status
        .lines()
        .find(|line| line.starts_with("VmHWM"))
        .ok_or("no VmHWM")?;
    let kib = line.split_whitespace().nth(1).ok_or("no number in VmHWM")?;
    Ok(kib.parse::<u64>()? * 1024)
}
