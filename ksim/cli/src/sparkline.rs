//! Scores as a line of blocks.

use std::io::IsTerminal as _;

use clap::ValueEnum;

/// Eighths of a line's height.
const BLOCKS: [char; 8] = ['▁', '▂', '▃', '▄', '▅', '▆', '▇', '█'];

/// Blocks of a line, at most.
pub(crate) const WIDTH: usize = 60;

/// When lines are drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum When {
    /// If stdout is a terminal
    Auto,
    /// Whatever stdout is
    Always,
    /// Not at all
    Never,
}

impl When {
    /// Whether now.
    pub(crate) fn is_now(self) -> bool {
        match self {
            Self::Auto => std::io::stdout().is_terminal(),
            Self::Always => true,
            Self::Never => false,
        }
    }
}

/// The scores of an episode's steps, 0 to 1 from the lowest block to a full one. Where steps are more than `width`
/// blocks, a block is the lowest of its steps.
pub(crate) fn line(scores: impl ExactSizeIterator<Item = f64>, width: usize) -> String {
    let n = scores.len();
    let width = width.min(n);
    let mut lowest = vec![f64::INFINITY; width];
    for (step, score) in scores.enumerate() {
        let block = &mut lowest[step * width / n];
        *block = block.min(score);
    }
    let block = |score: &f64| BLOCKS[((score * 8.0) as usize).min(7)];
    lowest.iter().map(block).collect()
}

#[cfg(test)]
mod tests {
    #[test]
    fn a_block_is_the_lowest_of_its_steps() {
        let line = |scores: &[f64]| super::line(scores.iter().copied(), 4);
        assert_eq!(line(&[0.0, 0.5, 0.874, 1.0]), "▁▅▇█");
        assert_eq!(line(&[1.0, 0.1, 1.0, 1.0, 1.0, 1.0, 1.0, 0.5]), "▁██▅");
        assert_eq!(line(&[0.3]), "▃");
        assert_eq!(line(&[]), "");
    }
}
