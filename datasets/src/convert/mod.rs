//! From one format to another.
//!
//! [`convert`] streams a dataset through a selection and a sink, in the memory of one batch and what the two
//! formats need, and reports everything that the result does not hold as the source did.

mod cast;
mod select;
mod space;

use std::ops::{ControlFlow, Range};
use std::path::Path;
use std::sync::Arc;

use arrow::array::{AsArray, RecordBatch};
use arrow::datatypes::{Int64Type, Schema, SchemaRef};

pub use cast::{Cast, CastReport};

use crate::episode::column;
use crate::error::{DatasetError, Result};
use crate::format::{Format, detect};
use crate::schema;
use crate::sink::{Loss, SinkInput, WriteOptions, create};
use crate::source::{DatasetInfo, DatasetSource, Scan};
use crate::staging::is_occupied;
use cast::Casts;

/// What to convert, and how.
#[derive(Debug, Clone)]
pub struct ConvertOptions {
    /// The format to write.
    pub format: Format,
    /// Ranges of episode numbers to keep, in the source's order; `None` keeps all.
    pub episodes: Option<Vec<Range<i64>>>,
    /// Columns to keep, or roots of several (`observation`, `info.goal`); `None` keeps all. The episode and
    /// step numbers are always kept.
    pub columns: Option<Vec<String>>,
    /// Value types to change.
    pub casts: Vec<Cast>,
    /// What the format leaves open.
    pub write: WriteOptions,
}

impl ConvertOptions {
    /// Everything, as it is.
    pub fn new(format: Format) -> Self {
        Self {
            format,
            episodes: None,
            columns: None,
            casts: Vec::new(),
            write: WriteOptions::default(),
        }
    }
}

/// What a conversion did.
#[derive(Debug, Clone)]
pub struct ConvertReport {
    /// The source, after reading: its warnings are part of the report.
    pub source: DatasetInfo,
    /// The result, as its own reader describes it.
    pub written: DatasetInfo,
    /// Episodes handed to the sink.
    pub n_episodes: u64,
    /// Steps handed to the sink.
    pub n_steps: u64,
    /// Rows handed to the sink: steps and final observations.
    pub n_rows: u64,
    /// Columns of the source that were not asked for.
    pub left_out: Vec<String>,
    /// Columns whose value type was changed.
    pub casts: Vec<CastReport>,
    /// What the result does not hold as the source did.
    pub losses: Vec<Loss>,
}

/// How far a conversion is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ConvertProgress {
    /// Rows written.
    pub rows: u64,
    /// Rows there are.
    pub of: u64,
}

/// Writes a dataset in another format. `on_progress` is called after every batch and can break off, which
/// leaves nothing behind and gives [`DatasetError::Interrupted`].
///
/// # Errors
/// A selection that fits nothing, a cast that would change a value to infinity or out of range, something
/// already at the destination (unless `write.overwrite`), or those of source and sink. The destination is untouched
/// then.
pub fn convert(
    source: &dyn DatasetSource,
    target: &Path,
    options: &ConvertOptions,
    on_progress: &mut dyn FnMut(ConvertProgress) -> ControlFlow<()>,
) -> Result<ConvertReport> {
    let in_source = |error: DatasetError| error.in_file(&source.info().path);
    let columns = options.columns.as_deref();
    let selected = select::columns(&source.schema(), columns).map_err(in_source)?;
    let all = source.episodes().map_err(in_source)?;
    let episodes = select::episodes(all, options.episodes.as_deref()).map_err(in_source)?;
    let casts = Casts::new(&selected.schema, &options.casts).map_err(in_source)?;
    let casted = without_records(casts.schema());
    let numbers = options
        .episodes
        .is_some()
        .then(|| episodes.iter().map(|e| e.episode_index).collect());
    check_target(target, options.format, options.write.overwrite)?;

    let input = SinkInput {
        schema: &casted,
        info: source.info(),
        episodes: &episodes,
    };
    let mut sink = create(target, options.format, &input, &options.write)?;
    let of: u64 = episodes.iter().map(|episode| episode.n_rows).sum();
    let mut run = Run {
        casts,
        schema: casted,
        rows: 0,
    };
    let scan = Scan {
        columns: columns.map(|_| selected.names),
        episodes: numbers,
        ..Scan::default()
    };
    for batch in source.scan(&scan).map_err(in_source)? {
        let batch = batch.map_err(|e| in_source(e.into()))?;
        sink.write(&run.prepare(&batch).map_err(in_source)?)?;
        let progress = ConvertProgress { rows: run.rows, of };
        if on_progress(progress).is_break() {
            return Err(DatasetError::Interrupted);
        }
    }
    if run.rows != of {
        let rows = DatasetError::LengthMismatch {
            key: "rows of the chosen episodes".to_owned(),
            actual: run.rows,
            expected: of,
        };
        return Err(in_source(rows));
    }
    let written = sink.finish()?;
    Ok(ConvertReport {
        source: source.info().clone(),
        written: written.info,
        n_episodes: episodes.len() as u64,
        n_steps: episodes.iter().map(|episode| episode.length).sum(),
        n_rows: run.rows,
        left_out: selected.left_out,
        casts: run.casts.into_reports(),
        losses: written.losses,
    })
}

/// The state of a conversion between batches.
struct Run {
    casts: Casts,
    schema: SchemaRef,
    rows: u64,
}

impl Run {
    fn prepare(&mut self, batch: &RecordBatch) -> Result<RecordBatch> {
        let episodes = column(batch, schema::EPISODE_INDEX)?.as_primitive::<Int64Type>();
        let columns = self.casts.apply(batch, episodes.values(), self.rows)?;
        self.rows += batch.num_rows() as u64;
        RecordBatch::try_new(Arc::clone(&self.schema), columns)
            .map_err(DatasetError::arrow("put columns together"))
    }
}

/// The schema without what the source records of all its episodes: sinks add it for those that are kept.
fn without_records(schema: &SchemaRef) -> SchemaRef {
    let mut metadata = schema.metadata().clone();
    metadata.remove(schema::EPISODE_RECORDS);
    Arc::new(Schema::new_with_metadata(schema.fields().clone(), metadata))
}

/// Checks that a dataset of a format can take its place.
///
/// # Errors
/// The destination is taken; with `overwrite`, only where it cannot be replaced: a folder by a file or a file by a
/// folder, or a folder that is no dataset.
pub fn check_target(target: &Path, format: Format, overwrite: bool) -> Result<()> {
    check_free(target, format, overwrite).map_err(|error| error.in_file(target))
}

fn check_free(target: &Path, format: Format, overwrite: bool) -> Result<()> {
    if !is_occupied(target) {
        return Ok(());
    }
    let is_folder = target.is_dir();
    if !overwrite || is_folder != format.is_folder() {
        return Err(DatasetError::AlreadyExists);
    }
    // A folder with a recording in it may hold anything else, and nothing that is written is one.
    match is_folder.then(|| detect(target)).transpose()? {
        Some(found) if !found.is_folder() => Err(DatasetError::AlreadyExists),
        _ => Ok(()),
    }
}
