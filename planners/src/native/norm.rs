//! Group norm (Wu and He 2018) and the Mish after it, in one.
//!
//! Every channel is summed over positions, every group over its channels, both in their order: a sample's numbers do
//! not depend on the samples beside it.

use pulp::{Arch, Simd, WithSimd};

use super::mish::mish;

/// PyTorch's default.
const EPSILON: f32 = 1e-5;

/// Sizes of the activations, `[length][samples][channels]`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sizes {
    pub(super) length: usize,
    pub(super) samples: usize,
    pub(super) channels: usize,
    pub(super) groups: usize,
}

impl Sizes {
    fn row(&self, position: usize, sample: usize) -> usize {
        (position * self.samples + sample) * self.channels
    }

    fn group_size(&self) -> usize {
        self.channels / self.groups
    }
}

/// What is added after the Mish.
#[derive(Clone, Copy)]
pub(super) enum Plus<'a> {
    Nothing,
    /// Per sample a row at `sample·stride`, the same at every position: the time.
    Rows {
        rows: &'a [f32],
        stride: usize,
    },
    /// As large as the activations.
    All(&'a [f32]),
}

/// Where the way back finds what it needs.
pub(super) struct Kept<'a> {
    /// Derivatives of the Mish.
    pub(super) slopes: &'a mut [f32],
    /// One over the standard deviation, `[samples][groups]`.
    pub(super) scales: &'a mut [f32],
}

/// A norm, the Mish after it, and what is added to that: y = Mish(norm(x)·gain + shift) + plus.
pub(super) struct Forward<'a> {
    pub(super) sizes: Sizes,
    pub(super) gain: &'a [f32],
    pub(super) shift: &'a [f32],
    pub(super) plus: Plus<'a>,
    /// If it is given, `x` becomes norm(x).
    pub(super) kept: Option<Kept<'a>>,
    pub(super) x: &'a mut [f32],
    pub(super) y: &'a mut [f32],
}

impl Forward<'_> {
    pub(super) fn run(self) {
        Arch::new().dispatch(self);
    }
}

impl WithSimd for Forward<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, _: S) {
        let sizes = self.sizes;
        let channels = sizes.channels;
        let (gain, shift) = (&self.gain[..channels], &self.shift[..channels]);
        let mut means = vec![0.0; channels];
        let mut scales = vec![0.0; channels];
        for n in 0..sizes.samples {
            moments(sizes, n, self.x, &mut means, &mut scales);
            for l in 0..sizes.length {
                let row = sizes.row(l, n);
                let x = &mut self.x[row..][..channels];
                let y = &mut self.y[row..][..channels];
                match &mut self.kept {
                    None => activate(x, y, (&means, &scales), (gain, shift)),
                    Some(kept) => {
                        let slopes = &mut kept.slopes[row..][..channels];
                        activate_kept(x, y, slopes, (&means, &scales), (gain, shift));
                    }
                }
                match self.plus {
                    Plus::Nothing => {}
                    Plus::Rows { rows, stride } => add(y, &rows[n * stride..][..channels]),
                    Plus::All(all) => add(y, &all[row..][..channels]),
                }
            }
            if let Some(kept) = &mut self.kept {
                let kept = &mut kept.scales[n * sizes.groups..][..sizes.groups];
                for (kept, group) in kept.iter_mut().zip(scales.chunks_exact(sizes.group_size())) {
                    *kept = group[0];
                }
            }
        }
    }
}

#[inline(always)]
fn add(y: &mut [f32], plus: &[f32]) {
    for (y, plus) in y.iter_mut().zip(plus) {
        *y += plus;
    }
}

#[inline(always)]
fn activate(x: &[f32], y: &mut [f32], moments: (&[f32], &[f32]), affine: (&[f32], &[f32])) {
    let n = y.len();
    let (means, scales) = (&moments.0[..n], &moments.1[..n]);
    let (gain, shift, x) = (&affine.0[..n], &affine.1[..n], &x[..n]);
    for c in 0..n {
        let normal = (x[c] - means[c]) * scales[c];
        y[c] = mish(normal.mul_add(gain[c], shift[c])).0;
    }
}

#[inline(always)]
fn activate_kept(
    x: &mut [f32],
    y: &mut [f32],
    slopes: &mut [f32],
    moments: (&[f32], &[f32]),
    affine: (&[f32], &[f32]),
) {
    let n = y.len();
    let (means, scales) = (&moments.0[..n], &moments.1[..n]);
    let (gain, shift) = (&affine.0[..n], &affine.1[..n]);
    let (x, slopes) = (&mut x[..n], &mut slopes[..n]);
    for c in 0..n {
        let normal = (x[c] - means[c]) * scales[c];
        (y[c], slopes[c]) = mish(normal.mul_add(gain[c], shift[c]));
        x[c] = normal;
    }
}

/// Mean and one over the standard deviation of every channel's group, for sample `n`.
#[inline(always)]
fn moments(sizes: Sizes, n: usize, x: &[f32], means: &mut [f32], scales: &mut [f32]) {
    let channels = sizes.channels;
    let over = 1.0 / (sizes.length * sizes.group_size()) as f32;
    let (means, scales) = (&mut means[..channels], &mut scales[..channels]);
    means.fill(0.0);
    for l in 0..sizes.length {
        let x = &x[sizes.row(l, n)..][..channels];
        for c in 0..channels {
            means[c] += x[c];
        }
    }
    spread_means(means, sizes.group_size(), over);
    scales.fill(0.0);
    for l in 0..sizes.length {
        let x = &x[sizes.row(l, n)..][..channels];
        for c in 0..channels {
            let off = x[c] - means[c];
            scales[c] = off.mul_add(off, scales[c]);
        }
    }
    spread_means(scales, sizes.group_size(), over);
    for scale in scales {
        *scale = 1.0 / (*scale + EPSILON).sqrt();
    }
}

/// Puts the mean of every group, the sum times `over`, in place of its numbers.
#[inline(always)]
fn spread_means(numbers: &mut [f32], group_size: usize, over: f32) {
    for group in numbers.chunks_exact_mut(group_size) {
        let mean = sum(group) * over;
        group.fill(mean);
    }
}

/// A sum in a fixed order that can be vectorized: eight strands, then these.
#[inline(always)]
fn sum(numbers: &[f32]) -> f32 {
    let (chunks, rest) = numbers.as_chunks::<8>();
    let mut strands = [0.0f32; 8];
    for chunk in chunks {
        for (strand, x) in strands.iter_mut().zip(chunk) {
            *strand += x;
        }
    }
    let mut sum = 0.0;
    for strand in strands {
        sum += strand;
    }
    for x in rest {
        sum += x;
    }
    sum
}

/// The way back of [`forward`].
pub(super) struct Backward<'a> {
    pub(super) sizes: Sizes,
    pub(super) gain: &'a [f32],
    /// Derivatives of the Mish, as kept; overwritten.
    pub(super) slopes: &'a mut [f32],
    /// One over the standard deviation, as kept.
    pub(super) scales: &'a [f32],
    /// Gradients by gain and shift, added to.
    pub(super) parameters: Option<(&'a mut [f32], &'a mut [f32])>,
    /// The gradient by the output.
    pub(super) dy: &'a [f32],
    /// norm(x) as kept; becomes the gradient by the input.
    pub(super) x: &'a mut [f32],
}

impl WithSimd for Backward<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(mut self, _: S) {
        let channels = self.sizes.channels;
        let size = self.sizes.group_size();
        let over = 1.0 / (self.sizes.length * size) as f32;
        let mut sums = vec![0.0; channels];
        let mut products = vec![0.0; channels];
        for n in 0..self.sizes.samples {
            self.sum(n, &mut sums, &mut products);
            if let Some((by_gain, by_shift)) = &mut self.parameters {
                add(&mut by_gain[..channels], &products);
                add(&mut by_shift[..channels], &sums);
            }
            for (c, gain) in self.gain[..channels].iter().enumerate() {
                sums[c] *= gain;
                products[c] *= gain;
            }
            spread_means(&mut sums, size, over);
            spread_means(&mut products, size, over);
            self.write(n, &sums, &products);
        }
    }
}

impl Backward<'_> {
    pub(super) fn run(self) {
        Arch::new().dispatch(self);
    }

    /// Turns the slopes into gradients by the Mish's input; sums them per channel, and their products with norm(x).
    #[inline(always)]
    fn sum(&mut self, n: usize, sums: &mut [f32], products: &mut [f32]) {
        let channels = self.sizes.channels;
        let (sums, products) = (&mut sums[..channels], &mut products[..channels]);
        sums.fill(0.0);
        products.fill(0.0);
        for l in 0..self.sizes.length {
            let row = self.sizes.row(l, n);
            let (dy, x) = (&self.dy[row..][..channels], &self.x[row..][..channels]);
            let slopes = &mut self.slopes[row..][..channels];
            for c in 0..channels {
                let dz = dy[c] * slopes[c];
                slopes[c] = dz;
                sums[c] += dz;
                products[c] = dz.mul_add(x[c], products[c]);
            }
        }
    }

    #[inline(always)]
    fn write(&mut self, n: usize, means: &[f32], slants: &[f32]) {
        let (channels, size) = (self.sizes.channels, self.sizes.group_size());
        let scales = &self.scales[n * self.sizes.groups..][..self.sizes.groups];
        for l in 0..self.sizes.length {
            let row = self.sizes.row(l, n);
            let x = &mut self.x[row..][..channels];
            let dz = &self.slopes[row..][..channels];
            let gain = &self.gain[..channels];
            for (group, &scale) in scales.iter().enumerate() {
                let range = group * size..(group + 1) * size;
                let (mean, slant) = (means[range.start], slants[range.start]);
                let (x, dz, gain) = (&mut x[range.clone()], &dz[range.clone()], &gain[range]);
                for c in 0..size {
                    let off = (-x[c]).mul_add(slant, dz[c].mul_add(gain[c], -mean));
                    x[c] = off * scale;
                }
            }
        }
    }
}
