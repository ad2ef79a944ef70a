//! Opening recordings: the first pass over each, and the table that results.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use arrow::datatypes::{DataType, Field, Schema};
use serde_json::{Value, json};

use super::align::Align;
use super::bind::Layout;
use super::describe;
use super::mapping::{Column, From, Grid, Kind, Mapping, Role};
use super::source::{FileState, McapSource};
use super::survey::Survey;
use super::{Metadata, Recording, plan, rows};
use crate::error::{DatasetError, Result};
use crate::format::OpenOptions;
use crate::schema;
use crate::source::Warning;

/// Recordings in a folder, at most.
const MAX_FILES: usize = 1_000_000;

impl McapSource {
    /// Opens a file, or all `.mcap` files of a folder in the order of their names.
    ///
    /// # Errors
    /// No mapping, a mapping that does not fit, damage; the file is named.
    pub(crate) fn open(path: &Path, options: &OpenOptions) -> Result<Self> {
        let paths = files(path)?;
        let mut recordings = Vec::with_capacity(paths.len());
        for path in &paths {
            recordings.push(Recording::open(path, options.recover)?);
        }
        let first = recordings.first().ok_or(DatasetError::Empty)?;
        let embedded = first.metadata()?;
        let mapping = match &options.mapping {
            Some(path) => Mapping::read(path)?,
            None => own_mapping(&embedded)?,
        };
        let library = first.library().to_owned();
        let mut opening = Opening::new(mapping);
        for recording in recordings {
            let path = recording.path().to_owned();
            opening
                .add(recording)
                .map_err(|error| error.in_file(&path))?;
        }
        opening.finish(path, &library, &embedded)
    }
}

/// The mapping that a recording brings along.
fn own_mapping(metadata: &[Metadata]) -> Result<Mapping> {
    let record = metadata
        .iter()
        .find(|record| record.name == describe::MAPPING_RECORD);
    match record.and_then(|record| record.entries.get(describe::MAPPING_ENTRY)) {
        Some(text) => Mapping::parse(text),
        None => Err(DatasetError::NoMapping),
    }
}

/// The recordings at a path.
pub(crate) fn files(path: &Path) -> Result<Vec<PathBuf>> {
    if !path.is_dir() {
        return Ok(vec![path.to_owned()]);
    }
    let entries = std::fs::read_dir(path).map_err(|e| DatasetError::io("list", e))?;
    let mut files = Vec::new();
    for entry in entries {
        let path = entry.map_err(|e| DatasetError::io("list", e))?.path();
        if path.extension().is_some_and(|ending| ending == "mcap") {
            files.push(path);
        }
        if files.len() > MAX_FILES {
            return Err(DatasetError::corrupt("more recordings than can be"));
        }
    }
    files.sort();
    Ok(files)
}

/// What is gathered while opening.
struct Opening {
    mapping: Mapping,
    files: Vec<FileState>,
    layouts: Vec<Option<Layout>>,
    warnings: Vec<Warning>,
    n_empty: u64,
    n_dropped: u64,
    n_split: u64,
}

impl Opening {
    fn new(mapping: Mapping) -> Self {
        Self {
            layouts: vec![None; mapping.columns.len()],
            mapping,
            files: Vec::new(),
            warnings: Vec::new(),
            n_empty: 0,
            n_dropped: 0,
            n_split: 0,
        }
    }

    fn add(&mut self, recording: Recording) -> Result<()> {
        let survey = Survey::new(&recording, &self.mapping)?;
        for (known, found) in self.layouts.iter_mut().zip(&survey.layouts) {
            if known.is_none() {
                known.clone_from(found);
            }
        }
        let found = plan::episodes(&survey, &self.mapping, recording.recovers())?;
        self.n_empty += found.n_empty;
        self.n_dropped += found.n_dropped;
        self.n_split += found.n_split;
        self.warnings.extend(survey.warnings.iter().cloned());
        self.warnings.extend(found.lost);
        let before = self.files.last().and_then(|file| file.episodes.last());
        let mut next = before.map_or(0, |(number, _)| number.saturating_add(1));
        next = next.max(
            self.files
                .iter()
                .map(|file| file.episodes.len() as i64)
                .sum(),
        );
        let mut episodes = Vec::with_capacity(found.episodes.len());
        for episode in found.episodes {
            let number = match episode.number {
                // Numbers of several files would clash.
                Some(number) if self.files.is_empty() => number,
                _ => next,
            };
            next = number.saturating_add(1);
            episodes.push((number, episode));
        }
        self.files.push(FileState {
            metadata: plan::metadata_json(&survey),
            recording,
            tracks: survey.tracks,
            episodes,
        });
        Ok(())
    }

    fn finish(mut self, path: &Path, library: &str, embedded: &[Metadata]) -> Result<McapSource> {
        let mut layouts = Vec::with_capacity(self.layouts.len());
        for place in 0..self.mapping.columns.len() {
            layouts.push(self.layout(place)?);
        }
        if self.n_empty > 0 {
            let n_episodes = self.n_empty;
            self.warnings.push(Warning::EmptyEpisodes { n_episodes });
        }
        for (n_steps, split) in [(self.n_dropped, false), (self.n_split, true)] {
            if n_steps > 0 {
                self.warnings.push(Warning::StepsLeftOut { n_steps, split });
            }
        }
        let fields = fields(&self.mapping, &layouts)?;
        let metadata =
            describe::schema_metadata(path, &self.mapping, library, embedded, self.metadata());
        let schema = Arc::new(Schema::new_with_metadata(fields, metadata));
        let info = describe::info(path, &self.mapping, &schema, self.counts(), self.warnings);
        Ok(McapSource {
            mapping: self.mapping,
            files: self.files,
            layouts,
            schema,
            info,
        })
    }

    /// Episodes and steps.
    fn counts(&self) -> (u64, u64) {
        let episodes = || self.files.iter().flat_map(|file| &file.episodes);
        let n_steps = episodes().map(|(_, episode)| episode.n_steps()).sum();
        (episodes().count() as u64, n_steps)
    }

    /// The metadata records of all files.
    fn metadata(&self) -> Value {
        let files = self.files.iter().map(|file| {
            let name = file.recording.path().file_name().unwrap_or_default();
            json!({ "file": name.to_string_lossy(), "metadata": file.metadata })
        });
        Value::Array(files.collect())
    }

    fn layout(&self, place: usize) -> Result<Layout> {
        let column = self.mapping.columns.get(place);
        let column = column.ok_or_else(|| DatasetError::corrupt("a column vanished"))?;
        let base = match column.from {
            From::NextOf(base) => base,
            From::Topic(_) => place,
        };
        let is_indexed = matches!(self.mapping.grid, Grid::Index(_)) && column.dtype.is_some();
        let known = self.layouts.get(base).and_then(Option::as_ref);
        if let Some(layout) = known.filter(|_| !is_indexed) {
            check(column, layout)?;
            return Ok(layout.clone());
        }
        match column.dtype {
            Some(dtype) => Ok(Layout {
                value_type: dtype.data_type(),
                shape: column.shape.clone().unwrap_or_default(),
                names: None,
                picture: None,
            }),
            None => Err(DatasetError::Unsupported {
                what: format!(
                    "column \"{}\", for which no message has a value: say its `dtype` and `shape`, or leave it out",
                    column.name
                ),
            }),
        }
    }
}

/// Whether a column of this layout can be what the mapping says.
fn check(column: &Column, layout: &Layout) -> Result<()> {
    let is_float = matches!(layout.value_type, DataType::Float32 | DataType::Float64);
    if column.align == Align::Linear && !is_float {
        return Err(rows::not_linear(&layout.value_type));
    }
    let wrong = |expected: &'static str| DatasetError::WrongType {
        key: column.name.clone(),
        actual: layout.value_type.to_string(),
        expected,
    };
    let is_flag = matches!(column.role, Role::Terminated | Role::Truncated);
    if is_flag && layout.value_type != DataType::Boolean {
        return Err(wrong("a flag"));
    }
    if column.role == Role::Reward
        && (!schema::is_number(&layout.value_type) || !layout.shape.is_empty())
    {
        return Err(wrong("one number"));
    }
    let quaternion = column.kind == Some(Kind::QuaternionXyzw);
    if quaternion && !layout.width().is_multiple_of(4) {
        return Err(DatasetError::ShapeMismatch {
            key: column.name.clone(),
            actual: layout.shape.clone(),
            expected: "quaternions of 4 values".to_owned(),
        });
    }
    Ok(())
}

/// The fields of the table.
fn fields(mapping: &Mapping, layouts: &[Layout]) -> Result<Vec<Field>> {
    let mut fields = vec![
        Field::new(schema::EPISODE_INDEX, DataType::Int64, false),
        Field::new(schema::STEP_INDEX, DataType::Int64, false),
    ];
    let has_time = match &mapping.grid {
        Grid::Index(index) => index.t_ns.is_some(),
        _ => true,
    };
    let mut time = has_time.then(|| Field::new(schema::T_NS, DataType::Int64, true));
    let mut names = BTreeSet::new();
    for (column, layout) in mapping.columns.iter().zip(layouts) {
        if !names.insert(&column.name) {
            return Err(DatasetError::corrupt(format!(
                "two columns are called \"{}\"",
                column.name
            )));
        }
        // Where the Parquet reader has it: after what makes a step.
        if column.role == Role::Info {
            fields.extend(time.take());
        }
        fields.push(describe::field(column, layout, mapping));
    }
    fields.extend(time);
    Ok(fields)
}
