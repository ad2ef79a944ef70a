//! The search bench measures what it says, and nothing but the times depends on the machine.

use ksim::{Search, Trajectories};
use ksim_bench_harness::search_bench::{
    Measurement, SearchBenchError, SearchPlan, SearchReport, SourcePart, StepSource, run,
};

fn plan() -> SearchPlan {
    SearchPlan {
        rows: vec![2000, 3000],
        widths: vec![3, 9],
        engines: Search::ALL.to_vec(),
        n_clusters: vec![4, 30],
        n_neighbors: 10,
        n_queries: 320,
        n_checked: 50,
        n_single: 5,
        threads: vec![1, 2],
        repeats: 1,
        n_resamples: 200,
        ..SearchPlan::default()
    }
}

fn report() -> SearchReport {
    let about = SourcePart {
        dataset: None,
        rollouts: Vec::new(),
    };
    let source = StepSource::Generated { seed: 0 };
    run(&source, about, &plan(), &mut |_| ()).expect("engines are measured")
}

#[test]
fn every_engine_is_measured_at_every_size_width_and_kind() {
    let report = report();
    // Six configurations of up to 8 columns (two of clusters), one less above; 2 sizes, 2 threads, 3 kinds.
    assert_eq!(report.measurements.len(), (6 + 5) * 2 * 2 * 3);
    for one in &report.measurements {
        assert!(one.query_s > 0.0 && one.n_queries == 320 && one.n_checked == 50);
        assert!(one.single_query_s.unwrap() > 0.0);
        assert_eq!(one.exact, one.approximation.is_none());
    }
}

#[test]
fn more_clusters_find_fewer_of_the_nearest_and_the_difference_is_that_of_the_scores() {
    let report = report();
    let of = |n_clusters: Option<usize>| {
        let is_it = |one: &&Measurement| {
            one.n_clusters == n_clusters
                && (one.n_rows, one.n_columns, one.threads) == (3000, 9, 1)
                && one.queries == "in-distribution"
        };
        report.measurements.iter().find(is_it).unwrap()
    };
    let (few, many) = (of(Some(4)), of(Some(30)));
    let recall = |one: &Measurement| one.approximation.unwrap().recall_at_k;
    assert!(recall(few) > recall(many) && recall(many) > 0.1 && recall(few) < 1.0);
    let difference = many.approximation.unwrap().score_difference;
    // Eight episodes, 40 steps of each: every query set has runs of one length, so the mean over episodes is that over steps.
    assert!((difference.value - (many.k_sim - of(None).k_sim)).abs() < 1e-9);
    let [low, high] = difference.interval.unwrap();
    assert!(low <= difference.value && difference.value <= high);
}

#[test]
fn all_but_the_times_repeats() {
    let untimed = |mut report: SearchReport| {
        for one in &mut report.measurements {
            (one.build_s, one.query_s, one.single_query_s) = (0.0, 0.0, None);
            one.memory_bytes = None;
        }
        report.measurements
    };
    let (one, other) = (untimed(report()), untimed(report()));
    assert_eq!(one, other);
    let scores = |threads: usize| {
        let of = one.iter().filter(move |one| one.threads == threads);
        of.map(|one| (one.k_sim, one.approximation))
            .collect::<Vec<_>>()
    };
    assert_eq!(scores(1), scores(2));
}

/// Episodes of very different lengths: a mean over episodes is another number than that over steps.
#[test]
fn the_difference_is_that_of_the_k_sims_beside_it() {
    let walk = |episodes: &[usize], pace: f64| {
        let mut data = Trajectories::new(3, 1).unwrap();
        for (episode, &n) in episodes.iter().enumerate() {
            let value = |i: usize| ((i + 31 * episode) as f64 * pace).sin() * (1 + episode) as f64;
            let states: Vec<f64> = (0..3 * n).map(value).collect();
            data.push(episode as i64, &states, &states[..n]).unwrap();
        }
        data
    };
    let source = StepSource::Recorded {
        dataset: walk(&[300, 300, 300], 0.37),
        rollouts: vec![("uneven".to_owned(), walk(&[7, 150, 20, 3], 0.53))],
        seed: 0,
    };
    let about = SourcePart {
        dataset: Some("d".to_owned()),
        rollouts: vec!["uneven".to_owned()],
    };
    let plan = SearchPlan {
        rows: vec![900],
        widths: vec![3],
        engines: vec![Search::Linear, Search::Clusters],
        n_clusters: vec![40],
        n_neighbors: 5,
        ..plan()
    };
    let report = run(&source, about, &plan, &mut |_| ()).unwrap();
    let exact = report.measurements.iter().find(|one| one.exact).unwrap();
    let clusters = report.measurements.iter().find(|one| !one.exact).unwrap();
    let difference = clusters.approximation.unwrap().score_difference;
    assert!(difference.value.abs() > 1e-4, "{difference:?}");
    assert!((difference.value - (clusters.k_sim - exact.k_sim)).abs() < 1e-9);
    let [low, high] = difference.interval.unwrap();
    assert!(low <= difference.value && difference.value <= high);
}

#[test]
fn a_plan_that_does_not_fit_is_refused() {
    let mut dataset = Trajectories::new(2, 1).unwrap();
    for episode in 0..3 {
        dataset
            .push(episode, &[0.0, 1.0, 2.0, 3.0], &[0.5, 0.5])
            .unwrap();
    }
    let source = StepSource::Recorded {
        dataset,
        rollouts: Vec::new(),
        seed: 0,
    };
    let about = SourcePart {
        dataset: Some("d".to_owned()),
        rollouts: Vec::new(),
    };
    let error = run(&source, about, &plan(), &mut |_| ()).unwrap_err();
    assert!(matches!(
        error,
        SearchBenchError::Width { asked: 3, found: 2 }
    ));
    for empty in [
        SearchPlan {
            engines: vec![Search::KdTree],
            widths: vec![31],
            ..plan()
        },
        SearchPlan {
            threads: Vec::new(),
            ..plan()
        },
        SearchPlan {
            rows: Vec::new(),
            ..plan()
        },
    ] {
        let about = SourcePart {
            dataset: None,
            rollouts: Vec::new(),
        };
        let generated = StepSource::Generated { seed: 0 };
        let error = run(&generated, about, &empty, &mut |_| ()).unwrap_err();
        assert!(matches!(error, SearchBenchError::EmptyPlan { .. }));
    }
}
