//! A planner as a policy.

use std::num::NonZeroUsize;
use std::sync::Arc;

use ksim_envs::EnvironmentSpec;
use ksim_planners::{PlanRequest, Planner, PlannerError};

use super::{Annotation, EpisodeStart, Policy, PolicyError, mlp};

/// What is told of every step: how novel the plan under way is to the planner, and how it scores it.
pub const ANNOTATIONS: [Annotation; 2] = [
    Annotation { name: "novelty" },
    Annotation { name: "plan_score" },
];

/// Executes the first actions of the plan that a planner chooses, then asks for the next one.
///
/// Observations reach the planner as the environment gives them: in the order of its parts, in which planners are
/// trained. Actions are clipped to the action space. Slots that want a plan at the same time are planned together.
/// A plan that is shorter than the replan interval is executed to its end.
pub struct Planned {
    name: String,
    planner: Box<dyn Planner>,
    replan_interval: NonZeroUsize,
    observation_dim: usize,
    low: Vec<f64>,
    high: Vec<f64>,
    slots: Vec<Plan>,
    /// The slots that want a plan, and their observations row by row.
    wanting: Vec<usize>,
    observations: Vec<f64>,
}

/// The plan of a slot.
#[derive(Debug, Clone, Default)]
struct Plan {
    /// Actions that are to be executed, row by row.
    actions: Vec<f64>,
    /// Numbers of them that were.
    done: usize,
    /// As in [`ANNOTATIONS`].
    notes: [f64; 2],
}

impl Planned {
    /// A planner that acts in `environment` and is asked anew every `replan_interval` steps.
    ///
    /// # Errors
    /// A planner of other widths than the environment's.
    pub fn new(
        name: String,
        planner: Box<dyn Planner>,
        replan_interval: NonZeroUsize,
        environment: &EnvironmentSpec,
    ) -> Result<Self, PolicyError> {
        let spec = planner.spec();
        let observation_dim = environment.observation_dim();
        for (what, found, expected) in [
            ("observations", spec.observation_dim, observation_dim),
            ("actions", spec.action_dim, environment.action_dim()),
        ] {
            if found != expected {
                return Err(mlp::width(&name, what, found, environment, expected));
            }
        }
        Ok(Self {
            name,
            planner,
            replan_interval,
            observation_dim,
            low: environment.action_low.clone(),
            high: environment.action_high.clone(),
            slots: Vec::new(),
            wanting: Vec::new(),
            observations: Vec::new(),
        })
    }

    /// Plans for the slots whose plan is used up.
    fn replan(&mut self, slots: &[usize], observations: &[f64]) -> Result<(), PlannerError> {
        let action_dim = self.low.len();
        self.wanting.clear();
        self.observations.clear();
        for (&slot, observation) in slots
            .iter()
            .zip(observations.chunks_exact(self.observation_dim))
        {
            let plan = &self.slots[slot];
            if plan.done * action_dim == plan.actions.len() {
                self.wanting.push(slot);
                self.observations.extend_from_slice(observation);
            }
        }
        if self.wanting.is_empty() {
            return Ok(());
        }
        let candidates = self.planner.plan(&PlanRequest {
            slots: &self.wanting,
            observations: &self.observations,
        })?;
        candidates.check(self.planner.spec(), self.wanting.len())?;
        let per_plan = candidates.horizon * action_dim;
        let n_executed = self.replan_interval.get().min(candidates.horizon) * action_dim;
        for (place, &slot) in self.wanting.iter().enumerate() {
            let row = place * candidates.n_candidates + candidates.chosen[place];
            let plan = &mut self.slots[slot];
            plan.done = 0;
            plan.actions.clear();
            let chosen = &candidates.actions[row * per_plan..][..n_executed];
            plan.actions
                .extend(chosen.iter().map(|value| f64::from(*value)));
            let note = |values: &[f64]| values.get(row).copied().unwrap_or(f64::NAN);
            plan.notes = [note(&candidates.novelties), note(&candidates.scores)];
        }
        Ok(())
    }
}

impl Policy for Planned {
    fn name(&self) -> &str {
        &self.name
    }

    fn start_episode(
        &mut self,
        slot: usize,
        start: &EpisodeStart,
    ) -> Result<Option<NonZeroUsize>, PolicyError> {
        if self.slots.len() <= slot {
            self.slots.resize_with(slot + 1, Plan::default);
        }
        self.slots[slot] = Plan::default();
        let reset = self.planner.reset(slot, start.seed);
        reset.map_err(|error| PolicyError::Planner(Arc::new(error)))?;
        Ok(None)
    }

    /// If the planner fails, it does so for all slots that were to be planned together; slots with a plan go on.
    fn act(
        &mut self,
        slots: &[usize],
        observations: &[f64],
        actions: &mut [f64],
    ) -> Result<(), Vec<(usize, PolicyError)>> {
        let action_dim = self.low.len();
        let failed = self.replan(slots, observations).err();
        for (&slot, action) in slots.iter().zip(actions.chunks_exact_mut(action_dim)) {
            let plan = &mut self.slots[slot];
            let Some(next) = plan.actions.chunks_exact(action_dim).nth(plan.done) else {
                continue;
            };
            for (k, value) in action.iter_mut().enumerate() {
                *value = next[k].clamp(self.low[k], self.high[k]);
            }
            plan.done += 1;
        }
        let Some(error) = failed else {
            return Ok(());
        };
        let error = Arc::new(error);
        let failure = |&slot| (slot, PolicyError::Planner(Arc::clone(&error)));
        Err(self.wanting.iter().map(failure).collect())
    }

    fn annotations(&self) -> &'static [Annotation] {
        &ANNOTATIONS
    }

    fn annotate(&self, slot: usize, out: &mut [f64]) {
        out.copy_from_slice(&self.slots[slot].notes);
    }
}

#[cfg(test)]
mod tests {
    use ksim_envs::Environment as _;
    use ksim_envs::toy::point_mass;
    use ksim_planners::{Candidates, PlannerSpec};

    use super::*;

    /// Two candidates, of which the second is chosen: 1, 2, 3, … from the first observation on. Fails where it is
    /// asked from -1.
    struct Counting(PlannerSpec, Vec<Vec<usize>>);

    impl Planner for Counting {
        fn spec(&self) -> &PlannerSpec {
            &self.0
        }

        fn reset(&mut self, _slot: usize, _seed: u64) -> Result<(), PlannerError> {
            Ok(())
        }

        fn plan(&mut self, request: &PlanRequest<'_>) -> Result<Candidates, PlannerError> {
            self.1.push(request.slots.to_vec());
            let mut plan = Candidates {
                n_candidates: 2,
                horizon: self.0.horizon,
                actions: Vec::new(),
                scores: Vec::new(),
                novelties: Vec::new(),
                chosen: vec![1; request.slots.len()],
            };
            for observation in request.observations.chunks_exact(2) {
                let first = observation[0];
                if first == -1.0 {
                    return Err(PlannerError::Length {
                        what: "patience",
                        expected: 1,
                        found: 0,
                    });
                }
                plan.actions.extend(vec![9.0; self.0.horizon]);
                plan.actions
                    .extend((0..self.0.horizon).map(|k| (first + 0.1 * k as f64) as f32));
                plan.novelties.extend([7.0, first]);
            }
            Ok(plan)
        }
    }

    fn planned(horizon: usize, interval: usize) -> Planned {
        let spec = PlannerSpec {
            family: "counting".to_owned(),
            observation_dim: 2,
            action_dim: 1,
            horizon,
        };
        let planner = Box::new(Counting(spec, Vec::new()));
        let interval = NonZeroUsize::new(interval).unwrap();
        Planned::new(
            "counting".to_owned(),
            planner,
            interval,
            point_mass(None).spec(),
        )
        .unwrap()
    }

    fn start(policy: &mut Planned, slot: usize) {
        let start = EpisodeStart {
            episode: 0,
            seed: 1,
        };
        policy.start_episode(slot, &start).unwrap();
    }

    fn act(policy: &mut Planned, slots: &[usize], places: &[f64]) -> Vec<f64> {
        let observations: Vec<f64> = places.iter().flat_map(|place| [*place, 0.0]).collect();
        let mut actions = vec![0.0; slots.len()];
        policy.act(slots, &observations, &mut actions).unwrap();
        actions
            .iter()
            .map(|action| (action * 1e6).round() / 1e6)
            .collect()
    }

    #[test]
    fn the_chosen_plan_is_executed_for_the_interval_and_clipped() {
        let mut policy = planned(5, 3);
        start(&mut policy, 2);
        let actions: Vec<f64> = [0.1, 0.0, 0.0, 0.95, 0.0]
            .map(|place| act(&mut policy, &[2], &[place])[0])
            .to_vec();
        // 0.95 + 0.1 is beyond the action space.
        assert_eq!(actions, [0.1, 0.2, 0.3, 0.95, 1.0]);
        let mut notes = [0.0; 2];
        policy.annotate(2, &mut notes);
        assert_eq!(notes[0], 0.95);
        assert!(notes[1].is_nan());
    }

    #[test]
    fn a_short_plan_is_executed_to_its_end_and_a_new_episode_plans_anew() {
        let mut policy = planned(2, 10);
        start(&mut policy, 0);
        let mut at = |place| act(&mut policy, &[0], &[place])[0];
        assert_eq!([at(0.1), at(0.5), at(0.5)], [0.1, 0.2, 0.5]);
        start(&mut policy, 0);
        assert_eq!(act(&mut policy, &[0], &[0.3]), [0.3]);
    }

    #[test]
    fn slots_that_want_a_plan_are_planned_together() {
        let mut policy = planned(4, 2);
        start(&mut policy, 0);
        act(&mut policy, &[0], &[0.1]);
        start(&mut policy, 3);
        // Slot 0 is in the middle of its plan.
        assert_eq!(act(&mut policy, &[0, 3], &[0.9, 0.5]), [0.2, 0.5]);
        assert_eq!(act(&mut policy, &[0, 3], &[0.7, 0.9]), [0.7, 0.6]);
        assert_eq!(act(&mut policy, &[0, 3], &[0.7, 0.4]), [0.8, 0.4]);
    }

    #[test]
    fn a_failure_is_that_of_the_slots_that_wanted_a_plan() {
        let mut policy = planned(4, 2);
        start(&mut policy, 0);
        act(&mut policy, &[0], &[0.1]);
        start(&mut policy, 1);
        start(&mut policy, 2);
        let mut actions = [0.0; 3];
        let observations = [0.0, 0.0, 0.5, 0.0, -1.0, 0.0];
        let failed = policy
            .act(&[0, 1, 2], &observations, &mut actions)
            .unwrap_err();
        let slots: Vec<usize> = failed.iter().map(|(slot, _)| *slot).collect();
        assert_eq!(slots, [1, 2]);
        assert!(failed[0].1.to_string().contains("patience"));
        assert!((actions[0] - 0.2).abs() < 1e-6);
    }

    #[test]
    fn a_planner_of_other_widths_is_refused() {
        let spec = PlannerSpec {
            family: "wide".to_owned(),
            observation_dim: 3,
            action_dim: 1,
            horizon: 1,
        };
        let planner = Box::new(Counting(spec, Vec::new()));
        let environment = point_mass(None);
        let refused = Planned::new(
            "wide".to_owned(),
            planner,
            NonZeroUsize::MIN,
            environment.spec(),
        );
        let error = refused.map(|_| ()).unwrap_err().to_string();
        assert_eq!(
            error,
            "policy `wide` has 3 observations, environment `PointMass-v0` has 2"
        );
    }
}
