//! Actions drawn from the action box: what a normalized score counts as 0.

use std::collections::BTreeMap;

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng as _, SeedableRng as _};

use super::error::BaselineError;
use crate::error::PlannerError;
use crate::planner::{Candidates, PlanRequest, Planner, PlannerSpec};

/// The stream of its draws, apart from those of whoever else has the same seed.
const STREAM: u64 = 0x7261_6e64;

/// Plans of actions drawn uniformly from the action box. The first candidate is chosen.
#[derive(Debug)]
pub struct Random {
    spec: PlannerSpec,
    low: Vec<f32>,
    high: Vec<f32>,
    n_candidates: usize,
    slots: BTreeMap<usize, ChaCha8Rng>,
}

impl Random {
    /// Id of the family.
    pub const FAMILY: &'static str = "random";

    /// Draws between `low` and `high`, one number of each per action column.
    ///
    /// # Errors
    /// Bounds that are no box, or a count of 0.
    pub fn new(
        observation_dim: usize,
        [low, high]: [Vec<f32>; 2],
        horizon: usize,
        n_candidates: usize,
    ) -> Result<Self, PlannerError> {
        let is_box = low.len() == high.len()
            && !low.is_empty()
            && low
                .iter()
                .zip(&high)
                .all(|(low, high)| low <= high && (high - low).is_finite());
        if !is_box {
            return Err(BaselineError::Setting {
                name: "action box",
                expected: "finite bounds, the lower ones not above the upper".to_owned(),
                found: format!("{low:?} and {high:?}"),
            }
            .into());
        }
        super::check_count("horizon", horizon)?;
        super::check_count("n_candidates", n_candidates)?;
        Ok(Self {
            spec: PlannerSpec {
                family: Self::FAMILY.to_owned(),
                observation_dim,
                action_dim: low.len(),
                horizon,
            },
            low,
            high,
            n_candidates,
            slots: BTreeMap::new(),
        })
    }
}

impl Planner for Random {
    fn spec(&self) -> &PlannerSpec {
        &self.spec
    }

    fn reset(&mut self, slot: usize, seed: u64) -> Result<(), PlannerError> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(STREAM);
        self.slots.insert(slot, rng);
        Ok(())
    }

    fn plan(&mut self, request: &PlanRequest<'_>) -> Result<Candidates, PlannerError> {
        request.check(&self.spec, |slot| self.slots.contains_key(&slot))?;
        let per_slot = self.n_candidates * self.spec.horizon;
        let mut actions = Vec::with_capacity(request.slots.len() * per_slot * self.low.len());
        for slot in request.slots {
            let Some(rng) = self.slots.get_mut(slot) else {
                continue; // checked above
            };
            for _ in 0..per_slot {
                for (low, high) in self.low.iter().zip(&self.high) {
                    // On the grid of 2^-24, which f32 holds.
                    let share = (rng.next_u32() >> 8) as f32 * (1.0 / (1u32 << 24) as f32);
                    actions.push((low + (high - low) * share).min(*high));
                }
            }
        }
        Ok(Candidates {
            n_candidates: self.n_candidates,
            horizon: self.spec.horizon,
            actions,
            scores: Vec::new(),
            novelties: Vec::new(),
            chosen: vec![0; request.slots.len()],
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::conformance;

    #[test]
    fn draws_fill_the_box_and_stay_in_it() {
        let mut random = Random::new(1, [vec![-2.0, 0.5], vec![1.0, 0.5]], 250, 4).unwrap();
        random.reset(0, 3).unwrap();
        let request = PlanRequest {
            slots: &[0],
            observations: &[0.0],
        };
        let plan = random.plan(&request).unwrap();
        let first: Vec<f32> = plan.actions.iter().copied().step_by(2).collect();
        assert_eq!(first.len(), 1000);
        let mean = first.iter().sum::<f32>() / 1000.0;
        assert!((mean + 0.5).abs() < 0.1, "{mean}");
        assert!(first.iter().all(|value| (-2.0..=1.0).contains(value)));
        assert!(first.iter().any(|value| *value < -1.9) && first.iter().any(|value| *value > 0.9));
        assert!(
            plan.actions
                .iter()
                .skip(1)
                .step_by(2)
                .all(|value| *value == 0.5)
        );
        // Two plans of an episode are not the same.
        assert_ne!(random.plan(&request).unwrap(), plan);
    }

    #[test]
    fn it_keeps_to_the_contract() {
        let make = || -> Box<dyn Planner> {
            Box::new(Random::new(2, [vec![-1.0; 3], vec![1.0; 3]], 4, 5).unwrap())
        };
        conformance::check(&make, &[0.5; 18]);
    }

    #[test]
    fn what_is_no_box_is_refused() {
        for bounds in [
            [vec![], vec![]],
            [vec![1.0], vec![0.0]],
            [vec![0.0], vec![0.0, 1.0]],
            [vec![f32::NAN], vec![0.0]],
            [vec![-f32::MAX], vec![f32::MAX]],
        ] {
            let error = Random::new(1, bounds, 1, 1).unwrap_err().to_string();
            assert!(error.contains("action box"), "{error}");
        }
        let error = Random::new(1, [vec![0.0], vec![1.0]], 0, 1).unwrap_err();
        assert_eq!(error.to_string(), "horizon is 0, expected 1 to 65536");
    }
}
