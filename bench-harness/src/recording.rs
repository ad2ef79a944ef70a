//! Writing finished episodes as a dataset.
//!
//! Episodes go to an unnamed file first, which the system removes however the process ends, and from there into any
//! format at the end, when their number and seeds are known: most formats want these before the first row. Memory
//! is one episode, and a few hundred bytes for each that is finished.

mod rows;
mod table;

use std::fs::File;
use std::io::{BufReader, BufWriter, Seek};
use std::path::Path;
use std::sync::Arc;

use arrow::array::RecordBatch;
use arrow::datatypes::SchemaRef;
use arrow::ipc::reader::StreamReader;
use arrow::ipc::writer::StreamWriter;
use ksim_datasets::{
    DatasetError, DatasetInfo, EpisodeRecord as DatasetEpisode, Format, SinkInput, WriteOptions,
    Written, schema,
};
use ksim_envs::EnvironmentSpec;
use serde_json::{Map, Value};

use self::rows::Rows;
use crate::policy::Annotation;
use crate::record::EpisodeTrace;

/// Name of the source format in files that hold rollouts.
pub const SOURCE_FORMAT: &str = "ksim-rollout";

/// How actions are stored.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum ActionPrecision {
    /// As they went into the environment.
    #[default]
    Double,
    /// As Gymnasium's action spaces declare them. Exact only for a policy that gives such actions.
    Single,
}

/// What a dataset says of itself.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct About {
    /// Gymnasium's specification of the environment, as JSON; `None` where Gymnasium has no such environment.
    pub env_spec: Option<Value>,
    /// Returns that count as 0 and 1 in the normalized score.
    pub reference: Option<(f64, f64)>,
    /// How the rollout was made. Formats of ours keep it as the source's metadata.
    pub rollout: Map<String, Value>,
    /// Fields of Minari's `metadata.json`, for its formats.
    pub minari: Map<String, Value>,
}

/// Episodes on their way to a dataset.
pub struct Recording {
    environment: EnvironmentSpec,
    annotations: &'static [Annotation],
    schema: SchemaRef,
    spool: StreamWriter<BufWriter<File>>,
    episodes: Vec<DatasetEpisode>,
    n_rows: u64,
}

impl Recording {
    /// Starts without episodes, of a policy that tells `annotations` of its steps. The spooled file is in `folder`, the one of the dataset to come: there must be room.
    ///
    /// # Errors
    /// Nothing can be written into the folder.
    pub fn start(
        environment: &EnvironmentSpec,
        annotations: &'static [Annotation],
        precision: ActionPrecision,
        folder: &Path,
    ) -> Result<Self, DatasetError> {
        let schema = table::schema(environment, annotations, precision);
        let file = tempfile::tempfile_in(folder).map_err(|source| DatasetError::InFile {
            path: folder.to_owned(),
            source: Box::new(DatasetError::Io {
                operation: "write into",
                source,
            }),
        })?;
        Ok(Self {
            environment: environment.clone(),
            annotations,
            spool: StreamWriter::try_new(BufWriter::new(file), &schema)?,
            schema,
            episodes: Vec::new(),
            n_rows: 0,
        })
    }

    /// Adds an episode.
    ///
    /// # Errors
    /// A failed write.
    pub fn add(&mut self, trace: &EpisodeTrace) -> Result<(), DatasetError> {
        let rows = Rows::new(trace, self.annotations);
        let columns = self.schema.fields().iter();
        let columns = columns.map(|field| rows.column(field, &self.environment));
        let batch =
            RecordBatch::try_new(Arc::clone(&self.schema), columns.collect::<Result<_, _>>()?)?;
        self.spool.write(&batch)?;
        let n_rows = batch.num_rows() as u64;
        self.episodes.push(rows.describe(self.n_rows, n_rows));
        self.n_rows += n_rows;
        Ok(())
    }

    /// Number of episodes so far.
    pub fn n_episodes(&self) -> usize {
        self.episodes.len()
    }

    /// Writes the dataset; nothing is visible at the target before it is complete. Without an episode there is
    /// nothing to write and the result is `None`.
    ///
    /// # Errors
    /// The format cannot hold the columns, something is at the target that is not replaced, or a failed write.
    pub fn finish(
        mut self,
        target: &Path,
        format: Format,
        about: &About,
        options: &WriteOptions,
    ) -> Result<Option<Written>, DatasetError> {
        if self.episodes.is_empty() {
            return Ok(None);
        }
        self.spool.finish()?;
        let mut spool = self
            .spool
            .into_inner()?
            .into_inner()
            .map_err(|error| spooled(error.into_error()))?;
        spool.rewind().map_err(spooled)?;
        let schema = table::described(&self.schema, &self.environment, about, format);
        let info = DatasetInfo {
            id: self.environment.id.clone(),
            format,
            path: target.to_owned(),
            n_episodes: Some(self.episodes.len() as u64),
            n_steps: Some(self.episodes.iter().map(|episode| episode.length).sum()),
            observation: table::leaves(&schema, schema::OBSERVATION),
            action: table::leaves(&schema, schema::ACTION),
            episode_rule: "as rolled out".to_owned(),
            boundaries_inferred: false,
            env_spec: about.env_spec.clone(),
            metadata: about.rollout.clone(),
            ref_min_score: about.reference.map(|(low, _)| low),
            ref_max_score: about.reference.map(|(_, high)| high),
            warnings: Vec::new(),
        };
        let input = SinkInput {
            schema: &schema,
            info: &info,
            episodes: &self.episodes,
        };
        let mut sink = ksim_datasets::create(target, format, &input, options)?;
        for batch in StreamReader::try_new(BufReader::new(spool), None)? {
            let columns = batch?.columns().to_vec();
            sink.write(&RecordBatch::try_new(Arc::clone(&schema), columns)?)?;
        }
        sink.finish().map(Some)
    }
}

fn spooled(source: std::io::Error) -> DatasetError {
    DatasetError::Io {
        operation: "read back the episodes",
        source,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::policy::ANNOTATIONS;
    use crate::record::EpisodeRecord;
    use arrow::array::{Array, AsArray};
    use arrow::datatypes::Float64Type;
    use ksim_datasets::{DatasetSource, OpenOptions, Scan};
    use ksim_envs::Part;

    fn environment() -> EnvironmentSpec {
        let part = |name, width| Part { name, width };
        EnvironmentSpec {
            id: "Maze-v0".to_owned(),
            observation: vec![
                part("achieved_goal", 2),
                part("observation", 1),
                part("desired_goal", 2),
            ],
            action_low: vec![-1.0],
            action_high: vec![1.0],
            info: vec![part("qpos", 1), part("goal", 2)],
            max_episode_steps: 3,
            dt_s: 0.05,
            reports_success: true,
            kwargs: Map::new(),
        }
    }

    /// An episode whose numbers say where they belong: row, then place in the row.
    fn trace(episode: usize, n_steps: usize) -> EpisodeTrace {
        let rows = |n: usize, width: usize| -> Vec<f64> {
            (0..n * width)
                .map(|i| (i / width * 10 + i % width) as f64)
                .collect()
        };
        EpisodeTrace {
            record: EpisodeRecord {
                episode,
                run: 0,
                seed: 70 + episode as u64,
                length: n_steps,
                total_return: 3.0,
                discounted_return: 2.5,
                terminated: true,
                truncated: false,
                success: Some(true),
                success_at_end: Some(true),
                first_success_step: Some(n_steps),
                normalized_score: None,
            },
            observations: rows(n_steps + 1, 5),
            actions: rows(n_steps, 1),
            rewards: rows(n_steps, 1),
            infos: rows(n_steps + 1, 3),
            successes: (0..=n_steps).map(|row| row == n_steps).collect(),
            annotations: rows(n_steps, 2),
        }
    }

    fn recorded(format: Format) -> (tempfile::TempDir, Box<dyn DatasetSource>) {
        let folder = tempfile::tempdir().unwrap();
        let target = folder.path().join("out");
        let mut recording = Recording::start(
            &environment(),
            &ANNOTATIONS,
            ActionPrecision::Double,
            folder.path(),
        )
        .unwrap();
        recording.add(&trace(0, 2)).unwrap();
        recording.add(&trace(1, 3)).unwrap();
        assert_eq!(recording.n_episodes(), 2);
        let about = About {
            reference: Some((0.0, 2.0)),
            rollout: Map::from_iter([("policy".to_owned(), "zero".into())]),
            ..About::default()
        };
        let options = WriteOptions::default();
        let written = recording.finish(&target, format, &about, &options);
        let written = written.unwrap().expect("there are episodes");
        assert_eq!(written.info.path, target);
        let source = ksim_datasets::open(&target, &OpenOptions::default()).unwrap();
        (folder, source)
    }

    #[test]
    fn columns_are_named_and_sorted_as_minaris_reader_does() {
        let (_folder, source) = recorded(Format::Parquet);
        let schema = source.schema();
        let names: Vec<&str> = schema.fields().iter().map(|f| f.name().as_str()).collect();
        assert_eq!(
            names,
            [
                "episode_index",
                "step_index",
                "observation.achieved_goal",
                "observation.desired_goal",
                "observation.observation",
                "action",
                "reward",
                "terminated",
                "truncated",
                "info.goal",
                "info.qpos",
                "info.success",
                "info.novelty",
                "info.plan_score",
            ]
        );
        let info = source.info();
        assert_eq!(
            (info.ref_min_score, info.ref_max_score),
            (Some(0.0), Some(2.0))
        );
        assert_eq!(info.metadata["policy"], "zero");
    }

    #[test]
    fn every_number_is_in_its_row_and_column() {
        for format in [Format::Parquet, Format::ArrowIpc] {
            let (_folder, source) = recorded(format);
            let mut batches = source.scan(&Scan::default()).unwrap();
            let batch = batches.next().unwrap().unwrap();
            assert_eq!(batch.num_rows(), 3 + 4, "{format}");
            let values = |name: &str| {
                let lists = batch.column_by_name(name).unwrap().as_fixed_size_list();
                lists
                    .values()
                    .as_primitive::<Float64Type>()
                    .values()
                    .to_vec()
            };
            assert_eq!(
                values("observation.desired_goal")[..6],
                [3.0, 4.0, 13.0, 14.0, 23.0, 24.0]
            );
            assert_eq!(
                values("observation.observation")[..4],
                [2.0, 12.0, 22.0, 2.0]
            );
            assert_eq!(values("info.goal")[2..4], [11.0, 12.0]);
            let nulls = |name: &str| {
                let column = batch.column_by_name(name).unwrap();
                (0..7)
                    .filter(|&row| column.is_null(row))
                    .collect::<Vec<_>>()
            };
            let scores = batch.column_by_name("info.plan_score").unwrap();
            let scores = scores.as_primitive::<Float64Type>();
            assert_eq!((scores.value(0), scores.value(1)), (1.0, 11.0));
            for name in [
                "action",
                "reward",
                "terminated",
                "truncated",
                "info.novelty",
            ] {
                assert_eq!(nulls(name), [2, 6], "{name}");
            }
            let ends = batch.column_by_name("terminated").unwrap().as_boolean();
            let ends: Vec<usize> = (0..7)
                .filter(|&row| ends.value(row) && ends.is_valid(row))
                .collect();
            assert_eq!(ends, [1, 5]);
        }
    }

    #[test]
    fn seeds_and_numbers_of_episodes_come_back() {
        for format in [Format::Parquet, Format::ArrowIpc] {
            let (_folder, source) = recorded(format);
            let episodes = source.episodes().unwrap();
            assert_eq!(episodes[1].seed, Some(71), "{format}");
            assert_eq!(episodes[1].attributes["rewards_max"], 20.0);
            assert_eq!(episodes[1].attributes["discounted_return"], 2.5);
            assert_eq!(episodes[0].success, Some(true));
        }
    }

    #[test]
    fn without_episodes_nothing_is_written() {
        let folder = tempfile::tempdir().unwrap();
        let recording = Recording::start(
            &environment(),
            &ANNOTATIONS,
            ActionPrecision::Double,
            folder.path(),
        )
        .unwrap();
        let target = folder.path().join("out.parquet");
        let options = WriteOptions::default();
        let written = recording.finish(&target, Format::Parquet, &About::default(), &options);
        assert!(written.unwrap().is_none());
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    }

    #[test]
    fn a_trace_of_other_widths_is_an_error() {
        let folder = tempfile::tempdir().unwrap();
        let mut recording = Recording::start(
            &environment(),
            &ANNOTATIONS,
            ActionPrecision::Single,
            folder.path(),
        )
        .unwrap();
        let mut odd = trace(0, 2);
        odd.infos.pop();
        assert!(recording.add(&odd).is_err());
    }
}
