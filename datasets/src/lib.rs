//! Robot-learning datasets as Arrow record batches.
//!
//! One data model for every file format: a dataset is a table of steps (see [`schema`]) that is read in
//! batches through the [`DatasetSource`] trait. There are readers for Parquet, Arrow IPC, LeRobot, npz and Minari's
//! Arrow and Parquet storages, with the feature `hdf5` for D4RL, robomimic and Minari HDF5, with `mcap` for MCAP
//! recordings; `download` fetches datasets by name. This crate knows nothing of scoring, planners or simulators.
//!
//! Where to look: [`open`] and [`resolve`] find and open a dataset, [`TransitionReader`] turns its rows into
//! plain matrices, [`summarize`] computes what `ksim dataset info` prints, [`create`] and
//! [`convert::convert`] write, [`validate`] looks for faults.
//!
//! ```no_run
//! use ksim_datasets::{OpenOptions, SearchRoots, TransitionOptions, TransitionReader};
//!
//! # fn main() -> Result<(), ksim_datasets::DatasetError> {
//! let found = ksim_datasets::resolve("antmaze-large-play", &SearchRoots::from_env())?;
//! let source = ksim_datasets::open(&found.path, &OpenOptions::default())?;
//! for batch in TransitionReader::new(source.as_ref(), &TransitionOptions::default())? {
//!     let batch = batch?;
//!     assert_eq!(batch.states.len(), batch.n_rows() * batch.state_width);
//! }
//! # Ok(())
//! # }
//! ```

#[cfg(feature = "test-util")]
pub mod conformance;
pub mod convert;
#[cfg(feature = "download")]
pub mod download;
mod episode;
mod error;
mod format;
mod formats;
mod guard;
mod layout;
mod matrix;
/// MCAP recordings as such: channels, messages, and what is in them. For datasets see [`open`].
#[cfg(feature = "mcap")]
pub mod mcap {
    pub use crate::formats::mcap::{
        AttachmentEntry, Channel, ChunkEntry, Decoder, Extracted, FieldDescription, FieldKind,
        FieldLength, FieldPath, Inspection, Message, MessageOptions, MessageSchema, Messages,
        Metadata, Plan, Recording, Slot, Statistics, Summary, TopicInspection, Value, inspect,
    };
}
pub mod registry;
mod resolve;
pub mod schema;
mod sink;
mod source;
mod spec;
mod staging;
mod summary;
pub mod validate;

pub use episode::{EpisodeEnd, EpisodeRecord};
pub use error::{DatasetError, Result};
pub use format::{Format, OpenOptions, detect, open};
pub use formats::d4rl::EpisodePolicy;
pub use formats::parquet::ParquetSink;
pub use formats::tabular::ColumnNames;
pub use layout::{LayoutLeaf, ObservationLayout};
pub use matrix::{TransitionOptions, TransitionReader, Transitions};
pub use resolve::{Listed, Resolved, SearchRoots, list, resolve};
pub use sink::{
    DatasetSink, FinalObservation, Loss, LossEffect, McapEncoding, SinkInput, WriteOptions,
    Written, copy, create,
};
pub use source::{DatasetInfo, DatasetSource, Scan, Warning};
pub use spec::{LeafKind, LeafSpec, arrow_type};
pub use summary::{ColumnSummary, Spread, Summary, summarize};
