/// Mean-reverting walks of 1000 steps, row-major: correlated in time as states are.
pub(crate) fn random_walk(rows: usize, width: usize, seed: u64) -> Vec<f32> {
    let mut state = seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1;
    let mut noise = move || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 40) as f32 / (1u64 << 23) as f32 - 1.0
    };
    let mut at = vec![0.0f32; width];
    (0..rows)
        .flat_map(|row| {
            for value in &mut at {
                let pull = if row % 1000 == 0 { 0.0 } else { 0.95 };
                *value = *value * pull + noise() * if row % 1000 == 0 { 3.0 } else { 0.3 };
            }
            at.clone()
        })
        .collect()
}
