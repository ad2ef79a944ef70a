//! How calls reach libtorch: on which device, with how many threads, and what becomes of its errors.

use std::panic::{AssertUnwindSafe, catch_unwind};

use tch::{Kind, TchError, Tensor};

use super::{Device, NAME};
use crate::error::PlannerError;

/// Where and how to compute.
#[derive(Debug, Clone, Copy)]
pub(super) struct Session {
    device: tch::Device,
    n_threads: i32,
}

impl Session {
    pub(super) fn new(device: Device, n_threads: usize) -> Result<Self, PlannerError> {
        let device = match device {
            Device::Cpu => tch::Device::Cpu,
            Device::Cuda(number) => {
                let n_devices = usize::try_from(tch::Cuda::device_count()).unwrap_or(0);
                if number >= n_devices {
                    return Err(problem(format!(
                        "CUDA device {number} was asked for, but this libtorch finds {n_devices}"
                    )));
                }
                tch::Device::Cuda(number)
            }
        };
        Ok(Self {
            device,
            n_threads: i32::try_from(n_threads.max(1)).unwrap_or(i32::MAX),
        })
    }

    /// Runs a computation. libtorch reports what is wrong as a C++ exception, which `tch` makes an error of, or, in a
    /// few places, a panic.
    pub(super) fn run<T>(
        &self,
        compute: impl FnOnce() -> Result<T, TchError>,
    ) -> Result<T, PlannerError> {
        // OpenMP counts threads per calling thread.
        if tch::get_num_threads() != self.n_threads {
            tch::set_num_threads(self.n_threads);
        }
        // After a panic nothing is used again but whole tensors.
        let outcome = catch_unwind(AssertUnwindSafe(compute));
        match outcome {
            Ok(Ok(value)) => Ok(value),
            Ok(Err(error)) => Err(problem(first_line(&error.to_string()))),
            Err(panic) => {
                let text = panic.downcast_ref::<String>().map(String::as_str);
                let text = text.or_else(|| panic.downcast_ref::<&str>().copied());
                Err(problem(first_line(text.unwrap_or("it gave up"))))
            }
        }
    }

    /// A tensor of numbers in row-major order, on the device.
    pub(super) fn tensor(&self, values: &[f32], shape: &[i64]) -> Result<Tensor, TchError> {
        let flat = Tensor::f_from_slice(values)?;
        flat.f_view(shape)?.f_to(self.device)
    }

    /// Copies the numbers of a tensor, in row-major order.
    pub(super) fn read(&self, tensor: &Tensor, into: &mut [f32]) -> Result<(), TchError> {
        let tensor = tensor.f_to(tch::Device::Cpu)?.f_contiguous()?;
        debug_assert_eq!(tensor.kind(), Kind::Float);
        if tensor.numel() != into.len() {
            let (found, expected) = (tensor.numel(), into.len());
            let shape = format!("{found} numbers, expected {expected}");
            return Err(TchError::Shape(shape));
        }
        tensor.f_copy_data(into, into.len())
    }
}

fn problem(problem: String) -> PlannerError {
    PlannerError::Backend {
        backend: NAME,
        problem,
    }
}

/// C++ exceptions come with the whole stack.
fn first_line(text: &str) -> String {
    text.lines().next().unwrap_or_default().to_owned()
}
