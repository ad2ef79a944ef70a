//! Named tensors.

use std::collections::BTreeMap;

use crate::error::PlannerError;

/// A tensor of f32, row by row.
#[derive(Debug, Clone, PartialEq)]
pub struct Tensor {
    /// Its shape; empty for a scalar.
    pub shape: Vec<usize>,
    /// Its numbers.
    pub values: Vec<f32>,
}

/// Tensors by name, as in a PyTorch state dict.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Weights {
    /// The tensors.
    pub tensors: BTreeMap<String, Tensor>,
}

impl Weights {
    /// The tensor of a name, which must have this shape.
    ///
    /// # Errors
    /// It is missing or has another shape.
    pub fn tensor(&self, name: &str, shape: &[usize]) -> Result<&[f32], PlannerError> {
        let Some(tensor) = self.tensors.get(name) else {
            return Err(PlannerError::MissingTensor {
                name: name.to_owned(),
            });
        };
        if tensor.shape != shape {
            return Err(PlannerError::TensorShape {
                name: name.to_owned(),
                expected: shape.to_vec(),
                found: tensor.shape.clone(),
            });
        }
        Ok(&tensor.values)
    }

    /// Tensors of the same names and shapes, all zero.
    #[must_use]
    pub fn zeros(&self) -> Self {
        let zero = |tensor: &Tensor| Tensor {
            shape: tensor.shape.clone(),
            values: vec![0.0; tensor.values.len()],
        };
        let tensors = self.tensors.iter();
        Self {
            tensors: tensors
                .map(|(name, tensor)| (name.clone(), zero(tensor)))
                .collect(),
        }
    }

    /// Numbers in all tensors together.
    pub fn n_parameters(&self) -> usize {
        self.tensors
            .values()
            .map(|tensor| tensor.values.len())
            .sum()
    }
}
