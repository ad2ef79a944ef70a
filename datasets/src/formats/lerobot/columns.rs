//! Features of LeRobot and columns of the canonical layout.
//!
//! | feature | column |
//! |---|---|
//! | `observation`, `observation.*`, `action`, `action.*`, `next_observation*`, `info.*` | the same |
//! | `next.reward`, one number | `reward` |
//! | `next.terminated`, `next.truncated`, one flag | `terminated`, `truncated` |
//! | `next.success`, one value | `info.success` |
//! | `timestamp` (and `t_ns`, which only this crate writes) | `t_ns` |
//! | `task_index` | `info.task`, the text |
//! | `episode_index`, `frame_index` | `episode_index`, `step_index` |
//! | `index` | none: checked |
//! | any other `x`, also `next.done` | `info.x` |
//!
//! `next.done` stays an info: recordings raise it on the last step of every episode, however it ended.

use std::sync::Arc;

use arrow::datatypes::{DataType, Field, FieldRef, Schema};

use super::info::Feature;
use super::picture;
use crate::error::{DatasetError, Result};
use crate::schema;
use crate::source::Warning;
use crate::spec::arrow_type;

/// Feature: seconds since the start of the episode.
pub(super) const TIMESTAMP: &str = "timestamp";
/// Feature: step inside the episode.
pub(super) const FRAME_INDEX: &str = "frame_index";
/// Feature: row in the whole dataset.
pub(super) const INDEX: &str = "index";
/// Feature: number of the task.
pub(super) const TASK_INDEX: &str = "task_index";
/// Column: text of the task.
pub(super) const INFO_TASK: &str = "info.task";
/// Features that every dataset has.
pub(super) const DEFAULT_FEATURES: [&str; 5] = [
    TIMESTAMP,
    FRAME_INDEX,
    schema::EPISODE_INDEX,
    INDEX,
    TASK_INDEX,
];
/// Features with another name than their column, if they hold one value.
const RENAMED: [(&str, &str); 4] = [
    ("next.reward", schema::REWARD),
    ("next.terminated", schema::TERMINATED),
    ("next.truncated", schema::TRUNCATED),
    ("next.success", schema::INFO_SUCCESS),
];

/// How a feature becomes a column.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Conversion {
    /// Values in the source's type.
    Values,
    /// Flags in any type to booleans.
    Flag,
    /// Encoded pictures out of `struct<bytes, path>`.
    Picture,
    /// Seconds to nanoseconds.
    Time,
    /// The number of a task to its text.
    Task,
}

/// A canonical column and the feature it comes from.
#[derive(Debug, Clone)]
pub(super) struct Column {
    pub(super) feature: String,
    pub(super) field: FieldRef,
    /// Shape of a row as it is stored; empty for a scalar.
    pub(super) shape: Vec<usize>,
    /// Type of a value as it is stored.
    pub(super) stored: DataType,
    pub(super) conversion: Conversion,
}

/// The columns of a dataset, in the order of the canonical layout.
#[derive(Debug, Default)]
pub(super) struct Columns {
    pub(super) columns: Vec<Column>,
    pub(super) warnings: Vec<Warning>,
}

/// The column of a feature, whose rows hold one value or not.
pub(super) fn column_name(feature: &str, is_scalar: bool) -> String {
    let renamed = RENAMED.iter().find(|(name, _)| *name == feature);
    if let Some((_, column)) = renamed.filter(|_| is_scalar) {
        return (*column).to_owned();
    }
    let roots = [
        schema::OBSERVATION,
        schema::ACTION,
        schema::NEXT_OBSERVATION,
    ];
    let is_info = schema::belongs_to(feature, schema::INFO) && feature != schema::INFO;
    match roots.iter().any(|root| schema::belongs_to(feature, root)) || is_info {
        true => feature.to_owned(),
        // Dots are levels here as they are there.
        false => format!("{}.{feature}", schema::INFO),
    }
}

/// The feature that is read back as this column, if there is one: the reverse of [`column_name`].
pub(super) fn feature_name(column: &str, is_scalar: bool) -> Option<String> {
    let renamed = RENAMED.iter().find(|(_, name)| *name == column);
    let short = column.strip_prefix("info.").filter(|short| {
        !DEFAULT_FEATURES.contains(short) && *short != schema::T_NS && !short.is_empty()
    });
    let candidates = [renamed.map(|(name, _)| *name), short, Some(column)];
    let mut candidates = candidates.into_iter().flatten();
    candidates
        .find(|name| column_name(name, is_scalar) == column)
        .map(str::to_owned)
}

impl Columns {
    /// Plans the columns of the features; types are those of `file`, the first data file, or as declared if
    /// there is none.
    ///
    /// # Errors
    /// A feature that the file does not have.
    pub(super) fn new(
        features: &[Feature],
        file: Option<&Schema>,
        first_picture: impl Fn(&str) -> Option<Vec<u8>>,
    ) -> Result<Self> {
        let mut columns = Self::default();
        for feature in features {
            let declared = declared_type(&feature.dtype);
            let stored = match (feature.dtype.as_str(), file) {
                ("video", _) | (_, None) => declared.clone(),
                (_, Some(file)) => {
                    let field = file.field_with_name(&feature.name);
                    let field = field.map_err(|_| DatasetError::MissingColumn {
                        role: "feature",
                        name: format!("\"{}\"", feature.name),
                        found: schema::column_names(file),
                    })?;
                    Some(value_type(field.data_type()))
                }
            };
            columns.add(feature, declared, stored, &first_picture);
        }
        if let Some(file) = file {
            for field in file.fields() {
                if !features.iter().any(|feature| feature.name == *field.name()) {
                    columns.leave_out(field.name(), "meta/info.json does not declare it");
                }
            }
        }
        // Stable, so that features keep their order inside each part.
        columns
            .columns
            .sort_by_key(|column| rank(column.field.name()));
        Ok(columns)
    }

    fn add(
        &mut self,
        feature: &Feature,
        declared: Option<DataType>,
        stored: Option<DataType>,
        first_picture: &impl Fn(&str) -> Option<Vec<u8>>,
    ) {
        let name = feature.name.as_str();
        let planned = match (name, feature.dtype.as_str(), stored) {
            (schema::EPISODE_INDEX | FRAME_INDEX | INDEX, _, _) => return,
            (_, "video", _) => Err("its frames are in video files, which are not read"),
            (_, "image", stored) => picture_column(feature, stored, first_picture(name)),
            (_, _, Some(stored)) => {
                let text = stored == DataType::Utf8;
                if declared
                    .as_ref()
                    .is_some_and(|declared| *declared != stored)
                {
                    self.warnings.push(Warning::DtypeMismatch {
                        column: name.to_owned(),
                        declared: feature.dtype.clone(),
                        actual: stored.to_string(),
                    });
                }
                match text || schema::is_number(&stored) || stored == DataType::Boolean {
                    true => value_column(feature, &stored),
                    false => Err("its type is neither numbers, flags, text nor an encoded picture"),
                }
            }
            _ => Err("its dtype is not known"),
        };
        let taken = |column: &Column| {
            let mut names = self.columns.iter().map(|other| other.field.name());
            names.any(|other| other == column.field.name())
        };
        if let Ok(column) = &planned
            && column.conversion == Conversion::Picture
            && !has_declared_shape(&column.field, &feature.shape)
        {
            self.warnings.push(Warning::SpaceMismatch {
                column: name.to_owned(),
            });
        }
        match planned {
            // The exact time wins over the rounded one, wherever it stands.
            Ok(column) if name == schema::T_NS => {
                self.columns.retain(|other| other.feature != TIMESTAMP);
                self.columns.push(column);
            }
            Ok(column) if name == TIMESTAMP && taken(&column) => {}
            Ok(column) if taken(&column) => {
                self.leave_out(name, "another feature has the name it gets");
            }
            Ok(column) => self.columns.push(column),
            Err(reason) => self.leave_out(name, reason),
        }
    }

    fn leave_out(&mut self, feature: &str, reason: &'static str) {
        self.warnings.push(Warning::ColumnLeftOut {
            column: feature.to_owned(),
            reason,
        });
    }
}

/// Observation, action, reward, flags, everything else: the order in which Parquet files are read.
fn rank(column: &str) -> usize {
    let is = |root: &&str| schema::belongs_to(column, root);
    let order = [
        schema::OBSERVATION,
        schema::ACTION,
        schema::REWARD,
        schema::TERMINATED,
        schema::TRUNCATED,
    ];
    order.iter().position(is).unwrap_or(order.len())
}

fn value_column(feature: &Feature, stored: &DataType) -> Result<Column, &'static str> {
    let name = feature.name.as_str();
    let shape: &[usize] = match feature.shape.as_slice() {
        [1] => &[],
        shape => shape,
    };
    let is_scalar = shape.is_empty();
    if feature.shape.contains(&0) {
        return Err("its rows hold no values");
    }
    if *stored == DataType::Utf8 && !is_scalar {
        return Err("its rows hold several texts");
    }
    let target = column_name(name, is_scalar && *stored != DataType::Utf8);
    let flags = [schema::TERMINATED, schema::TRUNCATED];
    let (field, conversion) = match name {
        TIMESTAMP if is_scalar => (time_field(), Conversion::Time),
        schema::T_NS if is_scalar && *stored == DataType::Int64 => {
            (time_field(), Conversion::Values)
        }
        TASK_INDEX if is_scalar && stored.is_integer() => {
            let field = Field::new(INFO_TASK, DataType::Utf8, true);
            (field, Conversion::Task)
        }
        TIMESTAMP | TASK_INDEX => return Err("it is not one number a row"),
        _ if flags.contains(&target.as_str()) => {
            let field = Field::new(target, DataType::Boolean, true);
            (field, Conversion::Flag)
        }
        _ => {
            let nullable = !schema::belongs_to(&target, schema::OBSERVATION);
            let as_flags = *stored == DataType::Boolean && !is_scalar;
            let value_type = if as_flags { &DataType::UInt8 } else { stored };
            let field = schema::leaf_field(&target, value_type.clone(), shape, nullable);
            (described(field, feature, as_flags), Conversion::Values)
        }
    };
    Ok(Column {
        feature: name.to_owned(),
        field: Arc::new(field),
        shape: shape.to_vec(),
        stored: stored.clone(),
        conversion,
    })
}

fn time_field() -> Field {
    Field::new(schema::T_NS, DataType::Int64, true)
}

/// Adds names of values, unit and kind where the feature has them.
fn described(field: Field, feature: &Feature, was_flags: bool) -> Field {
    let mut metadata = field.metadata().clone();
    let width = feature.shape.iter().product::<usize>();
    let is_vector = feature.shape.len() <= 1;
    if let Some(names) = feature
        .names
        .as_ref()
        .filter(|names| is_vector && names.len() == width)
    {
        metadata.insert(
            schema::NAMES.to_owned(),
            serde_json::json!(names).to_string(),
        );
    }
    for key in [schema::UNIT, schema::KIND] {
        if let Some(serde_json::Value::String(text)) = feature.info.get(key) {
            metadata.insert(key.to_owned(), text.clone());
        }
    }
    if was_flags {
        metadata.insert(schema::SOURCE_DTYPE.to_owned(), "bool".to_owned());
    }
    field.with_metadata(metadata)
}

fn picture_column(
    feature: &Feature,
    stored: Option<DataType>,
    first: Option<Vec<u8>>,
) -> Result<Column, &'static str> {
    let is_picture = |stored: &DataType| matches!(stored, DataType::Binary | DataType::Struct(_));
    if stored.as_ref().is_some_and(|stored| !is_picture(stored)) {
        return Err("it is declared as pictures but holds none");
    }
    let head = match (&stored, &first) {
        (None, _) => None,
        (Some(_), None) => {
            return Err("its pictures are only paths of other files, which are not followed");
        }
        (Some(_), Some(bytes)) => {
            Some(picture::head(bytes).ok_or("its pictures are neither JPEG nor PNG")?)
        }
    };
    let codec = head.as_ref().map_or(picture::PNG, |head| head.codec);
    let shape = match head {
        Some(head) => head.shape(),
        None => feature.shape.clone(),
    };
    let name = column_name(&feature.name, false);
    let field = schema::image_field(&name, codec, &shape);
    Ok(Column {
        feature: feature.name.clone(),
        field: Arc::new(field),
        shape: Vec::new(),
        stored: stored.unwrap_or(DataType::Binary),
        conversion: Conversion::Picture,
    })
}

/// Whether a picture's shape is the declared one, with the channels last or first.
fn has_declared_shape(field: &Field, declared: &[usize]) -> bool {
    let Some((_, mut shape)) = schema::row_shape(field) else {
        return false;
    };
    if shape.len() == 2 {
        shape.push(1);
    }
    let mut channels_last = declared.to_vec();
    if declared.len() == 2 {
        channels_last.push(1);
    }
    let mut rotated = declared.to_vec();
    let by = rotated.len().min(1);
    rotated.rotate_left(by);
    shape == channels_last || shape == rotated
}

/// The type of the values in nested lists.
pub(super) fn value_type(data_type: &DataType) -> DataType {
    match data_type {
        DataType::List(child) | DataType::LargeList(child) | DataType::FixedSizeList(child, _) => {
            value_type(child.data_type())
        }
        DataType::LargeUtf8 | DataType::Utf8View => DataType::Utf8,
        DataType::LargeBinary | DataType::BinaryView => DataType::Binary,
        other => other.clone(),
    }
}

/// The type that a dtype names.
fn declared_type(dtype: &str) -> Option<DataType> {
    match dtype {
        "bool" => Some(DataType::Boolean),
        "string" => Some(DataType::Utf8),
        number => arrow_type(number),
    }
}

/// The dtype of a type.
pub(super) fn dtype(data_type: &DataType) -> Option<&'static str> {
    let all = [
        "bool", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64",
        "float16", "float32", "float64", "string",
    ];
    let is = |dtype: &&str| declared_type(dtype).as_ref() == Some(data_type);
    all.into_iter().find(is)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn names_are_mapped_and_mapped_back() {
        for (feature, column) in [
            ("observation.images.front", "observation.images.front"),
            ("observation", "observation"),
            ("observations", "info.observations"),
            ("action", "action"),
            ("action_is_pad", "info.action_is_pad"),
            ("next.reward", "reward"),
            ("next.success", "info.success"),
            ("next.done", "info.next.done"),
            ("subtask", "info.subtask"),
        ] {
            assert_eq!(column_name(feature, true), column);
            assert_eq!(feature_name(column, true).as_deref(), Some(feature));
        }
        assert_eq!(column_name("next.reward", false), "info.next.reward");
        // Two features can have one column; the short name is written.
        assert_eq!(column_name("info.x", true), column_name("x", true));
        assert_eq!(feature_name("info.x", true).as_deref(), Some("x"));
        // What a short name would be mistaken for keeps its prefix.
        for column in [
            "info.index",
            "info.observation.x",
            "info.next.reward",
            "info.t_ns",
        ] {
            assert_eq!(feature_name(column, true).as_deref(), Some(column));
        }
    }

    proptest! {
        #[test]
        fn a_column_with_a_feature_comes_back(
            column in "(info|observation|action|next_observation)(\\.(next|reward|info|index|[a-z~0-9]{1,3})){0,3}",
            is_scalar: bool,
        ) {
            prop_assume!(column != "info");
            let feature = feature_name(&column, is_scalar).unwrap();
            prop_assert_eq!(column_name(&feature, is_scalar), column);
        }
    }
}
