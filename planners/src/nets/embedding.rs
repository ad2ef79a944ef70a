//! How a timestep becomes numbers.

use super::architecture::TimestepEmbedding;

impl TimestepEmbedding {
    /// Writes the embedding of `t`, as many numbers as `out` has (even), cosines first.
    pub fn embed(self, t: f32, out: &mut [f32]) {
        let half = out.len() / 2;
        let (cosines, sines) = out.split_at_mut(half);
        for (k, (cosine, sine)) in cosines.iter_mut().zip(sines).enumerate() {
            let frequency = match self {
                Self::Integer => f32::from(k == 0),
                Self::Sinusoidal => (1e-4f64.powf(k as f64 / half as f64)) as f32,
            };
            *cosine = (t * frequency).cos();
            *sine = (t * frequency).sin();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_integer_timestep_keeps_one_frequency() {
        let mut out = [9.0; 6];
        TimestepEmbedding::Integer.embed(3.0, &mut out);
        assert_eq!(out, [3f32.cos(), 1.0, 1.0, 3f32.sin(), 0.0, 0.0]);
    }
}
