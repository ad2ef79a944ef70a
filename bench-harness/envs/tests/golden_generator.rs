//! NumPy's generator against recorded draws: those in `$KSIM_GOLDEN/environments/seeded_resets.json`, by default the copy
//! in the repository, and a million of each kind in `fixtures/numpy_rng.json`, made by the script beside it.

#![expect(clippy::unwrap_used, reason = "a test stops where a step fails")]

use std::path::{Path, PathBuf};

use ksim_envs::numpy_rng::Generator;
use serde_json::Value;

fn golden() -> PathBuf {
    match std::env::var_os("KSIM_GOLDEN") {
        Some(root) => PathBuf::from(root),
        None => Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/fixtures/golden"),
    }
}

fn read(path: &Path) -> Value {
    let text = std::fs::read_to_string(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    serde_json::from_str(&text).unwrap()
}

fn floats(value: &Value) -> Vec<f64> {
    serde_json::from_value(value.clone()).unwrap()
}

/// Bits of the numbers as integers, each times 1, 3, 5, …, summed modulo 2^64.
fn checksum(bits: impl Iterator<Item = u64>) -> u64 {
    (bits.zip((1_u64..).step_by(2))).fold(0, |sum, (bits, weight)| {
        sum.wrapping_add(bits.wrapping_mul(weight))
    })
}

#[test]
fn golden_vectors_of_every_seed() {
    let recorded = read(&golden().join("environments/seeded_resets.json"));
    let seeds = recorded["rng_vectors"].as_object().unwrap();
    assert!(!seeds.is_empty());
    for (seed, vectors) in seeds {
        let generator = Generator::new(seed.parse().unwrap());
        let draws = |list: &str, draw: fn(&mut Generator) -> f64| {
            let mut generator = generator.clone();
            let recorded = floats(&vectors[list]);
            let drawn: Vec<f64> = recorded.iter().map(|_| draw(&mut generator)).collect();
            assert_eq!(drawn, recorded, "seed {seed}: {list}");
        };
        draws("random", Generator::random);
        draws("standard_normal", Generator::standard_normal);
        draws("integers_0_7", |generator| generator.integers(7) as f64);
    }
}

#[test]
fn golden_millions_of_draws() {
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    let recorded = read(&here.join("tests/fixtures/numpy_rng.json"));
    for vectors in recorded["vectors"].as_array().unwrap() {
        let seed = vectors["seed"].as_u64().unwrap();
        let n = vectors["n"].as_u64().unwrap();
        let spacing = usize::try_from(vectors["spacing"].as_u64().unwrap()).unwrap();
        let mut generator = Generator::new(seed);
        let normals: Vec<f64> = (0..n).map(|_| generator.standard_normal()).collect();
        let spaced: Vec<f64> = normals.iter().copied().step_by(spacing).collect();
        assert_eq!(spaced, floats(&vectors["normals"]), "seed {seed}");
        for draw in vectors["tail"].as_array().unwrap() {
            let at = usize::try_from(draw[0].as_u64().unwrap()).unwrap();
            assert_eq!(
                Some(normals[at]),
                draw[1].as_f64(),
                "seed {seed}, draw {at}"
            );
        }
        let expect = |name: &str, found: u64| {
            assert_eq!(Some(found), vectors[name].as_u64(), "seed {seed}: {name}");
        };
        expect(
            "normals_checksum",
            checksum(normals.iter().map(|x| x.to_bits())),
        );
        let mut generator = Generator::new(seed);
        let uniforms = (0..n).map(|_| generator.uniform(-0.25, 0.25).to_bits());
        expect("uniforms_checksum", checksum(uniforms));
        let mut generator = Generator::new(seed);
        let integers = (0..2000).map(|_| generator.integers((1 << 31) + 1));
        expect("rejecting_checksum", checksum(integers));
    }
}

#[test]
fn golden_integers_between_other_draws() {
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    let recorded = read(&here.join("tests/fixtures/numpy_rng.json"));
    for vectors in recorded["vectors"].as_array().unwrap() {
        let mut generator = Generator::new(vectors["seed"].as_u64().unwrap());
        for draw in vectors["integers"].as_array().unwrap() {
            let n = draw[0].as_u64().unwrap();
            let drawn = (generator.integers(n), generator.random());
            let expected = (draw[1].as_u64().unwrap(), draw[2].as_f64().unwrap());
            assert_eq!(drawn, expected, "of {n}");
        }
    }
}
