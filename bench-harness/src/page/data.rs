//! What a page shows.

use serde::Serialize;
use serde_json::Value;

use super::density::Density;
use super::pack::Column;
use super::steps::StepColumns;
use super::worst::WorstStep;
use crate::figure::Palettes;

/// Bins of a histogram, about.
const BINS: usize = 60;
/// Share of distances that a histogram's last bin begins above.
const COVERED: f64 = 0.995;

/// Everything on the page. Its JSON is embedded under `ksim.report/1`.
#[derive(Debug, Clone, Serialize)]
pub struct Page {
    /// Name and version of the embedded data.
    pub format: &'static str,
    /// What the page is called.
    pub title: String,
    /// The document of `ksim score`, without episodes (they are in `groups`), times and places on the machine.
    pub document: Value,
    /// A group per result of the document, in its order.
    pub groups: Vec<Group>,
    /// Bins of all histograms.
    pub histogram: Histogram,
    /// The dataset's own episodes, held out.
    pub held_out: Option<HeldOutPart>,
    /// Why there are none; empty if there are.
    pub held_out_missing: String,
    /// The dataset's episodes that steps were matched with.
    pub reference: ReferencePart,
    /// Where steps are drawn.
    pub map: Map,
    /// Colors of numbers.
    pub palettes: Palettes,
    /// The farthest steps.
    pub worst: Vec<WorstStep>,
    /// What is rounded, thinned or left out; for people.
    pub notes: Vec<String>,
}

impl Page {
    /// Name and version of the embedded data.
    pub const FORMAT: &'static str = "ksim.report/1";
}

/// One set of rollouts.
#[derive(Debug, Clone, Serialize)]
pub struct Group {
    /// Its name in tables and figures.
    pub label: String,
    /// Its episodes.
    pub episodes: EpisodeFacts,
    /// Steps per bin of [`Page::histogram`], of all steps.
    pub histogram: Vec<u64>,
    /// Its steps, or some of them.
    pub steps: StepColumns,
}

/// Numbers of the episodes of a group, one entry each.
#[derive(Debug, Clone, Default, Serialize)]
pub struct EpisodeFacts {
    /// Their own numbers.
    pub episode_index: Vec<i64>,
    /// Their lengths.
    pub n_steps: Vec<usize>,
    /// K-Sim over state and action, its parts, saturation and mean d/√d, as `ksim score` has them.
    pub k_sim: Vec<f64>,
    /// See `k_sim`.
    pub k_sim_state: Vec<f64>,
    /// See `k_sim`.
    pub k_sim_action: Vec<f64>,
    /// See `k_sim`.
    pub saturated_share: Vec<f64>,
    /// See `k_sim`.
    pub mean_scaled_distance: Vec<f64>,
    /// Undiscounted returns, where rewards are recorded.
    #[serde(rename = "return", skip_serializing_if = "Option::is_none")]
    pub total_return: Option<Vec<Option<f64>>>,
    /// Whether any step reports success, where it is recorded.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub success: Option<Vec<Option<bool>>>,
    /// Goals in the order in which an episode had them.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub goals: Option<Goals>,
}

/// Goals of the episodes of a group on the map, episode after episode.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Goals {
    /// Goals of every episode.
    pub n: Vec<usize>,
    /// Where they lie.
    pub x: Column,
    /// See `x`.
    pub y: Column,
}

impl Goals {
    /// Packs the goals of every episode, within the ranges of the map.
    pub fn new(episodes: &[Vec<[f64; 2]>], [x, y]: [[f64; 2]; 2]) -> Self {
        let all = |axis: usize| episodes.iter().flatten().map(move |goal| goal[axis]);
        Self {
            n: episodes.iter().map(Vec::len).collect(),
            x: Column::places(all(0), x),
            y: Column::places(all(1), y),
        }
    }
}

/// Equal bins from `low` to `high`; the last holds what lies beyond, too.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Histogram {
    low: f64,
    high: f64,
    n: usize,
}

impl Histogram {
    /// Bins for distances, from 0 to a round number that all but a few are below; none straddles the border, unless that
    /// is much smaller than a bin.
    pub fn covering(distances: impl Iterator<Item = f64>, border: f64) -> Self {
        let mut sorted: Vec<f64> = distances.collect();
        sorted.sort_by(f64::total_cmp);
        let last = sorted.len().saturating_sub(1);
        let most = sorted.get((COVERED * last as f64) as usize).copied();
        // Round numbers, so that figures of similar rollouts have the same axis.
        let halves = ((2.0 * most.unwrap_or(1.0)).ceil() / 2.0).max(1.0);
        let borders = (halves / border).ceil();
        let per_border = (BINS as f64 / borders).round();
        let (high, n) = match border < halves && per_border > 0.0 {
            true => (borders * border, (borders * per_border) as usize),
            false => (halves, BINS),
        };
        Self { low: 0.0, high, n }
    }

    /// Ends of the bins, ascending.
    pub fn edges(&self) -> Vec<f64> {
        let width = (self.high - self.low) / self.n as f64;
        (0..=self.n)
            .map(|bin| self.low + width * bin as f64)
            .collect()
    }

    /// Numbers per bin.
    pub fn counts(&self, distances: impl Iterator<Item = f64>) -> Vec<u64> {
        let mut counts = vec![0; self.n];
        for distance in distances {
            let share = (distance - self.low) / (self.high - self.low);
            let bin = ((share * self.n as f64) as usize).min(self.n - 1);
            counts[bin] += 1;
        }
        counts
    }
}

/// The dataset's own episodes, each compared with all others.
#[derive(Debug, Clone, Serialize)]
pub struct HeldOutPart {
    /// How many.
    pub n_episodes: usize,
    /// Their steps.
    pub n_steps: usize,
    /// The seed that chose them.
    pub seed: u64,
    /// K-Sim over all their steps.
    pub k_sim: f64,
    /// Mean of d/√d.
    pub mean_scaled_distance: f64,
    /// Steps per bin.
    pub histogram: Vec<u64>,
}

/// The dataset's episodes that steps were matched with.
#[derive(Debug, Clone, Default, Serialize)]
pub struct ReferencePart {
    /// Their own numbers; steps name a place in this list.
    pub episodes: Vec<i64>,
}

/// Where steps are drawn.
#[derive(Debug, Clone, Serialize)]
pub struct Map {
    /// `maze` or `projection`.
    pub kind: &'static str,
    /// Rows of a maze from its upper edge: `1` is a wall.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub rows: Vec<String>,
    /// Side of a maze's cells, in meters.
    pub cell: f64,
    /// Range from left to right.
    pub x: [f64; 2],
    /// Range from bottom to top.
    pub y: [f64; 2],
    /// Names of both axes.
    pub labels: [String; 2],
    /// What a projection shows; empty for a maze.
    pub explained: String,
    /// Where the dataset's steps are.
    pub density: Density,
}

#[cfg(test)]
mod tests {
    use super::*;

    const GAMMA: f64 = 0.5;

    #[test]
    fn the_last_bin_takes_what_lies_beyond() {
        let distances = || (0..1000).map(|i| f64::from(i) / 700.0).chain([1e300]);
        let bins = Histogram::covering(distances(), GAMMA);
        assert_eq!(bins.high, 1.5);
        let counts = bins.counts(distances());
        assert_eq!(counts.iter().sum::<u64>(), 1001);
        assert_eq!(counts.last(), Some(&1));
        for (far, border) in [(3.5, 0.5), (4.5, 0.5), (7.0, 0.5), (2.0, 0.3), (0.1, 0.9)] {
            let bins = Histogram::covering([far; 2].into_iter(), border);
            let at = |edge: &f64| (edge - border).abs() < 1e-12;
            assert!(bins.edges().iter().any(at), "{border}: {bins:?}");
            assert!(bins.high >= far && (40..=120).contains(&bins.n), "{bins:?}");
        }
        for border in [1e-300, 1e-4, 8.0, 1e300] {
            let bins = Histogram::covering([2.0].into_iter(), border);
            assert_eq!((bins.high, bins.n), (2.0, BINS));
        }
        // Nothing, and nothing but zeros.
        assert_eq!(Histogram::covering([].into_iter(), GAMMA).high, 1.0);
        assert_eq!(
            Histogram::covering([0.0].into_iter(), GAMMA).counts([0.0].into_iter())[0],
            1
        );
    }
}
