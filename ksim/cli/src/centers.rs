//! Cluster centers from a safetensors file.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, bail};
use safetensors::tensor::TensorView;
use safetensors::{Dtype, SafeTensors};

/// Endings of tensor names that say "cluster centers".
const NAMES: [&str; 2] = ["centroids", "centers"];

/// A file of centers, as given on the command line.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct CentersFile {
    /// The file.
    pub(crate) path: PathBuf,
    /// The tensor asked for.
    tensor: Option<String>,
}

/// Centers of the width that was asked for.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Centers {
    /// The tensor they come from.
    pub(crate) tensor: String,
    /// Shape `(n_clusters, width)`, row-major, all finite.
    pub(crate) values: Vec<f64>,
}

impl CentersFile {
    /// Splits `FILE.safetensors:TENSOR`; anything else is a file.
    pub(crate) fn parse(argument: &str) -> Self {
        const SUFFIX: &str = ".safetensors";
        let split = argument
            .find(&format!("{SUFFIX}:"))
            .map(|at| at + SUFFIX.len());
        match split {
            Some(at) => Self {
                path: PathBuf::from(&argument[..at]),
                tensor: Some(argument[at + 1..].to_owned()),
            },
            None => Self {
                path: PathBuf::from(argument),
                tensor: None,
            },
        }
    }

    /// Reads the centers of the given width.
    ///
    /// # Errors
    /// A file that cannot be read, or none or several tensors that fit.
    pub(crate) fn read(&self, width: usize) -> Result<Centers> {
        let read = || {
            let bytes = std::fs::read(&self.path).context("cannot read the file")?;
            let tensors = SafeTensors::deserialize(&bytes).context("not a safetensors file")?;
            self.choose(&tensors, width)
        };
        read().with_context(|| in_file(&self.path))
    }

    fn choose(&self, tensors: &SafeTensors<'_>, width: usize) -> Result<Centers> {
        let mut all: Vec<(&str, TensorView<'_>)> = tensors.iter().collect();
        all.sort_by_key(|(name, _)| *name);
        let fits = |view: &TensorView<'_>| {
            matches!(view.dtype(), Dtype::F32 | Dtype::F64)
                && matches!(view.shape(), [rows, columns] if *rows > 0 && *columns == width)
        };
        let chosen: Vec<_> = match &self.tensor {
            Some(tensor) => all
                .iter()
                .filter(|(name, view)| name == tensor && fits(view))
                .collect(),
            None => all
                .iter()
                .filter(|(name, view)| says_centers(name) && fits(view))
                .collect(),
        };
        match chosen.as_slice() {
            [(name, view)] => {
                let values = finite_values(name, view)?;
                Ok(Centers {
                    tensor: (*name).to_owned(),
                    values,
                })
            }
            none_or_several => {
                let found = match (none_or_several.len(), &self.tensor) {
                    (0, Some(tensor)) => format!("tensor \"{tensor}\" does not fit"),
                    (0, None) => "no tensor fits".to_owned(),
                    (n, _) => format!("{n} tensors fit; name one as FILE.safetensors:TENSOR"),
                };
                bail!(
                    "{found}: expected cluster centers as f32 or f64 of shape [n_clusters, {width}] \
                     in a tensor named centroids or centers, or ending so; found {}",
                    listing(&all)
                )
            }
        }
    }
}

/// A file as context of an error.
fn in_file(path: &Path) -> String {
    path.display().to_string()
}

fn says_centers(name: &str) -> bool {
    NAMES.iter().any(|ending| name.ends_with(ending))
}

fn finite_values(name: &str, view: &TensorView<'_>) -> Result<Vec<f64>> {
    let bytes = view.data();
    let values: Vec<f64> = match view.dtype() {
        Dtype::F32 => bytes
            .as_chunks()
            .0
            .iter()
            .map(|&bytes| f64::from(f32::from_le_bytes(bytes)))
            .collect(),
        _ => bytes
            .as_chunks()
            .0
            .iter()
            .map(|&bytes| f64::from_le_bytes(bytes))
            .collect(),
    };
    if let Some(at) = values.iter().position(|value| !value.is_finite()) {
        let width = view.shape()[1];
        bail!(
            "tensor \"{name}\", row {}, column {} holds {}, expected a finite number",
            at / width,
            at % width,
            values[at]
        );
    }
    Ok(values)
}

/// The tensors that are there, the likely ones first; a file can hold thousands.
fn listing(all: &[(&str, TensorView<'_>)]) -> String {
    const SHOWN: usize = 12;
    if all.is_empty() {
        return "no tensors".to_owned();
    }
    let (likely, others): (Vec<_>, Vec<_>) = all.iter().partition(|(name, _)| says_centers(name));
    let shown = likely.iter().chain(&others).take(SHOWN);
    let mut text: Vec<String> = shown
        .map(|(name, view)| format!("{name} {:?} {:?}", view.dtype(), view.shape()))
        .collect();
    if all.len() > SHOWN {
        text.push(format!("and {} more", all.len() - SHOWN));
    }
    text.join(", ")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(tensors: &[(&str, Dtype, &[usize], &[f64])]) -> tempfile::NamedTempFile {
        let bytes: Vec<(String, Dtype, Vec<usize>, Vec<u8>)> = tensors
            .iter()
            .map(|&(name, dtype, shape, values)| {
                let bytes = match dtype {
                    Dtype::F32 => values
                        .iter()
                        .flat_map(|&v| (v as f32).to_le_bytes())
                        .collect(),
                    _ => values.iter().flat_map(|v| v.to_le_bytes()).collect(),
                };
                (name.to_owned(), dtype, shape.to_vec(), bytes)
            })
            .collect();
        let views = bytes.iter().map(|(name, dtype, shape, bytes)| {
            (name, TensorView::new(*dtype, shape.clone(), bytes).unwrap())
        });
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), safetensors::serialize(views, None).unwrap()).unwrap();
        file
    }

    fn read(file: &tempfile::NamedTempFile, tensor: Option<&str>, width: usize) -> Result<Centers> {
        let tensor = tensor.map(str::to_owned);
        CentersFile {
            path: file.path().to_owned(),
            tensor,
        }
        .read(width)
    }

    #[test]
    fn the_one_tensor_that_fits_is_found() {
        let file = file(&[
            ("xy2.centroids", Dtype::F64, &[1, 2], &[1.0, 2.0]),
            ("full3.centroids", Dtype::F32, &[1, 3], &[1.0, 2.0, 3.5]),
            ("mean", Dtype::F64, &[2], &[0.0, 0.0]),
        ]);
        assert_eq!(read(&file, None, 2).unwrap().values, [1.0, 2.0]);
        let full = read(&file, None, 3).unwrap();
        assert_eq!(
            (full.tensor.as_str(), full.values.as_slice()),
            ("full3.centroids", &[1.0, 2.0, 3.5][..])
        );
        let error = format!("{:#}", read(&file, None, 4).unwrap_err());
        assert!(
            error.contains("no tensor fits") && error.contains("xy2.centroids F64 [1, 2]"),
            "{error}"
        );
    }

    #[test]
    fn several_that_fit_need_a_name() {
        let file = file(&[
            ("a.centers", Dtype::F64, &[1, 2], &[1.0, 2.0]),
            ("b.centers", Dtype::F64, &[1, 2], &[3.0, f64::NAN]),
        ]);
        assert!(format!("{:#}", read(&file, None, 2).unwrap_err()).contains("2 tensors fit"));
        assert_eq!(
            read(&file, Some("a.centers"), 2).unwrap().values,
            [1.0, 2.0]
        );
        let error = format!("{:#}", read(&file, Some("b.centers"), 2).unwrap_err());
        assert!(error.contains("row 0, column 1 holds NaN"), "{error}");
    }

    #[test]
    fn a_tensor_is_named_after_the_file() {
        let named = CentersFile::parse("d/x.safetensors:a:b");
        assert_eq!(named.path, Path::new("d/x.safetensors"));
        assert_eq!(named.tensor.as_deref(), Some("a:b"));
        assert_eq!(CentersFile::parse("x.safetensors").tensor, None);
    }
}
