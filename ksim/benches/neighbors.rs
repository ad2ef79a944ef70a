//! Searches on trajectory-like data: `neighbors/<engine>/<rows>x<columns>`, per batch of queries.

#![expect(clippy::unwrap_used, reason = "a bench stops where a step fails")]

use std::hint::black_box;
use std::sync::Arc;

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use ksim::{
    Blocked, Clusters, KMeans, KdTree, Linear, Matrix, MatrixView, NeighborIndex, SearchRequest,
};

#[path = "support/random_walk.rs"]
mod random_walk;

use random_walk::random_walk;

const N_QUERIES: usize = 500;

fn bench(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("neighbors");
    group
        .sample_size(10)
        .throughput(Throughput::Elements(N_QUERIES as u64));
    for (rows, width) in [(100_000, 2), (100_000, 31)] {
        let data = Arc::new(Matrix::from_f32(random_walk(rows, width, 1), width).unwrap());
        let queries: Vec<f64> = random_walk(N_QUERIES, width, 2)
            .into_iter()
            .map(f64::from)
            .collect();
        let request = SearchRequest::new(MatrixView::new(&queries, width).unwrap(), 50);
        let clusters = KMeans::params(50).fit(&data).unwrap();
        let mut engines: Vec<Box<dyn NeighborIndex>> = vec![
            Box::new(Linear::new(Arc::clone(&data))),
            Box::new(Blocked::new(Arc::clone(&data))),
            Box::new(Clusters::new(Arc::clone(&data), clusters)),
        ];
        if width <= KdTree::MAX_FEATURES {
            engines.push(Box::new(KdTree::new(Arc::clone(&data)).unwrap()));
        }
        for index in engines {
            let id = BenchmarkId::new(index.engine(), format!("{rows}x{width}"));
            group.bench_function(id, |b| {
                b.iter(|| index.search(black_box(&request)).unwrap())
            });
        }
    }
    group.finish();
}

criterion_group!(benches, bench);
criterion_main!(benches);
