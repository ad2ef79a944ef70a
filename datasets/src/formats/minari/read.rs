//! Delivering a Minari dataset with the HDF5 backend in batches.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use arrow::array::RecordBatchReader;
use arrow::datatypes::SchemaRef;
use serde_json::{Map, Value};

use super::describe::{Oddities, count_warnings, dataset_info, table_schema};
use super::empty::SpaceLeaves;
use super::metadata::Metadata;
use super::space::Space;
use super::structure::{Structure, check_members, episode_lengths, structure};
use crate::episode::EpisodeRecord;
use crate::error::{DatasetError, Result};
use crate::format::{Format, OpenOptions};
use crate::formats::hdf5::{
    Array, ColumnSource, EpisodeRows, H5File, LeafBuilder, MemberKind, Piece, RowRule, StepColumn,
    StepScan, StepTable, attributes, join, members,
};
use crate::source::{DatasetInfo, DatasetSource, Scan, Warning};

/// A Minari dataset, open.
pub(crate) struct MinariSource {
    /// The HDF5 file.
    data: PathBuf,
    file: H5File,
    episodes: Vec<Episode>,
    columns: Vec<StepColumn>,
    schema: SchemaRef,
    info: DatasetInfo,
}

struct Episode {
    group: String,
    rows: EpisodeRows,
}

impl MinariSource {
    /// Opens a dataset folder: reads the metadata, the structure of the first episode and the length of all.
    ///
    /// # Errors
    /// Whatever of that fails.
    pub(crate) fn open(path: &Path, options: &OpenOptions) -> Result<Self> {
        let metadata = Metadata::read(path)?;
        let mut warnings: Vec<Warning> =
            metadata.check_version(options.force)?.into_iter().collect();
        let data = path.join("data").join("main_data.hdf5");
        let mut inside = || -> Result<(H5File, Vec<Episode>, Structure)> {
            let file = H5File::open(&data)?;
            let names = episode_names(&file, &mut warnings)?;
            let structure = first_structure(&file, &names, &metadata, &mut warnings)?;
            let episodes = episodes(&file, names, &structure, &mut warnings)?;
            Ok((file, episodes, structure))
        };
        let (file, episodes, mut structure) = inside().map_err(|error| error.in_file(&data))?;
        warnings.append(&mut structure.warnings);
        let n_steps = episodes.iter().map(|episode| episode.rows.n_steps).sum();
        count_warnings(&metadata, episodes.len() as u64, n_steps, &mut warnings);
        let schema = table_schema(Format::MinariHdf5, &structure.fields, &metadata);
        let mut info = dataset_info(Format::MinariHdf5, path, metadata);
        info.n_episodes = Some(episodes.len() as u64);
        info.n_steps = Some(n_steps);
        info.observation = structure.observation;
        info.action = structure.action;
        info.warnings = warnings;
        Ok(Self {
            data,
            file,
            episodes,
            columns: structure.columns,
            schema,
            info,
        })
    }

    fn append_piece(
        &self,
        piece: &Piece,
        column: &ColumnSource,
        to: &mut LeafBuilder,
    ) -> Result<()> {
        let episode = self.episode_at(piece.episode)?;
        let path = join(&episode.group, &column.key);
        let steps = episode.rows.n_steps;
        if column.rule == RowRule::Info && !self.file.root().link_exists(&path) {
            // Infos may differ from episode to episode.
            to.append_nulls(piece.split_at(u64::MAX).0);
            return Ok(());
        }
        let array = Array::open(self.file.root(), &path, &path, self.file.size())?;
        let expected = match column.rule {
            RowRule::Observation => episode.rows.n_rows(),
            RowRule::Step => steps,
            RowRule::Info if array.n_rows() == steps + 1 => steps + 1,
            RowRule::Info => steps,
        };
        if array.n_rows() != expected {
            return Err(DatasetError::LengthMismatch {
                key: path,
                actual: array.n_rows(),
                expected,
            });
        }
        let (n, nulls) = piece.split_at(expected);
        to.append(&array, piece.from, n)?;
        to.append_nulls(nulls);
        Ok(())
    }

    fn episode_at(&self, place: usize) -> Result<&Episode> {
        self.episodes
            .get(place)
            .ok_or_else(|| DatasetError::corrupt("an episode vanished"))
    }
}

/// Names of the episode groups by number: the library's order has `episode_10` before `episode_2`.
fn episode_names(file: &H5File, warnings: &mut Vec<Warning>) -> Result<Vec<(u64, String)>> {
    let mut names = Vec::new();
    for member in members(file.root(), "")? {
        let number = member
            .name
            .strip_prefix("episode_")
            .and_then(|n| n.parse::<u64>().ok());
        match number
            .filter(|n| member.kind == MemberKind::Group && member.name == format!("episode_{n}"))
        {
            Some(number) => names.push((number, member.name)),
            None => warnings.push(Warning::ColumnLeftOut {
                column: member.name,
                reason: "it is no episode",
            }),
        }
    }
    names.sort_unstable();
    Ok(names)
}

fn first_structure(
    file: &H5File,
    names: &[(u64, String)],
    metadata: &Metadata,
    warnings: &mut Vec<Warning>,
) -> Result<Structure> {
    let Some((_, first)) = names.first() else {
        let leaves = SpaceLeaves::new(metadata)?;
        return Ok(Structure {
            fields: leaves.fields(),
            observation: leaves.observation,
            action: leaves.action,
            columns: Vec::new(),
            warnings: Vec::new(),
        });
    };
    if metadata.observation_space.is_none() || metadata.action_space.is_none() {
        warnings.push(Warning::NoSpace);
    }
    check_members(file, first)?;
    structure(
        file,
        first,
        &Space::of(&metadata.observation_space),
        &Space::of(&metadata.action_space),
    )
}

/// Lengths of all episodes; those without a step are left out.
fn episodes(
    file: &H5File,
    names: Vec<(u64, String)>,
    structure: &Structure,
    warnings: &mut Vec<Warning>,
) -> Result<Vec<Episode>> {
    if names.is_empty() {
        return Ok(Vec::new());
    }
    let observation = structure
        .columns
        .iter()
        .find(|column| column.source.rule == RowRule::Observation);
    let observation = observation
        .map(|column| column.source.key.as_str())
        .ok_or_else(|| DatasetError::MissingKey {
            key: "observations".to_owned(),
            found: "an empty group".to_owned(),
        })?;
    let mut episodes = Vec::with_capacity(names.len());
    let mut odd = Oddities::default();
    for (number, group) in names {
        odd.note_infos(check_members(file, &group)?);
        let (n_steps, n_observations) = episode_lengths(file, &group, observation)?;
        if n_steps == 0 {
            odd.n_empty += 1;
            continue;
        }
        let has_final_obs = n_observations == n_steps + 1;
        if n_observations == n_steps {
            odd.n_without_final += 1;
        } else if !has_final_obs {
            let (key, actual, expected) = (join(&group, observation), n_observations, n_steps + 1);
            return Err(DatasetError::LengthMismatch {
                key,
                actual,
                expected,
            });
        }
        let episode_index = i64::try_from(number).map_err(|_| {
            DatasetError::corrupt(format!("episode number {number} is out of range"))
        })?;
        episodes.push(Episode {
            group,
            rows: EpisodeRows {
                episode_index,
                n_steps,
                has_final_obs,
            },
        });
    }
    odd.warn(warnings);
    Ok(episodes)
}

/// Attributes with `options/a/b` unfolded into nested objects.
fn unfolded(flat: Map<String, Value>) -> Map<String, Value> {
    let mut nested = Map::new();
    for (name, value) in flat {
        let mut parts: Vec<&str> = name.split('/').collect();
        let last = parts.pop().unwrap_or_default();
        let parent = parts.iter().try_fold(&mut nested, |object, part| {
            object
                .entry(*part)
                .or_insert_with(|| Value::Object(Map::new()))
                .as_object_mut()
        });
        if let Some(parent) = parent {
            parent.insert(last.to_owned(), value);
        }
    }
    nested
}

impl DatasetSource for MinariSource {
    fn info(&self) -> &DatasetInfo {
        &self.info
    }

    fn schema(&self) -> SchemaRef {
        Arc::clone(&self.schema)
    }

    fn scan(&self, scan: &Scan) -> Result<Box<dyn RecordBatchReader + Send + '_>> {
        let scan = StepScan::new(self, &self.schema, &self.columns, scan);
        Ok(Box::new(scan.map_err(|error| error.in_file(&self.data))?))
    }

    fn episodes(&self) -> Result<Vec<EpisodeRecord>> {
        let mut records = (self as &dyn DatasetSource).derived_episodes()?;
        for (record, episode) in records.iter_mut().zip(&self.episodes) {
            let read = || -> Result<_> {
                let group = self.file.group(&episode.group)?;
                attributes(&group, &episode.group)
            };
            record.attributes = unfolded(read().map_err(|error| error.in_file(&self.data))?);
            record.seed = record.attributes.get("seed").and_then(Value::as_u64);
        }
        Ok(records)
    }
}

impl StepTable for MinariSource {
    fn path(&self) -> &Path {
        &self.data
    }

    fn episode(&self, place: usize) -> Option<Result<EpisodeRows>> {
        self.episodes.get(place).map(|episode| Ok(episode.rows))
    }

    fn append(&self, pieces: &[Piece], column: &ColumnSource, to: &mut LeafBuilder) -> Result<()> {
        pieces
            .iter()
            .try_for_each(|piece| self.append_piece(piece, column, to))
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn options_are_unfolded() {
        let flat = json!({"id": 1, "options/cfg/goal": "a", "options/level": 1});
        let Value::Object(flat) = flat else {
            unreachable!()
        };
        let expected = json!({"id": 1, "options": {"cfg": {"goal": "a"}, "level": 1}});
        assert_eq!(Value::Object(unfolded(flat)), expected);
    }
}
