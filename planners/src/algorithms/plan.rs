//! What all diffusion planners do: denoise candidates from the current observation and execute one.

use std::collections::BTreeMap;

use super::loaded::Loaded;
use crate::config::PlanningConfig;
use crate::data::Normalizer;
use crate::diffusion::{Guide, GuideScore, Prior, Sampler, SamplingTable, Schedule, SeededNoise};
use crate::error::PlannerError;
use crate::family::LoadOptions;
use crate::model::PlannerMeta;
use crate::model::network::DIFFUSION;
use crate::nets::Network;
use crate::planner::{Candidates, PlanRequest, Planner, PlannerSpec};
use crate::rng::{Purpose, Rng};

/// All candidates of one slot.
pub(crate) struct SlotPlans<'a> {
    /// Windows of the shape `(n_candidates, horizon, width)`.
    pub(crate) windows: &'a [f32],
    /// Numbers in a row of a window.
    pub(crate) width: usize,
    /// log p of each candidate.
    pub(crate) scores: &'a [f64],
}

/// What a choice came to.
pub(crate) struct Chosen {
    pub(crate) index: usize,
    /// Novelty of each candidate, where it is the choice that measures it.
    pub(crate) novelties: Option<Vec<f64>>,
}

/// Chooses among candidates.
pub(crate) trait Choice: Send {
    fn choose(&mut self, plans: &SlotPlans<'_>, rng: Rng) -> Result<Chosen, PlannerError>;
}

/// The candidate of the highest score; of equal ones the first.
pub(crate) struct Best;

impl Choice for Best {
    fn choose(&mut self, plans: &SlotPlans<'_>, _: Rng) -> Result<Chosen, PlannerError> {
        let mut index = 0;
        for (at, score) in plans.scores.iter().enumerate() {
            if *score > plans.scores[index] {
                index = at;
            }
        }
        Ok(Chosen {
            index,
            novelties: None,
        })
    }
}

/// An episode in a slot.
struct Slot {
    seed: u64,
    n_plans: u64,
    /// The window that was executed last.
    last: Option<Vec<f32>>,
}

/// A diffusion planner.
pub(crate) struct DiffusionPlanner {
    spec: PlannerSpec,
    meta: PlannerMeta,
    normalizer: Normalizer,
    planning: PlanningConfig,
    network: Box<dyn Network>,
    guide: Guide,
    choice: Box<dyn Choice>,
    schedule: Schedule,
    table: SamplingTable,
    /// The steps of a warm start.
    tail: Option<SamplingTable>,
    shift: usize,
    slots: BTreeMap<usize, Slot>,
}

impl DiffusionPlanner {
    pub(crate) fn new(
        loaded: Loaded,
        mut guide: Guide,
        choice: Box<dyn Choice>,
        options: &LoadOptions,
    ) -> Result<Self, PlannerError> {
        let mut network = loaded.network(DIFFUSION)?;
        let (meta, planning) = (loaded.meta, loaded.planning);
        // A plan does not depend on how many environments plan beside it.
        network.in_groups_of(planning.n_candidates);
        guide.in_groups_of(planning.n_candidates);
        let schedule = Schedule::cosine(meta.config.diffusion.n_timesteps);
        let table = SamplingTable::new(
            &schedule,
            planning.sampling_steps,
            meta.config.mode,
            planning.solver,
        );
        let tail = match options.warm_start {
            Some(share) if !(share > 0.0 && share <= 1.0) => {
                return Err(PlannerError::Request {
                    what: "the share of a warm start",
                    expected: "above 0, at most 1".to_owned(),
                    found: share.to_string(),
                });
            }
            share => share.map(|share| table.tail(share)),
        };
        Ok(Self {
            spec: PlannerSpec {
                family: meta.family.clone(),
                observation_dim: meta.observation_dim,
                action_dim: meta.action_dim,
                horizon: meta.config.data.horizon,
            },
            meta,
            normalizer: loaded.normalizer,
            planning,
            network,
            guide,
            choice,
            schedule,
            table,
            tail,
            shift: options.replan_interval.unwrap_or(1),
            slots: BTreeMap::new(),
        })
    }

    fn width(&self) -> usize {
        self.spec.observation_dim + self.spec.action_dim
    }

    fn window_len(&self) -> usize {
        self.spec.horizon * self.width()
    }

    /// Normalized, in the order that the networks see.
    fn normalized(&self, observation: &[f64]) -> Vec<f32> {
        let order = &self.meta.observation_order;
        let ordered: Vec<f64> = order.iter().map(|&column| observation[column]).collect();
        let mut normalized = vec![0.0; ordered.len()];
        self.normalizer.normalize(&ordered, &mut normalized);
        normalized
    }

    /// Candidates of some slots, which start alike.
    fn denoise(
        &mut self,
        members: &[(usize, Vec<f32>)],
        warm: bool,
    ) -> Result<(Vec<f32>, GuideScore), PlannerError> {
        let n_candidates = self.planning.n_candidates;
        let mut observations = Vec::new();
        let mut start = Vec::new();
        for (slot, observation) in members {
            observations.extend(observation.repeat(n_candidates));
            if warm && let Some(last) = self.slots.get(slot).and_then(|slot| slot.last.as_ref()) {
                start.extend(shifted(last, self.shift, self.width()).repeat(n_candidates));
            }
        }
        let plans = members.iter().filter_map(|(slot, _)| self.slots.get(slot));
        let mut noise = SeededNoise::new(plans.map(|slot| (slot.seed, slot.n_plans)), n_candidates);
        let table = if warm { self.tail.as_ref() } else { None };
        let prior = Prior {
            observations: &observations,
            observation_dim: self.spec.observation_dim,
            start: table.map(|_| start.as_slice()),
        };
        let sample = Sampler {
            network: self.network.as_mut(),
            guide: Some(&mut self.guide),
            schedule: &self.schedule,
            table: table.unwrap_or(&self.table),
            temperature: self.planning.temperature as f32,
            guidance_weight: self.planning.guidance_weight as f32,
        }
        .sample(&prior, &mut noise, &mut |_| ())?;
        Ok((sample.x, sample.score))
    }

    /// Chooses among the candidates of one slot.
    fn choose(
        &mut self,
        slot: usize,
        windows: &[f32],
        scores: &[f64],
    ) -> Result<Chosen, PlannerError> {
        let width = self.width();
        let (seed, n_plans) = self
            .slots
            .get(&slot)
            .map_or((0, 0), |state| (state.seed, state.n_plans));
        let plans = SlotPlans {
            windows,
            width,
            scores,
        };
        self.choice
            .choose(&plans, Rng::new(seed, Purpose::Choice, n_plans))
    }

    /// The actions of windows, clipped.
    fn actions(&self, windows: &[f32]) -> Vec<f32> {
        let mut actions = Vec::with_capacity(windows.len() / self.width() * self.spec.action_dim);
        for row in windows.chunks_exact(self.width()) {
            let bounds = self.meta.action_low.iter().zip(&self.meta.action_high);
            let raw = &row[self.spec.observation_dim..];
            actions.extend(
                raw.iter()
                    .zip(bounds)
                    .map(|(&value, (&low, &high))| value.max(low).min(high)),
            );
        }
        actions
    }
}

impl Planner for DiffusionPlanner {
    fn spec(&self) -> &PlannerSpec {
        &self.spec
    }

    fn reset(&mut self, slot: usize, seed: u64) -> Result<(), PlannerError> {
        let fresh = Slot {
            seed,
            n_plans: 0,
            last: None,
        };
        self.slots.insert(slot, fresh);
        Ok(())
    }

    fn plan(&mut self, request: &PlanRequest<'_>) -> Result<Candidates, PlannerError> {
        request.check(&self.spec, |slot| self.slots.contains_key(&slot))?;
        let n_candidates = self.planning.n_candidates;
        let mut groups: [Vec<(usize, Vec<f32>)>; 2] = [Vec::new(), Vec::new()];
        let observations = request.observations.chunks_exact(self.spec.observation_dim);
        for (&slot, observation) in request.slots.iter().zip(observations) {
            let warm = self
                .slots
                .get(&slot)
                .is_some_and(|slot| slot.last.is_some());
            groups[usize::from(warm)].push((slot, self.normalized(observation)));
        }
        let mut found = BTreeMap::new();
        for (warm, members) in [(false, &groups[0]), (true, &groups[1])] {
            if members.is_empty() {
                continue;
            }
            let (x, score) = self.denoise(members, warm)?;
            let part_len = n_candidates * self.window_len();
            for (at, (slot, _)) in members.iter().enumerate() {
                let windows = &x[at * part_len..(at + 1) * part_len];
                let range = at * n_candidates..(at + 1) * n_candidates;
                let widen = |values: &[f32]| -> Vec<f64> {
                    let part = values.get(range.clone()).unwrap_or_default();
                    part.iter().map(|&value| f64::from(value)).collect()
                };
                let (scores, novelties) = (widen(&score.log_p), widen(&score.novelty));
                let chosen = self.choose(*slot, windows, &scores)?;
                let novelties = chosen.novelties.unwrap_or(novelties);
                let window_len = self.window_len();
                let executed = self
                    .tail
                    .is_some()
                    .then(|| windows[chosen.index * window_len..][..window_len].to_vec());
                let plan = (self.actions(windows), scores, novelties, chosen.index);
                found.insert(*slot, (plan, executed));
            }
        }
        // Now that no plan can fail any more: a request that does leaves all slots as they were.
        let mut candidates = Candidates {
            n_candidates,
            horizon: self.spec.horizon,
            actions: Vec::new(),
            scores: Vec::new(),
            novelties: Vec::new(),
            chosen: Vec::new(),
        };
        for (slot, ((actions, scores, novelties, chosen), executed)) in found {
            if let Some(state) = self.slots.get_mut(&slot) {
                state.n_plans += 1;
                state.last = executed;
            }
            candidates.actions.extend(actions);
            candidates.scores.extend(scores);
            candidates.novelties.extend(novelties);
            candidates.chosen.push(chosen);
        }
        Ok(candidates)
    }
}

/// A window `n` rows later; its last row stands in for those that are not known.
fn shifted(window: &[f32], n: usize, width: usize) -> Vec<f32> {
    let n_rows = window.len() / width;
    let row = |at: usize| {
        let at = (at + n).min(n_rows - 1);
        &window[at * width..(at + 1) * width]
    };
    (0..n_rows).flat_map(row).copied().collect()
}
