//! Which feature each column becomes.

use std::collections::HashSet;
use std::sync::Arc;

use arrow::datatypes::{DataType, Field, Fields, Schema};
use serde_json::{Map, Value, json};

use super::super::columns::{self, INFO_TASK, dtype};
use crate::schema;
use crate::sink::{Loss, LossEffect};

/// Name that policies of LeRobot expect of a flat observation.
const STATE: &str = "observation.state";
/// Dimensions of a feature, at most: `datasets` has arrays up to five.
const MAX_RANK: usize = 5;

/// How a column becomes a feature.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Form {
    /// One value a row, out of a plain column or a list of one.
    Scalar,
    /// A `FixedSizeList`.
    Vector,
    /// Nested lists.
    Tensor,
    /// `struct<bytes, path>`.
    Picture,
}

/// A feature and the column it comes from.
#[derive(Debug, Clone)]
pub(super) struct Feature {
    pub(super) name: String,
    /// Place of the column in the schema.
    pub(super) source: usize,
    pub(super) form: Form,
    /// Type of a value in the file.
    pub(super) value_type: DataType,
    pub(super) dtype: &'static str,
    /// As `info.json` has it; `[1]` for a scalar.
    pub(super) shape: Vec<usize>,
    names: Value,
    info: Map<String, Value>,
}

impl Feature {
    /// One number a row that no column holds.
    pub(super) fn index(name: &str, dtype: &'static str) -> Self {
        let value_type = match dtype {
            "float32" => DataType::Float32,
            _ => DataType::Int64,
        };
        Self {
            name: name.to_owned(),
            source: usize::MAX,
            form: Form::Scalar,
            value_type,
            dtype,
            shape: vec![1],
            names: Value::Null,
            info: Map::new(),
        }
    }

    pub(super) fn width(&self) -> usize {
        self.shape.iter().product()
    }

    /// Numbers and flags have statistics.
    pub(super) fn is_numeric(&self) -> bool {
        self.form != Form::Picture && self.value_type != DataType::Utf8
    }

    /// The field in the data files.
    pub(super) fn field(&self) -> Field {
        let data_type = match self.form {
            Form::Scalar => self.value_type.clone(),
            Form::Vector => DataType::FixedSizeList(
                schema::element(self.value_type.clone()),
                i32::try_from(self.width()).unwrap_or(i32::MAX),
            ),
            Form::Tensor => nested_type(&self.value_type, self.shape.len()),
            Form::Picture => DataType::Struct(picture_fields()),
        };
        Field::new(&self.name, data_type, true)
    }

    /// Its entry in `info.json`.
    pub(super) fn json(&self) -> Value {
        let mut entry = json!({"dtype": self.dtype, "shape": self.shape, "names": self.names});
        if let (Value::Object(entry), false) = (&mut entry, self.info.is_empty()) {
            entry.insert("info".to_owned(), Value::Object(self.info.clone()));
        }
        entry
    }

    /// Its type as the library `datasets` notes it in the schema.
    pub(super) fn hugging_face(&self) -> Value {
        let value = json!({"dtype": self.dtype, "_type": "Value"});
        match self.form {
            Form::Scalar => value,
            Form::Vector => json!({"feature": value, "length": self.width(), "_type": "List"}),
            Form::Tensor => {
                let class = format!("Array{}D", self.shape.len());
                json!({"shape": self.shape, "dtype": self.dtype, "_type": class})
            }
            Form::Picture => json!({"_type": "Image"}),
        }
    }
}

/// The fields of an encoded picture.
pub(super) fn picture_fields() -> Fields {
    Fields::from(vec![
        Field::new("bytes", DataType::Binary, true),
        Field::new("path", DataType::Utf8, true),
    ])
}

/// Lists of lists, `depth` deep.
pub(super) fn nested_type(value_type: &DataType, depth: usize) -> DataType {
    (0..depth).fold(value_type.clone(), |inner, _| {
        DataType::List(schema::element(inner))
    })
}

/// The features of all columns that have a place, and what is lost of the others.
pub(super) fn features(schema: &Schema, keep_time: bool, losses: &mut Vec<Loss>) -> Vec<Feature> {
    let mut taken: HashSet<String> = columns::DEFAULT_FEATURES.map(str::to_owned).into();
    let mut features = Vec::new();
    for (source, field) in schema.fields().iter().enumerate() {
        let is_index = [schema::EPISODE_INDEX, schema::STEP_INDEX].contains(&field.name().as_str());
        let is_time = field.name() == schema::T_NS && !keep_time;
        let is_task = field.name() == INFO_TASK && *field.data_type() == DataType::Utf8;
        if is_index || is_time || is_task {
            continue;
        }
        match feature(field, source) {
            Ok(mut feature) => {
                feature.name = name(&feature, field.name(), schema, &taken, losses);
                taken.insert(feature.name.clone());
                if feature.form == Form::Scalar
                    && matches!(field.data_type(), DataType::FixedSizeList(_, _))
                {
                    let detail = "a list of one value becomes the value: LeRobot has no other form";
                    losses.push(loss(field.name(), LossEffect::Changed, detail));
                }
                features.push(feature);
            }
            Err(detail) => losses.push(loss(field.name(), LossEffect::Dropped, detail)),
        }
    }
    features
}

/// What became of one column.
pub(super) fn loss(item: &str, effect: LossEffect, detail: impl Into<String>) -> Loss {
    Loss {
        item: item.to_owned(),
        effect,
        detail: detail.into(),
        count: None,
    }
}

fn name(
    feature: &Feature,
    column: &str,
    schema: &Schema,
    taken: &HashSet<String>,
    losses: &mut Vec<Loss>,
) -> String {
    let is_scalar = feature.form == Form::Scalar && feature.is_numeric();
    let exact = match column {
        schema::T_NS => Some(schema::T_NS.to_owned()),
        schema::OBSERVATION if schema.index_of(STATE).is_err() => Some(STATE.to_owned()),
        _ => columns::feature_name(column, is_scalar),
    };
    let mut name = exact.unwrap_or_else(|| column.to_owned()).replace('/', "_");
    while taken.contains(&name) {
        name.push('_');
    }
    let read_back = match column {
        schema::T_NS => column.to_owned(),
        _ => columns::column_name(&name, is_scalar),
    };
    if read_back != column {
        let detail = format!("its feature is `{name}`, which is read back as `{read_back}`");
        losses.push(loss(column, LossEffect::Changed, detail));
    }
    name
}

fn feature(field: &Field, source: usize) -> Result<Feature, &'static str> {
    let no_feature = "LeRobot has no feature of its type";
    let (value_type, shape) = schema::row_shape(field).ok_or(no_feature)?;
    let was_flags = field
        .metadata()
        .get(schema::SOURCE_DTYPE)
        .is_some_and(|dtype| dtype == "bool");
    let value_type = match was_flags && value_type.is_integer() {
        true => DataType::Boolean,
        false => value_type,
    };
    let width = shape.iter().product::<usize>();
    let (form, dtype, shape) = match (&value_type, shape.as_slice()) {
        (DataType::Binary, [_, _, 3]) => (Form::Picture, "image", shape),
        (DataType::Binary, _) => {
            return Err("LeRobot has pictures with red, green and blue only");
        }
        (_, _) if width == 0 => return Err("its rows hold no values"),
        (_, [] | [1]) => (Form::Scalar, dtype(&value_type).ok_or(no_feature)?, vec![1]),
        (_, [_]) => (Form::Vector, dtype(&value_type).ok_or(no_feature)?, shape),
        (_, shape) if shape.len() > MAX_RANK => {
            return Err("LeRobot has arrays of up to five dimensions");
        }
        _ => (Form::Tensor, dtype(&value_type).ok_or(no_feature)?, shape),
    };
    let text = |key: &str| field.metadata().get(key);
    let names = text(schema::NAMES).and_then(|names| serde_json::from_str(names).ok());
    let names = match (form, names) {
        (Form::Picture, _) => json!(["height", "width", "channels"]),
        (Form::Scalar | Form::Vector, Some(Value::Array(names))) if names.len() == width => {
            Value::Array(names)
        }
        _ => Value::Null,
    };
    let described = [schema::UNIT, schema::KIND];
    let info = described.into_iter().filter_map(|key| {
        let value = Value::String(text(key)?.clone());
        Some((key.to_owned(), value))
    });
    Ok(Feature {
        name: String::new(),
        source,
        form,
        value_type,
        dtype,
        shape,
        names,
        info: info.collect(),
    })
}

/// The schema of data files, and what `datasets` notes in it.
pub(super) fn file_schema(features: &[Feature]) -> Arc<Schema> {
    let fields: Vec<Field> = features.iter().map(Feature::field).collect();
    let noted: Map<String, Value> = features
        .iter()
        .map(|feature| (feature.name.clone(), feature.hugging_face()))
        .collect();
    let noted = json!({"info": {"features": noted}});
    let noted = [("huggingface".to_owned(), noted.to_string())];
    Arc::new(Schema::new_with_metadata(fields, noted.into()))
}
