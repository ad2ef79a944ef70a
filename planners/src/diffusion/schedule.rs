//! The discrete variance-preserving process with a cosine schedule, and tables to sample from it.
//!
//! x_t = α_t·x_0 + σ_t·ε with amplitudes α and σ, α² + σ² = 1 (Nichol and Dhariwal 2021 for the cosine).

use std::f32::consts::FRAC_PI_2;

use crate::config::{Mode, Solver};

/// Offset s of the cosine.
const OFFSET: f32 = 0.008;
/// Where the cosine is cut, so that α stays positive.
const LAST_TIME: f32 = 0.9946;
/// Time of the first timestep.
const FIRST_TIME: f64 = 1e-3;

/// Amplitudes of signal and noise at every timestep.
#[derive(Debug, Clone, PartialEq)]
pub struct Schedule {
    /// Amplitude α_t of the signal.
    pub alphas: Vec<f32>,
    /// Amplitude σ_t of the noise.
    pub sigmas: Vec<f32>,
}

impl Schedule {
    /// The cosine schedule on `n_timesteps` times, evenly spaced from 0.001 to 1; at least 2.
    pub fn cosine(n_timesteps: usize) -> Self {
        let scale = (FRAC_PI_2 * OFFSET / (1.0 + OFFSET)).cos();
        let last = (n_timesteps - 1) as f64;
        // In f32, as the reference: the last α is the cosine of nearly π/2 and moves by 1e-5, the first σ by 3e-6.
        let alpha = |t: usize| {
            let time = (FIRST_TIME + (1.0 - FIRST_TIME) * t as f64 / last) as f32;
            let time = time.clamp(0.0, LAST_TIME);
            (FRAC_PI_2 * (time + OFFSET) / (1.0 + OFFSET)).cos() / scale
        };
        let alphas: Vec<f32> = (0..n_timesteps).map(alpha).collect();
        let sigmas = alphas.iter().map(|alpha| (1.0 - alpha * alpha).sqrt());
        Self {
            sigmas: sigmas.collect(),
            alphas,
        }
    }

    /// Timesteps.
    pub fn n_timesteps(&self) -> usize {
        self.alphas.len()
    }

    /// x_t = α_t·x_0 + σ_t·ε of one window at one timestep.
    pub fn noise(&self, t: usize, x0: &[f32], epsilon: &[f32], out: &mut [f32]) {
        let (alpha, sigma) = (self.alphas[t], self.sigmas[t]);
        for ((out, x0), epsilon) in out.iter_mut().zip(x0).zip(epsilon) {
            *out = alpha * x0 + sigma * epsilon;
        }
    }
}

/// One denoising step: x' = `signal`·p + `residual`·ε̂ + `std`·N(0, 1), with the prediction p of x_0 and the noise
/// ε̂ = (x − `alpha`·p) / `sigma` that goes with it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SamplingStep {
    /// Timestep at which the networks are asked.
    pub timestep: usize,
    /// α before the step.
    pub alpha: f32,
    /// σ before the step.
    pub sigma: f32,
    /// Factor of the prediction, the α after the step.
    pub signal: f32,
    /// Factor of the predicted noise.
    pub residual: f32,
    /// Deviation of the fresh noise; 0 draws none.
    pub std: f32,
    /// σ²/α: what a gradient of log p at x is worth at the prediction of x_0.
    pub guidance_scale: f32,
}

/// The denoising steps of a plan, the noisiest first.
#[derive(Debug, Clone, PartialEq)]
pub struct SamplingTable {
    /// The steps.
    pub steps: Vec<SamplingStep>,
}

impl SamplingTable {
    /// `n_steps` steps, at least 1, from pure noise.
    ///
    /// Mode reference goes through `n_steps` + 1 points ⌊k·(T − 1)/`n_steps`⌋, of which the first two are 0 when there
    /// are T steps: the last step goes nowhere, and the sample keeps the noise of timestep 0. Mode corrected spends
    /// every step on a timestep of its own, from T − 1 to 0, and ends at time 0 without noise.
    pub fn new(schedule: &Schedule, n_steps: usize, mode: Mode, solver: Solver) -> Self {
        let last = schedule.n_timesteps() - 1;
        let point = |t: usize| (f64::from(schedule.alphas[t]), f64::from(schedule.sigmas[t]));
        let steps = (1..=n_steps).rev().map(|k| {
            let (timestep, next) = match mode {
                Mode::Reference => (last * k / n_steps, point(last * (k - 1) / n_steps)),
                Mode::Corrected => {
                    let at = |k: usize| spread(last, k, n_steps);
                    let next = if k == 1 { (1.0, 0.0) } else { point(at(k - 1)) };
                    (at(k), next)
                }
            };
            step(timestep, point(timestep), next, mode, solver)
        });
        Self {
            steps: steps.collect(),
        }
    }

    /// The last steps of the table, from about `share` of the diffusion time on (at least one step). A plan that is
    /// near its end already starts here, noised to [`SamplingTable::first_timestep`].
    #[must_use]
    pub fn tail(&self, share: f64) -> Self {
        let n_steps = (share * self.steps.len() as f64).round() as usize;
        let n_steps = n_steps.clamp(1, self.steps.len());
        Self {
            steps: self.steps[self.steps.len() - n_steps..].to_vec(),
        }
    }

    /// Timestep of the noise with which sampling begins.
    pub fn first_timestep(&self) -> usize {
        self.steps[0].timestep
    }
}

/// The `k`-th of `n` whole numbers evenly spread over 0..=last, from 1; the only one is `last`.
fn spread(last: usize, k: usize, n: usize) -> usize {
    if n == 1 {
        return last;
    }
    // Rounded to the nearest whole number.
    (2 * last * (k - 1) + (n - 1)) / (2 * (n - 1))
}

fn step(
    timestep: usize,
    (alpha, sigma): (f64, f64),
    (next_alpha, next_sigma): (f64, f64),
    mode: Mode,
    solver: Solver,
) -> SamplingStep {
    let std = match solver {
        Solver::Ddpm => {
            let kept = (alpha / next_alpha).powi(2);
            next_sigma / sigma * (1.0 - kept).max(0.0).sqrt()
        }
        Solver::Ddim => 0.0,
    };
    let variance = next_sigma * next_sigma - std * std;
    let residual = match (mode, solver) {
        // The reference adds 1e-8 to keep the root real.
        (Mode::Reference, Solver::Ddpm) => (variance + 1e-8).sqrt(),
        _ => variance.max(0.0).sqrt(),
    };
    SamplingStep {
        timestep,
        alpha: alpha as f32,
        sigma: sigma as f32,
        signal: next_alpha as f32,
        residual: residual as f32,
        std: std as f32,
        guidance_scale: (sigma * sigma / alpha) as f32,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn corrected_steps_end_at_time_zero_without_noise() {
        let schedule = Schedule::cosine(20);
        for n_steps in [1, 2, 5, 20] {
            let table = SamplingTable::new(&schedule, n_steps, Mode::Corrected, Solver::Ddpm);
            assert_eq!(table.steps.len(), n_steps);
            assert_eq!(table.first_timestep(), 19);
            let last = table.steps[n_steps - 1];
            assert_eq!((last.signal, last.residual, last.std), (1.0, 0.0, 0.0));
            let timesteps: Vec<usize> = table.steps.iter().map(|step| step.timestep).collect();
            assert!(
                timesteps.windows(2).all(|pair| pair[0] > pair[1]),
                "{timesteps:?}"
            );
        }
    }

    #[test]
    fn variance_is_preserved() {
        let schedule = Schedule::cosine(20);
        for solver in [Solver::Ddpm, Solver::Ddim] {
            for step in SamplingTable::new(&schedule, 20, Mode::Corrected, solver).steps {
                let total = step.signal.powi(2) + step.residual.powi(2) + step.std.powi(2);
                assert!((total - 1.0).abs() < 1e-6, "{step:?}");
            }
        }
    }

    #[test]
    fn a_tail_has_the_last_steps() {
        let schedule = Schedule::cosine(20);
        let table = SamplingTable::new(&schedule, 20, Mode::Corrected, Solver::Ddpm);
        assert_eq!(table.tail(0.3).steps, table.steps[14..]);
        assert_eq!(table.tail(0.3).first_timestep(), 5);
        assert_eq!(table.tail(1e-9).steps.len(), 1);
    }
}
