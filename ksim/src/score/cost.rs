//! What an exact search is expected to cost: a model with measured constants, by which `auto` chooses.
//!
//! The constants are nanoseconds of one thread, read off `ksim bench search` on the states of AntMaze,
//! 10³ to 10⁶ rows of 2 to 8 columns and of 31, K = 50 (`docs/adr/0016`), where they are right within a
//! factor of two. Only their ratios matter. A k-d tree also depends on how many directions the data
//! really have, which no model knows beforehand: on smooth curves it is up to seven times faster.

use super::params::Search;
use crate::neighbors::KdTree;

/// Nanoseconds.
#[derive(Debug, Clone, Copy)]
struct Cost {
    build: f64,
    query: f64,
}

/// A job that an engine is to be chosen for.
#[derive(Debug, Clone, Copy)]
pub(super) struct Workload {
    /// Rows of the reference.
    pub(super) n_rows: usize,
    /// Columns searched in.
    pub(super) n_features: usize,
    /// Queries over the life of the engine.
    pub(super) n_queries: usize,
    /// Whether the rows were rounded before, which is what `blocked` builds.
    pub(super) is_rounded: bool,
}

impl Workload {
    /// The engine that is expected to take least, building included.
    pub(super) fn cheapest(&self) -> Search {
        let (rows, columns) = (self.n_rows as f64, self.n_features as f64);
        // Few rows are all looked at; of many, those of so many leaves.
        let (leaves, all) = (5.5e3 * 1.8f64.powf(columns - 2.0), 6.0 * rows);
        let tree = Cost {
            build: rows * rows.max(2.0).log2() * (7.0 + 2.2 * columns),
            query: leaves * all / (leaves + all),
        };
        // Columns are compared four at a time.
        let groups = (columns / 4.0).ceil();
        let blocked = Cost {
            build: if self.is_rounded {
                0.0
            } else {
                rows * (40.0 + 6.5 * columns)
            },
            query: 8e3 + rows * (0.12 + 0.06 * groups),
        };
        let linear = Cost {
            build: 0.0,
            query: rows * (8.0 + columns),
        };
        let total = |cost: Cost| cost.build + cost.query * self.n_queries as f64;
        let mut cheapest = (Search::Blocked, total(blocked));
        let can_be_a_tree = self.n_features <= KdTree::MAX_FEATURES;
        if can_be_a_tree && total(tree) < cheapest.1 {
            cheapest = (Search::KdTree, total(tree));
        }
        if total(linear) < cheapest.1 {
            cheapest = (Search::Linear, total(linear));
        }
        cheapest.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cheapest(n_rows: usize, n_features: usize, n_queries: usize) -> Search {
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
        assert_eq!(cheapest(1_000_000, 2, 10_000), Search::KdTree);
        assert_eq!(cheapest(1_000_000, 4, 100_000), Search::KdTree);
        assert_eq!(cheapest(100_000, 8, 100_000), Search::Blocked);
        assert_eq!(cheapest(10_000, 8, 100_000), Search::Blocked);
        assert_eq!(cheapest(1_000_000, 31, 10_000), Search::Blocked);
        // Nothing is worth building for a single question.
        assert_eq!(cheapest(100_000, 31, 1), Search::Linear);
        // A tree takes long to build, rounded rows do not.
        assert_eq!(cheapest(1_000_000, 2, 300), Search::Blocked);
    }

    #[test]
    fn rows_rounded_before_cost_no_build() {
        let workload = Workload {
            n_rows: 1_000_000,
            n_features: 2,
            n_queries: 1000,
            is_rounded: true,
        };
        assert_eq!(workload.cheapest(), Search::Blocked);
        let afresh = Workload {
            n_queries: 100_000,
            ..workload
        };
        assert_eq!(afresh.cheapest(), Search::KdTree);
    }

    #[test]
    fn no_tree_is_planted_where_none_can_be() {
        for n_rows in [0, 1, 10, 1000, 1_000_000] {
            for n_queries in [0, 1, 1000, 1_000_000_000] {
                let engine = cheapest(n_rows, KdTree::MAX_FEATURES + 1, n_queries);
                assert_ne!(engine, Search::KdTree, "{n_rows} rows, {n_queries} queries");
            }
        }
    }
}
