//! Plans that Diffuser generates for the original ReDiffuser.

use crate::config::ConfidenceConfig;
use crate::diffusion::{Guide, Prior, Sampler, SamplingTable, SeededNoise};
use crate::error::PlannerError;
use crate::family::{TrainControl, TrainObserver};
use crate::model::network::{DIFFUSION, REWARD};
use crate::rng::{Purpose, Rng};
use crate::training::setting::Setting;

/// Raw states of the best plans from states in which episodes start, of the shape
/// `(n_plans, horizon·observation_dim)`: of each round of candidates the best `top_candidates` by value. `None` if the
/// observer stops it.
pub(super) fn generate(
    setting: &Setting<'_>,
    config: &ConfidenceConfig,
    observer: &mut dyn TrainObserver,
) -> Result<Option<Vec<f32>>, PlannerError> {
    let (windows, planning) = (setting.windows, &setting.config.planning);
    let (observation_dim, width) = (windows.observation_dim(), windows.width());
    let mut network = setting.trained(DIFFUSION, &setting.config.diffusion_network(width))?;
    let reward = setting.trained(REWARD, &setting.config.classifier_network(width, 1))?;
    let mut guide = Guide::new(reward, setting.value_mean, setting.value_std);
    let table = SamplingTable::new(
        &setting.schedule,
        planning.sampling_steps,
        setting.config.mode,
        planning.solver,
    );
    let n_candidates = planning.n_candidates;
    let n_kept = config.top_candidates.min(n_candidates);
    let mut plans = Vec::new();
    let mut raw = vec![0.0; observation_dim];
    let n_rounds = config.n_plans.div_ceil(n_kept) as u64;
    for round in 0..n_rounds {
        if observer.preparing("plans to learn from", round, n_rounds) == TrainControl::Stop {
            return Ok(None);
        }
        let mut starts = Rng::new(setting.seed, Purpose::Starts, round);
        let start = windows.first_observation(starts.below(windows.n_episodes()));
        let prior = Prior {
            observations: &start.repeat(n_candidates),
            observation_dim,
            start: None,
        };
        let mut noise = SeededNoise::of(
            Purpose::GeneratedPlan,
            std::iter::once((setting.seed, round)),
            n_candidates,
        );
        let sample = Sampler {
            network: network.as_mut(),
            guide: Some(&mut guide),
            schedule: &setting.schedule,
            table: &table,
            temperature: planning.temperature as f32,
            guidance_weight: planning.guidance_weight as f32,
        }
        .sample(&prior, &mut noise, &mut |_| ())?;
        let mut order: Vec<usize> = (0..n_candidates).collect();
        let value = |at: usize| sample.score.log_p[at];
        order.sort_by(|&a, &b| value(b).total_cmp(&value(a)));
        let window_len = windows.horizon * width;
        for &candidate in &order[..n_kept] {
            let window = &sample.x[candidate * window_len..(candidate + 1) * window_len];
            for row in window.chunks_exact(width) {
                windows
                    .normalizer
                    .denormalize(&row[..observation_dim], &mut raw);
                plans.extend_from_slice(&raw);
            }
        }
    }
    plans.truncate(config.n_plans * windows.horizon * observation_dim);
    Ok(Some(plans))
}
