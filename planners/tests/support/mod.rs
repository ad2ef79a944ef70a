//! Golden files of the planners: tensors that the reference implementation wrote, under `$KSIM_GOLDEN/planners`, by
//! default a small part of them in the repository. A folder has an `index.json` that says what every file holds and
//! how weights that are not stored are made.
#![allow(dead_code, reason = "no test uses all of it")]
#![allow(
    clippy::unwrap_used,
    reason = "a test that cannot read its files fails"
)]

pub(crate) mod hash_weights;
pub(crate) mod tolerance;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use ksim_planners::nets::{
    Architecture, Backend, HalfJannerConfig, JannerConfig, Tensor, TimestepEmbedding, Weights,
};
use safetensors::{Dtype, SafeTensors};
use serde_json::Value;

/// Every backend that this build has.
pub(crate) fn backends() -> Vec<Box<dyn Backend>> {
    vec![
        #[cfg(feature = "native")]
        Box::new(ksim_planners::native::NativeBackend::new()),
        #[cfg(feature = "torch")]
        Box::new(
            ksim_planners::torch::TorchBackend::new(ksim_planners::torch::Device::Cpu, 2).unwrap(),
        ),
    ]
}

/// Every folder of golden files: the root, and those of its folders that have an index of their own.
pub(crate) fn folders() -> Vec<Folder> {
    let root = match std::env::var_os("KSIM_GOLDEN") {
        Some(root) => PathBuf::from(root).join("planners"),
        None => Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/golden/planners"),
    };
    let mut paths = vec![root.clone()];
    let entries = std::fs::read_dir(&root).unwrap_or_else(|e| panic!("{}: {e}", root.display()));
    let mut inner: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
    inner.sort();
    paths.extend(
        inner
            .into_iter()
            .filter(|path| path.join("index.json").exists()),
    );
    paths.into_iter().map(Folder::open).collect()
}

/// A folder and its index.
pub(crate) struct Folder {
    path: PathBuf,
    index: Value,
}

impl Folder {
    fn open(path: PathBuf) -> Self {
        let text = std::fs::read_to_string(path.join("index.json"))
            .unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        let index = serde_json::from_str(&text).unwrap();
        let folder = Self { path, index };
        folder.check_hash();
        folder
    }

    /// The files of this folder whose names start with `prefix`, such as `forward_`.
    pub(crate) fn files(&self, prefix: &str) -> Vec<File> {
        let entries = std::fs::read_dir(&self.path).unwrap();
        let mut names: Vec<String> = entries
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .filter(|name| name.starts_with(prefix) && name.ends_with(".safetensors"))
            .collect();
        names.sort();
        names.iter().map(|name| self.file(name)).collect()
    }

    /// Where a file lies.
    pub(crate) fn path(&self, name: &str) -> PathBuf {
        self.path.join(name)
    }

    /// A file by name.
    pub(crate) fn file(&self, name: &str) -> File {
        let stem = name.trim_end_matches(".safetensors");
        File {
            name: name.to_owned(),
            config: stem
                .split_once('_')
                .map_or(stem, |(_, config)| config)
                .to_owned(),
            entry: self.index["files"][name].clone(),
            tensors: read_tensors(&self.path.join(name)),
        }
    }

    /// The weights of a network (`unet`, `reward`, `rnd_pred`, `rnd_target`) of a file's configuration: stored ones,
    /// or those of the hash rule.
    pub(crate) fn weights(&self, file: &File, net: &str) -> Weights {
        let architecture = file.architecture(net, TimestepEmbedding::Integer);
        let weights = if file.entry["weights"].as_str().unwrap().starts_with("hash") {
            hash_weights::fill(self.hash_seed(), &file.config, net, &architecture)
        } else {
            let stored = read_tensors(
                &self
                    .path
                    .join(format!("weights_{}.safetensors", file.config)),
            );
            let prefix = format!("{net}.");
            let own = stored.into_iter().filter_map(|(name, stored)| {
                let name = name.strip_prefix(&prefix)?.to_owned();
                let tensor = Tensor {
                    shape: stored.shape,
                    values: stored.values,
                };
                Some((name, tensor))
            });
            Weights {
                tensors: own.collect(),
            }
        };
        let expected = file.entry["param_counts"][net].as_u64();
        if let Some(expected) = expected {
            assert_eq!(
                weights.n_parameters() as u64,
                expected,
                "{} {net}",
                file.name
            );
        }
        weights
    }

    fn hash_seed(&self) -> u64 {
        self.index["hash_seed"].as_u64().unwrap()
    }

    /// The index holds values of one tensor, so that a wrong rule is found here.
    fn check_hash(&self) {
        let name = "unet/map_emb.0.weight[0,0:4] of antmaze";
        let expected = self.index["hash_weights"]["check"][name]
            .as_array()
            .unwrap();
        let key = "antmaze/unet/map_emb.0.weight";
        let values = hash_weights::tensor(self.hash_seed(), key, &[256, 64]);
        for (value, expected) in values.iter().zip(expected) {
            assert_eq!(f64::from(*value), expected.as_f64().unwrap(), "{name}");
        }
    }
}

/// A golden file.
pub(crate) struct File {
    /// Its name.
    pub(crate) name: String,
    /// The configuration that it is of: `hopper` of `forward_hopper.safetensors`.
    pub(crate) config: String,
    /// What the index says of it.
    pub(crate) entry: Value,
    tensors: BTreeMap<String, Stored>,
}

/// A tensor as stored; integers become f32 (exact: they are small).
pub(crate) struct Stored {
    /// Its shape.
    pub(crate) shape: Vec<usize>,
    /// Its numbers.
    pub(crate) values: Vec<f32>,
}

impl File {
    /// A tensor that must be there.
    pub(crate) fn tensor(&self, name: &str) -> &Stored {
        let found = self.tensors.get(name);
        found.unwrap_or_else(|| panic!("{} has no tensor {name}", self.name))
    }

    /// The numbers of a tensor that must be there.
    pub(crate) fn values(&self, name: &str) -> &[f32] {
        &self.tensor(name).values
    }

    /// Whether there is such a tensor.
    pub(crate) fn has(&self, name: &str) -> bool {
        self.tensors.contains_key(name)
    }

    fn setting(&self, name: &str) -> usize {
        self.entry["config"][name].as_u64().unwrap() as usize
    }

    /// One of the four networks of this file's configuration.
    pub(crate) fn architecture(&self, net: &str, embedding: TimestepEmbedding) -> Architecture {
        let horizon = self.setting("horizon");
        let width = self.setting("obs") + self.setting("act");
        let dim = self.setting("dim");
        let mult = self.entry["config"]["mult"].as_array().unwrap();
        let dim_mult: Vec<usize> = mult.iter().map(|m| m.as_u64().unwrap() as usize).collect();
        let half = |out_dim, model_dim, dim_mult| {
            Architecture::HalfJanner(HalfJannerConfig {
                horizon,
                width,
                out_dim,
                model_dim,
                embedding_dim: dim,
                dim_mult,
                kernel_size: 3,
                embedding,
            })
        };
        match net {
            "unet" => Architecture::Janner(JannerConfig {
                horizon,
                width,
                model_dim: dim,
                embedding_dim: dim,
                dim_mult,
                kernel_size: 5,
                embedding,
            }),
            "reward" => half(1, dim, dim_mult),
            "rnd_pred" => half(64, dim, dim_mult),
            "rnd_target" => half(64, dim / 2, vec![1, 2]),
            other => panic!("no network {other}"),
        }
    }
}

/// All tensors of a safetensors file.
pub(crate) fn read_tensors(path: &Path) -> BTreeMap<String, Stored> {
    let bytes = std::fs::read(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let mut tensors = BTreeMap::new();
    for (name, view) in file.tensors() {
        let data = view.data();
        let values = match view.dtype() {
            Dtype::F32 => numbers(data, f32::from_le_bytes),
            Dtype::F64 => numbers(data, |b| f64::from_le_bytes(b) as f32),
            Dtype::U8 => data.iter().map(|&byte| f32::from(byte)).collect(),
            Dtype::I64 => numbers(data, |b| i64::from_le_bytes(b) as f32),
            other => panic!("{name} of {} is {other:?}", path.display()),
        };
        let shape = view.shape().to_vec();
        tensors.insert(name, Stored { shape, values });
    }
    tensors
}

fn numbers<const N: usize>(data: &[u8], number: impl Fn([u8; N]) -> f32) -> Vec<f32> {
    let (chunks, rest) = data.as_chunks::<N>();
    assert!(rest.is_empty());
    chunks.iter().map(|bytes| number(*bytes)).collect()
}
