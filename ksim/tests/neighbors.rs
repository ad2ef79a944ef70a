//! One suite for every search engine: `linear` is the oracle, the others must give its neighbors
//! in its order, ties included.

#![expect(clippy::unwrap_used, reason = "a test stops where a step fails")]

use std::ops::Range;
use std::sync::Arc;

use ksim::{
    Blocked, Clusters, KMeans, KdTree, Linear, Matrix, MatrixView, Neighbor, NeighborIndex,
    Neighbors, SearchError, SearchRequest,
};
use proptest::prelude::*;

type Build = fn(&Arc<Matrix>) -> Box<dyn NeighborIndex>;

/// The exact engines; the tree only where it is compiled for the width.
fn exact_engines(width: usize) -> Vec<Build> {
    let mut engines: Vec<Build> = vec![
        |data| Box::new(Linear::new(Arc::clone(data))),
        |data| Box::new(Blocked::new(Arc::clone(data))),
        // With one cluster the probe covers everything, so this engine must be exact too.
        |data| Box::new(clusters(data, 1)),
    ];
    if width <= KdTree::MAX_FEATURES {
        engines.push(|data| Box::new(KdTree::new(Arc::clone(data)).unwrap()));
    }
    engines
}

fn clusters(data: &Arc<Matrix>, n_clusters: usize) -> Clusters {
    Clusters::new(
        Arc::clone(data),
        KMeans::params(n_clusters).fit(data).unwrap(),
    )
}

fn matrix(values: &[f64], width: usize) -> Arc<Matrix> {
    Arc::new(Matrix::from_f64(values, width).unwrap())
}

fn search(index: &dyn NeighborIndex, queries: &[f64], n: usize) -> Neighbors {
    let queries = MatrixView::new(queries, index.n_features()).unwrap();
    index.search(&SearchRequest::new(queries, n)).unwrap()
}

/// By sorting everything: independent of what the engines share.
fn by_sorting(data: &Matrix, query: &[f64], n: usize, excluded: &Range<usize>) -> Vec<Neighbor> {
    let mut all: Vec<(f64, u32)> = (0..data.n_rows())
        .filter(|row| !excluded.contains(row))
        .map(|row| (data.squared_distance(row, query), row as u32))
        .collect();
    all.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    all.truncate(n);
    all.into_iter()
        .map(|(d, row)| Neighbor {
            row,
            distance: d.sqrt(),
        })
        .collect()
}

#[track_caller]
fn check(values: &[f64], queries: &[f64], width: usize, n: usize) {
    let data = matrix(values, width);
    for build in exact_engines(width) {
        let index = build(&data);
        let found = search(&*index, queries, n);
        for (query, row) in queries.chunks_exact(width).enumerate() {
            let expected = by_sorting(&data, row, n, &(0..0));
            assert_eq!(
                found.of(query),
                expected,
                "{} at query {query}",
                index.engine()
            );
        }
    }
}

/// Repeatable numbers in [-1, 1).
fn noise(n: usize, seed: u64) -> Vec<f64> {
    let mut state = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1;
    (0..n)
        .map(|_| {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            (state >> 11) as f64 / (1u64 << 52) as f64 - 1.0
        })
        .collect()
}

#[test]
fn one_row() {
    check(&[1.0, 2.0], &[0.0, 0.0, 1.0, 2.0], 2, 3);
}

#[test]
fn random_rows_at_every_width() {
    for width in [1, 2, 3, 4, 5, 7, 8, 9, 15, 16, 17, 31, 64, 130] {
        check(&noise(width * 300, 1), &noise(width * 5, 2), width, 20);
    }
}

#[test]
fn more_rows_than_a_tile_and_a_batch() {
    check(&noise(6000 * 9, 3), &noise(300 * 9, 4), 9, 50);
    check(&noise(6000 * 2, 3), &noise(600 * 2, 4), 2, 50);
}

#[test]
fn ties_and_duplicates_go_to_the_smaller_row() {
    // A grid: from a grid point or a center of a cell, distances come in large ties.
    let grid: Vec<f64> = (0..400)
        .flat_map(|i| [f64::from(i % 20), f64::from(i / 20)])
        .collect();
    let queries = [5.0, 5.0, 5.5, 5.5, 0.0, 0.0, -3.0, 7.0, 100.0, 100.0];
    for n in [1, 3, 4, 5, 50, 399, 400, 500] {
        check(&grid, &queries, 2, n);
    }
    check(&[0.25; 300 * 3], &[0.25, 0.25, 0.25, 1.0, 0.0, 0.0], 3, 50);
    check(&[0.1; 300 * 12], &[0.1; 24], 12, 50);
}

#[test]
fn constant_columns_and_wild_magnitudes() {
    let constant: Vec<f64> = noise(500, 5)
        .into_iter()
        .flat_map(|v| [v, 7.0, 0.0])
        .collect();
    check(&constant, &[0.3, 7.0, 0.0, 0.0, 9.0, 1.0], 3, 20);
    for scale in [1e-44, 1e-38, 1e-30, 1e-22, 1e-20, 1e-12, 1e6, 1e15, 1e30] {
        for width in [2, 10] {
            let scaled = |seed, n: usize| -> Vec<f64> {
                noise(n * width, seed)
                    .into_iter()
                    .map(|v| v * scale)
                    .collect()
            };
            check(&scaled(6, 400), &scaled(7, 4), width, 20);
        }
    }
    // One far row must not blur the near ones.
    let mut mixed = noise(300 * 10, 8);
    mixed[50] = 3e20;
    check(&mixed, &noise(40, 9), 10, 20);
}

/// All rows within the f32 bound of each other, so that the first pass can drop none: it must not
/// carry them all along (which took minutes for what follows).
#[test]
fn ties_and_far_queries_stay_cheap() {
    let width = 12;
    let equal = vec![0.5; 60_000 * width];
    let random = noise(60_000 * width, 20);
    let far: Vec<f64> = noise(4 * width, 21).into_iter().map(|v| v * 1e9).collect();
    let farther: Vec<f64> = far.iter().map(|v| v * 1e15).collect();
    for (values, queries) in [
        (&equal, &far),
        (&equal, &vec![0.5; width]),
        (&random, &far),
        (&random, &farther),
    ] {
        let data = matrix(values, width);
        for index in [
            Box::new(Blocked::new(Arc::clone(&data))) as Box<dyn NeighborIndex>,
            Box::new(clusters(&data, 1)),
        ] {
            let found = search(&*index, queries, 50);
            for (query, row) in queries.chunks_exact(width).enumerate() {
                assert_eq!(
                    found.of(query),
                    by_sorting(&data, row, 50, &(0..0)),
                    "{}",
                    index.engine()
                );
            }
        }
    }
}

#[test]
fn differences_below_f32_are_seen() {
    // All rows equal in f32; only the second plane tells them apart.
    let values: Vec<f64> = noise(200, 10)
        .into_iter()
        .flat_map(|v| (0..10).map(move |_| 1.0 + v * 1e-9))
        .collect();
    check(&values, &[1.0; 10], 10, 20);
    let narrow: Vec<f64> = noise(400, 10).into_iter().map(|v| 1.0 + v * 1e-9).collect();
    check(&narrow, &[1.0, 1.0], 2, 20);
}

#[test]
fn excluded_rows_are_not_found() {
    for width in [2, 12] {
        let data = matrix(&noise(400 * width, 11), width);
        let values = noise(6 * width, 12);
        let queries = MatrixView::new(&values, width).unwrap();
        let excluded = [0..100, 100..250, 0..400, 399..400, 0..0, 5..390];
        let request = SearchRequest {
            queries,
            n_neighbors: 20,
            excluded: Some(&excluded),
        };
        for build in exact_engines(width) {
            let index = build(&data);
            let found = index.search(&request).unwrap();
            for (query, excluded) in excluded.iter().enumerate() {
                let expected = by_sorting(&data, queries.row(query), 20, excluded);
                assert_eq!(found.of(query), expected, "{} at {query}", index.engine());
            }
        }
    }
}

#[test]
fn clusters_search_exactly_inside_the_nearest_cluster() {
    let width = 6;
    let data = matrix(&noise(3000 * width, 13), width);
    let index = clusters(&data, 12);
    let values = noise(200 * width, 14);
    let found = search(&index, &values, 15);
    for (query, point) in values.chunks_exact(width).enumerate() {
        let cluster = index.kmeans().nearest_center(point);
        assert_eq!(found.cluster(query), Some(cluster));
        let labels = index.kmeans().labels();
        let mut members: Vec<(f64, u32)> = (0..data.n_rows())
            .filter(|&row| labels[row] == cluster)
            .map(|row| (data.squared_distance(row, point), row as u32))
            .collect();
        members.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let rows: Vec<u32> = found.of(query).iter().map(|n| n.row).collect();
        let expected: Vec<u32> = members.iter().take(15).map(|m| m.1).collect();
        assert_eq!(rows, expected);
    }
}

#[test]
fn a_small_cluster_gives_all_it_has() {
    // Two far clumps; the smaller has 3 rows, fewer than the 10 asked for.
    let values: Vec<f64> = (0..40)
        .map(|i| if i < 3 { 100.0 } else { f64::from(i) * 0.01 })
        .collect();
    let index = clusters(&matrix(&values, 1), 2);
    assert_eq!(search(&index, &[99.0], 10).of(0).len(), 3);
}

#[test]
fn wrong_requests_are_typed_errors() {
    let data = matrix(&noise(60, 15), 3);
    let wide = MatrixView::new(&[0.0; 4], 4).unwrap();
    let fitting = MatrixView::new(&[0.0; 6], 3).unwrap();
    for build in exact_engines(3) {
        let index = build(&data);
        assert_eq!(
            index.search(&SearchRequest::new(wide, 1)),
            Err(SearchError::DimensionMismatch {
                expected: 3,
                found: 4
            })
        );
        assert_eq!(
            index.search(&SearchRequest::new(fitting, 0)),
            Err(SearchError::NoNeighbors)
        );
        let one = std::array::from_fn::<_, 1, _>(|_| 0..1);
        let request = SearchRequest {
            queries: fitting,
            n_neighbors: 1,
            excluded: Some(&one),
        };
        let count = SearchError::ExclusionCount {
            expected: 2,
            found: 1,
        };
        assert_eq!(index.search(&request), Err(count));
    }
    let nine = matrix(&[0.0; 18], 9);
    assert!(matches!(
        KdTree::new(nine),
        Err(SearchError::TooWideForTree {
            largest: 8,
            found: 9
        })
    ));
}

#[test]
fn answers_do_not_depend_on_threads() {
    let width = 12;
    let data = matrix(&noise(70_000 * width, 16), width);
    // So many rows that the clusters, too, look at rounded ones.
    let kmeans = KMeans::params(5).fit(&data).unwrap();
    let engines: [Box<dyn NeighborIndex>; 2] = [
        Box::new(Blocked::new(Arc::clone(&data))),
        Box::new(Clusters::new(Arc::clone(&data), kmeans)),
    ];
    for index in engines {
        for n_queries in [1, 3, 40, 2000] {
            let queries = noise(n_queries * width, 17);
            let on = |threads: usize| {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
                pool.build()
                    .unwrap()
                    .install(|| search(&*index, &queries, 10))
            };
            let alone = on(1);
            for threads in [2, 7] {
                assert!(
                    on(threads) == alone,
                    "{}: {n_queries} queries on {threads} threads",
                    index.engine()
                );
            }
        }
    }
}

#[test]
fn more_neighbors_than_there_are_rows_are_all_rows() {
    for (n_rows, width) in [(300, 3), (9000, 12)] {
        let data = matrix(&noise(n_rows * width, 18), width);
        let expected = search(
            &Linear::new(Arc::clone(&data)),
            &noise(2 * width, 19),
            n_rows,
        );
        let engines: [Box<dyn NeighborIndex>; 3] = [
            Box::new(Linear::new(Arc::clone(&data))),
            Box::new(Blocked::new(Arc::clone(&data))),
            Box::new(clusters(&data, 1)),
        ];
        for index in engines {
            let found = search(&*index, &noise(2 * width, 19), usize::MAX);
            assert!(found.of(0) == expected.of(0), "{}", index.engine());
            assert_eq!(found.of(1).len(), n_rows);
        }
    }
}

#[test]
fn an_empty_index_finds_nothing() {
    for width in [2, 12] {
        let data = matrix(&[], width);
        let engines: [Build; 2] = [
            |data| Box::new(Linear::new(Arc::clone(data))),
            |data| Box::new(Blocked::new(Arc::clone(data))),
        ];
        for build in engines {
            assert!(
                search(&*build(&data), &vec![0.0; width], 5)
                    .of(0)
                    .is_empty()
            );
        }
    }
    let tree = KdTree::new(matrix(&[], 2)).unwrap();
    assert!(search(&tree, &[0.0, 0.0], 5).of(0).is_empty());
}

proptest! {
    /// Coarse values make ties and duplicates likely.
    #[test]
    fn coarse_rows_match_the_oracle(
        width in 1usize..12,
        values in prop::collection::vec(-3i8..4, 1..600),
        query in prop::collection::vec(-4i8..5, 12),
        n in 1usize..70,
    ) {
        let rows = values.len() / width;
        prop_assume!(rows > 0);
        let values: Vec<f64> = values[..rows * width].iter().map(|&v| f64::from(v) / 3.0).collect();
        let query: Vec<f64> = query[..width].iter().map(|&v| f64::from(v) / 3.0).collect();
        check(&values, &query, width, n);
    }
}
