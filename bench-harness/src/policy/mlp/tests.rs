use std::collections::HashMap;

use ksim_envs::Environment as _;
use ksim_envs::toy::point_mass;
use safetensors::tensor::{Dtype, TensorView, serialize};
use tempfile::TempDir;

use super::*;

/// A file under construction.
struct Weights {
    header: HashMap<String, String>,
    tensors: Vec<(&'static str, Dtype, Vec<usize>, Vec<u8>)>,
}

impl Weights {
    fn new(kind: &str) -> Self {
        Self {
            header: HashMap::from([("kind".to_owned(), kind.to_owned())]),
            tensors: Vec::new(),
        }
    }

    /// Two inputs, one output: y = 2 x₀ - x₁ + 0.25.
    fn linear() -> Self {
        Self::new("linear")
            .with("mean.weight", &[1, 2], &[2.0, -1.0])
            .with("mean.bias", &[1], &[0.25])
    }

    fn header(mut self, key: &str, value: &str) -> Self {
        self.header.insert(key.to_owned(), value.to_owned());
        self
    }

    fn with(self, name: &'static str, shape: &[usize], values: &[f32]) -> Self {
        let bytes = values.iter().flat_map(|value| value.to_le_bytes());
        self.raw(name, Dtype::F32, shape, bytes.collect())
    }

    fn raw(mut self, name: &'static str, dtype: Dtype, shape: &[usize], bytes: Vec<u8>) -> Self {
        self.tensors.retain(|tensor| tensor.0 != name);
        self.tensors.push((name, dtype, shape.to_vec(), bytes));
        self
    }

    fn bytes(&self) -> Vec<u8> {
        let views = self.tensors.iter().map(|(name, dtype, shape, bytes)| {
            (
                *name,
                TensorView::new(*dtype, shape.clone(), bytes).unwrap(),
            )
        });
        serialize(views, Some(self.header.clone())).unwrap()
    }

    fn open(&self, options: MlpOptions) -> Result<Mlp, PolicyError> {
        open_bytes(&self.bytes(), options)
    }
}

fn open_bytes(bytes: &[u8], options: MlpOptions) -> Result<Mlp, PolicyError> {
    let folder = TempDir::new().unwrap();
    let file = folder.path().join("net.safetensors");
    std::fs::write(&file, bytes).unwrap();
    Mlp::open(
        "mlp:net".to_owned(),
        &file,
        options,
        point_mass(None).spec(),
    )
}

/// The action for one observation, in slot 0 of an episode with this seed.
fn act(mlp: &mut Mlp, seed: u64, observation: [f64; 2]) -> f64 {
    let start = EpisodeStart { episode: 0, seed };
    mlp.start_episode(0, &start).unwrap();
    let mut action = [0.0];
    mlp.act(&[0], &observation, &mut action).unwrap();
    action[0]
}

#[test]
fn a_linear_policy_multiplies_and_clips() {
    let mut mlp = Weights::linear().open(MlpOptions::default()).unwrap();
    assert_eq!(act(&mut mlp, 0, [0.5, 0.75]), 0.5);
    assert_eq!(act(&mut mlp, 0, [3.0, 0.0]), 1.0);
    assert_eq!(act(&mut mlp, 0, [-3.0, 0.0]), -1.0);
}

#[test]
fn hidden_layers_wider_than_a_block_sum_every_input_once() {
    // Unit i of 40 gives x₀ + i, rectified; the output sums them with weight 1/1024.
    let weight: Vec<f32> = (0..40).flat_map(|_| [1.0, 0.0]).collect();
    let bias: Vec<f32> = (0..40).map(|i| i as f32).collect();
    let network = Weights::new("gaussian")
        .header("activation", "relu")
        .with("layers.0.weight", &[40, 2], &weight)
        .with("layers.0.bias", &[40], &bias)
        .with("mean.weight", &[1, 40], &[1.0 / 1024.0; 40])
        .with("mean.bias", &[1], &[0.0]);
    let mut mlp = network.open(MlpOptions::default()).unwrap();
    assert_eq!(act(&mut mlp, 0, [1.0, 9.0]), 820.0 / 1024.0);
    // Units 0 to 10 are at rest.
    assert_eq!(act(&mut mlp, 0, [-10.0, 9.0]), 435.0 / 1024.0);
}

#[test]
fn a_pass_that_overflows_is_seen_in_the_action() {
    // Both units add up infinities of either sign.
    let huge = [3e38, -3e38, -3e38, 3e38];
    let network = Weights::new("gaussian")
        .header("activation", "relu")
        .with("layers.0.weight", &[2, 2], &huge)
        .with("layers.0.bias", &[2], &[0.0, 0.0])
        .with("mean.weight", &[1, 2], &[1.0, 1.0])
        .with("mean.bias", &[1], &[0.5]);
    let mut mlp = network.open(MlpOptions::default()).unwrap();
    assert!(act(&mut mlp, 0, [9.0, 9.0]).is_nan());
    assert_eq!(act(&mut mlp, 0, [0.0, 0.0]), 0.5);
}

#[test]
fn observations_are_normalized_in_f64_and_clipped() {
    let doubles = |values: [f64; 2]| values.iter().flat_map(|v| v.to_le_bytes()).collect();
    let network = Weights::linear()
        .raw("obs_mean", Dtype::F64, &[2], doubles([1e9, 0.0]))
        .raw("obs_var", Dtype::F64, &[2], doubles([15.0, 0.0]))
        .header("obs_eps", "1.0")
        .header("obs_clip", "2.5");
    let mut mlp = network.open(MlpOptions::default()).unwrap();
    // (1e9 + 1 - 1e9) / √16 = 1/4, which f32 could not tell from 0; 9 / √1 is clipped to 2.5.
    assert_eq!(act(&mut mlp, 0, [1e9 + 1.0, 0.5]), 0.25);
    assert_eq!(act(&mut mlp, 0, [1e9 + 5.0, 9.0]), 2.5 - 2.5 + 0.25);
}

#[test]
fn draws_follow_the_distribution_and_the_seed_alone() {
    let network = Weights::new("tanh_gaussian")
        .with("mean.weight", &[1, 2], &[0.0, 0.0])
        .with("mean.bias", &[1], &[0.3])
        .with("log_std.weight", &[1, 2], &[1.0, 0.0])
        .with("log_std.bias", &[1], &[0.0]);
    let sample = MlpOptions {
        sample: true,
        noise: 0.0,
    };
    let mut mlp = network.open(sample).unwrap();
    // A log_std of -50 counts as -20.
    assert!((act(&mut mlp, 1, [-50.0, 0.0]) - 0.3f64.tanh()).abs() < 1e-6);
    let draws: Vec<f64> = (0..20_000)
        .map(|seed| act(&mut mlp, seed, [-1.0, 0.0]).atanh())
        .collect();
    let mean = draws.iter().sum::<f64>() / 20_000.0;
    let variance = draws.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / 20_000.0;
    assert!((mean - 0.3).abs() < 0.01, "{mean}");
    assert!((variance.sqrt() - (-1f64).exp()).abs() < 0.01, "{variance}");
    assert_eq!(act(&mut mlp, 5, [-1.0, 0.0]).atanh(), draws[5]);
    let mut mode = network.open(MlpOptions::default()).unwrap();
    assert!((act(&mut mode, 1, [0.0; 2]) - 0.3f64.tanh()).abs() < 1e-6);
}

#[test]
fn noise_is_added_before_clipping_and_leaves_samples_alone() {
    let noise = MlpOptions {
        sample: false,
        noise: 0.2,
    };
    let mut mlp = Weights::linear().open(noise).unwrap();
    let draws: Vec<f64> = (0..500)
        .map(|seed| act(&mut mlp, seed, [0.5, 0.25]))
        .collect();
    assert!(draws.iter().all(|draw| (-1.0..=1.0).contains(draw)));
    assert!(draws.contains(&1.0));
    let below = draws.iter().filter(|&&draw| draw < 1.0).count();
    assert!((150..350).contains(&below), "{below}");
}

#[test]
fn slots_do_not_see_each_other() {
    let noise = MlpOptions {
        sample: false,
        noise: 0.1,
    };
    let mut mlp = Weights::linear().open(noise).unwrap();
    let alone = act(&mut mlp, 3, [0.1, 0.2]);
    for (slot, seed) in [(0, 9), (2, 3)] {
        let start = EpisodeStart { episode: 0, seed };
        mlp.start_episode(slot, &start).unwrap();
    }
    let mut actions = [0.0; 2];
    mlp.act(&[0, 2], &[0.7, 0.0, 0.1, 0.2], &mut actions)
        .unwrap();
    assert_eq!(actions[1], alone);
}

#[test]
fn what_does_not_fit_is_refused_by_name() {
    let sample = MlpOptions {
        sample: true,
        noise: 0.0,
    };
    let cases = [
        (
            Weights::new("magic"),
            "header `kind`: expected tanh_gaussian, gaussian or linear",
        ),
        (
            Weights::new("linear"),
            "tensor `mean.weight`: expected a tensor of this name, found none",
        ),
        (
            Weights::linear().with("mean.bias", &[2], &[0.0, 0.0]),
            "tensor `mean.bias`: expected shape [1], found [2]",
        ),
        (
            Weights::linear().with("mean.weight", &[0, 2], &[]),
            "expected shape [out, in], neither 0, found [0, 2]",
        ),
        (
            Weights::linear().with("mean.weight", &[1, 2], &[f32::NAN, 0.0]),
            "tensor `mean.weight`: expected finite numbers, found NaN",
        ),
        (
            Weights::linear().raw(
                "mean.bias",
                Dtype::F64,
                &[1],
                1e300f64.to_le_bytes().to_vec(),
            ),
            "tensor `mean.bias`: expected numbers within the range of f32, found 1e300",
        ),
        (
            Weights::linear().raw("mean.bias", Dtype::I32, &[1], vec![0; 4]),
            "expected F32 or F64, found I32",
        ),
        (
            Weights::linear().with("layers.1.weight", &[1, 2], &[0.0, 0.0]),
            "found `layers.1.weight`",
        ),
        (
            Weights::linear().with("obs_mean", &[2], &[0.0, 0.0]),
            "tensor `obs_var`: expected a tensor of this name",
        ),
        (
            Weights::linear().with("mean.weight", &[1, 3], &[0.0; 3]),
            "policy `mlp:net` has 3 observations, environment `PointMass-v0` has 2",
        ),
        (
            Weights::linear()
                .with("mean.weight", &[2, 2], &[0.0; 4])
                .with("mean.bias", &[2], &[0.0; 2]),
            "policy `mlp:net` has 2 actions, environment `PointMass-v0` has 1",
        ),
    ];
    for (weights, message) in cases {
        let found = weights.open(MlpOptions::default()).unwrap_err().to_string();
        assert!(found.contains(message), "{found}");
    }
    let found = Weights::linear().open(sample).unwrap_err().to_string();
    assert!(found.contains("a network with `log_std`"), "{found}");
}

#[test]
fn damaged_files_are_errors() {
    let bytes = Weights::linear().bytes();
    for length in 0..bytes.len() {
        assert!(open_bytes(&bytes[..length], MlpOptions::default()).is_err());
    }
    // Whatever byte of the header is damaged, the file is read or refused, and nothing panics.
    for position in 0..bytes.len() - 12 {
        for value in [0, b'9', b'"', 0xFF] {
            let mut damaged = bytes.clone();
            damaged[position] = value;
            let _ = open_bytes(&damaged, MlpOptions::default());
        }
    }
}

#[test]
fn ants_of_older_versions_see_27_numbers_and_zeros() {
    let part = |name, width| ksim_envs::Part { name, width };
    let ant = |id: &str, width: usize| EnvironmentSpec {
        id: id.to_owned(),
        observation: vec![part("", width)],
        info: vec![part("qpos", 15), part("qvel", 14)],
        ..point_mass(None).spec().clone()
    };
    let wide = Network {
        kind: network::Kind::Linear,
        activation: network::Activation::Relu,
        normalization: None,
        hidden: Vec::new(),
        mean: network::Dense::new(&[1.0; 111], &[0.0]),
        log_std: network::LogStd::None,
    };
    assert_eq!(n_seen(&wide, &ant("Ant-v4", 27)), Some(27));
    assert_eq!(n_seen(&wide, &ant("Ant-v5", 105)), Some(27));
    assert_eq!(n_seen(&wide, &ant("Ant-v4", 111)), Some(111));
    assert_eq!(n_seen(&wide, &ant("Walker2d-v4", 27)), None);
    // x and y come first.
    let mut placed = ant("Ant-v5", 107);
    let shown = "exclude_current_positions_from_observation".to_owned();
    placed.kwargs.insert(shown, false.into());
    assert_eq!(n_seen(&wide, &placed), None);
    // Another robot.
    let mut other = ant("Ant-v5", 105);
    other.info[0].width = 11;
    assert_eq!(n_seen(&wide, &other), None);
    let mut pass = Pass::default();
    wide.forward(&[1.0; 27], &mut pass);
    let mut action = [0.0];
    wide.mean_action(&pass, &mut action);
    assert_eq!(action, [27.0]);
}
