//! Steps per second, which LeRobot has as an integer.

use arrow::array::{Array, AsArray, RecordBatch};
use arrow::datatypes::{DataType, Int64Type, Schema};
use serde_json::Value;

use super::plan::loss;
use crate::episode::column;
use crate::error::{DatasetError, Result};
use crate::format::Format;
use crate::schema;
use crate::sink::{Loss, LossEffect};

/// The rate where nothing says it.
const UNKNOWN_FPS: f64 = 10.0;

/// The rate, as far as it is known.
pub(super) struct Rate {
    fps: Option<f64>,
    has_time: bool,
}

impl Rate {
    /// By the option, else by the source's record; with times in the rows it may come later.
    ///
    /// # Errors
    /// An option that is no positive number.
    pub(super) fn new(
        schema: &Schema,
        option: Option<f64>,
        losses: &mut Vec<Loss>,
    ) -> Result<Self> {
        let is_rate = |fps: &f64| fps.is_finite() && *fps > 0.0;
        if let Some(fps) = option.filter(|fps| !is_rate(fps)) {
            return Err(DatasetError::Metadata {
                field: schema::FPS.to_owned(),
                actual: fps.to_string(),
                expected: "a positive number",
            });
        }
        let recorded = schema.metadata().get(schema::FPS);
        let recorded = recorded.and_then(|fps| fps.parse().ok()).filter(is_rate);
        let mut rate = Self {
            fps: None,
            has_time: schema.index_of(schema::T_NS).is_ok(),
        };
        if let (Some(recorded), Some(option)) = (recorded, option)
            && recorded != option
        {
            let detail = format!("the source records {recorded}, {option} was asked for");
            losses.push(loss(schema::FPS, LossEffect::Changed, detail));
        }
        if let Some(fps) = option.or(recorded) {
            rate.set(fps, losses);
        }
        Ok(rate)
    }

    fn set(&mut self, fps: f64, losses: &mut Vec<Loss>) {
        let whole = fps.round().clamp(1.0, 1e9);
        if whole != fps {
            let time = match self.has_time {
                true => "the feature `t_ns` keeps the recorded times",
                false => "timestamps are step / fps",
            };
            let detail = format!("LeRobot has whole rates: {fps} is written as {whole}; {time}");
            losses.push(loss(schema::FPS, LossEffect::Changed, detail));
        }
        self.fps = Some(whole);
    }

    /// Whether times in the rows are known to be step / fps, or as near as a LeRobot dataset has them.
    pub(super) fn is_grid(&self, schema: &Schema) -> bool {
        let recorded = schema.metadata().get(schema::SOURCE_METADATA);
        let info = recorded.and_then(|text| serde_json::from_str::<Value>(text).ok());
        let exact = info.is_some_and(|info| info["features"].get(schema::T_NS).is_some());
        let fps = schema.metadata().get(schema::FPS);
        let whole = fps.is_some_and(|fps| fps.parse::<f64>().ok() == self.fps);
        is_lerobot(schema) && !exact && whole
    }

    pub(super) fn is_known(&self) -> bool {
        self.fps.is_some()
    }

    /// Tries to learn the rate from rows: the median of the times between steps.
    ///
    /// # Errors
    /// The batch lacks its index columns.
    pub(super) fn estimate(&mut self, batch: &RecordBatch, losses: &mut Vec<Loss>) -> Result<bool> {
        let Some(times) = batch.column_by_name(schema::T_NS) else {
            return Ok(false);
        };
        let times = arrow::compute::cast(times, &DataType::Int64)
            .map_err(DatasetError::arrow("read times"))?;
        let times = times.as_primitive::<Int64Type>();
        let episodes = column(batch, schema::EPISODE_INDEX)?.as_primitive::<Int64Type>();
        let mut between: Vec<i64> = (1..times.len())
            .filter(|&row| episodes.value(row) == episodes.value(row - 1))
            .filter(|&row| !times.is_null(row) && !times.is_null(row - 1))
            .map(|row| times.value(row).saturating_sub(times.value(row - 1)))
            .filter(|ns| *ns > 0)
            .collect();
        between.sort_unstable();
        let Some(&median) = between.get(between.len() / 2) else {
            return Ok(false);
        };
        let fps = 1e9 / median as f64;
        // Times in whole nanoseconds, and clocks, are never quite on it.
        let fps = match (fps - fps.round()).abs() < 1e-3 * fps {
            true => fps.round(),
            false => fps,
        };
        self.set(fps, losses);
        Ok(true)
    }

    /// Makes a rate up if there is none yet.
    pub(super) fn settle(&mut self, losses: &mut Vec<Loss>) {
        if self.fps.is_none() {
            self.fps = Some(UNKNOWN_FPS);
            let detail = format!("no rate and no times are recorded: it is {UNKNOWN_FPS}");
            losses.push(loss(schema::FPS, LossEffect::Invented, detail));
        }
    }

    /// The rate that is written, a whole number.
    pub(super) fn fps(&self) -> f64 {
        self.fps.unwrap_or(UNKNOWN_FPS)
    }
}

/// Whether the source is a LeRobot dataset itself.
pub(super) fn is_lerobot(schema: &Schema) -> bool {
    let format = schema.metadata().get(schema::SOURCE_FORMAT);
    format.is_some_and(|format| format == Format::LeRobot.name())
}
