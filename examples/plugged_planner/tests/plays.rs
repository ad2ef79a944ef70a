//! From a dataset to success, through the registry and the rollout loop that all planners share.

use std::num::NonZeroUsize;

use ksim_bench_harness::HarnessError;
use ksim_bench_harness::policy::{Planned, Policy, Random};
use ksim_bench_harness::record::{EpisodeTrace, Summary};
use ksim_bench_harness::recording::{About, ActionPrecision, Recording};
use ksim_bench_harness::rollout::{Continue, Observer, RolloutConfig, rollout};
use ksim_bench_harness::stats::BootstrapOptions;
use ksim_datasets::{Format, OpenOptions, WriteOptions};
use ksim_envs::ResetOptions;
use ksim_envs::toy::point_mass;
use ksim_envs::vector::VectorEnvironment;
use ksim_planners::{LoadOptions, Registry, SilentObserver, TrainRequest, conformance};
use plugged_planner::PushFamily;

struct Keep(Vec<EpisodeTrace>);

impl Observer for Keep {
    fn episode(&mut self, trace: EpisodeTrace) -> Result<Continue, HarnessError> {
        self.0.push(trace);
        Ok(Continue::Yes)
    }
}

fn play(policy: &mut dyn Policy) -> Vec<EpisodeTrace> {
    let one = || Box::new(point_mass(None)) as _;
    let mut environments = VectorEnvironment::new((0..4).map(|_| one()).collect()).unwrap();
    let config = RolloutConfig {
        n_episodes: 20,
        n_runs: 1,
        seed: 3,
        discount: 0.99,
        reset: ResetOptions::default(),
        reference: None,
    };
    let mut keep = Keep(Vec::new());
    rollout(&mut environments, policy, &config, &mut keep).unwrap();
    keep.0
}

#[test]
fn a_planner_of_another_crate_is_trained_loaded_and_played() {
    let environment = point_mass(None);
    let spec = ksim_envs::Environment::spec(&environment);
    let folder = tempfile::tempdir().unwrap();
    let data = folder.path().join("data.parquet");
    let mut recording =
        Recording::start(spec, &[], ActionPrecision::Double, folder.path()).unwrap();
    for trace in play(&mut Random::new(spec)) {
        recording.add(&trace).unwrap();
    }
    let options = WriteOptions::default();
    recording
        .finish(&data, Format::Parquet, &About::default(), &options)
        .unwrap()
        .unwrap();

    let mut registry = Registry::builtin();
    registry.register(Box::new(PushFamily)).unwrap();
    let source = ksim_datasets::open(&data, &OpenOptions::default()).unwrap();
    let run = folder.path().join("run");
    let family = registry.family("push").unwrap();
    family
        .train(
            &TrainRequest::default(),
            &*source,
            &run,
            &mut SilentObserver,
        )
        .unwrap();

    let load = || registry.load(&run, &LoadOptions::default()).unwrap();
    conformance::check(&load, &[0.5; 18]);
    let interval = NonZeroUsize::MIN;
    let mut policy = Planned::new("push".to_owned(), load(), interval, spec).unwrap();
    let records: Vec<_> = play(&mut policy)
        .into_iter()
        .map(|trace| trace.record)
        .collect();
    let summary = Summary::new(&records, &BootstrapOptions::default()).unwrap();
    assert_eq!(summary.success.unwrap().ever.value, 1.0);
}
