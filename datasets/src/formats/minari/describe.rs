//! What is the same for every storage: the dataset's description, by its `metadata.json`.

use std::collections::{BTreeSet, HashMap};
use std::path::Path;
use std::sync::Arc;

use arrow::datatypes::{DataType, Field, FieldRef, Schema, SchemaRef};
use serde_json::Value;

use super::metadata::Metadata;
use crate::format::Format;
use crate::schema;
use crate::source::{DatasetInfo, Warning};

/// What the metadata say about a dataset; counts, leaves and warnings are left to the reader.
pub(super) fn dataset_info(format: Format, path: &Path, metadata: Metadata) -> DatasetInfo {
    let mut info = DatasetInfo::new(id(&metadata, path), format, path.to_owned());
    info.episode_rule = "as recorded".to_owned();
    info.ref_min_score = metadata.number("ref_min_score");
    info.ref_max_score = metadata.number("ref_max_score");
    info.env_spec = metadata.env_spec;
    info.metadata = metadata.fields;
    info
}

fn id(metadata: &Metadata, path: &Path) -> String {
    if metadata.id.is_empty() {
        return path
            .file_name()
            .map(|name| name.to_string_lossy().into_owned())
            .unwrap_or_default();
    }
    metadata.id.clone()
}

/// What is odd about a dataset's episodes, gathered from one after the other.
#[derive(Debug, Default)]
pub(super) struct Oddities {
    /// Episodes without a step.
    pub(super) n_empty: u64,
    /// Episodes without an observation after their last step.
    pub(super) n_without_final: u64,
    /// Info leaves of the first episode.
    first_infos: Option<BTreeSet<String>>,
    late_infos: BTreeSet<String>,
}

impl Oddities {
    /// Notes the info leaves of the next episode.
    pub(super) fn note_infos(&mut self, infos: BTreeSet<String>) {
        match &self.first_infos {
            None => self.first_infos = Some(infos),
            Some(first) => {
                let late = infos.into_iter().filter(|path| !first.contains(path));
                self.late_infos.extend(late);
            }
        }
    }

    /// Adds what was gathered to the warnings.
    pub(super) fn warn(self, warnings: &mut Vec<Warning>) {
        if self.n_empty > 0 {
            warnings.push(Warning::EmptyEpisodes {
                n_episodes: self.n_empty,
            });
        }
        if self.n_without_final > 0 {
            warnings.push(Warning::NoFinalObservation {
                n_episodes: self.n_without_final,
            });
        }
        let late = self.late_infos.into_iter();
        warnings.extend(late.map(|column| Warning::ColumnLeftOut {
            column,
            reason: "the first episode does not have it",
        }));
    }
}

/// Warns where the data's counts are not those of the metadata.
pub(super) fn count_warnings(
    metadata: &Metadata,
    n_episodes: u64,
    n_steps: u64,
    warnings: &mut Vec<Warning>,
) {
    let counts = [
        ("episodes", metadata.total_episodes, n_episodes),
        ("steps", metadata.total_steps, n_steps),
    ];
    for (what, recorded, actual) in counts {
        if let Some(recorded) = recorded.filter(|recorded| *recorded != actual) {
            warnings.push(Warning::CountMismatch {
                what,
                recorded,
                actual,
            });
        }
    }
}

/// The index columns, then `columns`, with what the metadata say.
pub(super) fn table_schema(format: Format, columns: &[FieldRef], metadata: &Metadata) -> SchemaRef {
    let mut fields: Vec<FieldRef> = vec![
        Arc::new(Field::new(schema::EPISODE_INDEX, DataType::Int64, false)),
        Arc::new(Field::new(schema::STEP_INDEX, DataType::Int64, false)),
    ];
    fields.extend(columns.iter().map(Arc::clone));
    let json = |value: &Option<Value>| value.as_ref().map(Value::to_string);
    let entries = [
        (schema::VERSION_KEY, Some(schema::VERSION.to_owned())),
        (schema::SOURCE_FORMAT, Some(format.name().to_owned())),
        (schema::SOURCE_VERSION, metadata.version.clone()),
        (schema::SOURCE_ID, Some(metadata.id.clone())),
        (
            schema::SOURCE_METADATA,
            Some(Value::Object(metadata.fields.clone()).to_string()),
        ),
        (schema::SPACE_OBSERVATION, json(&metadata.observation_space)),
        (schema::SPACE_ACTION, json(&metadata.action_space)),
        (schema::ENV_SPEC, json(&metadata.env_spec)),
    ];
    let present = entries
        .into_iter()
        .filter_map(|(key, value)| Some((key.to_owned(), value?)));
    Arc::new(Schema::new_with_metadata(
        fields,
        present.collect::<HashMap<_, _>>(),
    ))
}
