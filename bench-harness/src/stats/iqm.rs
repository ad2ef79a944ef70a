//! Interquartile mean over runs.

use super::Estimate;
use super::bootstrap::{BootstrapOptions, interval, mean};

/// Mean of the middle half of the values: ⌊n/4⌋ are left out at either end. `None` for no values.
pub fn interquartile_mean(values: &[f64]) -> Option<f64> {
    let mut sorted = values.to_vec();
    middle_mean(&mut sorted)
}

fn middle_mean(values: &mut [f64]) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    let cut = values.len() / 4;
    mean(&values[cut..values.len() - cut])
}

/// Interquartile mean of the scores of all runs on all environments, with the stratified bootstrap of Agarwal et al.
/// (2021, "Deep Reinforcement Learning at the Edge of the Statistical Precipice"): every resample draws the runs of
/// each environment anew, with replacement, and never an environment. `runs` holds the scores of the runs of one
/// environment each.
///
/// `None` for no scores; no interval where no environment has two runs.
pub fn stratified_iqm(runs: &[&[f64]], options: &BootstrapOptions) -> Option<Estimate> {
    let value = interquartile_mean(&runs.concat())?;
    let has_spread = runs.iter().any(|scores| scores.len() > 1);
    let interval = interval(has_spread, options, |rng| {
        let mut drawn = Vec::new();
        for scores in runs {
            drawn.extend(scores.iter().map(|_| scores[rng.below(scores.len())]));
        }
        middle_mean(&mut drawn).unwrap_or(value)
    });
    Some(Estimate { value, interval })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_quarter_is_left_out_at_either_end() {
        let values = [100.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, -50.0];
        assert_eq!(interquartile_mean(&values), Some(4.5));
        // scipy.stats.trim_mean(range(10), 0.25) leaves out two at either end.
        let values: Vec<f64> = (0..10).map(f64::from).collect();
        assert_eq!(interquartile_mean(&values), Some(4.5));
        assert_eq!(interquartile_mean(&[1.0, 2.0, 6.0]), Some(3.0));
        assert_eq!(interquartile_mean(&[]), None);
    }

    #[test]
    fn strata_are_resampled_on_their_own() {
        let options = BootstrapOptions::default();
        // Within each environment all runs agree: no resample differs, though environments do.
        let agreed = stratified_iqm(&[&[1.0; 4], &[5.0; 4]], &options).unwrap();
        assert_eq!((agreed.value, agreed.interval), (3.0, Some([3.0, 3.0])));
        let spread = stratified_iqm(&[&[1.0, 2.0, 3.0, 4.0]], &options).unwrap();
        assert_eq!(spread.value, 2.5);
        let [low, high] = spread.interval.unwrap();
        assert!((1.0..2.5).contains(&low) && high > 2.5 && high <= 4.0);
    }

    #[test]
    fn a_single_run_has_no_interval() {
        let one = stratified_iqm(&[&[3.0], &[5.0]], &BootstrapOptions::default()).unwrap();
        assert_eq!((one.value, one.interval), (4.0, None));
        assert_eq!(stratified_iqm(&[], &BootstrapOptions::default()), None);
    }
}
