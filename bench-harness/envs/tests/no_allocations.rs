//! Stepping environments together allocates nothing, and gives the same numbers for any number of threads.
//!
//! One test only: the counter sees every thread of the process.
#![expect(clippy::unwrap_used, reason = "a test stops where a step fails")]
#![expect(unsafe_code, reason = "a global allocator that counts")]

use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicUsize, Ordering};

use ksim_envs::registry::{self, EnvironmentRequest};
use ksim_envs::vector::VectorEnvironment;
use ksim_envs::{Environment, ResetOptions};

struct Counting;

static N_ALLOCATIONS: AtomicUsize = AtomicUsize::new(0);

// SAFETY: hands everything on to the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        N_ALLOCATIONS.fetch_add(1, Ordering::Relaxed);
        // SAFETY: the caller's promises are the system's.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: as above.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

const N_SLOTS: usize = 7;
const N_STEPS: usize = 100;

/// Observations and rewards of all slots after some steps, and how often those steps allocated.
fn run(id: &str, n_threads: usize) -> (Vec<f64>, usize) {
    let request = EnvironmentRequest {
        max_episode_steps: Some(2 * N_STEPS),
        ..EnvironmentRequest::of_id(id)
    };
    let environments: Vec<Box<dyn Environment>> = (0..N_SLOTS)
        .map(|_| registry::make(&request).unwrap())
        .collect();
    let mut vector = VectorEnvironment::new(environments).unwrap();
    for slot in 0..N_SLOTS {
        vector
            .reset(slot, Some(slot as u64), &ResetOptions::default())
            .unwrap();
    }
    let slots: Vec<usize> = (0..N_SLOTS).collect();
    let n_actions = N_SLOTS * vector.spec().action_dim();
    let actions: Vec<f64> = (0..n_actions).map(|i| -0.01 * (i % 11) as f64).collect();
    let mut rewards = vec![0.0; N_SLOTS];
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(n_threads)
        .build()
        .unwrap();
    let n_allocations = pool.install(|| {
        let mut before = 0;
        for step in 0..N_STEPS {
            // The first steps may allocate what later ones use.
            if step == 10 {
                before = N_ALLOCATIONS.load(Ordering::Relaxed);
            }
            vector.step(&slots, &actions).unwrap();
            for (sum, outcome) in rewards.iter_mut().zip(vector.outcomes()) {
                *sum += outcome.reward;
            }
        }
        N_ALLOCATIONS.load(Ordering::Relaxed) - before
    });
    rewards.extend(vector.observations());
    (rewards, n_allocations)
}

#[test]
fn steps_allocate_nothing_and_threads_change_nothing() {
    let robots = ["HalfCheetah-v5", "Ant-v5", "AntMaze_UMaze-v4"];
    let ids = ["PointMass-v0"]
        .into_iter()
        .chain(robots.into_iter().filter(|_| cfg!(feature = "mujoco")));
    for id in ids {
        let (expected, n_allocations) = run(id, 1);
        assert_eq!(n_allocations, 0, "{id}, 1 thread");
        for n_threads in [2, 3] {
            let (found, n_allocations) = run(id, n_threads);
            // A worker of the pool allocates when it first takes work from another, once, whenever that is.
            let is_once = n_allocations <= 2 * n_threads;
            assert!(is_once, "{id}, {n_threads} threads: {n_allocations}");
            assert_eq!(found, expected, "{id}, {n_threads} threads");
        }
    }
}
