//! Saved indexes: everything `ksim` computes from a dataset before the first rollout is scored, in one
//! file that is mapped instead of read. A score with the index is the score without it, to the last bit.
//!
//! | module | holds |
//! |---|---|
//! | `format` | the file: header, sections, directory, checksums |
//! | `writer`, `build` | how one is made, in passes over data that need not fit into memory |
//! | `staging` | steps on their way in, in unnamed temporary files |
//! | `saved` | how one is opened, checked and used |
//! | `mapping` | files in memory: the only unsafe code here |
//! | `limit` | keeps what is resident of large files within bounds |
//!
//! # Format, version 1
//! All numbers are little-endian. A file is a header of 64 bytes, sections, a directory and a footer of 64
//! bytes. Sections begin at multiples of 4096 and the gaps between them are zeros, so that flat arrays can be
//! used where they lie.
//!
//! | part | bytes |
//! |---|---|
//! | header | magic `\x89KSIMIX\n`, version u32, alignment u32, 48 zeros |
//! | directory, per section | name (16 bytes, zeros behind), offset u64, length u64, BLAKE3 of the section (32 bytes) |
//! | footer | offset of the directory u64, sections u32, 4 zeros, BLAKE3 of header and directory (32 bytes), 8 zeros, magic `KSIMEND\n` |
//!
//! | section | holds |
//! |---|---|
//! | `about` | JSON: version of ksim, dataset, columns, clusters |
//! | `state.mean`, `state.std`, `action.mean`, `action.std` | f64 per column, raw units |
//! | `episodes` | i64 × 3 per episode: its number, first row, row after its last |
//! | `numbers` | i64 per row: recorded step numbers, where they do not count from 0 |
//! | `state.high`, `state.low`, `action.high`, `action.low` | normalized values as two f32, row-major |
//! | `rows.…` | the states rounded to bytes, as [`ksim::RoundedRows`] has them |
//! | `cells.…` | the same by clusters: only with clusters |
//! | `centers`, `labels`, `inertia` | f64 per center and column, u32 per row, one f64: only with clusters |

mod about;
mod build;
mod error;
mod format;
mod limit;
mod mapping;
mod saved;
mod staging;
mod writer;

pub use about::{About, AboutClusters, AboutDataset};
pub use build::{Clustering, Stage, write};
pub use error::IndexError;
pub use format::VERSION;
pub use saved::{SavedIndex, SectionInfo};
pub use staging::StagedSteps;
