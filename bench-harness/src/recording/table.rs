//! The columns of a rollout, and what its file says of itself.

use std::collections::HashMap;
use std::sync::Arc;

use arrow::datatypes::{DataType, Field, FieldRef, Schema, SchemaRef};
use ksim_datasets::{Format, LeafKind, LeafSpec, schema};
use ksim_envs::{EnvironmentSpec, Part, registry};
use serde_json::{Map, Value};

use super::{About, ActionPrecision, SOURCE_FORMAT};
use crate::policy::Annotation;

/// The columns of a rollout: those that Minari's reader gives for the same environment, in the same order.
pub(super) fn schema(
    environment: &EnvironmentSpec,
    annotations: &[Annotation],
    precision: ActionPrecision,
) -> SchemaRef {
    let number = |name: &str, width: usize, value_type: DataType, nullable: bool| {
        Arc::new(schema::leaf_field(name, value_type, &[width], nullable))
    };
    let flag = |name: &str| Arc::new(Field::new(name, DataType::Boolean, true));
    let action_type = match precision {
        ActionPrecision::Double => DataType::Float64,
        ActionPrecision::Single => DataType::Float32,
    };
    let parts = |parts: &[Part], root: &str| -> Vec<FieldRef> {
        let mut fields: Vec<FieldRef> = parts
            .iter()
            .map(|part| {
                number(
                    &column_name(root, part),
                    part.width,
                    DataType::Float64,
                    false,
                )
            })
            .collect();
        fields.sort_by(|a, b| a.name().cmp(b.name()));
        fields
    };
    let mut fields: Vec<FieldRef> = vec![
        Arc::new(Field::new(schema::EPISODE_INDEX, DataType::Int64, false)),
        Arc::new(Field::new(schema::STEP_INDEX, DataType::Int64, false)),
    ];
    fields.extend(parts(&environment.observation, schema::OBSERVATION));
    fields.extend([
        number(schema::ACTION, environment.action_dim(), action_type, true),
        Arc::new(Field::new(schema::REWARD, DataType::Float64, true)),
        flag(schema::TERMINATED),
        flag(schema::TRUNCATED),
    ]);
    fields.extend(parts(&environment.info, schema::INFO));
    if environment.reports_success {
        fields.push(flag(schema::INFO_SUCCESS));
    }
    fields.extend(annotations.iter().map(|annotation| {
        let name = schema::join_key(schema::INFO, annotation.name);
        Arc::new(Field::new(name, DataType::Float64, true))
    }));
    Arc::new(Schema::new(fields))
}

/// `observation.achieved_goal`; a nameless part is the whole.
pub(super) fn column_name(root: &str, part: &Part) -> String {
    match part.name {
        "" => root.to_owned(),
        name => schema::join_key(root, name),
    }
}

/// The schema with what the file says of itself.
pub(super) fn described(
    columns: &SchemaRef,
    environment: &EnvironmentSpec,
    about: &About,
    format: Format,
) -> SchemaRef {
    let is_minari = matches!(
        format,
        Format::MinariHdf5 | Format::MinariArrow | Format::MinariParquet
    );
    let (source_format, source_metadata) = match is_minari {
        true => (format.name(), about.minari.clone()),
        false => (SOURCE_FORMAT, with_reference(about)),
    };
    let mut metadata = HashMap::from([
        (schema::VERSION_KEY, schema::VERSION.to_owned()),
        (schema::SOURCE_FORMAT, source_format.to_owned()),
        (schema::SOURCE_ID, environment.id.clone()),
        (
            schema::SOURCE_METADATA,
            Value::Object(source_metadata).to_string(),
        ),
        (
            schema::SPACE_OBSERVATION,
            registry::observation_space(environment).to_string(),
        ),
        (
            schema::SPACE_ACTION,
            action_space(environment, columns).to_string(),
        ),
        (schema::FPS, (1.0 / environment.dt_s).to_string()),
    ]);
    if let Some(spec) = &about.env_spec {
        metadata.insert(schema::ENV_SPEC, spec.to_string());
    }
    let metadata = metadata
        .into_iter()
        .map(|(key, value)| (key.to_owned(), value))
        .collect();
    Arc::new(Schema::new_with_metadata(
        columns.fields().clone(),
        metadata,
    ))
}

/// How the rollout was made, with the names by which readers look for reference scores.
fn with_reference(about: &About) -> Map<String, Value> {
    let mut metadata = about.rollout.clone();
    if let Some((low, high)) = about.reference {
        metadata.insert("ref_min_score".to_owned(), low.into());
        metadata.insert("ref_max_score".to_owned(), high.into());
    }
    metadata
}

/// The action space as Gymnasium declares it; in the type of the column, or the values would not be in it.
fn action_space(environment: &EnvironmentSpec, columns: &Schema) -> Value {
    let mut space = registry::action_space(environment);
    let column = columns
        .field_with_name(schema::ACTION)
        .ok()
        .and_then(schema::row_shape);
    if column.is_some_and(|(value_type, _)| value_type == DataType::Float64) {
        space["dtype"] = "float64".into();
    }
    space
}

pub(super) fn leaves(schema: &Schema, root: &str) -> Vec<LeafSpec> {
    let fields = schema
        .fields()
        .iter()
        .filter(|field| schema::belongs_to(field.name(), root));
    let leaves = fields.filter_map(|field| {
        let (data_type, shape) = schema::row_shape(field)?;
        Some(LeafSpec {
            column: field.name().clone(),
            kind: LeafKind::Box,
            shape,
            data_type,
        })
    });
    leaves.collect()
}
