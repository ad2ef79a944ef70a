//! Mish, x·tanh(softplus(x)) (Misra 2019), and its derivative, for compilers to vectorize.

use pulp::{Arch, Simd, WithSimd};

/// e^x to about one unit in the last place, for x within ±87.
#[inline(always)]
fn exp(x: f32) -> f32 {
    // Cody and Waite: x = n·ln 2 + r with |r| ≤ ln 2 / 2. Adding and taking away 1.5·2²³ rounds to an integer, whose
    // bits end the sum.
    const ROUND: f32 = 12_582_912.0;
    const LN_2_HIGH: f32 = 0.693_359_4;
    const LN_2_LOW: f32 = -2.121_944_4e-4;
    let shifted = x.mul_add(std::f32::consts::LOG2_E, ROUND);
    let n = shifted - ROUND;
    let r = (-n).mul_add(LN_2_LOW, (-n).mul_add(LN_2_HIGH, x));
    // The polynomial of Cephes (Moshier 1992).
    let mut p = 1.987_569_1e-4f32;
    for coefficient in [
        1.398_2e-3,
        8.333_452e-3,
        4.166_579_6e-2,
        1.666_666_5e-1,
        0.5,
    ] {
        p = p.mul_add(r, coefficient);
    }
    let mantissa = p.mul_add(r * r, r) + 1.0;
    let exponent = shifted.to_bits().wrapping_add(127) << 23;
    mantissa * f32::from_bits(exponent)
}

/// Mish of `x`, and its derivative there.
///
/// With e = eˣ and w = e² + 2e: tanh(softplus(x)) = w/(w + 2), and the derivative is that plus
/// 4·x·e·(1 + e)/(w + 2)².
#[inline(always)]
pub(super) fn mish(x: f32) -> (f32, f32) {
    // Beyond ±20 and ±80 nothing changes in f32.
    let e = exp(x.clamp(-80.0, 20.0));
    let w = e * (e + 2.0);
    let q = 1.0 / (w + 2.0);
    let tanh = w * q;
    let slope = (4.0 * x * q).mul_add((e.mul_add(e, e)) * q, tanh);
    (x * tanh, slope)
}

/// Mish of every number; the derivative too, where there is room for it.
pub(super) fn apply(x: &[f32], out: &mut [f32], slopes: Option<&mut [f32]>) {
    Arch::new().dispatch(Apply { x, out, slopes });
}

struct Apply<'a> {
    x: &'a [f32],
    out: &'a mut [f32],
    slopes: Option<&'a mut [f32]>,
}

impl WithSimd for Apply<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        match self.slopes {
            None => {
                for (out, x) in self.out.iter_mut().zip(self.x) {
                    *out = mish(*x).0;
                }
            }
            Some(slopes) => {
                for ((out, slope), x) in self.out.iter_mut().zip(slopes).zip(self.x) {
                    (*out, *slope) = mish(*x);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mish_and_slope_are_right_to_a_few_units_in_the_last_place() {
        for i in -4000..4000 {
            let x = i as f32 * 0.025;
            let z = f64::from(x);
            let softplus = if z > 30.0 { z } else { z.exp().ln_1p() };
            let tanh = softplus.tanh();
            let sigmoid = 1.0 / (1.0 + (-z).exp());
            let slope = tanh + z * sigmoid * (1.0 - tanh * tanh);
            let found = mish(x);
            let scale = z.abs().max(1.0);
            assert!((f64::from(found.0) - z * tanh).abs() < 3e-7 * scale, "{x}");
            assert!((f64::from(found.1) - slope).abs() < 6e-7, "{x}");
        }
    }
}
