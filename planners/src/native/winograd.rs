//! Convolutions of width 3 and 5 with fewer multiplications: F(4, k) of Winograd (1980; Lavin and Gray 2016).
//!
//! Four neighboring outputs come from k + 3 products instead of 4·k: of inputs and weights transformed by the points
//! 0, ±1, ±2, (±½,) ∞. Since activations of a position lie together, a transformation is a sum of whole rows. For
//! width 5, with Bᵀ, G and Aᵀ as usually named (width 3 has no ±½):
//!
//! ```text
//! Bᵀd: −d0 + 21/4·(d2 − d4) + d6,  (e ± o) per pair of points,  −d1 + 21/4·(d3 − d5) + d7
//! ±1: e = d2 − 17/4·d4 + d6        o = d1 − 17/4·d3 + d5
//! ±2: e = 1/4·d2 − 5/4·d4 + d6     o = 1/2·d1 − 5/2·d3 + 2·d5
//! ±½: e = 4·d2 − 5·d4 + d6         o = 2·d1 − 5/2·d3 + 1/2·d5
//! ```
//!
//! The error against the direct sum is a few 10⁻⁶ of the largest output.

use pulp::{Arch, Simd, WithSimd};

use super::aligned::Aligned;
use super::geometry::Kind;
use super::plan::Layer;
use super::product::{Dense, PANEL, Start, n_panels};

/// Outputs that are computed together.
const TILE: usize = 4;

/// Fewer channels than these are not worth the transformations.
const LEAST_CHANNELS: usize = 32;

/// A group of fewer windows is computed directly: it is bound by reading the weights, of which there are more here.
pub(super) const LEAST_SAMPLES: usize = 4;

/// Numbers of both transformed arrays that stay in the cache.
const GROUP_NUMBERS: usize = 1 << 16;

/// Rows that a product should have at least.
const GROUP_ROWS: usize = 32;

/// Points of the transformation of a layer, if it is one for Winograd.
pub(super) fn n_points(layer: &Layer) -> Option<usize> {
    let fits = |channels: usize| channels >= LEAST_CHANNELS && channels.is_multiple_of(PANEL);
    match layer.kind {
        Kind::Same {
            taps: taps @ (3 | 5),
        } if layer.length.is_multiple_of(TILE) && fits(layer.inputs) && fits(layer.outputs) => {
            Some(taps + TILE - 1)
        }
        _ => None,
    }
}

/// Room for a group's transformed inputs and products, and for other sums meanwhile.
#[derive(Debug, Default)]
pub(super) struct Room {
    inputs: Aligned,
    pub(super) products: Aligned,
}

/// A layer applied to some samples: the same as a [`Product`](super::product::Product), of transformed weights.
pub(super) struct Winograd<'a> {
    /// `[length][samples][inputs]`.
    pub(super) input: &'a [f32],
    pub(super) length: usize,
    pub(super) samples: usize,
    pub(super) inputs: usize,
    pub(super) outputs: usize,
    /// `[point][panel][inputs][PANEL]`.
    pub(super) weights: &'a [f32],
    pub(super) points: usize,
    pub(super) start: Start<'a>,
    /// At least `samples·inputs` zeros.
    pub(super) zeros: &'a [f32],
}

impl Winograd<'_> {
    /// Writes all of `output`, `[length][samples][outputs]`.
    pub(super) fn write(&self, room: &mut Room, output: &mut [f32]) {
        let tiles = self.length / TILE;
        let of_tile = self.points * self.samples * (self.inputs + self.outputs);
        let group = (GROUP_NUMBERS / of_tile).max(GROUP_ROWS.div_ceil(self.samples));
        for first in (0..tiles).step_by(group) {
            let n = group.min(tiles - first);
            let rows = n * self.samples;
            room.inputs.grow(self.points * rows * self.inputs);
            room.products.grow(self.points * rows * self.outputs);
            let run = Group {
                winograd: self,
                first,
                n,
            };
            run.transform_inputs(&mut room.inputs);
            Dense {
                input: &room.inputs[..self.points * rows * self.inputs],
                points: self.points,
                inputs: self.inputs,
                outputs: self.outputs,
                weights: self.weights,
                output: &mut room.products[..self.points * rows * self.outputs],
            }
            .run();
            run.transform_products(&room.products, output);
        }
    }
}

/// Some tiles of four positions.
struct Group<'a> {
    winograd: &'a Winograd<'a>,
    first: usize,
    n: usize,
}

impl Group<'_> {
    fn transform_inputs(&self, inputs: &mut [f32]) {
        let Winograd {
            input,
            length,
            samples,
            points,
            zeros,
            ..
        } = *self.winograd;
        let len = samples * self.winograd.inputs;
        let before = (points - TILE) / 2;
        for tile in 0..self.n {
            let mut from = [&zeros[..len]; MOST_POINTS];
            for (j, from) in from[..points].iter_mut().enumerate() {
                let position = ((self.first + tile) * TILE + j).checked_sub(before);
                if let Some(position) = position.filter(|position| *position < length) {
                    *from = &input[position * len..][..len];
                }
            }
            let mut to = rows_of(inputs, self.n * len, tile * len..(tile + 1) * len);
            Arch::new().dispatch(Transform {
                which: Which::Inputs,
                five: points == MOST_POINTS,
                from: &from[..points],
                to: &mut to,
            });
        }
    }

    fn transform_products(&self, products: &[f32], output: &mut [f32]) {
        let winograd = self.winograd;
        let len = winograd.samples * winograd.outputs;
        for tile in 0..self.n {
            let mut from = [winograd.zeros; MOST_POINTS];
            for (point, from) in from[..winograd.points].iter_mut().enumerate() {
                *from = &products[(point * self.n + tile) * len..][..len];
            }
            let output = &mut output[(self.first + tile) * TILE * len..][..TILE * len];
            match winograd.start {
                Start::Output => {}
                Start::Zero => output.fill(0.0),
                Start::Bias(bias) => {
                    for row in output.chunks_exact_mut(winograd.outputs) {
                        row.copy_from_slice(&bias[..winograd.outputs]);
                    }
                }
            }
            let mut to = rows_of(output, len, 0..len);
            Arch::new().dispatch(Transform {
                which: Which::Products,
                five: winograd.points == MOST_POINTS,
                from: &from[..winograd.points],
                to: &mut to,
            });
        }
    }
}

/// The same range of every row of so many numbers.
fn rows_of(numbers: &mut [f32], row: usize, range: std::ops::Range<usize>) -> Vec<&mut [f32]> {
    let rows = numbers.chunks_exact_mut(row);
    rows.map(|row| &mut row[range.clone()]).collect()
}

/// Writes the transformed weights of a layer, `[point][panel][depth][PANEL]` from `[panel][tap][depth][PANEL]`; for
/// the way back the taps are in reverse order.
pub(super) fn transform_weights(
    weights: &[f32],
    (taps, depth, outputs): (usize, usize, usize),
    reversed: bool,
    transformed: &mut [f32],
) {
    let len = depth * PANEL;
    let panels = n_panels(outputs);
    for panel in 0..panels {
        let mut from: Vec<&[f32]> = weights[panel * taps * len..][..taps * len]
            .chunks_exact(len)
            .collect();
        if reversed {
            from.reverse();
        }
        let mut to = rows_of(transformed, panels * len, panel * len..(panel + 1) * len);
        Arch::new().dispatch(Transform {
            which: Which::Weights,
            five: taps == 5,
            from: &from,
            to: &mut to,
        });
    }
}

/// Points for width 5.
const MOST_POINTS: usize = 8;

#[derive(Clone, Copy)]
enum Which {
    Inputs,
    Weights,
    Products,
}

/// Sums of rows, all as long as each other and a multiple of [`PANEL`].
struct Transform<'a, 'b> {
    which: Which,
    /// Width 5, otherwise 3.
    five: bool,
    from: &'a [&'a [f32]],
    to: &'a mut [&'b mut [f32]],
}

impl WithSimd for Transform<'_, '_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        match (self.which, self.five) {
            (Which::Inputs, true) => self.rows::<S, 8, 8, InputsOf5>(simd),
            (Which::Inputs, false) => self.rows::<S, 6, 6, InputsOf3>(simd),
            (Which::Weights, true) => self.rows::<S, 5, 8, WeightsOf5>(simd),
            (Which::Weights, false) => self.rows::<S, 3, 6, WeightsOf3>(simd),
            (Which::Products, true) => self.rows::<S, 8, 4, ProductsOf5>(simd),
            (Which::Products, false) => self.rows::<S, 6, 4, ProductsOf3>(simd),
        }
    }
}

/// What a transformation makes of one vector of each row.
trait Formula<const FROM: usize, const TO: usize> {
    /// The results are added to what is there.
    const ADDS: bool = false;

    fn apply<S: Simd>(v: Vectors<S>, from: [S::f32s; FROM]) -> [S::f32s; TO];
}

impl Transform<'_, '_> {
    // Loops, not closures over arrays: those would not become part of the vectorized function.
    #[expect(clippy::needless_range_loop, reason = "several arrays at a time")]
    #[inline(always)]
    fn rows<S: Simd, const FROM: usize, const TO: usize, F: Formula<FROM, TO>>(self, simd: S) {
        let len = self.to[0].len();
        let n = len / S::F32_LANES;
        let mut from: [&[S::f32s]; FROM] = [&[]; FROM];
        for i in 0..FROM {
            from[i] = &S::as_simd_f32s(&self.from[i][..len]).0[..n];
        }
        for at in 0..n {
            let mut vectors = [simd.splat_f32s(0.0); FROM];
            for i in 0..FROM {
                vectors[i] = from[i][at];
            }
            let results = F::apply::<S>(Vectors { simd }, vectors);
            for i in 0..TO {
                let to = &mut S::as_mut_simd_f32s(&mut self.to[i][..len]).0[at];
                *to = if F::ADDS {
                    simd.add_f32s(*to, results[i])
                } else {
                    results[i]
                };
            }
        }
    }
}

/// Sums of vectors.
#[derive(Clone, Copy)]
struct Vectors<S: Simd> {
    simd: S,
}

impl<S: Simd> Vectors<S> {
    #[inline(always)]
    fn scale(self, factor: f32, x: S::f32s) -> S::f32s {
        self.simd.mul_f32s(self.simd.splat_f32s(factor), x)
    }

    /// factor·x + y
    #[inline(always)]
    fn plus(self, factor: f32, x: S::f32s, y: S::f32s) -> S::f32s {
        self.simd.mul_add_f32s(self.simd.splat_f32s(factor), x, y)
    }

    /// y + x and y − x
    #[inline(always)]
    fn pair(self, y: S::f32s, x: S::f32s) -> (S::f32s, S::f32s) {
        (self.simd.add_f32s(y, x), self.simd.sub_f32s(y, x))
    }
}

struct InputsOf5;

impl Formula<8, 8> for InputsOf5 {
    #[inline(always)]
    fn apply<S: Simd>(v: Vectors<S>, d: [S::f32s; 8]) -> [S::f32s; 8] {
        let first = v.plus(
            5.25,
            v.simd.sub_f32s(d[2], d[4]),
            v.simd.sub_f32s(d[6], d[0]),
        );
        let last = v.plus(
            5.25,
            v.simd.sub_f32s(d[3], d[5]),
            v.simd.sub_f32s(d[7], d[1]),
        );
        let one = v.pair(
            v.plus(-4.25, d[4], v.simd.add_f32s(d[2], d[6])),
            v.plus(-4.25, d[3], v.simd.add_f32s(d[1], d[5])),
        );
        let two = v.pair(
            v.plus(0.25, d[2], v.plus(-1.25, d[4], d[6])),
            v.plus(0.5, d[1], v.plus(-2.5, d[3], v.scale(2.0, d[5]))),
        );
        let half = v.pair(
            v.plus(4.0, d[2], v.plus(-5.0, d[4], d[6])),
            v.plus(2.0, d[1], v.plus(-2.5, d[3], v.scale(0.5, d[5]))),
        );
        [first, one.0, one.1, two.0, two.1, half.0, half.1, last]
    }
}

struct InputsOf3;

impl Formula<6, 6> for InputsOf3 {
    #[inline(always)]
    fn apply<S: Simd>(v: Vectors<S>, d: [S::f32s; 6]) -> [S::f32s; 6] {
        let first = v.plus(4.0, d[0], v.plus(-5.0, d[2], d[4]));
        let last = v.plus(4.0, d[1], v.plus(-5.0, d[3], d[5]));
        let one = v.pair(v.plus(-4.0, d[2], d[4]), v.plus(-4.0, d[1], d[3]));
        let two = v.pair(
            v.simd.sub_f32s(d[4], d[2]),
            v.scale(2.0, v.simd.sub_f32s(d[3], d[1])),
        );
        [first, one.0, one.1, two.0, two.1, last]
    }
}

struct WeightsOf5;

impl Formula<5, 8> for WeightsOf5 {
    #[inline(always)]
    fn apply<S: Simd>(v: Vectors<S>, g: [S::f32s; 5]) -> [S::f32s; 8] {
        let third = -2.0 / 9.0;
        let one = v.pair(
            v.scale(third, v.simd.add_f32s(v.simd.add_f32s(g[0], g[2]), g[4])),
            v.scale(third, v.simd.add_f32s(g[1], g[3])),
        );
        let two = v.pair(
            v.scale(1.0 / 90.0, v.plus(16.0, g[4], v.plus(4.0, g[2], g[0]))),
            v.scale(1.0 / 45.0, v.plus(4.0, g[3], g[1])),
        );
        let half = v.pair(
            v.scale(2.0 / 45.0, v.plus(16.0, g[0], v.plus(4.0, g[2], g[4]))),
            v.scale(4.0 / 45.0, v.plus(4.0, g[1], g[3])),
        );
        let first = v.scale(-1.0, g[0]);
        [first, one.0, one.1, two.0, two.1, half.0, half.1, g[4]]
    }
}

struct WeightsOf3;

impl Formula<3, 6> for WeightsOf3 {
    #[inline(always)]
    fn apply<S: Simd>(v: Vectors<S>, g: [S::f32s; 3]) -> [S::f32s; 6] {
        let sixth = -1.0 / 6.0;
        let one = v.pair(
            v.scale(sixth, v.simd.add_f32s(g[0], g[2])),
            v.scale(sixth, g[1]),
        );
        let two = v.pair(
            v.scale(1.0 / 24.0, v.plus(4.0, g[2], g[0])),
            v.scale(1.0 / 12.0, g[1]),
        );
        [v.scale(0.25, g[0]), one.0, one.1, two.0, two.1, g[2]]
    }
}

struct ProductsOf5;

impl Formula<8, 4> for ProductsOf5 {
    const ADDS: bool = true;

    #[inline(always)]
    fn apply<S: Simd>(v: Vectors<S>, m: [S::f32s; 8]) -> [S::f32s; 4] {
        let (one, two, half) = (v.pair(m[1], m[2]), v.pair(m[3], m[4]), v.pair(m[5], m[6]));
        let sums = v.simd.add_f32s(v.simd.add_f32s(one.0, two.0), half.0);
        [
            v.simd.add_f32s(m[0], sums),
            v.plus(0.5, half.1, v.plus(2.0, two.1, one.1)),
            v.plus(0.25, half.0, v.plus(4.0, two.0, one.0)),
            v.plus(
                0.125,
                half.1,
                v.plus(8.0, two.1, v.simd.add_f32s(one.1, m[7])),
            ),
        ]
    }
}

struct ProductsOf3;

impl Formula<6, 4> for ProductsOf3 {
    const ADDS: bool = true;

    #[inline(always)]
    fn apply<S: Simd>(v: Vectors<S>, m: [S::f32s; 6]) -> [S::f32s; 4] {
        let (one, two) = (v.pair(m[1], m[2]), v.pair(m[3], m[4]));
        [
            v.simd.add_f32s(m[0], v.simd.add_f32s(one.0, two.0)),
            v.plus(2.0, two.1, one.1),
            v.plus(4.0, two.0, one.0),
            v.plus(8.0, two.1, v.simd.add_f32s(one.1, m[5])),
        ]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Four outputs of one channel, against the sum.
    fn check<const TAPS: usize>(tolerance: f32) {
        let len = PANEL;
        let number =
            |seed: usize| (0..len).map(move |i| ((seed * 31 + i * 7) % 97) as f32 / 97.0 - 0.4);
        let points = TAPS + TILE - 1;
        let weights: Vec<Vec<f32>> = (0..TAPS).map(|k| number(k + 50).collect()).collect();
        let inputs: Vec<Vec<f32>> = (0..points).map(|j| number(j).collect()).collect();
        let transform = |which, from: &[Vec<f32>], n: usize| {
            let from: Vec<&[f32]> = from.iter().map(Vec::as_slice).collect();
            let mut to = vec![vec![0.0; len]; n];
            let mut rows: Vec<&mut [f32]> = to.iter_mut().map(Vec::as_mut_slice).collect();
            Arch::new().dispatch(Transform {
                which,
                five: TAPS == 5,
                from: &from,
                to: &mut rows,
            });
            to
        };
        let u = transform(Which::Weights, &weights, points);
        let v = transform(Which::Inputs, &inputs, points);
        let pairs = u.iter().zip(&v);
        let products: Vec<Vec<f32>> = pairs
            .map(|(u, v)| u.iter().zip(v).map(|(u, v)| u * v).collect())
            .collect();
        let outputs = transform(Which::Products, &products, TILE);
        for (l, output) in outputs.iter().enumerate() {
            for (i, output) in output.iter().enumerate() {
                let sum: f32 = (0..TAPS).map(|k| inputs[l + k][i] * weights[k][i]).sum();
                assert!((sum - output).abs() < tolerance, "{sum} {output}");
            }
        }
    }

    #[test]
    fn transformed_products_are_the_convolution() {
        check::<3>(1e-6);
        check::<5>(4e-6);
    }
}
