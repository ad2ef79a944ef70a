//! Draws windows from a diffusion model: one sampler for every planner, backend and solver.

use super::guide::both;
use super::{Guide, GuideScore, Noise, SamplingTable, Schedule};
use crate::error::PlannerError;
use crate::nets::Network;

/// What windows are drawn around.
#[derive(Debug, Clone, Copy)]
pub struct Prior<'a> {
    /// Normalized observation with which each window starts, of the shape `(n, observation_dim)`.
    pub observations: &'a [f32],
    /// Numbers in an observation.
    pub observation_dim: usize,
    /// Windows near which to start instead of at noise, of the shape `(n, horizon, width)`: they are noised to the
    /// first timestep of the table, see [`SamplingTable::tail`].
    pub start: Option<&'a [f32]>,
}

/// What sampling looks like from inside, before each step.
#[derive(Debug, Clone, Copy)]
pub struct Denoising<'a> {
    /// Number of the step, from 0.
    pub step: usize,
    /// Windows before the step.
    pub x: &'a [f32],
    /// The diffusion model's prediction of the clean windows.
    pub prediction: &'a [f32],
    /// The same after guidance.
    pub guided: &'a [f32],
    /// The guide's score of `x`; `None` without guidance.
    pub score: Option<&'a GuideScore>,
}

/// What was drawn.
#[derive(Debug, Clone, PartialEq)]
pub struct Sample {
    /// Windows of the shape `(n, horizon, width)`.
    pub x: Vec<f32>,
    /// The guide's score of them at timestep 0; empty without a guide.
    pub score: GuideScore,
}

/// The diffusion model, and how it is sampled.
pub struct Sampler<'a> {
    /// Predicts clean windows.
    pub network: &'a mut dyn Network,
    /// Scores windows.
    pub guide: Option<&'a mut Guide>,
    /// Amplitudes of the process.
    pub schedule: &'a Schedule,
    /// The steps.
    pub table: &'a SamplingTable,
    /// Factor of the initial noise.
    pub temperature: f32,
    /// Weight w_cg of the guide's gradient; with 0 the guide only scores the result.
    pub guidance_weight: f32,
}

impl Sampler<'_> {
    /// Draws one window for each observation of the prior. The given observations are put in place at the start and
    /// after every step. `watch` sees every step.
    ///
    /// Guidance adds w_cg·(σ²/α)·∇ log p(x_t, t) to the prediction of x_0 (Dhariwal and Nichol 2021, in the space of
    /// x_0).
    ///
    /// # Errors
    /// Lengths that do not go together, or numbers that are not finite.
    pub fn sample(
        &mut self,
        prior: &Prior<'_>,
        noise: &mut dyn Noise,
        watch: &mut dyn FnMut(&Denoising<'_>),
    ) -> Result<Sample, PlannerError> {
        let n = prior.check()?;
        let len = n * self.network.architecture().input_len();
        let mut fresh = vec![0.0; len];
        let mut x = self.start(prior, noise, &mut fresh)?;
        let mut prediction = vec![0.0; len];
        let mut guided = vec![0.0; len];
        let mut gradient = vec![0.0; len];
        for (number, step) in self.table.steps.iter().enumerate() {
            let t = vec![step.timestep as f32; n];
            let guide = self.guide.as_deref_mut();
            let guide = guide.filter(|_| self.guidance_weight != 0.0);
            // Neither waits for the other: both ask about the windows as they are.
            let (predicted, score) = match guide {
                None => (
                    self.network.forward(&x, &t, false, &mut prediction),
                    Ok(None),
                ),
                Some(guide) => both(
                    self.network.on_rayon() && guide.on_rayon(),
                    || self.network.forward(&x, &t, false, &mut prediction),
                    || guide.score(&x, &t, Some(&mut gradient)).map(Some),
                ),
            };
            predicted?;
            let score = score?;
            guided.copy_from_slice(&prediction);
            if score.is_some() {
                let scale = self.guidance_weight * step.guidance_scale;
                for (guided, gradient) in guided.iter_mut().zip(&gradient) {
                    *guided += scale * gradient;
                }
            }
            watch(&Denoising {
                step: number,
                x: &x,
                prediction: &prediction,
                guided: &guided,
                score: score.as_ref(),
            });
            if step.std != 0.0 {
                noise.draw(&mut fresh);
            }
            for ((x, &clean), fresh) in x.iter_mut().zip(&guided).zip(&fresh) {
                let epsilon = (*x - step.alpha * clean) / step.sigma;
                *x = step.signal * clean + step.residual * epsilon;
                if step.std != 0.0 {
                    *x += step.std * fresh;
                }
            }
            prior.put_in_place(&mut x);
        }
        finite(&x)?;
        let score = match self.guide.as_deref_mut() {
            Some(guide) => guide.score(&x, &vec![0.0; n], None)?,
            None => GuideScore::default(),
        };
        Ok(Sample { x, score })
    }

    /// Noise, or the start of the prior noised to the first timestep.
    fn start(
        &self,
        prior: &Prior<'_>,
        noise: &mut dyn Noise,
        fresh: &mut [f32],
    ) -> Result<Vec<f32>, PlannerError> {
        noise.draw(fresh);
        let mut x = vec![0.0; fresh.len()];
        match prior.start {
            Some(start) if start.len() != x.len() => {
                return Err(PlannerError::Length {
                    what: "the start of a plan",
                    expected: x.len(),
                    found: start.len(),
                });
            }
            Some(start) => {
                let timestep = self.table.first_timestep();
                self.schedule.noise(timestep, start, fresh, &mut x);
            }
            None => {
                for (x, fresh) in x.iter_mut().zip(fresh) {
                    *x = self.temperature * *fresh;
                }
            }
        }
        prior.put_in_place(&mut x);
        Ok(x)
    }
}

impl Prior<'_> {
    /// Number of windows.
    fn check(&self) -> Result<usize, PlannerError> {
        let n = self.observations.len() / self.observation_dim.max(1);
        if n == 0 || n * self.observation_dim != self.observations.len() {
            return Err(PlannerError::Length {
                what: "the observations of a plan",
                expected: n.max(1) * self.observation_dim,
                found: self.observations.len(),
            });
        }
        Ok(n)
    }

    /// Writes the given observations into the first rows.
    fn put_in_place(&self, x: &mut [f32]) {
        let observations = self.observations.chunks_exact(self.observation_dim);
        let window_len = x.len() / observations.len();
        for (window, observation) in x.chunks_exact_mut(window_len).zip(observations) {
            window[..self.observation_dim].copy_from_slice(observation);
        }
    }
}

fn finite(x: &[f32]) -> Result<(), PlannerError> {
    match x.iter().find(|value| !value.is_finite()) {
        None => Ok(()),
        Some(_) => Err(PlannerError::NotFinite {
            what: "a plan".to_owned(),
            place: "after its last denoising step".to_owned(),
            checkpoint: None,
        }),
    }
}
