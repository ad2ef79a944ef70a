//! What an exact search is expected to cost: a model with measured constants, by which `auto` chooses.
//!
//! The constants are nanoseconds of one thread, read off `ksim bench search` on the states of AntMaze
//! and on generated trajectories, 10³ to 10⁶ rows of 1 to 31 columns, K = 50 (`docs/adr/0016`). Only
//! their ratios matter. The model is right within a factor of two on those data; a k-d tree also
//! depends on how many directions the data really have, which no model knows beforehand: the constants
//! are those of robot states, where it is slower than on smooth curves.

use super::KdTree;

/// An exact engine.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Exact {
    /// [`Linear`](super::Linear).
    Linear,
    /// [`KdTree`].
    KdTree,
    /// [`Blocked`](super::Blocked).
    Blocked,
}

/// A job that an engine is to be chosen for.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Workload {
    /// Rows of the reference.
    pub(crate) n_rows: usize,
    /// Columns searched in.
    pub(crate) n_features: usize,
    /// Queries over the life of the engine.
    pub(crate) n_queries: usize,
    /// Whether the rows were rounded before, which is what `blocked` builds.
    pub(crate) is_rounded: bool,
}

impl Workload {
    /// The engine that is expected to take least, building included.
    pub(crate) fn cheapest(&self) -> Exact {
        let engines = [Exact::KdTree, Exact::Blocked, Exact::Linear].into_iter();
        engines
            .filter(|&engine| engine != Exact::KdTree || self.n_features <= KdTree::MAX_FEATURES)
            .min_by(|&a, &b| self.cost(a).total_cmp(&self.cost(b)))
            .unwrap_or(Exact::Linear)
    }

    /// Nanoseconds of one thread to build `engine` and to answer all queries.
    fn cost(&self, engine: Exact) -> f64 {
        let (rows, columns) = (self.n_rows as f64, self.n_features as f64);
        let (build, query) = match engine {
            Exact::Linear => (0.0, rows * (8.0 + columns)),
            Exact::KdTree => {
                let leaves = 5.5e3 * 1.8f64.powf(columns - 2.0);
                let all = 6.0 * rows;
                let build = rows * rows.max(2.0).log2() * (7.0 + 2.2 * columns);
                (build, leaves * all / (leaves + all))
            }
            Exact::Blocked => {
                let build = if self.is_rounded {
                    0.0
                } else {
                    rows * (40.0 + 6.5 * columns)
                };
                // Columns are compared four at a time.
                let groups = (columns / 4.0).ceil();
                (build, 8e3 + rows * (0.12 + 0.06 * groups))
            }
        };
        build + query * self.n_queries as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cheapest(n_rows: usize, n_features: usize, n_queries: usize) -> Exact {
        Workload {
            n_rows,
            n_features,
            n_queries,
            is_rounded: false,
        }
        .cheapest()
    }

    /// What the measurements behind the constants say.
    #[test]
    fn measured_winners_are_chosen() {
        assert_eq!(cheapest(1_000_000, 2, 10_000), Exact::KdTree);
        assert_eq!(cheapest(1_000_000, 4, 100_000), Exact::KdTree);
        assert_eq!(cheapest(100_000, 8, 100_000), Exact::Blocked);
        assert_eq!(cheapest(10_000, 8, 100_000), Exact::Blocked);
        assert_eq!(cheapest(1_000_000, 31, 10_000), Exact::Blocked);
        // Nothing is worth building for a single question.
        assert_eq!(cheapest(100_000, 31, 1), Exact::Linear);
        // A tree takes long to build, rounded rows do not.
        assert_eq!(cheapest(1_000_000, 2, 300), Exact::Blocked);
    }

    #[test]
    fn rows_rounded_before_cost_no_build() {
        let workload = Workload {
            n_rows: 1_000_000,
            n_features: 2,
            n_queries: 1000,
            is_rounded: true,
        };
        assert_eq!(workload.cheapest(), Exact::Blocked);
        let afresh = Workload {
            n_queries: 100_000,
            ..workload
        };
        assert_eq!(afresh.cheapest(), Exact::KdTree);
    }

    #[test]
    fn no_tree_is_planted_where_none_can_be() {
        for n_rows in [0, 1, 10, 1000, 1_000_000] {
            for n_queries in [0, 1, 1000, 1_000_000_000] {
                let engine = cheapest(n_rows, KdTree::MAX_FEATURES + 1, n_queries);
                assert_ne!(engine, Exact::KdTree, "{n_rows} rows, {n_queries} queries");
            }
        }
    }
}
