//! The HDF5 storage: a group per episode in one file.

use std::path::{Path, PathBuf};

use arrow::array::{Array, ArrayRef};
use arrow::datatypes::DataType;
use hdf5_metno as hdf5;
use serde_json::{Map, Value};

use super::columns::{Group, Leaf};
use super::{Episode, EpisodeStore, Rows};
use crate::error::Result;
use crate::format::Format;
use crate::formats::fill::{blank_row, concat, without_nulls};
use crate::formats::hdf5::{
    ArrayPlan, ArrayWriter, close_file, create_file, failed, join, write_attribute,
};
use crate::sink::{DatasetSink, LossEffect, LossTally, SinkInput, WriteOptions};

/// Starts a dataset with the HDF5 storage.
///
/// # Errors
/// The columns do not fit, or the folder cannot be made.
pub(crate) fn create(
    path: &Path,
    input: &SinkInput<'_>,
    options: &WriteOptions,
) -> Result<Box<dyn DatasetSink>> {
    super::create(
        path,
        Format::MinariHdf5,
        input,
        options,
        |data, columns, _| {
            let path = data.join("main_data.hdf5");
            Ok(Box::new(Hdf5Store {
                file: create_file(&path)?,
                path,
                observation: Paths::new(&columns.observation),
                action: Paths::new(&columns.action),
                infos: Paths::new(&columns.infos),
                open: None,
            }))
        },
    )
}

struct Hdf5Store {
    path: PathBuf,
    file: hdf5::File,
    observation: Paths,
    action: Paths,
    infos: Paths,
    open: Option<OpenEpisode>,
}

/// Where the leaves of a group are in an episode, in the order of the leaves.
struct Paths {
    leaves: Vec<(Leaf, Vec<String>)>,
}

/// The arrays of the episode that is being written.
struct OpenEpisode {
    group: hdf5::Group,
    name: String,
    n_steps: u64,
    /// Observations, actions, rewards, terminations, truncations.
    arrays: Vec<ArrayWriter>,
    infos: Vec<Info>,
}

/// An info column of an episode. It is made at its first value: infos may be missing in an episode.
#[derive(Default)]
struct Info {
    array: Option<ArrayWriter>,
    /// Rows without a value since the last one.
    n_missing: u64,
}

impl Paths {
    fn new(group: &Group) -> Self {
        let paths = group.tree.iter();
        let mut paths: Vec<(usize, Vec<String>)> = paths
            .flat_map(|tree| tree.paths(|index| format!("_index_{index}")))
            .collect();
        paths.sort_by_key(|(place, _)| *place);
        let leaves = group.leaves.iter().zip(paths);
        Self {
            leaves: leaves
                .map(|(leaf, (_, path))| (leaf.clone(), path))
                .collect(),
        }
    }
}

impl Hdf5Store {
    fn write_attributes(
        group: &hdf5::Group,
        attributes: &Map<String, Value>,
        losses: &mut LossTally,
    ) -> Result<()> {
        for (name, value) in flattened(attributes) {
            if write_attribute(group, &name, &value)? {
                continue;
            }
            let item = format!("attribute {name}");
            if value.is_null() {
                losses.add(item, LossEffect::Dropped, "HDF5 has no null", 1);
                continue;
            }
            let text = Value::from(value.to_string());
            if write_attribute(group, &name, &text)? {
                losses.add(item, LossEffect::Changed, "kept as JSON text", 1);
            } else {
                losses.add(item, LossEffect::Dropped, "HDF5 cannot hold it", 1);
            }
        }
        Ok(())
    }
}

impl EpisodeStore for Hdf5Store {
    fn begin(&mut self, episode: &Episode, losses: &mut LossTally) -> Result<()> {
        let name = format!("episode_{}", episode.number);
        let made = self.file.create_group(&name);
        let group = made.map_err(failed("create", &name))?;
        Self::write_attributes(&group, &episode.attributes, losses)?;
        let mut open = OpenEpisode {
            n_steps: episode.n_steps,
            arrays: Vec::new(),
            infos: Vec::new(),
            group,
            name,
        };
        for (root, paths, n_rows) in [
            ("observations", &self.observation, episode.n_steps + 1),
            ("actions", &self.action, episode.n_steps),
        ] {
            for (leaf, path) in &paths.leaves {
                let array = open.array(root, path, leaf, n_rows)?;
                open.arrays.push(array);
            }
        }
        for (name, value_type) in [
            ("rewards", DataType::Float64),
            ("terminations", DataType::Boolean),
            ("truncations", DataType::Boolean),
        ] {
            let array = open.create(name, value_type, &[], episode.n_steps)?;
            open.arrays.push(array);
        }
        open.group
            .create_group("infos")
            .map_err(failed("create", "infos"))?;
        open.infos
            .resize_with(self.infos.leaves.len(), Info::default);
        self.open = Some(open);
        Ok(())
    }

    fn append(&mut self, rows: Rows, losses: &mut LossTally) -> Result<()> {
        let Some(open) = &mut self.open else {
            return Ok(());
        };
        let steps = [&rows.rewards, &rows.terminations, &rows.truncations];
        let all = rows.observations.iter().chain(&rows.actions).chain(steps);
        for (array, rows) in open.arrays.iter_mut().zip(all) {
            array.append(rows)?;
        }
        for (place, ((leaf, path), rows)) in self.infos.leaves.iter().zip(&rows.infos).enumerate() {
            open.append_info(place, (leaf, path), rows, losses)?;
        }
        if rows.is_end {
            for (place, (leaf, _)) in self.infos.leaves.iter().enumerate() {
                open.end_info(place, leaf, losses)?;
            }
            self.open = None;
        }
        Ok(())
    }

    fn finish(self: Box<Self>) -> Result<()> {
        let Self {
            file, path, open, ..
        } = *self;
        drop(open);
        close_file(file, &path)
    }
}

impl OpenEpisode {
    fn array(&self, root: &str, path: &[String], leaf: &Leaf, n_rows: u64) -> Result<ArrayWriter> {
        let name = path
            .iter()
            .fold(root.to_owned(), |path, name| join(&path, name));
        self.create(&name, leaf.value_type.clone(), &leaf.shape, n_rows)
    }

    fn create(
        &self,
        name: &str,
        value_type: DataType,
        shape: &[usize],
        n_rows: u64,
    ) -> Result<ArrayWriter> {
        let row_shape = match value_type {
            // One run of bytes a picture.
            DataType::Binary => Vec::new(),
            _ => shape.to_vec(),
        };
        let plan = ArrayPlan {
            value_type,
            row_shape,
            n_rows,
            deflate: None,
        };
        ArrayWriter::create(&self.group, name, &join(&self.name, name), &plan)
    }

    fn append_info(
        &mut self,
        place: usize,
        (leaf, path): (&Leaf, &[String]),
        rows: &ArrayRef,
        losses: &mut LossTally,
    ) -> Result<()> {
        let n_trailing = (0..rows.len())
            .rev()
            .take_while(|&row| rows.is_null(row))
            .count();
        let made = match self.infos.get(place) {
            Some(info) if info.array.is_none() && n_trailing < rows.len() => {
                Some(self.array("infos", path, leaf, self.n_steps + 1)?)
            }
            _ => None,
        };
        let Some(info) = self.infos.get_mut(place) else {
            return Ok(());
        };
        if n_trailing == rows.len() {
            info.n_missing += n_trailing as u64;
            return Ok(());
        }
        info.array = info.array.take().or(made);
        info.fill(leaf, info.n_missing, losses)?;
        let valued = rows.slice(0, rows.len() - n_trailing);
        let (filled, n_filled) = without_nulls(&valued)?;
        note_filled(leaf, n_filled, losses);
        if let Some(array) = &mut info.array {
            array.append(&filled)?;
        }
        info.n_missing = n_trailing as u64;
        Ok(())
    }

    /// Infos have a row for each step at least.
    fn end_info(&mut self, place: usize, leaf: &Leaf, losses: &mut LossTally) -> Result<()> {
        let Some(info) = self.infos.get_mut(place) else {
            return Ok(());
        };
        let Some(array) = &info.array else {
            return Ok(());
        };
        let n_missing = self.n_steps.saturating_sub(array.n_rows());
        info.fill(leaf, n_missing, losses)
    }
}

impl Info {
    /// Rows that stand for nothing.
    fn fill(&mut self, leaf: &Leaf, n: u64, losses: &mut LossTally) -> Result<()> {
        let Some(array) = self.array.as_mut().filter(|_| n > 0) else {
            return Ok(());
        };
        let row = blank_row(&leaf.data_type, f64::NAN)?;
        let n_rows = usize::try_from(n).unwrap_or(usize::MAX);
        array.append(&concat(&vec![&row; n_rows])?)?;
        note_filled(leaf, n, losses);
        Ok(())
    }
}

fn note_filled(leaf: &Leaf, n: u64, losses: &mut LossTally) {
    let detail = "steps without a value got NaN, 0 or empty text";
    losses.add(&leaf.column, LossEffect::Invented, detail, n);
}

/// Nested objects as Minari flattens them: `options/a/b`.
fn flattened(attributes: &Map<String, Value>) -> Vec<(String, Value)> {
    let mut flat = Vec::new();
    for (name, value) in attributes {
        match value {
            Value::Object(inner) if !inner.is_empty() => {
                let inner = flattened(inner).into_iter();
                flat.extend(inner.map(|(key, value)| (format!("{name}/{key}"), value)));
            }
            other => flat.push((name.clone(), other.clone())),
        }
    }
    flat
}
