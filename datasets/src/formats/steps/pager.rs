//! Cutting the rows of many episodes into batches.

/// Rows `from..to` of one episode.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Piece {
    /// Place of the episode in the list of episodes.
    pub(crate) episode: usize,
    pub(crate) from: u64,
    pub(crate) to: u64,
}

/// Hands out batches of at most `batch_rows` rows.
///
/// A batch is cut short at an episode border if the next episode fits a batch but not the rest of this one:
/// so no episode is opened twice but those longer than a batch.
#[derive(Debug)]
pub(crate) struct Pager {
    batch_rows: u64,
    episode: usize,
    from: u64,
}

impl Pager {
    pub(crate) fn new(batch_rows: usize) -> Self {
        Self {
            batch_rows: (batch_rows as u64).max(1),
            episode: 0,
            from: 0,
        }
    }

    /// The pieces of the next batch; none at the end. `rows_of` gives an episode's number of rows (0 skips
    /// it), or `None` past the last episode; its error ends the pass.
    pub(crate) fn next_batch<E>(
        &mut self,
        mut rows_of: impl FnMut(usize) -> Option<Result<u64, E>>,
    ) -> Result<Vec<Piece>, E> {
        let mut pieces: Vec<Piece> = Vec::new();
        let mut room = self.batch_rows;
        while room > 0 {
            let Some(rows) = rows_of(self.episode) else {
                break;
            };
            let rows = rows?;
            let left = rows.saturating_sub(self.from);
            if left > room && left <= self.batch_rows && !pieces.is_empty() {
                break;
            }
            let taken = left.min(room);
            if taken > 0 {
                pieces.push(Piece {
                    episode: self.episode,
                    from: self.from,
                    to: self.from + taken,
                });
            }
            room -= taken;
            self.from += taken;
            if self.from >= rows {
                self.episode += 1;
                self.from = 0;
            }
        }
        Ok(pieces)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn all(batch_rows: usize, rows: &[u64]) -> Vec<Vec<(usize, u64, u64)>> {
        let mut pager = Pager::new(batch_rows);
        let mut batches = Vec::new();
        loop {
            let next = pager
                .next_batch(|e| rows.get(e).map(|&n| Ok::<_, ()>(n)))
                .unwrap();
            if next.is_empty() {
                return batches;
            }
            batches.push(next.iter().map(|p| (p.episode, p.from, p.to)).collect());
        }
    }

    #[test]
    fn short_episodes_stay_whole() {
        assert_eq!(
            all(5, &[3, 3, 0, 2]),
            [vec![(0, 0, 3)], vec![(1, 0, 3), (3, 0, 2)]]
        );
        assert_eq!(
            all(2, &[5]),
            [vec![(0, 0, 2)], vec![(0, 2, 4)], vec![(0, 4, 5)]]
        );
        assert!(all(4, &[]).is_empty());
    }

    proptest! {
        #[test]
        fn every_row_comes_once_and_in_order(batch in 1usize..9, rows in prop::collection::vec(0u64..12, 0..9)) {
            let seen: Vec<(usize, u64)> = all(batch, &rows)
                .into_iter()
                .inspect(|pieces| {
                    let n: u64 = pieces.iter().map(|(_, from, to)| to - from).sum();
                    assert!(n >= 1 && n <= batch as u64);
                })
                .flatten()
                .flat_map(|(episode, from, to)| (from..to).map(move |row| (episode, row)))
                .collect();
            let expected: Vec<(usize, u64)> =
                rows.iter().enumerate().flat_map(|(e, &n)| (0..n).map(move |row| (e, row))).collect();
            prop_assert_eq!(seen, expected);
        }
    }
}
