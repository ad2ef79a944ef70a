//! What every planner must keep to, as one check that any implementation can call in its tests.

use crate::error::PlannerError;
use crate::planner::{Candidates, PlanRequest, Planner};

/// Makes a planner anew.
pub type Make<'a> = &'a (dyn Fn() -> Box<dyn Planner> + Sync);

/// Slots that the check plans for; not from 0 and not without gaps.
const SLOTS: [usize; 3] = [1, 2, 6];
/// Plans of every episode.
const N_PLANS: usize = 3;

/// Makes planners with `make` and asserts the contract of [`Planner`] on them. `observations` holds rows that the
/// planner may meet, of the shape `(n, observation_dim)` with n of at least 9.
///
/// - the same seed and observations give the same plans: in the same planner, in another, in any slot;
/// - plans do not depend on what is planned beside them, nor on the number of rayon threads;
/// - shapes are as the specification says and all numbers are finite;
/// - wrong widths, unordered slots, slots without a reset and observations that are not finite are errors, after
///   which the planner goes on as if they had not been asked;
/// - no slots, no plan, no error.
///
/// # Panics
/// Where the planner breaks it.
pub fn check(make: Make<'_>, observations: &[f64]) {
    check_within(make, observations, 0.0);
}

/// As [`check`] for planners whose numbers may differ in their last bits with the size of a batch: actions, scores
/// and novelties are the same where they differ by at most `tolerance` × max(1, |number|).
///
/// # Panics
/// Where the planner breaks the contract.
pub fn check_within(make: Make<'_>, observations: &[f64], tolerance: f64) {
    let spec = make().spec().clone();
    assert!(spec.observation_dim > 0, "observation_dim is 0");
    assert!(spec.action_dim > 0, "action_dim is 0");
    assert!(spec.horizon > 0, "horizon is 0");
    assert!(!spec.family.is_empty(), "the family has no id");
    let rows: Vec<&[f64]> = observations.chunks_exact(spec.observation_dim).collect();
    assert!(
        rows.len() >= SLOTS.len() * N_PLANS,
        "the check needs 9 observations"
    );
    let episode = |number: usize| -> Vec<&[f64]> {
        rows.iter()
            .skip(number)
            .step_by(SLOTS.len())
            .take(N_PLANS)
            .copied()
            .collect()
    };
    let episodes: Vec<Vec<&[f64]>> = (0..SLOTS.len()).map(episode).collect();

    let together = play_together(&mut *make(), &episodes);
    for plans in &together {
        for plan in plans {
            plan.check(&spec, 1).expect("a plan as specified");
            assert!(
                plan.horizon <= spec.horizon,
                "a plan is longer than the horizon"
            );
        }
    }
    let expected = Expected {
        plans: &together,
        tolerance,
    };
    alone_and_again(make, &episodes, &expected);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(3).build();
    let threads = pool.expect("threads");
    let threaded = threads.install(|| play_together(&mut *make(), &episodes));
    for (number, plans) in threaded.iter().enumerate() {
        expected.are(number, plans, "plans depend on the number of threads");
    }
    refusals(&mut *make(), &episodes, &expected);
}

/// The plans of all episodes, and how close others must come.
struct Expected<'a> {
    plans: &'a [Vec<Candidates>],
    tolerance: f64,
}

impl Expected<'_> {
    fn are(&self, number: usize, found: &[Candidates], otherwise: &str) {
        assert_eq!(found.len(), N_PLANS);
        for (step, found) in found.iter().enumerate() {
            self.is(number, step, found, otherwise);
        }
    }

    fn is(&self, number: usize, step: usize, found: &Candidates, otherwise: &str) {
        let expected = &self.plans[number][step];
        let shape = |plan: &Candidates| {
            let lengths = [plan.actions.len(), plan.scores.len(), plan.novelties.len()];
            (
                plan.n_candidates,
                plan.horizon,
                lengths,
                plan.chosen.clone(),
            )
        };
        assert_eq!(
            shape(found),
            shape(expected),
            "{otherwise} (shape or choice)"
        );
        let numbers = |plan: &Candidates| -> Vec<f64> {
            let actions = plan.actions.iter().map(|value| f64::from(*value));
            actions
                .chain(plan.scores.iter().chain(&plan.novelties).copied())
                .collect()
        };
        for (found, expected) in numbers(found).into_iter().zip(numbers(expected)) {
            let limit = self.tolerance * expected.abs().max(1.0);
            let is_same = found == expected || (found - expected).abs() <= limit;
            assert!(is_same, "{otherwise}: {found:?} instead of {expected:?}");
        }
    }
}

/// Seed of an episode.
fn seed(number: usize) -> u64 {
    17 + number as u64
}

/// The plans of every episode, all planned side by side.
fn play_together(planner: &mut dyn Planner, episodes: &[Vec<&[f64]>]) -> Vec<Vec<Candidates>> {
    for (number, &slot) in SLOTS.iter().enumerate() {
        planner.reset(slot, seed(number)).expect("a reset");
    }
    let mut plans = vec![Vec::new(); episodes.len()];
    for step in 0..N_PLANS {
        let observations: Vec<f64> = episodes
            .iter()
            .flat_map(|rows| rows[step].to_vec())
            .collect();
        let request = PlanRequest {
            slots: &SLOTS,
            observations: &observations,
        };
        let plan = planner.plan(&request).expect("a plan");
        plan.check(planner.spec(), SLOTS.len())
            .expect("a plan as specified");
        for (number, plans) in plans.iter_mut().enumerate() {
            plans.push(part(&plan, number, SLOTS.len()));
        }
    }
    plans
}

/// The plans of one episode.
fn play_alone(
    planner: &mut dyn Planner,
    slot: usize,
    seed: u64,
    rows: &[&[f64]],
) -> Vec<Candidates> {
    planner.reset(slot, seed).expect("a reset");
    let plan = |row: &&[f64]| {
        let request = PlanRequest {
            slots: &[slot],
            observations: row,
        };
        planner.plan(&request).expect("a plan")
    };
    rows.iter().map(plan).collect()
}

/// The plan of one of several slots.
fn part(plan: &Candidates, place: usize, n_slots: usize) -> Candidates {
    fn of<T: Clone>(values: &[T], place: usize, n_slots: usize) -> Vec<T> {
        let n = values.len() / n_slots;
        values[place * n..(place + 1) * n].to_vec()
    }
    Candidates {
        n_candidates: plan.n_candidates,
        horizon: plan.horizon,
        actions: of(&plan.actions, place, n_slots),
        scores: of(&plan.scores, place, n_slots),
        novelties: of(&plan.novelties, place, n_slots),
        chosen: of(&plan.chosen, place, n_slots),
    }
}

fn alone_and_again(make: Make<'_>, episodes: &[Vec<&[f64]>], expected: &Expected<'_>) {
    let mut planner = make();
    for (number, rows) in episodes.iter().enumerate() {
        let alone = play_alone(&mut *planner, SLOTS[number], seed(number), rows);
        expected.are(
            number,
            &alone,
            "plans depend on what is planned beside them",
        );
        let again = play_alone(&mut *planner, SLOTS[number], seed(number), rows);
        expected.are(
            number,
            &again,
            "a second episode with the same seed has other plans",
        );
        let elsewhere = play_alone(&mut *planner, 4, seed(number), rows);
        expected.are(number, &elsewhere, "plans depend on the slot");
    }
    let anew = play_alone(&mut *make(), 0, seed(0), &episodes[0]);
    expected.are(0, &anew, "another planner has other plans");
}

/// Asks what must be refused between the plans of an episode, which must stay as they were.
fn refusals(planner: &mut dyn Planner, episodes: &[Vec<&[f64]>], expected: &Expected<'_>) {
    let (slot, unknown) = (SLOTS[0], 5);
    planner.reset(slot, seed(0)).expect("a reset");
    for (step, row) in episodes[0].iter().enumerate() {
        let mut infinite = row.to_vec();
        infinite[0] = f64::NAN;
        let twice = [*row, *row].concat();
        for (slots, observations, what) in [
            (&[slot][..], &row[1..], "a number too few"),
            (&[slot], &twice, "a row too many"),
            (&[slot, slot], &twice, "a slot twice"),
            (&[unknown], row, "a slot without a reset"),
            (&[slot], &infinite, "an observation that is not finite"),
        ] {
            let request = PlanRequest {
                slots,
                observations,
            };
            let refused: Result<_, PlannerError> = planner.plan(&request);
            assert!(refused.is_err(), "{what} is not refused");
        }
        let none = PlanRequest {
            slots: &[],
            observations: &[],
        };
        let nothing = planner.plan(&none).expect("nothing to plan is no error");
        assert!(nothing.actions.is_empty() && nothing.chosen.is_empty());
        let request = PlanRequest {
            slots: &[slot],
            observations: row,
        };
        let plan = planner
            .plan(&request)
            .expect("a plan after what was refused");
        expected.is(0, step, &plan, "what was refused shows in a later plan");
    }
}
