//! k-means: exact labels, a true optimum of Lloyd's iteration, and the odd cases.

#![expect(clippy::unwrap_used, reason = "a test stops where a step fails")]

use ksim::{KMeans, KMeansError, Matrix};
use proptest::prelude::*;

fn nearest(centers: &[f64], point: &[f64]) -> u32 {
    let squared = |c: &[f64]| {
        c.iter()
            .zip(point)
            .map(|(a, b)| (a - b) * (a - b))
            .sum::<f64>()
    };
    let distances: Vec<f64> = centers.chunks_exact(point.len()).map(squared).collect();
    (0..distances.len())
        .min_by(|&a, &b| distances[a].total_cmp(&distances[b]))
        .unwrap() as u32
}

/// Clumps with noise, repeatable.
fn clumps(n: usize, width: usize) -> Vec<f64> {
    (0..n * width)
        .map(|i| {
            let (row, column) = (i / width, i % width);
            let clump = ((row % 7) * (column + 1)) as f64;
            clump + ((i * 2_654_435_761) % 1009) as f64 / 1009.0
        })
        .collect()
}

#[test]
fn labels_are_the_nearest_centers_and_centers_the_means() {
    for (n, width, k) in [(500, 3, 7), (3000, 31, 50), (2500, 2, 9), (700, 20, 130)] {
        let values = clumps(n, width);
        let data = Matrix::from_f64(&values, width).unwrap();
        let fitted = KMeans::params(k).tolerance(0.0).fit(&data).unwrap();
        assert!(fitted.converged() == Some(true), "{n} {width} {k}");
        for (point, &label) in values.chunks_exact(width).zip(fitted.labels()) {
            assert_eq!(label, nearest(fitted.centers(), point));
        }
        for (c, center) in fitted.centers().chunks_exact(width).enumerate() {
            let rows: Vec<&[f64]> = values
                .chunks_exact(width)
                .zip(fitted.labels())
                .filter(|(_, label)| **label == c as u32)
                .map(|(row, _)| row)
                .collect();
            assert!(!rows.is_empty(), "cluster {c} of {n} {width} {k} is empty");
            for (column, &value) in center.iter().enumerate() {
                let mean = rows.iter().map(|row| row[column]).sum::<f64>() / rows.len() as f64;
                assert!((mean - value).abs() < 1e-9);
            }
        }
    }
}

#[test]
fn the_same_bits_for_any_number_of_threads() {
    let data = Matrix::from_f64(&clumps(30_000, 11), 11).unwrap();
    let on = |threads| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap();
        let fitted = pool.install(|| KMeans::params(3).fit(&data).unwrap());
        let bits: Vec<u64> = fitted.centers().iter().map(|c| c.to_bits()).collect();
        (
            bits,
            fitted.labels().to_vec(),
            fitted.inertia().to_bits(),
            fitted.n_iterations(),
        )
    };
    assert_eq!(on(1), on(2));
    assert_eq!(on(1), on(5));
}

#[test]
fn seeds_differ_and_repeat() {
    let data = Matrix::from_f64(&clumps(900, 4), 4).unwrap();
    let fit = |seed| {
        KMeans::params(12)
            .seed(seed)
            .fit(&data)
            .unwrap()
            .centers()
            .to_vec()
    };
    assert_eq!(fit(3), fit(3));
    assert_ne!(fit(3), fit(4));
}

#[test]
fn fewer_distinct_rows_than_clusters() {
    let data = Matrix::from_f64(&[1.0, 1.0, 1.0, 2.0, 2.0, 2.0], 1).unwrap();
    let fitted = KMeans::params(4).fit(&data).unwrap();
    assert_eq!(fitted.inertia(), 0.0);
    assert_eq!(fitted.n_clusters(), 4);
    let same = Matrix::from_f64(&[5.0; 40], 4).unwrap();
    assert_eq!(KMeans::params(10).fit(&same).unwrap().inertia(), 0.0);
}

#[test]
fn one_cluster_is_the_mean_and_every_row_can_be_its_own() {
    let data = Matrix::from_f64(&[1.0, 2.0, 6.0], 1).unwrap();
    let one = KMeans::params(1).fit(&data).unwrap();
    assert_eq!(
        (one.centers(), one.labels()),
        ([3.0].as_slice(), [0, 0, 0].as_slice())
    );
    let mut own = KMeans::params(3).fit(&data).unwrap().centers().to_vec();
    own.sort_by(f64::total_cmp);
    assert_eq!(own, [1.0, 2.0, 6.0]);
}

#[test]
fn given_centers_assign_with_ties_to_the_smaller_number() {
    let data = Matrix::from_f64(&[0.0, 1.0, 2.0, 0.5], 1).unwrap();
    let given = KMeans::from_centers(&[2.0, 0.0, 1.0, 0.0], 1, &data).unwrap();
    assert_eq!(given.labels(), [1, 2, 0, 1]);
    assert!(matches!(
        KMeans::from_centers(&[0.0, 0.0], 2, &data),
        Err(KMeansError::CenterWidth {
            expected: 1,
            found: 2
        })
    ));
}

#[test]
fn impossible_parameters_are_typed_errors() {
    let data = Matrix::from_f64(&[0.0, 1.0], 1).unwrap();
    assert!(matches!(
        KMeans::params(0).fit(&data),
        Err(KMeansError::NoClusters)
    ));
    assert!(matches!(
        KMeans::params(3).fit(&data),
        Err(KMeansError::TooFewRows {
            n_rows: 2,
            n_clusters: 3
        })
    ));
    assert!(matches!(
        KMeans::params(1).tolerance(f64::NAN).fit(&data),
        Err(KMeansError::Tolerance { .. })
    ));
}

#[cfg(feature = "linfa")]
#[test]
fn linfa_finds_clusters_about_as_tight() {
    let data = Matrix::from_f64(&clumps(3000, 4), 4).unwrap();
    let params = KMeans::params(7);
    let ours = params.fit(&data).unwrap();
    let linfas = params
        .clone()
        .backend(ksim::KMeansBackend::Linfa)
        .fit(&data)
        .unwrap();
    assert_eq!(linfas.n_clusters(), 7);
    assert!(
        ours.inertia() <= linfas.inertia() * 1.05,
        "{} {}",
        ours.inertia(),
        linfas.inertia()
    );
}

proptest! {
    #[test]
    fn a_clump_far_away_gets_a_cluster(shift in 50.0f64..1e6) {
        let values: Vec<f64> =
            (0..200).map(|i| f64::from(i % 10) * 0.01 + if i < 20 { shift } else { 0.0 }).collect();
        let fitted = KMeans::params(2).fit(&Matrix::from_f64(&values, 1).unwrap()).unwrap();
        prop_assert!(fitted.labels()[..20].iter().all(|&l| l == fitted.labels()[0]));
        prop_assert!(fitted.labels()[20..].iter().all(|&l| l != fitted.labels()[0]));
    }
}
