//! Times the engine on arrays that another program timed too: the Rust half of
//! `ksim/benches/compare_peers.py`.
//!
//! `peer_timings REFERENCE.f32 QUERIES.f32 WIDTH N_CLUSTERS N_NEIGHBORS ENGINE…` reads raw
//! little-endian row-major f32 and prints one JSON line: seconds for k-means, seconds per query
//! for every engine named, and the peak resident memory in bytes.

use std::error::Error;
use std::io::Write;
use std::sync::Arc;
use std::time::Instant;

use ksim::{
    Blocked, Clusters, KMeans, KdTree, Linear, Matrix, MatrixView, NeighborIndex, SearchRequest,
};

fn main() -> Result<(), Box<dyn Error>> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [
        reference,
        queries,
        width,
        n_clusters,
        n_neighbors,
        engines @ ..,
    ] = args.as_slice()
    else {
        return Err(
            "usage: peer_timings REFERENCE QUERIES WIDTH N_CLUSTERS N_NEIGHBORS ENGINE…".into(),
        );
    };
    let width: usize = width.parse()?;
    let data = Arc::new(Matrix::from_f32(read_f32(reference)?, width)?);
    let query_values: Vec<f64> = read_f32(queries)?.into_iter().map(f64::from).collect();
    let queries = MatrixView::new(&query_values, width)?;
    let request = SearchRequest::new(queries, n_neighbors.parse()?);
    let warm_up = MatrixView::new(&query_values[..width * queries.n_rows().min(64)], width)?;
    let first = SearchRequest::new(warm_up, n_neighbors.parse()?);
    let mut fields = vec![format!("\"rows\": {}", data.n_rows())];
    for engine in engines {
        let start = Instant::now();
        let index: Box<dyn NeighborIndex> = match engine.as_str() {
            "linear" => Box::new(Linear::new(Arc::clone(&data))),
            "blocked" => Box::new(Blocked::new(Arc::clone(&data))),
            "kd-tree" => Box::new(KdTree::new(Arc::clone(&data))?),
            "clusters" => {
                let kmeans = KMeans::params(n_clusters.parse()?).fit(&data)?;
                fields.push(format!(
                    "\"kmeans_s\": {}, \"kmeans_iterations\": {}, \"inertia\": {}",
                    start.elapsed().as_secs_f64(),
                    kmeans.n_iterations().unwrap_or(0),
                    kmeans.inertia()
                ));
                Box::new(Clusters::new(Arc::clone(&data), kmeans))
            }
            other => return Err(format!("unknown engine {other:?}").into()),
        };
        let built = start.elapsed().as_secs_f64();
        // After a warm-up: the peers' threads run already when they are timed.
        let mut per_query = f64::INFINITY;
        let mut found = index.search(&first)?;
        for _ in 0..repeats(engine) {
            let start = Instant::now();
            found = index.search(&request)?;
            per_query = per_query.min(start.elapsed().as_secs_f64() / queries.n_rows() as f64);
        }
        let last = found
            .of(found.n_queries() - 1)
            .last()
            .map_or(0.0, |n| n.distance);
        fields.push(format!(
            "\"{engine}\": {{\"build_s\": {built}, \"query_s\": {per_query}, \"last\": {last}}}"
        ));
    }
    fields.push(format!("\"peak_bytes\": {}", peak_bytes()?));
    writeln!(std::io::stdout(), "{{{}}}", fields.join(", "))?;
    Ok(())
}

/// Timed searches: one where a single one takes long.
fn repeats(engine: &str) -> usize {
    if matches!(engine, "linear" | "blocked") {
        1
    } else {
        3
    }
}

fn read_f32(path: &str) -> Result<Vec<f32>, Box<dyn Error>> {
    use std::io::Read;
    let file = std::fs::File::open(path)?;
    let n = file.metadata()?.len() as usize / 4;
    let mut reader = std::io::BufReader::new(file);
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
