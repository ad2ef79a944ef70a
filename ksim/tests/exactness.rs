//! Every exact engine gives the neighbors of `linear`, ties included, on every vector unit of the
//! machine, over data of all kinds.
//!
//! `KSIM_EXACTNESS_PAIRS` is how many pairs of a query and an engine to check, 30,000 unless set;
//! `KSIM_EXACTNESS_DATA` may name a file of raw little-endian f32 rows of 31 columns to add.

#![expect(clippy::unwrap_used, reason = "a test stops where a step fails")]

use std::ops::Range;
use std::sync::Arc;

use ksim::{
    Blocked, Clusters, KMeans, KdTree, Linear, Matrix, MatrixView, NeighborIndex, SearchRequest,
    Simd,
};

/// Repeatable numbers.
struct Noise(u64);

impl Noise {
    fn next(&mut self) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0
    }

    fn below(&mut self, n: usize) -> usize {
        (self.next() >> 11) as usize % n
    }

    /// In [−1, 1).
    fn uniform(&mut self) -> f64 {
        (self.next() >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    }

    /// Roughly normal, with variance 1.
    fn normal(&mut self) -> f64 {
        (0..6).map(|_| self.uniform()).sum::<f64>() / 2f64.sqrt()
    }
}

/// What the values of a case look like.
const KINDS: [&str; 10] = [
    "walk",
    "normal",
    "duplicates",
    "grid",
    "constant",
    "denormal",
    "huge",
    "outliers",
    "offset",
    "second plane",
];

fn rows(kind: &str, n: usize, width: usize, noise: &mut Noise) -> Vec<f64> {
    let mut at = vec![0.0; width];
    let distinct = n / 40 + 1;
    let mut values: Vec<f64> = Vec::with_capacity(n * width);
    for row in 0..n {
        if kind == "duplicates" && row >= distinct {
            let from = noise.below(distinct) * width;
            values.extend_from_within(from..from + width);
            continue;
        }
        for (column, at) in at.iter_mut().enumerate() {
            *at = if row % 500 == 0 {
                noise.normal()
            } else {
                0.97 * *at + 0.25 * noise.normal()
            };
            let value = match kind {
                "normal" | "duplicates" => noise.normal(),
                "grid" => noise.below(4) as f64,
                "constant" if column % 3 != 0 => 7.0,
                "denormal" => *at * 1e-41,
                "huge" => *at * 1e37,
                "outliers" if noise.below(300) == 0 => *at * 10f64.powi(noise.below(20) as i32),
                "offset" => *at + 1e6 * (column % 2) as f64,
                "second plane" => 1.0 + *at * 1e-9,
                _ => *at,
            };
            values.push(value);
        }
    }
    values
}

/// Half near the rows (some on them), half of their own.
fn queries(kind: &str, values: &[f64], n: usize, width: usize, noise: &mut Noise) -> Vec<f64> {
    let mut out = rows(kind, n, width, noise);
    for query in out.chunks_exact_mut(width).step_by(2) {
        let from = noise.below(values.len() / width) * width;
        query.copy_from_slice(&values[from..from + width]);
        if noise.below(4) != 0 {
            query
                .iter_mut()
                .for_each(|value| *value *= 1.0 + 0.1 * noise.normal());
        }
    }
    // And some far away.
    for query in out.chunks_exact_mut(width).step_by(17) {
        query
            .iter_mut()
            .for_each(|value| *value = (*value * 30.0).clamp(-3e38, 3e38));
    }
    out
}

struct Case {
    kind: String,
    width: usize,
    values: Vec<f64>,
    queries: Vec<f64>,
    n: usize,
    excluded: Option<Vec<Range<usize>>>,
}

/// Checks one case; returns the number of pairs.
fn check(case: &Case) -> usize {
    let Case { width, n, .. } = *case;
    let data = Arc::new(Matrix::from_f64(&case.values, width).unwrap());
    let queries = MatrixView::new(&case.queries, width).unwrap();
    let request = SearchRequest {
        queries,
        n_neighbors: n,
        excluded: case.excluded.as_deref(),
    };
    let expected = Linear::new(Arc::clone(&data)).search(&request).unwrap();
    let mut engines: Vec<(String, Box<dyn NeighborIndex>)> = Vec::new();
    let (blocked, one) = (
        Blocked::new(Arc::clone(&data)),
        Clusters::new(
            Arc::clone(&data),
            KMeans::from_centers(&vec![0.0; width], width, &data).unwrap(),
        ),
    );
    for simd in Simd::available() {
        engines.push((
            format!("blocked, {simd:?}"),
            Box::new(blocked.clone().with_simd(simd)),
        ));
    }
    // One cluster: the probe covers everything.
    engines.push(("clusters".to_owned(), Box::new(one)));
    if width <= KdTree::MAX_FEATURES {
        engines.push((
            "kd-tree".to_owned(),
            Box::new(KdTree::new(Arc::clone(&data)).unwrap()),
        ));
    }
    for (name, index) in &engines {
        let found = index.search(&request).unwrap();
        for query in 0..queries.n_rows() {
            assert_eq!(
                found.of(query),
                expected.of(query),
                "{name}: {} rows of {} x {width}, {n} neighbors, query {query}",
                case.kind,
                data.n_rows(),
            );
        }
    }
    // One query at a time takes another way through the engine.
    let single = 5.min(queries.n_rows());
    for query in 0..single {
        let view = MatrixView::new(queries.row(query), width).unwrap();
        let excluded = case.excluded.as_ref().map(|all| &all[query..=query]);
        let request = SearchRequest {
            queries: view,
            n_neighbors: n,
            excluded,
        };
        for (name, index) in &engines {
            let found = index.search(&request).unwrap();
            assert_eq!(
                found.of(0),
                expected.of(query),
                "{name}, alone: {}",
                case.kind
            );
        }
    }
    engines.len() * (queries.n_rows() + single)
}

fn case(kind: &str, round: usize, noise: &mut Noise) -> Case {
    let widths = [31, 2, 12, 3, 8, 31, 17, 5, 64, 31, 1, 130, 40];
    case_of(kind, widths[round % widths.len()], round, noise)
}

fn case_of(kind: &str, width: usize, round: usize, noise: &mut Noise) -> Case {
    // Without a sample, with one, and with a sample of the sample.
    let sizes = [3000, 300, 9000, 2100, 70_000];
    let n_rows = match width {
        ..=200 => sizes[(round + round / 5) % sizes.len()] + noise.below(40),
        _ => 2500,
    };
    let values = rows(kind, n_rows, width, noise);
    let n_queries = if n_rows > 20_000 || width > 40 {
        60
    } else {
        200
    };
    let queries = queries(kind, &values, n_queries, width, noise);
    let n = [50, 1, 7, 300, 50][noise.below(5)];
    let excluded = (round % 3 == 1).then(|| {
        let range = |_| {
            let start = noise.below(n_rows);
            start..(start + noise.below(n_rows)).min(n_rows)
        };
        (0..n_queries).map(range).collect()
    });
    Case {
        kind: kind.to_owned(),
        width,
        values,
        queries,
        n,
        excluded,
    }
}

#[test]
fn every_engine_finds_the_neighbors_of_the_oracle() {
    let wanted = std::env::var("KSIM_EXACTNESS_PAIRS").map_or(30_000, |n| n.parse().unwrap());
    let mut noise = Noise(0x5EED_CAFE);
    let (mut pairs, mut round) = (0, 0);
    while pairs < wanted {
        for (number, kind) in KINDS.iter().enumerate() {
            pairs += check(&case(kind, round + number, &mut noise));
        }
        round += 1;
    }
    assert!(pairs >= wanted);
}

/// Wider than what is summed of a query at once: 400 groups of four columns.
#[test]
fn wide_rows_too() {
    let mut noise = Noise(0xC0FFEE);
    for (round, width) in [512, 1601, 2500].into_iter().enumerate() {
        for kind in ["walk", "normal", "duplicates", "outliers", "huge"] {
            check(&case_of(kind, width, round, &mut noise));
        }
    }
}

#[test]
fn recorded_states_if_there_are_any() {
    let Ok(path) = std::env::var("KSIM_EXACTNESS_DATA") else {
        return;
    };
    let bytes = std::fs::read(&path).unwrap();
    let values: Vec<f64> = bytes
        .chunks_exact(4)
        .map(|b| f64::from(f32::from_le_bytes([b[0], b[1], b[2], b[3]])))
        .collect();
    let mut noise = Noise(77);
    let width = 31;
    let queries = queries("walk", &values, 4000, width, &mut noise);
    let case = Case {
        kind: path,
        width,
        values,
        queries,
        n: 50,
        excluded: None,
    };
    check(&case);
}
