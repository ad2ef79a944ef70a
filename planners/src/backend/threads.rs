//! A backend whose networks compute on threads of their own.

use std::sync::Arc;

use rayon::{ThreadPool, ThreadPoolBuilder};

use crate::error::PlannerError;
use crate::nets::{Adam, Architecture, Backend, Network, TrainableNetwork, TrainingState, Weights};

/// A backend that uses rayon, on a pool of its own.
pub(super) struct Threaded<B> {
    backend: B,
    pool: Arc<ThreadPool>,
}

impl<B: Backend> Threaded<B> {
    /// On `n_threads` threads, at least 1.
    pub(super) fn new(backend: B, n_threads: usize) -> Result<Self, PlannerError> {
        let pool = ThreadPoolBuilder::new()
            .num_threads(n_threads.max(1))
            .build();
        let pool = pool.map_err(|source| PlannerError::Request {
            what: "the number of threads",
            expected: "as many as the system gives".to_owned(),
            found: format!("{n_threads} ({source})"),
        })?;
        Ok(Self {
            backend,
            pool: Arc::new(pool),
        })
    }
}

impl<B: Backend> Backend for Threaded<B> {
    fn name(&self) -> &'static str {
        self.backend.name()
    }

    fn network(
        &self,
        architecture: &Architecture,
        weights: &Weights,
    ) -> Result<Box<dyn Network>, PlannerError> {
        Ok(Box::new(OnPool {
            network: self.backend.network(architecture, weights)?,
            pool: self.pool.clone(),
        }))
    }

    fn trainable(
        &self,
        architecture: &Architecture,
        state: TrainingState,
    ) -> Result<Box<dyn TrainableNetwork>, PlannerError> {
        Ok(Box::new(OnPool {
            network: self.backend.trainable(architecture, state)?,
            pool: self.pool.clone(),
        }))
    }
}

/// A network whose work is done on a pool.
struct OnPool<N: ?Sized> {
    pool: Arc<ThreadPool>,
    network: Box<N>,
}

impl<N: Network + ?Sized> Network for OnPool<N> {
    fn architecture(&self) -> &Architecture {
        self.network.architecture()
    }

    fn forward(
        &mut self,
        x: &[f32],
        t: &[f32],
        keep: bool,
        out: &mut [f32],
    ) -> Result<(), PlannerError> {
        let network = &mut self.network;
        self.pool.install(|| network.forward(x, t, keep, out))
    }

    fn input_gradient(
        &mut self,
        cotangent: &[f32],
        gradient: &mut [f32],
    ) -> Result<(), PlannerError> {
        let network = &mut self.network;
        self.pool
            .install(|| network.input_gradient(cotangent, gradient))
    }

    fn in_groups_of(&mut self, n: usize) {
        self.network.in_groups_of(n);
    }

    fn on_rayon(&self) -> bool {
        self.network.on_rayon() && self.pool.current_num_threads() > 1
    }
}

impl TrainableNetwork for OnPool<dyn TrainableNetwork> {
    fn backward(&mut self, cotangent: &[f32]) -> Result<f64, PlannerError> {
        let network = &mut self.network;
        self.pool.install(|| network.backward(cotangent))
    }

    fn update(&mut self, adam: &Adam, learning_rate: f64) -> Result<(), PlannerError> {
        let network = &mut self.network;
        self.pool.install(|| network.update(adam, learning_rate))
    }

    fn state(&self) -> Result<TrainingState, PlannerError> {
        self.network.state()
    }
}
