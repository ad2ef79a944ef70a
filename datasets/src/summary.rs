//! What there is to say about a dataset after one pass over it.

use arrow::array::{Array, ArrayRef, AsArray, RecordBatch};
use arrow::datatypes::{DataType, Float16Type, Float32Type, Float64Type};

use crate::episode::{EpisodeEnd, EpisodeRecord};
use crate::error::Result;
use crate::schema;
use crate::source::{DatasetSource, Scan};

/// Mean and extent of one quantity over the episodes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spread {
    /// Mean.
    pub mean: f64,
    /// Standard deviation of the population (divided by n).
    pub std: f64,
    /// Smallest value.
    pub min: f64,
    /// Largest value.
    pub max: f64,
}

/// One column.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ColumnSummary {
    /// Name.
    pub name: String,
    /// Type of one value.
    pub data_type: String,
    /// Values in a row.
    pub width: usize,
    /// Rows that are null.
    pub n_null: u64,
    /// Values that are NaN.
    pub n_nan: u64,
    /// Values that are infinite.
    pub n_infinite: u64,
}

/// A dataset in numbers.
#[derive(Debug, Clone, PartialEq)]
pub struct Summary {
    /// Episodes.
    pub n_episodes: u64,
    /// Steps; final-observation rows are not counted.
    pub n_steps: u64,
    /// Rows, final observations included.
    pub n_rows: u64,
    /// All columns in schema order.
    pub columns: Vec<ColumnSummary>,
    /// Undiscounted returns, where rewards are recorded.
    pub returns: Option<Spread>,
    /// Episode lengths in steps; `None` without episodes.
    pub lengths: Option<Spread>,
    /// Share of successful episodes among those where success is known.
    pub success_rate: Option<f64>,
    /// Episodes where success is known.
    pub n_success_known: u64,
    /// Number of episodes per kind of end, only kinds that occur.
    pub ends: Vec<(EpisodeEnd, u64)>,
}

/// Reads the whole dataset once, and its few episode columns a second time.
///
/// # Errors
/// Those of the scans.
pub fn summarize(source: &dyn DatasetSource) -> Result<Summary> {
    let schema = source.schema();
    let mut columns: Vec<ColumnSummary> = schema
        .fields()
        .iter()
        .map(|field| {
            let (data_type, shape) =
                schema::row_shape(field).unwrap_or_else(|| (field.data_type().clone(), Vec::new()));
            ColumnSummary {
                name: field.name().clone(),
                data_type: data_type.to_string(),
                width: if data_type == DataType::Binary {
                    1
                } else {
                    shape.iter().product()
                },
                n_null: 0,
                n_nan: 0,
                n_infinite: 0,
            }
        })
        .collect();
    let mut n_rows = 0;
    for batch in source.scan(&Scan::default())? {
        let batch = batch?;
        n_rows += batch.num_rows() as u64;
        count_batch(&batch, &mut columns);
    }
    Ok(Summary {
        columns,
        n_rows,
        ..episode_summary(&source.episodes()?)
    })
}

fn count_batch(batch: &RecordBatch, columns: &mut [ColumnSummary]) {
    for (array, summary) in batch.columns().iter().zip(columns) {
        summary.n_null += array.null_count() as u64;
        let (n_nan, n_infinite) = non_finite(array);
        summary.n_nan += n_nan;
        summary.n_infinite += n_infinite;
    }
}

/// Counts NaN and infinite values of a float column, lists included; other columns have none.
fn non_finite(array: &ArrayRef) -> (u64, u64) {
    fn count<T: Copy>(
        values: &[T],
        is_nan: impl Fn(T) -> bool,
        is_infinite: impl Fn(T) -> bool,
    ) -> (u64, u64) {
        values.iter().fold((0, 0), |(nan, infinite), &value| {
            (
                nan + u64::from(is_nan(value)),
                infinite + u64::from(is_infinite(value)),
            )
        })
    }
    match array.data_type() {
        DataType::Float64 => count(
            array.as_primitive::<Float64Type>().values(),
            f64::is_nan,
            f64::is_infinite,
        ),
        DataType::Float32 => count(
            array.as_primitive::<Float32Type>().values(),
            f32::is_nan,
            f32::is_infinite,
        ),
        DataType::Float16 => count(
            array.as_primitive::<Float16Type>().values(),
            half::f16::is_nan,
            half::f16::is_infinite,
        ),
        DataType::FixedSizeList(_, size) => {
            let list = array.as_fixed_size_list();
            let size = usize::try_from(*size).unwrap_or(0);
            let start = usize::try_from(list.value_offset(0)).unwrap_or(0);
            non_finite(&list.values().slice(start, list.len() * size))
        }
        _ => (0, 0),
    }
}

#[expect(clippy::cast_precision_loss, reason = "counts are far below 2^53")]
fn episode_summary(episodes: &[EpisodeRecord]) -> Summary {
    let lengths: Vec<f64> = episodes
        .iter()
        .map(|episode| episode.length as f64)
        .collect();
    let returns: Option<Vec<f64>> = episodes
        .iter()
        .map(|episode| episode.total_return)
        .collect();
    let known: Vec<bool> = episodes
        .iter()
        .filter_map(|episode| episode.success)
        .collect();
    let n_successes = known.iter().filter(|&&success| success).count();
    let kinds = [
        EpisodeEnd::Terminated,
        EpisodeEnd::Truncated,
        EpisodeEnd::Cut,
        EpisodeEnd::Unknown,
    ];
    let count = |kind| {
        episodes
            .iter()
            .filter(|episode| episode.end == kind)
            .count() as u64
    };
    Summary {
        n_episodes: episodes.len() as u64,
        n_steps: episodes.iter().map(|episode| episode.length).sum(),
        n_rows: 0,
        columns: Vec::new(),
        returns: returns.and_then(|returns| spread(&returns)),
        lengths: spread(&lengths),
        success_rate: (!known.is_empty()).then(|| n_successes as f64 / known.len() as f64),
        n_success_known: known.len() as u64,
        ends: kinds
            .into_iter()
            .map(|kind| (kind, count(kind)))
            .filter(|(_, n)| *n > 0)
            .collect(),
    }
}

#[expect(clippy::cast_precision_loss, reason = "counts are far below 2^53")]
fn spread(values: &[f64]) -> Option<Spread> {
    if values.is_empty() {
        return None;
    }
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let variance = values
        .iter()
        .map(|value| (value - mean).powi(2))
        .sum::<f64>()
        / n;
    Some(Spread {
        mean,
        std: variance.sqrt(),
        min: values.iter().copied().fold(f64::INFINITY, f64::min),
        max: values.iter().copied().fold(f64::NEG_INFINITY, f64::max),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_spread_of_one_value_has_no_width() {
        let one = spread(&[2.0]).unwrap();
        assert_eq!((one.mean, one.std, one.min, one.max), (2.0, 0.0, 2.0, 2.0));
        assert_eq!(spread(&[]), None);
    }
}
