//! The schedule and the sampling table of mode reference against recorded constants.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on fails")]

mod support;

use ksim_planners::config::{Mode, Solver};
use ksim_planners::diffusion::{SamplingTable, Schedule};
use support::folders;
use support::tolerance::assert_close;

#[test]
fn golden_schedule() {
    let mut n_files = 0;
    for folder in folders() {
        for file in folder.files("schedule") {
            n_files += 1;
            let schedule = Schedule::cosine(20);
            assert_close(
                &schedule.alphas,
                file.values("alpha_by_timestep"),
                1e-6,
                "alpha",
            );
            assert_close(
                &schedule.sigmas,
                file.values("sigma_by_timestep"),
                1e-6,
                "sigma",
            );
            let mut steps = SamplingTable::new(&schedule, 20, Mode::Reference, Solver::Ddpm).steps;
            // The file counts from the last step, and has no step 0.
            steps.reverse();
            let column = |value: fn(&ksim_planners::diffusion::SamplingStep) -> f32| {
                steps.iter().map(value).collect::<Vec<f32>>()
            };
            let expected = |name: &str| &file.values(name)[1..];
            let timesteps = column(|step| step.timestep as f32);
            assert_eq!(timesteps, expected("sample_timestep_index"));
            assert_close(
                &column(|step| step.alpha),
                expected("alphas_i"),
                1e-6,
                "alpha_i",
            );
            assert_close(
                &column(|step| step.sigma),
                expected("sigmas_i"),
                1e-6,
                "sigma_i",
            );
            assert_close(&column(|step| step.std), expected("stds_i"), 1e-6, "std_i");
            // These are differences and ratios of small numbers, which the reference computes in f32.
            let residual = column(|step| step.residual);
            assert_close(&residual, expected("coef_b_i"), 1e-5, "coef_b");
            let ratio = column(|step| step.signal / step.alpha);
            assert_close(&ratio, expected("coef_a_i"), 1e-5, "coef_a");
            let scales = column(|step| step.guidance_scale);
            assert_close(
                &scales,
                expected("guidance_x0_scale_i"),
                1e-5,
                "guidance scale",
            );
        }
    }
    assert!(n_files > 0);
}
