//! Delivering an archive in batches.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use arrow::array::RecordBatchReader;
use arrow::datatypes::SchemaRef;

use super::archive::Archive;
use super::array::{Found, NpyArray, Rows};
use super::ogbench::{self, VALIDS};
use crate::episode::{EpisodeEnd, EpisodeRecord};
use crate::error::{DatasetError, Result};
use crate::format::{Format, OpenOptions};
use crate::formats::d4rl::cut::Cut;
use crate::formats::d4rl::flat::{
    ACTIONS, FlatArrays, FlatRows, OBSERVATIONS, REQUIRED, REWARDS, TERMINALS, TIMEOUTS, check,
    columns, is_known, missing,
};
use crate::formats::d4rl::plan::plan;
use crate::formats::steps::{
    ArrayInfo, ColumnSource, EpisodeRows, LeafBuilder, Piece, RowRule, StepColumn, StepScan,
    StepTable, table_schema,
};
use crate::schema;
use crate::source::{DatasetInfo, DatasetSource, Scan, Warning};
use crate::spec::LeafSpec;

/// Per-step arrays that only OGBench has.
const STATES: [&str; 4] = [VALIDS, "qpos", "qvel", "button_states"];

/// Opens an archive: reads the headers of its arrays and its flags, cuts it into episodes.
///
/// # Errors
/// What is wrong with it.
pub(crate) fn open(path: &Path, options: &OpenOptions) -> Result<Box<dyn DatasetSource>> {
    let stem = path.file_stem().unwrap_or_default();
    let id = stem.to_string_lossy().into_owned();
    let mut info = DatasetInfo::new(id, Format::Npz, path.to_owned());
    let file = NpzFile::open(path, &mut info.warnings)?;
    let infos = file.infos();
    let (cuts, columns) = match file.is_ogbench {
        true => ogbench_plan(&file, &infos, options, &mut info)?,
        false => {
            let name = path.file_name().unwrap_or_default().to_string_lossy();
            let mut plan = plan(&file, &name, options)?;
            info.episode_rule = plan.rule;
            info.boundaries_inferred = plan.inferred;
            info.warnings.append(&mut plan.warnings);
            (plan.cuts, columns(&infos, plan.policy))
        }
    };
    let schema = table_schema(&columns, &info);
    let leaf = |name: &str| LeafSpec::of_field(schema.field_with_name(name).ok()?);
    info.n_episodes = Some(cuts.len() as u64);
    info.n_steps = Some(cuts.iter().map(|cut| cut.n_steps).sum());
    info.observation = leaf(schema::OBSERVATION).into_iter().collect();
    info.action = leaf(schema::ACTION).into_iter().collect();
    Ok(Box::new(NpzSource {
        path: path.to_owned(),
        file,
        cuts,
        columns,
        schema,
        info,
    }))
}

fn ogbench_plan(
    file: &NpzFile,
    infos: &[ArrayInfo],
    options: &OpenOptions,
    info: &mut DatasetInfo,
) -> Result<(Vec<Cut>, Vec<StepColumn>)> {
    if let Some(policy) = options.episode_policy {
        return Err(DatasetError::PolicyNeeds {
            policy: policy.name(),
            needs: "the key \"rewards\" or \"timeouts\": without them the archive has OGBench's layout",
        });
    }
    let (cuts, n_empty) = ogbench::cut(file)?;
    if n_empty > 0 {
        info.warnings.push(Warning::EmptyEpisodes {
            n_episodes: n_empty,
        });
    }
    let mark = match infos.iter().any(|array| array.key == VALIDS) {
        true => "`valids` is 0 on",
        false => "`terminals` marks",
    };
    info.episode_rule =
        format!("OGBench: {mark} the last row of a trajectory, whose action is unused");
    Ok((cuts, ogbench::columns(infos)))
}

/// The arrays of an archive with a row per step.
struct NpzFile {
    arrays: Vec<NpyArray>,
    n_rows: u64,
    is_ogbench: bool,
}

impl NpzFile {
    fn open(path: &Path, warnings: &mut Vec<Warning>) -> Result<Self> {
        let mut arrays = arrays(&Archive::open(path)?, warnings)?;
        let find = |key: &str| arrays.iter().find(|array| array.info.key == key);
        let is_ogbench = find(REWARDS).is_none() && find(TIMEOUTS).is_none();
        let ogbench = [OBSERVATIONS, ACTIONS, TERMINALS];
        let required: &[&str] = if is_ogbench { &ogbench } else { &REQUIRED };
        if let Some(key) = required.iter().find(|key| find(key).is_none()) {
            let found = arrays.iter().map(|array| array.info.key.as_str());
            return Err(missing(key, found));
        }
        let n_rows = find(OBSERVATIONS).map_or(0, |array| array.info.n_rows);
        arrays.retain(|array| {
            let keep = must_fit(&array.info.key) || array.info.n_rows == n_rows;
            if !keep {
                let reason = "it does not have one row per step";
                warnings.push(left_out(&array.info.key, reason));
            }
            keep
        });
        arrays
            .iter()
            .try_for_each(|array| check(&array.info, n_rows))?;
        Ok(Self {
            arrays,
            n_rows,
            is_ogbench,
        })
    }
}

/// The arrays of an archive that can be columns, by key.
fn arrays(archive: &Archive, warnings: &mut Vec<Warning>) -> Result<Vec<NpyArray>> {
    let mut arrays = Vec::new();
    for entry in &archive.entries {
        let Some(key) = entry.name.strip_suffix(".npy") else {
            warnings.push(left_out(&entry.name, "it is no array"));
            continue;
        };
        match NpyArray::open(&archive.path, entry, key)? {
            Found::Array(array) if array.info.width() > 0 => arrays.push(array),
            Found::Array(_) if !must_fit(key) => {
                warnings.push(left_out(key, "its rows are empty"));
            }
            Found::Array(array) => {
                return Err(DatasetError::ShapeMismatch {
                    key: array.info.key,
                    actual: array.info.row_shape,
                    expected: "at least one value a row".to_owned(),
                });
            }
            Found::Other { .. } if !must_fit(key) => {
                warnings.push(left_out(key, "its type or shape cannot be a column"));
            }
            Found::Other { actual } => {
                return Err(DatasetError::WrongType {
                    key: key.to_owned(),
                    actual,
                    expected: "an array of numbers or flags",
                });
            }
        }
    }
    arrays.sort_by(|a, b| a.info.key.cmp(&b.info.key));
    Ok(arrays)
}

fn left_out(column: &str, reason: &'static str) -> Warning {
    Warning::ColumnLeftOut {
        column: column.to_owned(),
        reason,
    }
}

/// Whether an array of this key has a row per step in every archive.
fn must_fit(key: &str) -> bool {
    is_known(key) || STATES.contains(&key)
}

impl NpzFile {
    fn array(&self, key: &str) -> Result<&NpyArray> {
        let keys = || self.arrays.iter().map(|array| array.info.key.as_str());
        let found = self.arrays.iter().find(|array| array.info.key == key);
        found.ok_or_else(|| missing(key, keys()))
    }
}

impl FlatArrays for NpzFile {
    fn infos(&self) -> Vec<ArrayInfo> {
        self.arrays.iter().map(|array| array.info.clone()).collect()
    }

    fn n_rows(&self) -> u64 {
        self.n_rows
    }

    fn rows<'a>(&'a self, key: &str) -> Result<Box<dyn FlatRows + 'a>> {
        Ok(Box::new(Rows::open(self.array(key)?)?))
    }
}

impl FlatRows for Rows {
    fn append(&mut self, start: u64, n: usize, to: &mut LeafBuilder) -> Result<()> {
        Rows::append(self, start, n, to)
    }
}

struct NpzSource {
    path: PathBuf,
    file: NpzFile,
    cuts: Vec<Cut>,
    columns: Vec<StepColumn>,
    schema: SchemaRef,
    info: DatasetInfo,
}

impl DatasetSource for NpzSource {
    fn info(&self) -> &DatasetInfo {
        &self.info
    }

    fn schema(&self) -> SchemaRef {
        Arc::clone(&self.schema)
    }

    fn scan(&self, scan: &Scan) -> Result<Box<dyn RecordBatchReader + Send + '_>> {
        let pass = NpzPass {
            source: self,
            rows: Mutex::default(),
        };
        let scan = StepScan::new(pass, &self.schema, &self.columns, scan);
        Ok(Box::new(scan.map_err(|error| error.in_file(&self.path))?))
    }

    fn episodes(&self) -> Result<Vec<EpisodeRecord>> {
        let mut episodes = (self as &dyn DatasetSource).derived_episodes()?;
        // The cuts know about ends that no flag records.
        let ends = self.cuts.iter().map(|cut| cut.end);
        episodes
            .iter_mut()
            .zip(ends)
            .for_each(|(episode, end)| episode.end = end);
        Ok(episodes)
    }
}

/// One pass: the rows of each column are read in order.
struct NpzPass<'a> {
    source: &'a NpzSource,
    rows: Mutex<BTreeMap<String, Rows>>,
}

impl StepTable for NpzPass<'_> {
    fn path(&self) -> &Path {
        &self.source.path
    }

    fn episode(&self, place: usize) -> Option<Result<EpisodeRows>> {
        let cut = self.source.cuts.get(place)?;
        Some(Ok(EpisodeRows {
            episode_index: i64::try_from(place).unwrap_or(i64::MAX),
            n_steps: cut.n_steps,
            has_final_obs: cut.has_final_obs,
        }))
    }

    fn append(&self, pieces: &[Piece], column: &ColumnSource, to: &mut LeafBuilder) -> Result<()> {
        let file = &self.source.file;
        let is_made_up = file.is_ogbench && column.key == TERMINALS;
        let mut open = self.rows.lock().unwrap_or_else(PoisonError::into_inner);
        if !is_made_up && !open.contains_key(&column.key) {
            open.insert(column.key.clone(), Rows::open(file.array(&column.key)?)?);
        }
        let vanished = || DatasetError::corrupt("an array vanished");
        for piece in pieces {
            let cut = self.source.cuts.get(piece.episode).ok_or_else(vanished)?;
            let end = match column.rule {
                RowRule::Step => cut.n_steps,
                RowRule::Observation | RowRule::Info => u64::MAX,
            };
            let (n, nulls) = piece.split_at(end);
            if is_made_up {
                let last =
                    (cut.end == EpisodeEnd::Truncated).then(|| cut.n_steps.saturating_sub(1));
                to.append_flags((piece.from..).take(n).map(|row| Some(row) == last));
            } else {
                let rows = open.get_mut(&column.key).ok_or_else(vanished)?;
                rows.append(cut.start + piece.from, n, to)?;
                if nulls > 0 {
                    rows.go_to(cut.start + piece.to)?;
                }
            }
            to.append_nulls(nulls);
        }
        Ok(())
    }
}
