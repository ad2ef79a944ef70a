//! Delivering a D4RL file in batches.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use arrow::array::RecordBatchReader;
use arrow::datatypes::SchemaRef;

use super::cut::Cut;
use super::flat::{FlatArrays, columns};
use super::plan::plan;
use super::walk::{Walked, walk};
use crate::episode::EpisodeRecord;
use crate::error::{DatasetError, Result};
use crate::format::{Format, OpenOptions};
use crate::formats::hdf5::{
    ColumnSource, EpisodeRows, H5File, LeafBuilder, Piece, RowRule, StepColumn, StepScan,
    StepTable, table_schema,
};
use crate::registry;
use crate::schema;
use crate::source::{DatasetInfo, DatasetSource, Scan};
use crate::spec::LeafSpec;

/// A D4RL file, open.
pub(crate) struct D4rlSource {
    path: PathBuf,
    walked: Walked,
    cuts: Vec<Cut>,
    columns: Vec<StepColumn>,
    schema: SchemaRef,
    info: DatasetInfo,
}

impl D4rlSource {
    /// Opens a file: lists its arrays, reads its flags, cuts it into episodes.
    ///
    /// # Errors
    /// Whatever of that fails.
    pub(crate) fn open(path: &Path, options: &OpenOptions) -> Result<Self> {
        let file = H5File::open(path)?;
        let mut walked = walk(&file)?;
        let file_name = path
            .file_name()
            .map(|name| name.to_string_lossy().into_owned())
            .unwrap_or_default();
        let plan = plan(&walked, &file_name, options)?;
        let columns = columns(&walked.infos(), plan.policy);
        let mut info = DatasetInfo::new(
            path.file_stem()
                .map(|stem| stem.to_string_lossy().into_owned())
                .unwrap_or_default(),
            Format::D4rlHdf5,
            path.to_owned(),
        );
        info.metadata = std::mem::take(&mut walked.metadata);
        let schema = table_schema(&columns, &info);
        let leaf = |name: &str| {
            schema
                .field_with_name(name)
                .ok()
                .and_then(LeafSpec::of_field)
        };
        info.n_episodes = Some(plan.cuts.len() as u64);
        info.n_steps = Some(plan.cuts.iter().map(|cut| cut.n_steps).sum());
        info.observation = leaf(schema::OBSERVATION).into_iter().collect();
        info.action = leaf(schema::ACTION).into_iter().collect();
        info.episode_rule = plan.rule;
        info.boundaries_inferred = plan.inferred;
        let known = registry::find_file(&file_name);
        info.ref_min_score = known.and_then(|known| known.ref_min_score);
        info.ref_max_score = known.and_then(|known| known.ref_max_score);
        info.warnings = plan.warnings;
        info.warnings.append(&mut walked.warnings);
        Ok(Self {
            path: path.to_owned(),
            walked,
            cuts: plan.cuts,
            columns,
            schema,
            info,
        })
    }
}

impl DatasetSource for D4rlSource {
    fn info(&self) -> &DatasetInfo {
        &self.info
    }

    fn schema(&self) -> SchemaRef {
        Arc::clone(&self.schema)
    }

    fn scan(&self, scan: &Scan) -> Result<Box<dyn RecordBatchReader + Send + '_>> {
        let scan = StepScan::new(self, &self.schema, &self.columns, scan);
        Ok(Box::new(scan.map_err(|error| error.in_file(&self.path))?))
    }

    fn episodes(&self) -> Result<Vec<EpisodeRecord>> {
        let mut episodes = (self as &dyn DatasetSource).derived_episodes()?;
        // The cuts know about ends that no flag records.
        for (episode, cut) in episodes.iter_mut().zip(&self.cuts) {
            episode.end = cut.end;
        }
        Ok(episodes)
    }
}

impl StepTable for D4rlSource {
    fn path(&self) -> &Path {
        &self.path
    }

    fn episode(&self, place: usize) -> Option<Result<EpisodeRows>> {
        let cut = self.cuts.get(place)?;
        let episode_index = i64::try_from(place).unwrap_or(i64::MAX);
        Some(Ok(EpisodeRows {
            episode_index,
            n_steps: cut.n_steps,
            has_final_obs: cut.has_final_obs,
        }))
    }

    fn append(&self, pieces: &[Piece], column: &ColumnSource, to: &mut LeafBuilder) -> Result<()> {
        let array = self.walked.required(&column.key)?;
        // Episodes mostly follow each other without a gap: read them in one go.
        let mut run: (u64, usize) = (0, 0);
        for piece in pieces {
            let cut = self
                .cuts
                .get(piece.episode)
                .ok_or_else(|| DatasetError::corrupt("an episode vanished"))?;
            let end = if column.rule == RowRule::Observation {
                u64::MAX
            } else {
                cut.n_steps
            };
            let (n, nulls) = piece.split_at(end);
            let start = cut.start + piece.from;
            if run.0 + run.1 as u64 == start {
                run.1 += n;
            } else {
                to.append(array, run.0, run.1)?;
                run = (start, n);
            }
            if nulls > 0 {
                to.append(array, run.0, run.1)?;
                to.append_nulls(nulls);
                run = (start + n as u64, 0);
            }
        }
        to.append(array, run.0, run.1)
    }
}
