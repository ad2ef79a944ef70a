//! Reading HDF5 into Arrow and into matrices.
//!
//! `read_minari/...` wants a Minari dataset in `$KSIM_BENCH_MINARI`, `read_d4rl/...` a D4RL file in
//! `$KSIM_BENCH_D4RL`; what is not given is left out. `scripts/bench_read.py` makes a large one of each and
//! compares with h5py.
#![expect(clippy::unwrap_used, reason = "a bench has nobody to report errors to")]
#![allow(missing_docs, reason = "criterion's macros make public items")]

use std::hint::black_box;
use std::path::{Path, PathBuf};

use criterion::{Criterion, criterion_group, criterion_main};
use ksim_datasets::{OpenOptions, Scan, TransitionOptions, TransitionReader, open, schema};

/// Opens the dataset and reads observations and actions of every row.
fn to_arrow(path: &Path) -> usize {
    let source = open(path, &OpenOptions::default()).unwrap();
    let names = source
        .schema()
        .fields()
        .iter()
        .map(|field| field.name().clone())
        .collect::<Vec<_>>();
    let wanted = |name: &String| {
        schema::belongs_to(name, schema::OBSERVATION) || schema::belongs_to(name, schema::ACTION)
    };
    let columns = Some(names.into_iter().filter(wanted).collect());
    let batches = source
        .scan(&Scan {
            columns,
            ..Scan::default()
        })
        .unwrap();
    batches
        .map(|batch| black_box(batch.unwrap()).num_rows())
        .sum()
}

fn to_matrix(path: &Path) -> usize {
    let source = open(path, &OpenOptions::default()).unwrap();
    let batches = TransitionReader::new(source.as_ref(), &TransitionOptions::default()).unwrap();
    batches
        .map(|batch| black_box(batch.unwrap()).n_rows())
        .sum()
}

fn read(criterion: &mut Criterion) {
    for (group, variable) in [
        ("read_minari", "KSIM_BENCH_MINARI"),
        ("read_d4rl", "KSIM_BENCH_D4RL"),
    ] {
        let Some(path) = std::env::var_os(variable).map(PathBuf::from) else {
            continue;
        };
        let mut group = criterion.benchmark_group(group);
        group.sample_size(10);
        group.bench_function("to_arrow", |bench| bench.iter(|| to_arrow(&path)));
        group.bench_function("to_matrix", |bench| bench.iter(|| to_matrix(&path)));
        group.finish();
    }
}

criterion_group!(benches, read);
criterion_main!(benches);
