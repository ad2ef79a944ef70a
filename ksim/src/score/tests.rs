use super::*;
use crate::Matrix;

/// Reference on a line, actions alternating, and rollouts beside it.
fn line() -> (Trajectories, Trajectories) {
    let mut reference = Trajectories::new(2, 1).unwrap();
    for episode in 0..4i64 {
        let states: Vec<f64> = (0..30)
            .flat_map(|t| [t as f64 + episode as f64 * 0.25, episode as f64])
            .collect();
        let actions: Vec<f64> = (0..30).map(|t| f64::from(t % 3) - 1.0).collect();
        reference.push(episode, &states, &actions).unwrap();
    }
    let mut rollouts = Trajectories::new(2, 1).unwrap();
    for episode in 0..3i64 {
        let n = 10 + episode as usize * 5;
        let states: Vec<f64> = (0..n)
            .flat_map(|t| [t as f64 * 1.7, 0.4 * episode as f64])
            .collect();
        let actions: Vec<f64> = (0..n).map(|t| (t as f64).sin()).collect();
        rollouts.push(episode, &states, &actions).unwrap();
    }
    (reference, rollouts)
}

/// The definition, word by word, in plain loops.
fn by_definition(reference: &Trajectories, rollouts: &Trajectories, k: usize) -> Vec<(u32, f64)> {
    let column = |m: &Matrix, c: usize| (0..m.n_rows()).map(|r| m.value(r, c)).collect::<Vec<_>>();
    let z = |m: &Matrix, from: &Matrix| -> Vec<Vec<f64>> {
        let stats: Vec<(f64, f64)> = (0..m.n_features())
            .map(|c| {
                let values = column(from, c);
                let n = values.len() as f64;
                let mean = values.iter().sum::<f64>() / n;
                let std = (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n).sqrt();
                (mean, if std < 1e-6 { 1.0 } else { std })
            })
            .collect();
        (0..m.n_rows())
            .map(|r| {
                (0..m.n_features())
                    .map(|c| (m.value(r, c) - stats[c].0) / stats[c].1)
                    .collect()
            })
            .collect()
    };
    let dist = |a: &[f64], b: &[f64]| {
        a.iter()
            .zip(b)
            .map(|(a, b)| (a - b).powi(2))
            .sum::<f64>()
            .sqrt()
    };
    let (rs, ra) = (
        z(&reference.states, &reference.states),
        z(&reference.actions, &reference.actions),
    );
    let (ts, ta) = (
        z(&rollouts.states, &reference.states),
        z(&rollouts.actions, &reference.actions),
    );
    ts.iter()
        .zip(&ta)
        .map(|(s, a)| {
            let mut order: Vec<usize> = (0..rs.len()).collect();
            order.sort_by(|&i, &j| dist(&rs[i], s).total_cmp(&dist(&rs[j], s)).then(i.cmp(&j)));
            let best = order[..k.min(order.len())]
                .iter()
                .copied()
                .min_by(|&i, &j| dist(&ra[i], a).total_cmp(&dist(&ra[j], a)))
                .unwrap();
            (best as u32, dist(&rs[best], s).hypot(dist(&ra[best], a)))
        })
        .collect()
}

#[test]
fn every_exact_search_follows_the_definition() {
    let (reference, rollouts) = line();
    let expected = by_definition(&reference, &rollouts, 7);
    for search in [
        Search::Linear,
        Search::KdTree,
        Search::Blocked,
        Search::Auto,
    ] {
        let ksim = KSim::params()
            .n_neighbors(7)
            .search(search)
            .fit(reference.clone())
            .unwrap();
        assert!(ksim.index().is_exact());
        let report = ksim.score(&rollouts).unwrap();
        for (step, (row, distance)) in report.steps.iter().zip(&expected) {
            assert_eq!(step.reference_row, *row, "{search}");
            assert!((step.distance - distance).abs() < 1e-12, "{search}");
            assert!((step.score - (0.5 * 3f64.sqrt() / distance).min(1.0)).abs() < 1e-12);
        }
    }
}

#[test]
fn aggregates_are_what_their_names_say() {
    let (reference, rollouts) = line();
    let report = KSim::params()
        .fit(reference)
        .unwrap()
        .score(&rollouts)
        .unwrap();
    let pooled = report.steps.iter().map(|s| s.score).sum::<f64>() / report.steps.len() as f64;
    assert!((report.state_action.pooled - pooled).abs() < 1e-15);
    assert_eq!(
        report
            .episodes
            .iter()
            .map(|e| e.n_steps)
            .collect::<Vec<_>>(),
        [10, 15, 20]
    );
    let first = report.steps[..10].iter().map(|s| s.score).sum::<f64>() / 10.0;
    assert!((report.episodes[0].k_sim - first).abs() < 1e-15);
    let mean = report.episodes.iter().map(|e| e.k_sim).sum::<f64>() / 3.0;
    assert!((report.state_action.episode_mean - mean).abs() < 1e-15);
    let [low, high] = report.state_action.interval_95.unwrap();
    assert!(low <= mean && mean <= high);
    let saturated = report.steps.iter().filter(|s| s.score == 1.0).count();
    assert_eq!(report.saturated_share, saturated as f64 / 45.0);
}

#[test]
fn a_dataset_against_itself_needs_the_exclusion() {
    let (reference, _) = line();
    for search in [
        Search::Linear,
        Search::KdTree,
        Search::Blocked,
        Search::Clusters,
    ] {
        let params = KSim::params().n_neighbors(5).search(search);
        let ksim = params
            .kmeans(crate::KMeans::params(4))
            .fit(reference.clone())
            .unwrap();
        assert_eq!(ksim.score(&reference).unwrap().state_action.pooled, 1.0);
        let mut options = ScoreOptions {
            exclude_same_episode: true,
            progress: None,
        };
        let report = ksim.score_with(&reference, &mut options).unwrap();
        for (row, step) in report.steps.iter().enumerate() {
            assert_ne!(
                ksim.reference_step(step.reference_row).0,
                row as i64 / 30,
                "{search}"
            );
        }
        assert!(report.mean_scaled_distance > 0.0);
    }
}

#[test]
fn exclusion_refuses_other_data() {
    let (reference, rollouts) = line();
    let ksim = KSim::params().fit(reference).unwrap();
    let mut options = ScoreOptions {
        exclude_same_episode: true,
        progress: None,
    };
    assert!(matches!(
        ksim.score_with(&rollouts, &mut options),
        Err(ScoreError::NotSelf { episode_index: 0 })
    ));
}

#[test]
fn an_only_episode_cannot_exclude_itself() {
    let mut data = Trajectories::new(1, 1).unwrap();
    data.push(7, &[0.0, 1.0], &[0.0, 1.0]).unwrap();
    for search in [Search::Linear, Search::KdTree, Search::Blocked] {
        let ksim = KSim::params().search(search).fit(data.clone()).unwrap();
        let mut options = ScoreOptions {
            exclude_same_episode: true,
            progress: None,
        };
        assert!(matches!(
            ksim.score_with(&data, &mut options),
            Err(ScoreError::NoCandidate {
                episode_index: 7,
                step_index: 0
            })
        ));
    }
}

#[test]
fn the_approximation_is_measured_against_the_truth() {
    let (reference, rollouts) = line();
    let exact = KSim::params().n_neighbors(7).fit(reference).unwrap();
    let none = ApproximationError::measure(&exact, &exact, &rollouts, false).unwrap();
    assert_eq!(
        (
            none.recall,
            none.match_differs_share,
            none.max_score_difference
        ),
        (1.0, 0.0, 0.0)
    );
    let clusters = exact.with_search(Search::Clusters).unwrap();
    let some = ApproximationError::measure(&clusters, &exact, &rollouts, false).unwrap();
    assert!(some.recall < 1.0 && some.match_differs_share > 0.0);
    assert!(some.max_score_difference >= some.mean_score_difference.abs());
    // From answers that are there already it is the same.
    let states = exact
        .normalizers()
        .0
        .normalized_rows(rollouts.states(), 0..rollouts.n_rows());
    let answers = |ksim: &KSim| {
        let queries = MatrixView::new(&states, 2).unwrap();
        let found = ksim.index().search(&SearchRequest::new(queries, 7));
        (found.unwrap(), ksim.score(&rollouts).unwrap())
    };
    let (own, truth) = (answers(&clusters), answers(&exact));
    let between = ApproximationError::between((&own.0, &own.1), (&truth.0, &truth.1));
    assert_eq!(between, some);
}

#[test]
fn bad_requests_are_typed_errors() {
    let (reference, rollouts) = line();
    let empty = Trajectories::new(2, 1).unwrap();
    let fit = |params: KSimParams| params.fit(reference.clone());
    assert!(matches!(
        KSim::params().fit(empty.clone()),
        Err(ScoreError::EmptyReference)
    ));
    assert!(matches!(
        fit(KSim::params().gamma(0.0)),
        Err(ScoreError::Gamma { .. })
    ));
    assert!(matches!(
        fit(KSim::params().gamma(f64::NAN)),
        Err(ScoreError::Gamma { .. })
    ));
    assert!(matches!(
        fit(KSim::params().n_neighbors(0)),
        Err(ScoreError::Search(_))
    ));
    let ksim = fit(KSim::params()).unwrap();
    assert!(matches!(ksim.score(&empty), Err(ScoreError::EmptyRollouts)));
    let mut wide = Trajectories::new(3, 1).unwrap();
    wide.push(0, &[0.0; 3], &[0.0]).unwrap();
    assert!(matches!(
        ksim.score(&wide),
        Err(ScoreError::WidthMismatch {
            part: "state",
            expected: 2,
            found: 3
        })
    ));
    assert!(ksim.score(&rollouts).is_ok());
}

#[test]
fn scores_do_not_depend_on_threads() {
    let (reference, rollouts) = line();
    let on = |threads| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap();
        pool.install(|| {
            let params = KSim::params()
                .search(Search::Clusters)
                .kmeans(crate::KMeans::params(9));
            params
                .fit(reference.clone())
                .unwrap()
                .score(&rollouts)
                .unwrap()
        })
    };
    assert_eq!(on(1), on(4));
}

#[test]
fn a_state_beyond_the_range_of_the_engine_is_placed() {
    let mut reference = Trajectories::new(1, 1).unwrap();
    reference
        .push(0, &[0.0, 1e-5, 2e-5], &[0.0, 0.5, 1.0])
        .unwrap();
    let ksim = KSim::params().fit(reference).unwrap();
    let mut rollouts = Trajectories::new(1, 1).unwrap();
    rollouts.push(3, &[0.0, 0.0, 3e38], &[0.0; 3]).unwrap();
    let Err(ScoreError::Data(error)) = ksim.score(&rollouts) else {
        panic!("a finite score of an infinite distance");
    };
    assert!(matches!(
        error,
        DataError::NonFiniteStep {
            episode_index: 3,
            step_index: 2,
            ..
        }
    ));
    assert!(error.to_string().len() < 160, "{error}");
}
