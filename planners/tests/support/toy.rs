//! A small dataset in a Parquet file, from a seedless rule.

use std::path::Path;
use std::sync::Arc;

use arrow::array::{
    ArrayRef, BooleanArray, FixedSizeListArray, Float64Array, Int64Array, RecordBatch,
};
use arrow::datatypes::{DataType, Field, Schema};
use ksim_datasets::{DatasetSink, DatasetSource, OpenOptions, ParquetSink, schema};

/// Rows of a toy robot: every third episode falls after 25 steps, the others run for 40.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Toy {
    pub(crate) n_episodes: usize,
    pub(crate) observation_dim: usize,
    /// Rewards of 0 and 1, as in a maze.
    pub(crate) sparse: bool,
    /// A reward that is no number.
    pub(crate) broken: bool,
}

impl Default for Toy {
    fn default() -> Self {
        Self {
            n_episodes: 6,
            observation_dim: 3,
            sparse: false,
            broken: false,
        }
    }
}

impl Toy {
    /// Writes the dataset and opens it.
    pub(crate) fn open(&self, path: &Path) -> Box<dyn DatasetSource> {
        let batch = self.batch();
        let mut sink = Box::new(ParquetSink::create(path, batch.schema()).unwrap());
        sink.write(&batch).unwrap();
        sink.finish().unwrap();
        ksim_datasets::open(path, &OpenOptions::default()).unwrap()
    }

    fn batch(&self) -> RecordBatch {
        let (mut episode, mut step) = (Vec::new(), Vec::new());
        let (mut observations, mut actions) = (Vec::new(), Vec::new());
        let (mut rewards, mut terminated, mut truncated) = (Vec::new(), Vec::new(), Vec::new());
        for number in 0..self.n_episodes {
            let falls = number % 3 == 2;
            let length = if falls { 25 } else { 40 };
            for at in 0..length {
                let phase = 0.3 * at as f64 + number as f64;
                episode.push(number as i64);
                step.push(at as i64);
                observations.extend((0..self.observation_dim).map(|k| (phase + k as f64).sin()));
                actions.extend([phase.cos(), 0.5 * (2.0 * phase).sin()]);
                let reward = if self.sparse {
                    f64::from(at > 30)
                } else {
                    1.0 + phase.cos()
                };
                rewards.push(if self.broken && at == 7 {
                    f64::NAN
                } else {
                    reward
                });
                terminated.push(falls && at + 1 == length);
                truncated.push(!falls && at + 1 == length);
            }
        }
        let columns: Vec<(&str, ArrayRef)> = vec![
            (schema::EPISODE_INDEX, Arc::new(Int64Array::from(episode))),
            (schema::STEP_INDEX, Arc::new(Int64Array::from(step))),
            (
                schema::OBSERVATION,
                list(observations, self.observation_dim),
            ),
            (schema::ACTION, list(actions, 2)),
            (schema::REWARD, Arc::new(Float64Array::from(rewards))),
            (schema::TERMINATED, Arc::new(BooleanArray::from(terminated))),
            (schema::TRUNCATED, Arc::new(BooleanArray::from(truncated))),
        ];
        let fields: Vec<Field> = columns
            .iter()
            .map(|(name, column)| Field::new(*name, column.data_type().clone(), false))
            .collect();
        let columns = columns.into_iter().map(|(_, column)| column).collect();
        RecordBatch::try_new(Arc::new(Schema::new(fields)), columns).unwrap()
    }
}

fn list(values: Vec<f64>, width: usize) -> ArrayRef {
    let element = Arc::new(Field::new("element", DataType::Float64, false));
    let values = Arc::new(Float64Array::from(values));
    Arc::new(FixedSizeListArray::new(element, width as i32, values, None))
}
