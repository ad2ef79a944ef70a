//! Which positions of its input a convolution reads for which positions of its output.

/// A convolution over the time axis, or a linear layer, which is one of a single position.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    /// Stride 1, odd width, padded by half of it at both ends: output position l reads l + tap − taps/2.
    Same {
        /// Width.
        taps: usize,
    },
    /// Width 3, stride 2, padding 1: reads 2·l + tap − 1. Halves the length.
    Halving,
    /// Transposed, width 4, stride 2, padding 1: input position i adds to 2·i + tap − 1. Doubles the length.
    Doubling,
}

impl Kind {
    /// Width of the convolution.
    pub(super) fn taps(self) -> usize {
        match self {
            Self::Same { taps } => taps,
            Self::Halving => 3,
            Self::Doubling => 4,
        }
    }

    /// Positions of the output for an input of `length` positions.
    pub(super) fn output_length(self, length: usize) -> usize {
        match self {
            Self::Same { .. } => length,
            Self::Halving => length.div_ceil(2),
            Self::Doubling => 2 * length,
        }
    }
}

/// A tap of a [`Pass`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Tap {
    /// Which of the convolution's weights.
    pub(super) weight: usize,
    /// Added to the position that is read.
    pub(super) offset: isize,
}

/// Output positions `start + m·step` for m in `0..count`, of which tap k reads input position
/// `m·in_step + taps[k].offset`. A convolution is one or two of these.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Pass {
    pub(super) start: usize,
    pub(super) step: usize,
    pub(super) count: usize,
    pub(super) in_step: usize,
    pub(super) taps: Vec<Tap>,
}

impl Pass {
    fn new(
        start: usize,
        step: usize,
        count: usize,
        in_step: usize,
        taps: &[(usize, isize)],
    ) -> Self {
        let taps = taps.iter().map(|&(weight, offset)| Tap { weight, offset });
        Self {
            start,
            step,
            count,
            in_step,
            taps: taps.collect(),
        }
    }

    /// The input position that a tap reads for output number `m`, if it lies within `length`.
    pub(super) fn reads(&self, m: usize, tap: Tap, length: usize) -> Option<usize> {
        let position = (m * self.in_step).checked_add_signed(tap.offset)?;
        (position < length).then_some(position)
    }
}

/// How the outputs of a convolution come from its inputs of `length` positions.
pub(super) fn forward(kind: Kind, length: usize) -> Vec<Pass> {
    match kind {
        Kind::Same { taps } => {
            let half = (taps / 2) as isize;
            let taps: Vec<_> = (0..taps).map(|k| (k, k as isize - half)).collect();
            vec![Pass::new(0, 1, length, 1, &taps)]
        }
        Kind::Halving => {
            let count = kind.output_length(length);
            vec![Pass::new(0, 1, count, 2, &[(0, -1), (1, 0), (2, 1)])]
        }
        Kind::Doubling => vec![
            Pass::new(0, 2, length, 1, &[(3, -1), (1, 0)]),
            Pass::new(1, 2, length, 1, &[(2, 0), (0, 1)]),
        ],
    }
}

/// How the gradient by a convolution's input of `length` positions comes from the gradient by its output.
pub(super) fn backward(kind: Kind, length: usize) -> Vec<Pass> {
    match kind {
        Kind::Same { taps } => {
            let half = (taps / 2) as isize;
            let taps: Vec<_> = (0..taps).map(|k| (k, half - k as isize)).rev().collect();
            vec![Pass::new(0, 1, length, 1, &taps)]
        }
        Kind::Halving => vec![
            Pass::new(0, 2, length.div_ceil(2), 1, &[(1, 0)]),
            Pass::new(1, 2, length / 2, 1, &[(2, 0), (0, 1)]),
        ],
        Kind::Doubling => {
            let taps = [(0, -1), (1, 0), (2, 1), (3, 2)];
            vec![Pass::new(0, 1, length, 2, &taps)]
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Every (output, weight, input) of the definition, as PyTorch gives it.
    fn by_definition(kind: Kind, length: usize) -> Vec<(usize, usize, usize)> {
        let outputs = kind.output_length(length) as isize;
        let inputs = length as isize;
        let mut found = Vec::new();
        for o in 0..outputs {
            for i in 0..inputs {
                for k in 0..kind.taps() {
                    let k_signed = k as isize;
                    let reads = match kind {
                        Kind::Same { taps } => i == o + k_signed - (taps / 2) as isize,
                        Kind::Halving => i == 2 * o + k_signed - 1,
                        Kind::Doubling => o == 2 * i + k_signed - 1,
                    };
                    if reads {
                        found.push((o as usize, k, i as usize));
                    }
                }
            }
        }
        found.sort_unstable();
        found
    }

    fn by_passes(passes: &[Pass], length: usize) -> Vec<(usize, usize, usize)> {
        let mut found = Vec::new();
        for pass in passes {
            for m in 0..pass.count {
                for &tap in &pass.taps {
                    if let Some(position) = pass.reads(m, tap, length) {
                        found.push((pass.start + m * pass.step, tap.weight, position));
                    }
                }
            }
        }
        found.sort_unstable();
        found
    }

    #[test]
    fn passes_are_the_convolutions_and_their_transposes() {
        let kinds = [
            Kind::Same { taps: 1 },
            Kind::Same { taps: 3 },
            Kind::Same { taps: 5 },
            Kind::Halving,
            Kind::Doubling,
        ];
        for kind in kinds {
            for length in [1, 2, 3, 4, 7, 8] {
                let expected = by_definition(kind, length);
                assert_eq!(by_passes(&forward(kind, length), length), expected);
                let outputs = kind.output_length(length);
                let mut transposed = by_passes(&backward(kind, length), outputs);
                transposed
                    .iter_mut()
                    .for_each(|triple| *triple = (triple.2, triple.1, triple.0));
                transposed.sort_unstable();
                assert_eq!(transposed, expected, "{kind:?} of {length}");
            }
        }
    }
}
