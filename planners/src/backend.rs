//! Which backends this build has.

use crate::error::PlannerError;
use crate::family::{LoadOptions, Precision, TrainRequest};
use crate::nets::Backend;

/// Which backend, and how it computes.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct BackendOptions<'a> {
    /// Name of the backend; `None` takes the first that this build has.
    pub name: Option<&'a str>,
    /// Device; `None` is `cpu`.
    pub device: Option<&'a str>,
    /// Threads; `None` takes all.
    pub n_threads: Option<usize>,
    /// How numbers are computed.
    pub precision: Precision,
}

impl<'a> BackendOptions<'a> {
    /// What a training asks for.
    pub fn of_training(request: &'a TrainRequest) -> Self {
        Self {
            name: request.backend.as_deref(),
            device: request.device.as_deref(),
            n_threads: request.n_threads,
            precision: Precision::F32,
        }
    }

    /// What a planner asks for.
    pub fn of_planning(options: &'a LoadOptions) -> Self {
        Self {
            name: options.backend.as_deref(),
            device: options.device.as_deref(),
            n_threads: options.n_threads,
            precision: options.precision,
        }
    }
}

/// Names of the backends of this build, the default first.
pub const BACKENDS: &[&str] = &[
    #[cfg(feature = "native")]
    "native",
    #[cfg(feature = "torch")]
    "torch",
];

/// The backend that was asked for.
///
/// # Errors
/// This build does not have it, or it does not have the device or precision.
pub fn open(options: &BackendOptions<'_>) -> Result<Box<dyn Backend>, PlannerError> {
    let name = options
        .name
        .or(BACKENDS.first().copied())
        .unwrap_or_default();
    match name {
        #[cfg(feature = "native")]
        "native" => open_native(options),
        #[cfg(feature = "torch")]
        "torch" => open_torch(options),
        _ => Err(PlannerError::UnknownBackend {
            what: "backend",
            name: name.to_owned(),
            known: BACKENDS.to_vec(),
        }),
    }
}

#[cfg(feature = "native")]
fn open_native(options: &BackendOptions<'_>) -> Result<Box<dyn Backend>, PlannerError> {
    use crate::native::NativeBackend;

    let device = options.device.unwrap_or("cpu");
    if device != "cpu" {
        return Err(PlannerError::UnknownBackend {
            what: "device of backend native",
            name: device.to_owned(),
            known: vec!["cpu"],
        });
    }
    let backend = NativeBackend::with_precision(options.precision);
    match options.n_threads {
        None => Ok(Box::new(backend)),
        Some(n_threads) => Ok(Box::new(threads::Threaded::new(backend, n_threads)?)),
    }
}

#[cfg(feature = "torch")]
fn open_torch(options: &BackendOptions<'_>) -> Result<Box<dyn Backend>, PlannerError> {
    use crate::torch::{Device, TorchBackend};

    let device: Device = options.device.unwrap_or("cpu").parse()?;
    if options.precision != Precision::F32 {
        return Err(PlannerError::UnknownBackend {
            what: "precision of backend torch",
            name: options.precision.to_string(),
            known: vec!["f32"],
        });
    }
    let n_threads = match options.n_threads {
        Some(n_threads) => n_threads,
        None => std::thread::available_parallelism().map_or(1, usize::from),
    };
    Ok(Box::new(TorchBackend::new(device, n_threads)?))
}

#[cfg(feature = "native")]
mod threads;
