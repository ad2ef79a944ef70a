//! What is written to the process.

use std::collections::HashMap;
use std::sync::Arc;

use arrow::array::{
    ArrayRef, FixedSizeListArray, Float64Array, RecordBatch, StringArray, UInt64Array,
};
use arrow::buffer::NullBuffer;
use arrow::datatypes::{DataType, Field, Schema, SchemaRef};
use arrow::error::ArrowError;
use serde::{Deserialize, Serialize};

use super::error::ProcessErrorKind;
use crate::planner::{PlanRequest, PlannerSpec};

/// Version of the protocol.
pub const VERSION: &str = "1";

/// Keys of the schemas' metadata.
pub(super) const PROTOCOL_KEY: &str = "ksim.planner.protocol";
pub(super) const SETTING_KEY: &str = "ksim.planner.setting";
pub(super) const SPEC_KEY: &str = "ksim.planner.spec";

/// Values of the column `message`.
pub(super) const RESET: &str = "reset";
pub(super) const PLAN: &str = "plan";

/// What a process is told of the task before it answers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Setting {
    /// Id of the environment; may be empty.
    #[serde(default)]
    pub environment: String,
    /// Numbers in an observation.
    pub observation_dim: usize,
    /// Numbers in an action.
    pub action_dim: usize,
    /// Lowest action.
    #[serde(default)]
    pub action_low: Vec<f64>,
    /// Highest action.
    #[serde(default)]
    pub action_high: Vec<f64>,
}

/// A specification as it is written in the handshake.
#[derive(Debug, Serialize, Deserialize)]
pub(super) struct WrittenSpec {
    family: String,
    observation_dim: usize,
    action_dim: usize,
    horizon: usize,
}

impl From<&PlannerSpec> for WrittenSpec {
    fn from(spec: &PlannerSpec) -> Self {
        Self {
            family: spec.family.clone(),
            observation_dim: spec.observation_dim,
            action_dim: spec.action_dim,
            horizon: spec.horizon,
        }
    }
}

/// Rows of `width` numbers.
fn rows_type(of: DataType, width: usize) -> DataType {
    let width = i32::try_from(width).unwrap_or(i32::MAX);
    DataType::FixedSizeList(Arc::new(Field::new("item", of, false)), width)
}

/// Schema of what is asked.
pub(super) fn request_schema(setting: &Setting) -> SchemaRef {
    let fields = vec![
        Field::new("message", DataType::Utf8, false),
        Field::new("slot", DataType::UInt64, false),
        Field::new("seed", DataType::UInt64, true),
        Field::new(
            "observation",
            rows_type(DataType::Float64, setting.observation_dim),
            true,
        ),
    ];
    let text = serde_json::to_string(setting).unwrap_or_default();
    let metadata = HashMap::from([
        (PROTOCOL_KEY.to_owned(), VERSION.to_owned()),
        (SETTING_KEY.to_owned(), text),
    ]);
    Arc::new(Schema::new_with_metadata(fields, metadata))
}

/// Schema of what is answered.
pub(super) fn answer_schema(spec: &PlannerSpec) -> SchemaRef {
    let actions = rows_type(DataType::Float32, spec.horizon * spec.action_dim);
    let fields = vec![
        Field::new("slot", DataType::UInt64, true),
        Field::new("actions", actions, true),
        Field::new("score", DataType::Float64, true),
        Field::new("novelty", DataType::Float64, true),
        Field::new("chosen", DataType::Boolean, true),
        Field::new("error", DataType::Utf8, true),
    ];
    let text = serde_json::to_string(&WrittenSpec::from(spec)).unwrap_or_default();
    let metadata = HashMap::from([
        (PROTOCOL_KEY.to_owned(), VERSION.to_owned()),
        (SPEC_KEY.to_owned(), text),
    ]);
    Arc::new(Schema::new_with_metadata(fields, metadata))
}

/// The specification in the schema of a process.
pub(super) fn spec_of(schema: &Schema) -> Result<PlannerSpec, ProcessErrorKind> {
    let written: WrittenSpec = read_handshake(schema, SPEC_KEY)?;
    let spec = PlannerSpec {
        family: written.family,
        observation_dim: written.observation_dim,
        action_dim: written.action_dim,
        horizon: written.horizon,
    };
    if spec.horizon == 0 {
        return Err(ProcessErrorKind::Handshake {
            key: SPEC_KEY,
            expected: "a horizon of at least 1".to_owned(),
            found: "horizon 0".to_owned(),
        });
    }
    Ok(spec)
}

/// The setting in the schema of the requests.
pub(super) fn setting_of(schema: &Schema) -> Result<Setting, ProcessErrorKind> {
    read_handshake(schema, SETTING_KEY)
}

/// Checks the version and reads the JSON of a key.
fn read_handshake<T: for<'a> Deserialize<'a>>(
    schema: &Schema,
    key: &'static str,
) -> Result<T, ProcessErrorKind> {
    let refuse = |key, expected: &str, found: Option<&String>| ProcessErrorKind::Handshake {
        key,
        expected: expected.to_owned(),
        found: found.map_or("nothing".to_owned(), |text| format!("{text:?}")),
    };
    let version = schema.metadata().get(PROTOCOL_KEY);
    if version.is_none_or(|version| version != VERSION) {
        return Err(refuse(PROTOCOL_KEY, "\"1\"", version));
    }
    let text = schema.metadata().get(key);
    let Some(given) = text else {
        return Err(refuse(key, "JSON", text));
    };
    serde_json::from_str(given).map_err(|error| refuse(key, &format!("JSON ({error})"), text))
}

/// An episode starts in a slot.
pub(super) fn reset(setting: &Setting, slot: usize, seed: u64) -> Result<RecordBatch, ArrowError> {
    let observation = vec![0.0; setting.observation_dim];
    message(setting, RESET, &[slot], Some(seed), &observation)
}

/// Slots want plans.
pub(super) fn plan(
    setting: &Setting,
    request: &PlanRequest<'_>,
) -> Result<RecordBatch, ArrowError> {
    message(setting, PLAN, request.slots, None, request.observations)
}

/// A row per slot; with a seed there is no observation, without one there is.
fn message(
    setting: &Setting,
    kind: &str,
    slots: &[usize],
    seed: Option<u64>,
    observations: &[f64],
) -> Result<RecordBatch, ArrowError> {
    let schema = request_schema(setting);
    let DataType::FixedSizeList(item, width) = schema.field(3).data_type() else {
        return Err(ArrowError::SchemaError("observation is no list".to_owned()));
    };
    let n = slots.len();
    let values: ArrayRef = Arc::new(Float64Array::from(observations.to_vec()));
    let nulls = seed.is_some().then(|| NullBuffer::new_null(n));
    let columns: Vec<ArrayRef> = vec![
        Arc::new(StringArray::from(vec![kind; n])),
        Arc::new(
            slots
                .iter()
                .map(|&slot| Some(slot as u64))
                .collect::<UInt64Array>(),
        ),
        Arc::new(UInt64Array::from(vec![seed; n])),
        Arc::new(FixedSizeListArray::try_new(
            Arc::clone(item),
            *width,
            values,
            nulls,
        )?),
    ];
    RecordBatch::try_new(schema, columns)
}
