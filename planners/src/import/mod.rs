//! Networks that the reference implementation trained: PyTorch's `.pt` files, without PyTorch and without running
//! anything in them.
//!
//! Such a file is an uncompressed zip archive: a pickle that names tensors, and one entry of raw numbers for each.
//! A pickle is a program. The reader here knows only the instructions and the functions that a file of tensors
//! needs, and refuses every other by name and place; what it builds is plain data. Sizes are checked before anything
//! is allocated: reading takes no more memory than a small multiple of the file's length.
//!
//! [`read_state_dicts`] reads any such file; [`reference_networks`] puts the files of one trained planner
//! together, [`reference_planner`] makes a planner of them, and [`import_run`] a run folder.

mod archive;
mod error;
mod opcode;
mod pickle;
mod planner;
mod reference;
mod run;
mod shapes;
mod state_dict;
mod storage;

pub use error::ImportError;
pub use planner::{ReferenceImport, reference_planner};
pub use reference::{ImportedNetwork, reference_networks};
pub use run::import_run;
pub use state_dict::{StateDicts, read_state_dicts};
