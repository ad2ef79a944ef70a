//! A planner for the point mass from another crate: pushes towards the goal with what force is left.

use std::{collections::BTreeSet, path::Path};

use ksim_planners::*;

struct Push(PlannerSpec, BTreeSet<usize>);

impl Planner for Push {
    fn spec(&self) -> &PlannerSpec {
        &self.0
    }
    fn reset(&mut self, slot: usize, _seed: u64) -> Result<(), PlannerError> {
        self.1.insert(slot);
        Ok(())
    }
    fn plan(&mut self, request: &PlanRequest<'_>) -> Result<Candidates, PlannerError> {
        request.check(&self.0, |slot| self.1.contains(&slot))?;
        let states = request.observations.chunks_exact(2);
        Ok(Candidates {
            n_candidates: 1,
            horizon: 1,
            actions: states
                .map(|s| (2.2 - 2.0 * s[0] - 0.5 * s[1]) as f32)
                .collect(),
            scores: Vec::new(),
            novelties: Vec::new(),
            chosen: vec![0; request.slots.len()],
        })
    }
}

/// To be registered beside the others: `Registry::builtin().register(Box::new(PushFamily))`.
pub struct PushFamily;

impl PlannerFamily for PushFamily {
    fn id(&self) -> &'static str {
        "push"
    }
    fn summary(&self) -> &'static str {
        "pushes a point mass to its goal"
    }
    // A planner that learns reads `_data` here and writes what `load` needs.
    fn train(
        &self,
        _request: &TrainRequest,
        _data: &dyn ksim_datasets::DatasetSource,
        run: &Path,
        _observer: &mut dyn TrainObserver,
    ) -> Result<TrainSummary, PlannerError> {
        write_manifest(run, "push")?;
        Ok(TrainSummary {
            finished: true,
            ..TrainSummary::default()
        })
    }
    fn load(&self, _run: &Path, _: &LoadOptions) -> Result<Box<dyn Planner>, PlannerError> {
        let (family, horizon) = ("push".to_owned(), 1);
        let spec = PlannerSpec {
            family,
            observation_dim: 2,
            action_dim: 1,
            horizon,
        };
        Ok(Box::new(Push(spec, BTreeSet::new())))
    }
}
