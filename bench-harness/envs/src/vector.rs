//! Many environments stepped at once.

use rayon::prelude::*;

use crate::environment::{Environment, EnvironmentSpec, ResetOptions, ResetOutcome, StepOutcome};
use crate::error::EnvironmentError;

/// What can go wrong with environments stepped together.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum VectorError {
    /// No environment at all.
    #[error("no environments to step")]
    Empty,
    /// Environments of different kinds.
    #[error(
        "slot {slot} holds `{found}`, expected `{expected}` with the same specification as slot 0"
    )]
    DifferentSpec {
        /// The slot that differs.
        slot: usize,
        /// Id of slot 0.
        expected: String,
        /// Id of the slot.
        found: String,
    },
    /// Slots to step that are not ascending, or do not exist.
    #[error(
        "slots to step: found {found} at position {position}, expected ascending slots below {n_slots}"
    )]
    Slots {
        /// Position in the list.
        position: usize,
        /// The slot there.
        found: usize,
        /// How many slots there are.
        n_slots: usize,
    },
    /// Actions of another width than `slots × action_dim`.
    #[error("actions of {n_slots} slots have {found} numbers, expected {expected}")]
    Actions {
        /// How many slots were to be stepped.
        n_slots: usize,
        /// Numbers that were expected.
        expected: usize,
        /// Numbers that were given.
        found: usize,
    },
    /// What went wrong in one environment.
    #[error("slot {slot}")]
    Slot {
        /// Its slot.
        slot: usize,
        /// What went wrong.
        source: EnvironmentError,
    },
}

/// Environments of one kind, stepped together on the current rayon pool.
///
/// Each slot has its own simulator and generator, so the numbers are the same for any number of threads. Stepping
/// allocates nothing when called inside the pool (`pool.install`), but for what each of its threads once needs.
pub struct VectorEnvironment {
    slots: Vec<Slot>,
    /// `(n_slots, observation_dim)`, row-major.
    observations: Vec<f64>,
    outcomes: Vec<StepOutcome>,
    observation_dim: usize,
    action_dim: usize,
}

struct Slot {
    environment: Box<dyn Environment>,
    /// Row of the current actions, if the slot is to be stepped.
    action_row: Option<usize>,
    error: Option<EnvironmentError>,
}

impl std::fmt::Debug for VectorEnvironment {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("VectorEnvironment")
            .field("id", &self.spec().id)
            .field("n_slots", &self.len())
            .finish_non_exhaustive()
    }
}

impl VectorEnvironment {
    /// Takes environments, one per slot.
    ///
    /// # Errors
    /// No environments, or environments whose specifications are not all equal.
    pub fn new(environments: Vec<Box<dyn Environment>>) -> Result<Self, VectorError> {
        let spec = environments.first().ok_or(VectorError::Empty)?.spec();
        let (observation_dim, action_dim) = (spec.observation_dim(), spec.action_dim());
        if let Some(slot) = environments.iter().position(|other| other.spec() != spec) {
            return Err(VectorError::DifferentSpec {
                slot,
                expected: spec.id.clone(),
                found: environments[slot].spec().id.clone(),
            });
        }
        Ok(Self {
            observations: vec![0.0; environments.len() * observation_dim],
            outcomes: vec![StepOutcome::default(); environments.len()],
            slots: environments.into_iter().map(Slot::new).collect(),
            observation_dim,
            action_dim,
        })
    }

    /// What is fixed about every one of them.
    pub fn spec(&self) -> &EnvironmentSpec {
        self.slots[0].environment.spec()
    }

    /// How many there are, at least one.
    #[expect(clippy::len_without_is_empty, reason = "there always is at least one")]
    pub fn len(&self) -> usize {
        self.slots.len()
    }

    /// Starts an episode in one slot, as [`Environment::reset`]; its observation then stands in
    /// [`VectorEnvironment::observation`].
    ///
    /// # Errors
    /// What the environment says, with the slot.
    ///
    /// # Panics
    /// If there is no such slot.
    pub fn reset(
        &mut self,
        slot: usize,
        seed: Option<u64>,
        options: &ResetOptions,
    ) -> Result<ResetOutcome, VectorError> {
        let row = slot * self.observation_dim;
        let observation = &mut self.observations[row..row + self.observation_dim];
        self.outcomes[slot] = StepOutcome::default();
        self.slots[slot]
            .environment
            .reset(seed, options, observation)
            .map_err(|source| VectorError::Slot { slot, source })
    }

    /// Steps the slots listed, in parallel on the current rayon pool; the others stay as they are. `slots` is
    /// ascending, `actions` holds one row of `action_dim` numbers per listed slot.
    ///
    /// # Errors
    /// Slots or actions that do not fit, before anything is stepped; or the error of the lowest slot whose
    /// environment failed (all of them: [`VectorEnvironment::errors`]). The other slots were stepped all the same.
    pub fn step(&mut self, slots: &[usize], actions: &[f64]) -> Result<(), VectorError> {
        self.check(slots, actions)?;
        for slot in &mut self.slots {
            slot.action_row = None;
            slot.error = None;
        }
        for (row, &slot) in slots.iter().enumerate() {
            self.slots[slot].action_row = Some(row);
        }
        let action_dim = self.action_dim;
        self.slots
            .par_iter_mut()
            .zip(self.observations.par_chunks_mut(self.observation_dim))
            .zip(self.outcomes.par_iter_mut())
            // An environment's step takes far longer than handing it to a thread.
            .with_max_len(1)
            .for_each(|((slot, observation), outcome)| {
                if let Some(row) = slot.action_row {
                    let action = &actions[row * action_dim..(row + 1) * action_dim];
                    slot.step(action, observation, outcome);
                }
            });
        self.errors().next().map_or(Ok(()), Err)
    }

    fn check(&self, slots: &[usize], actions: &[f64]) -> Result<(), VectorError> {
        let n_slots = self.len();
        let bad =
            (0..slots.len()).find(|&k| slots[k] >= n_slots || (k > 0 && slots[k] <= slots[k - 1]));
        if let Some(position) = bad {
            return Err(VectorError::Slots {
                position,
                found: slots[position],
                n_slots,
            });
        }
        let expected = slots.len() * self.action_dim;
        if actions.len() != expected {
            return Err(VectorError::Actions {
                n_slots: slots.len(),
                expected,
                found: actions.len(),
            });
        }
        Ok(())
    }

    /// The newest observation of every slot, shape `(n_slots, observation_dim)`, row-major.
    pub fn observations(&self) -> &[f64] {
        &self.observations
    }

    /// The newest observation of a slot.
    ///
    /// # Panics
    /// If there is no such slot.
    pub fn observation(&self, slot: usize) -> &[f64] {
        &self.observations[slot * self.observation_dim..][..self.observation_dim]
    }

    /// The newest outcome of every slot; the default after a reset.
    pub fn outcomes(&self) -> &[StepOutcome] {
        &self.outcomes
    }

    /// What went wrong in the last [`VectorEnvironment::step`], by slot.
    pub fn errors(&self) -> impl Iterator<Item = VectorError> + '_ {
        self.slots.iter().enumerate().filter_map(|(slot, state)| {
            let source = state.error.clone()?;
            Some(VectorError::Slot { slot, source })
        })
    }

    /// Writes a slot's state and goal, as [`Environment::read_info`].
    ///
    /// # Panics
    /// If there is no such slot, or `info` has another width than [`EnvironmentSpec::info_dim`].
    pub fn read_info(&self, slot: usize, info: &mut [f64]) {
        self.slots[slot].environment.read_info(info);
    }
}

impl Slot {
    fn new(environment: Box<dyn Environment>) -> Self {
        Self {
            environment,
            action_row: None,
            error: None,
        }
    }

    fn step(&mut self, action: &[f64], observation: &mut [f64], outcome: &mut StepOutcome) {
        match self.environment.step(action, observation) {
            Ok(stepped) => *outcome = stepped,
            Err(error) => self.error = Some(error),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::toy::point_mass;

    fn three() -> VectorEnvironment {
        let environments = (0..3).map(|_| Box::new(point_mass(None)) as Box<dyn Environment>);
        let mut vector = VectorEnvironment::new(environments.collect()).unwrap();
        for slot in 0..3 {
            vector
                .reset(slot, Some(slot as u64), &ResetOptions::default())
                .unwrap();
        }
        vector
    }

    #[test]
    fn only_the_listed_slots_move() {
        let mut vector = three();
        let before = vector.observations().to_vec();
        vector.step(&[0, 2], &[1.0, -1.0]).unwrap();
        assert!(vector.observation(0)[0] > before[0]);
        assert_eq!(vector.observation(1), &before[2..4]);
        assert!(vector.observation(2)[0] < before[4]);
        assert_eq!(vector.outcomes()[1], StepOutcome::default());
    }

    #[test]
    fn what_does_not_fit_is_refused_before_a_step() {
        let mut vector = three();
        let before = vector.observations().to_vec();
        for (slots, actions) in [
            (&[1, 0][..], &[0.0, 0.0][..]),
            (&[0, 0], &[0.0, 0.0]),
            (&[0, 3], &[0.0, 0.0]),
            (&[0, 1], &[0.0]),
        ] {
            assert!(vector.step(slots, actions).is_err());
        }
        assert_eq!(vector.observations(), before);
        assert_eq!(
            VectorEnvironment::new(Vec::new()).unwrap_err(),
            VectorError::Empty
        );
        let kinds: Vec<Box<dyn Environment>> =
            vec![Box::new(point_mass(None)), Box::new(point_mass(Some(3)))];
        assert!(matches!(
            VectorEnvironment::new(kinds),
            Err(VectorError::DifferentSpec { slot: 1, .. })
        ));
    }

    #[test]
    fn an_error_names_its_slot_and_the_others_go_on() {
        let mut vector = three();
        let before = vector.observations().to_vec();
        let error = vector.step(&[0, 1, 2], &[1.0, f64::NAN, f64::INFINITY]);
        let Err(VectorError::Slot { slot: 1, source }) = error else {
            panic!("{error:?}");
        };
        assert!(matches!(
            source,
            EnvironmentError::ActionNotFinite { index: 0, .. }
        ));
        assert_eq!(vector.errors().count(), 2);
        assert!(vector.observation(0)[0] > before[0]);
        vector.step(&[1], &[0.5]).unwrap();
        assert_eq!(vector.errors().count(), 0);
    }
}
