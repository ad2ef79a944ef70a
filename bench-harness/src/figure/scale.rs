//! Colors for numbers, and the bar that explains them.

use colorous::Gradient;
use serde::Serialize;
use svg::node::element::{Group, Line, Rectangle};

use super::{px, text};

/// Distinct colors: fine enough to look continuous, coarse enough that neighboring steps share one.
const N_LEVELS: usize = 64;

/// Maps numbers to colors that people with any color vision can order.
#[derive(Debug, Clone)]
pub(super) struct ColorScale {
    gradient: Gradient,
    low: f64,
    high: f64,
    label: &'static str,
}

impl ColorScale {
    /// Steps of an episode, 0 to `last`.
    pub(super) fn steps(last: usize) -> Self {
        let high = last.max(1) as f64;
        Self {
            gradient: colorous::VIRIDIS,
            low: 0.0,
            high,
            label: "step",
        }
    }

    /// K-Sim scores, always 0 to 1, so that figures compare.
    pub(super) fn k_sim() -> Self {
        Self {
            gradient: colorous::CIVIDIS,
            low: 0.0,
            high: 1.0,
            label: "K-Sim of the step",
        }
    }

    /// Novelties of plans, from the smallest to the largest of them; what is not finite does not count.
    pub(super) fn novelty(values: impl Iterator<Item = f64> + Clone) -> Self {
        let finite = values.filter(|value| value.is_finite());
        let low = finite.clone().fold(f64::INFINITY, f64::min);
        let high = finite.fold(f64::NEG_INFINITY, f64::max);
        let (low, high) = match (low.is_finite(), low < high) {
            (true, true) => (low, high),
            (true, false) => (low - 0.5, low + 0.5),
            (false, _) => (0.0, 1.0),
        };
        Self {
            gradient: colorous::INFERNO,
            low,
            high,
            label: "novelty of the plan",
        }
    }

    /// The level of a number; what lies outside gets the outermost.
    pub(super) fn level(&self, value: f64) -> usize {
        let share = (value - self.low) / (self.high - self.low);
        let level = (share * N_LEVELS as f64) as usize;
        level.min(N_LEVELS - 1)
    }

    /// Color of a level, such as `#440154`.
    pub(super) fn color(&self, level: usize) -> String {
        format!("#{:x}", self.gradient.eval_rational(level, N_LEVELS))
    }

    /// The bar, its lower left corner at `(x, bottom)`.
    pub(super) fn bar(&self, x: f64, bottom: f64, height: f64) -> Group {
        const WIDTH: f64 = 14.0;
        let band = height / N_LEVELS as f64;
        let mut group = Group::new();
        let mut y = bottom;
        for level in 0..N_LEVELS {
            y -= band;
            let rectangle = Rectangle::new()
                .set("x", px(x))
                .set("y", px(y))
                .set("width", WIDTH)
                // A hair more, or the background shines through the joints.
                .set("height", px(band + 0.5))
                .set("fill", self.color(level));
            group = group.add(rectangle);
        }
        for tick in ticks(self.low, self.high, 5) {
            let y = bottom - (tick - self.low) / (self.high - self.low) * height;
            let line = Line::new()
                .set("x1", px(x + WIDTH))
                .set("x2", px(x + WIDTH + 4.0))
                .set("y1", px(y))
                .set("y2", px(y))
                .set("stroke", "#222");
            let number = text(&tick.to_string(), [x + WIDTH + 7.0, y + 3.5], 10.0, "start");
            group = group.add(line).add(number);
        }
        let (middle, right) = (bottom - height / 2.0, x + WIDTH + 42.0);
        let turn = format!("rotate(-90 {} {})", px(right), px(middle));
        group.add(text(self.label, [right, middle], 11.0, "middle").set("transform", turn))
    }
}

/// The colors of the scales from low to high, such as `#440154`, for figures that are drawn elsewhere.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Palettes {
    /// K-Sim scores, from 0 to 1.
    pub k_sim: Vec<String>,
    /// Novelties of plans.
    pub novelty: Vec<String>,
    /// Steps.
    pub step: Vec<String>,
}

impl Default for Palettes {
    fn default() -> Self {
        let colors = |scale: ColorScale| (0..N_LEVELS).map(|level| scale.color(level)).collect();
        Self {
            k_sim: colors(ColorScale::k_sim()),
            novelty: colors(ColorScale::novelty([0.0, 1.0].into_iter())),
            step: colors(ColorScale::steps(1)),
        }
    }
}

/// Round numbers from `low` to `high`: about `n` of them, and always both sides of what is between.
pub(super) fn ticks(low: f64, high: f64, n: u32) -> Vec<f64> {
    let rough = (high - low) / f64::from(n.max(1));
    let power = 10f64.powf(rough.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0]
        .into_iter()
        .map(|factor| factor * power)
        .find(|step| *step >= rough * 0.999)
        .unwrap_or(power);
    let first = (low / step).ceil();
    (0..=2 * n)
        .map(|i| round_to((first + f64::from(i)) * step, power))
        .take_while(|tick| *tick <= high + step * 1e-9)
        .collect()
}

/// Takes away what binary fractions add to a multiple of a power of ten.
fn round_to(value: f64, power: f64) -> f64 {
    if power >= 1.0 {
        return value.round();
    }
    let parts = (1.0 / power).round();
    (value * parts).round() / parts
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_inside() {
        assert_eq!(ticks(0.0, 1.0, 5), [0.0, 0.2, 0.4, 0.6, 0.8, 1.0]);
        assert_eq!(ticks(0.0, 700.0, 5), [0.0, 200.0, 400.0, 600.0]);
        assert_eq!(ticks(-10.0, 10.0, 5), [-10.0, -5.0, 0.0, 5.0, 10.0]);
        assert_eq!(ticks(0.0, 1.0, 1), [0.0, 1.0]);
    }

    #[test]
    fn levels_cover_the_scale_and_nothing_falls_out_of_it() {
        let scale = ColorScale::k_sim();
        let levels = [-1.0, 0.0, 0.5, 1.0, 7.0, f64::NAN].map(|value| scale.level(value));
        assert_eq!(levels, [0, 0, 32, 63, 63, 0]);
        assert_ne!(scale.color(0), scale.color(63));
        assert!(scale.color(0).len() == 7);
    }
}
