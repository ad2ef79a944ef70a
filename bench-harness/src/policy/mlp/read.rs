//! Networks as they stand in safetensors files.

use std::collections::{BTreeSet, HashMap};
use std::path::Path;

use safetensors::{Dtype, SafeTensors};

use super::network::{Activation, Dense, Kind, LogStd, Network, Normalization};
use crate::policy::PolicyError;

/// Reads a network.
///
/// # Errors
/// A file that cannot be read or is no safetensors file, tensors that are missing, superfluous, of a shape that does
/// not fit or with numbers that are not finite, and a header without `kind`, `activation`, `obs_eps` or `obs_clip`
/// where they are needed.
pub(in crate::policy) fn read(path: &Path) -> Result<Network, PolicyError> {
    let bytes = std::fs::read(path).map_err(|source| PolicyError::Read {
        path: path.to_owned(),
        source,
    })?;
    let mut file = File::new(path, &bytes)?;
    let kind = match file.word("kind")? {
        "tanh_gaussian" => Kind::TanhGaussian,
        "gaussian" => Kind::Gaussian,
        "linear" => Kind::Linear,
        other => {
            let expected = "tanh_gaussian, gaussian or linear";
            return Err(file.refuse("header `kind`", expected, format!("`{other}`")));
        }
    };
    let mut hidden: Vec<Dense> = Vec::new();
    let mut width = None;
    while file.has(&format!("layers.{}.weight", hidden.len())) {
        let (layer, n_out) = file.dense(&format!("layers.{}", hidden.len()), width)?;
        width = Some(n_out);
        hidden.push(layer);
    }
    let activation = if hidden.is_empty() {
        Activation::Relu
    } else {
        file.activation()?
    };
    let (mean, action_dim) = file.dense("mean", width)?;
    let log_std = file.log_std(kind, width, action_dim)?;
    let mut network = Network {
        kind,
        activation,
        normalization: None,
        hidden,
        mean,
        log_std,
    };
    network.normalization = file.normalization(network.observation_dim())?;
    file.refuse_rest()?;
    Ok(network)
}

/// A safetensors file, and which of its tensors have been taken.
struct File<'a> {
    path: &'a Path,
    tensors: SafeTensors<'a>,
    header: HashMap<String, String>,
    rest: BTreeSet<String>,
}

impl<'a> File<'a> {
    fn new(path: &'a Path, bytes: &'a [u8]) -> Result<Self, PolicyError> {
        let refuse = |source| PolicyError::Tensors {
            path: path.to_owned(),
            source,
        };
        let (_, metadata) = SafeTensors::read_metadata(bytes).map_err(refuse)?;
        // The sum of sizes that a header declares can wrap around to the one of the file.
        if metadata.data_len() > bytes.len() {
            return Err(refuse(
                safetensors::SafeTensorError::MetadataIncompleteBuffer,
            ));
        }
        let tensors = SafeTensors::deserialize(bytes).map_err(refuse)?;
        let rest = tensors.names().into_iter().map(str::to_owned).collect();
        Ok(Self {
            path,
            tensors,
            header: metadata.metadata().clone().unwrap_or_default(),
            rest,
        })
    }

    fn refuse(&self, item: &str, expected: impl Into<String>, found: String) -> PolicyError {
        PolicyError::Content {
            path: self.path.to_owned(),
            item: item.to_owned(),
            expected: expected.into(),
            found,
        }
    }

    fn word(&self, key: &str) -> Result<&str, PolicyError> {
        let word = self.header.get(key).map(String::as_str);
        word.ok_or_else(|| self.refuse(&format!("header `{key}`"), "a value", "none".to_owned()))
    }

    fn activation(&self) -> Result<Activation, PolicyError> {
        match self.word("activation")? {
            "relu" => Ok(Activation::Relu),
            "tanh" => Ok(Activation::Tanh),
            other => {
                let found = format!("`{other}`");
                Err(self.refuse("header `activation`", "relu or tanh", found))
            }
        }
    }

    fn number(
        &self,
        key: &str,
        expected: &str,
        is_good: fn(f64) -> bool,
    ) -> Result<f64, PolicyError> {
        let word = self.word(key)?;
        let number = word.parse().ok().filter(|&number| is_good(number));
        number.ok_or_else(|| {
            let item = format!("header `{key}`");
            self.refuse(&item, expected, format!("`{word}`"))
        })
    }

    fn has(&self, name: &str) -> bool {
        self.rest.contains(name)
    }

    /// Takes a tensor: its shape and values.
    fn take(&mut self, name: &str) -> Result<(Vec<usize>, Vec<f64>), PolicyError> {
        let item = format!("tensor `{name}`");
        if !self.rest.remove(name) {
            return Err(self.refuse(&item, "a tensor of this name", "none".to_owned()));
        }
        let view = self
            .tensors
            .tensor(name)
            .map_err(|source| PolicyError::Tensors {
                path: self.path.to_owned(),
                source,
            })?;
        let data = view.data();
        let values: Vec<f64> = match view.dtype() {
            Dtype::F32 => (data.as_chunks().0.iter())
                .map(|bytes| f64::from(f32::from_le_bytes(*bytes)))
                .collect(),
            Dtype::F64 => (data.as_chunks().0.iter())
                .map(|bytes| f64::from_le_bytes(*bytes))
                .collect(),
            other => return Err(self.refuse(&item, "F32 or F64", format!("{other:?}"))),
        };
        if let Some(value) = values.iter().find(|value| !value.is_finite()) {
            return Err(self.refuse(&item, "finite numbers", value.to_string()));
        }
        Ok((view.shape().to_vec(), values))
    }

    /// Takes a vector of a known length.
    fn vector(&mut self, name: &str, length: usize) -> Result<Vec<f64>, PolicyError> {
        let (shape, values) = self.take(name)?;
        if shape != [length] {
            let item = format!("tensor `{name}`");
            return Err(self.refuse(&item, format!("shape [{length}]"), format!("{shape:?}")));
        }
        Ok(values)
    }

    /// Takes a layer with so many inputs, if known already. Returns it with its number of outputs.
    fn dense(&mut self, name: &str, n_in: Option<usize>) -> Result<(Dense, usize), PolicyError> {
        let weight_name = format!("{name}.weight");
        let (shape, weight) = self.take(&weight_name)?;
        let fits = |width: usize| width > 0 && n_in.is_none_or(|n_in| n_in == width);
        let n_out = match shape[..] {
            [n_out, width] if n_out > 0 && fits(width) => n_out,
            _ => {
                let width = n_in.map_or_else(|| "in".to_owned(), |n_in| n_in.to_string());
                let item = format!("tensor `{weight_name}`");
                let expected = format!("shape [out, {width}], neither 0");
                return Err(self.refuse(&item, expected, format!("{shape:?}")));
            }
        };
        let bias_name = format!("{name}.bias");
        let bias = self.vector(&bias_name, n_out)?;
        let weight = self.narrow(&weight_name, &weight)?;
        let bias = self.narrow(&bias_name, &bias)?;
        Ok((Dense::new(&weight, &bias), n_out))
    }

    fn log_std(
        &mut self,
        kind: Kind,
        n_in: Option<usize>,
        action_dim: usize,
    ) -> Result<LogStd, PolicyError> {
        if kind == Kind::Linear {
            return Ok(LogStd::None);
        }
        if self.has("log_std") {
            let values = self.vector("log_std", action_dim)?;
            return Ok(LogStd::Fixed(self.narrow("log_std", &values)?));
        }
        if !self.has("log_std.weight") {
            return Ok(LogStd::None);
        }
        let (layer, n_out) = self.dense("log_std", n_in)?;
        if n_out != action_dim {
            let expected = format!("{action_dim} outputs");
            return Err(self.refuse("tensor `log_std.weight`", expected, n_out.to_string()));
        }
        Ok(LogStd::Layer(layer))
    }

    fn normalization(&mut self, width: usize) -> Result<Option<Normalization>, PolicyError> {
        if !self.has("obs_mean") && !self.has("obs_var") {
            return Ok(None);
        }
        let mean = self.vector("obs_mean", width)?;
        let variance = self.vector("obs_var", width)?;
        let eps = self.number("obs_eps", "a number of 0 or more", |eps| {
            eps >= 0.0 && eps.is_finite()
        })?;
        let clip = self.number("obs_clip", "a positive number", |clip| clip > 0.0)?;
        if let Some(value) = variance.iter().find(|&&v| v < 0.0 || v + eps <= 0.0) {
            return Err(self.refuse("tensor `obs_var`", "positive numbers", value.to_string()));
        }
        Ok(Some(Normalization {
            mean,
            scale: variance.iter().map(|v| (v + eps).sqrt()).collect(),
            clip,
        }))
    }

    /// To the f32 that the networks were trained in.
    fn narrow(&self, name: &str, values: &[f64]) -> Result<Vec<f32>, PolicyError> {
        let narrowed: Vec<f32> = values.iter().map(|&value| value as f32).collect();
        match narrowed.iter().position(|value| !value.is_finite()) {
            None => Ok(narrowed),
            Some(at) => {
                let (item, found) = (format!("tensor `{name}`"), format!("{:e}", values[at]));
                Err(self.refuse(&item, "numbers within the range of f32", found))
            }
        }
    }

    /// A tensor that nothing was done with would be a network that is run wrongly.
    fn refuse_rest(&self) -> Result<(), PolicyError> {
        let Some(name) = self.rest.first() else {
            return Ok(());
        };
        let expected = "layers.N, mean, log_std, obs_mean and obs_var only";
        Err(self.refuse("tensors", expected, format!("`{name}`")))
    }
}
