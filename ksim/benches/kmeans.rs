//! Fits to convergence on trajectory-like data: `kmeans/fit/<rows>x<columns>`.

#![expect(clippy::unwrap_used, reason = "a bench stops where a step fails")]

use std::hint::black_box;

use criterion::{BenchmarkId, Criterion, criterion_group, criterion_main};
use ksim::{KMeans, Matrix};

#[path = "support/random_walk.rs"]
mod random_walk;

use random_walk::random_walk;

fn bench(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("kmeans");
    group.sample_size(10);
    for (rows, width) in [(100_000, 2), (100_000, 31)] {
        let data = Matrix::from_f32(random_walk(rows, width, 1), width).unwrap();
        group.bench_function(BenchmarkId::new("fit", format!("{rows}x{width}")), |b| {
            b.iter(|| KMeans::params(50).fit(black_box(&data)).unwrap());
        });
    }
    group.finish();
}

criterion_group!(benches, bench);
criterion_main!(benches);
