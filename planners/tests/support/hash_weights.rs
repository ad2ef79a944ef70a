//! Weights that golden files do not store: an integer hash of the tensor's name and the element's number, as
//! `hash_weights` in `index.json` says.

use ksim_planners::nets::{Architecture, Tensor, Weights};

/// All tensors of network `net` of configuration `config`.
pub(crate) fn fill(seed: u64, config: &str, net: &str, architecture: &Architecture) -> Weights {
    let specs = architecture.tensors().unwrap().into_iter();
    let tensors = specs.map(|spec| {
        let key = format!("{config}/{net}/{}", spec.name);
        let values = tensor(seed, &key, &spec.shape);
        let tensor = Tensor {
            shape: spec.shape,
            values,
        };
        (spec.name, tensor)
    });
    Weights {
        tensors: tensors.collect(),
    }
}

/// The tensor of a full name, such as `hopper/unet/map_emb.0.weight`.
pub(crate) fn tensor(seed: u64, key: &str, shape: &[usize]) -> Vec<f32> {
    let base = fnv1a64(key.as_bytes()) ^ seed.wrapping_mul(GOLDEN_GAMMA);
    let fan_in: usize = shape[1..].iter().product();
    let scale = (2.0 / (fan_in as f64).sqrt()) as f32;
    let n: usize = shape.iter().product();
    let value = |i: usize| {
        let step = (i as u64).wrapping_mul(0xD134_2543_DE82_EF95);
        let z = splitmix64(base.wrapping_add(step));
        let u = (z >> 40) as f32 / (1u32 << 24) as f32 - 0.5;
        match shape.len() {
            1 if key.ends_with(".weight") => 1.0 + 0.25 * u,
            1 => 0.25 * u,
            _ => u * scale,
        }
    };
    (0..n).map(value).collect()
}

const GOLDEN_GAMMA: u64 = 0x9E37_79B9_7F4A_7C15;

fn fnv1a64(bytes: &[u8]) -> u64 {
    bytes.iter().fold(0xCBF2_9CE4_8422_2325, |hash, byte| {
        (hash ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01B3)
    })
}

fn splitmix64(x: u64) -> u64 {
    let x = x.wrapping_add(GOLDEN_GAMMA);
    let z = (x ^ (x >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}
