//! The dataset's `metadata.json`.

use std::fs::File;
use std::io::Write as _;
use std::path::Path;

use serde_json::{Map, Value};

use super::super::json;
use super::Rows;
use super::columns::Columns;
use super::episodes::Fates;
use super::spaces::{SpaceText, jpeg_encoding};
use crate::error::{DatasetError, Result};
use crate::format::Format;
use crate::schema;
use crate::sink::{Loss, LossEffect, SinkInput, WriteOptions};

/// The version whose layout is written.
const MINARI_VERSION: &str = "0.5.4";

/// What `metadata.json` will say.
pub(super) struct DatasetMetadata {
    fields: Map<String, Value>,
    observation: SpaceText,
    action: SpaceText,
}

impl DatasetMetadata {
    /// Takes over what the source says of itself.
    ///
    /// # Errors
    /// An id that is none, or pictures of which some are encoded and some are not.
    pub(super) fn new(
        path: &Path,
        format: Format,
        columns: &Columns,
        (input, options): (&SinkInput<'_>, &WriteOptions),
        losses: &mut Vec<Loss>,
    ) -> Result<Self> {
        let metadata = input.schema.metadata();
        let text = |key: &str| metadata.get(key).map(String::as_str);
        let mut fields = source_fields(input, losses)?;
        let space = |key: &str| -> Result<Option<Value>> {
            text(key).map(|text| json::parse(text, key)).transpose()
        };
        let verbatim = |field: &str| fields.get(field).and_then(Value::as_str);
        let (observed, acted) = (
            space(schema::SPACE_OBSERVATION)?,
            space(schema::SPACE_ACTION)?,
        );
        let spaces = [
            ("observation_space", &columns.observation, observed),
            ("action_space", &columns.action, acted),
        ];
        let [observation, action] = spaces.map(|(field, group, recorded)| {
            let space = SpaceText::new(group, recorded.as_ref(), verbatim(field));
            if recorded.is_some() && !space.is_kept() {
                let detail = "the source's space does not fit the columns: made from them";
                losses.push(Loss::new(field, LossEffect::Changed, detail));
            }
            space
        });
        let env_spec = match (verbatim("env_spec"), text(schema::ENV_SPEC)) {
            (Some(spec), _) | (None, Some(spec)) => Some(spec.to_owned()),
            (None, None) => input.info.env_spec.as_ref().map(Value::to_string),
        };
        let env_spec = env_spec.filter(|spec| {
            let is_kept = is_gymnasium_spec(spec);
            if !is_kept {
                let detail = "it is no specification of Gymnasium, and Minari would not open the dataset with it";
                losses.push(Loss::new("env_spec", LossEffect::Dropped, detail));
            }
            is_kept
        });
        let encoded = jpeg_encoding([&observation, &action])?;
        let encoded = encoded.or_else(|| fields.get("jpeg_encoding").and_then(Value::as_bool));
        let mut set = |key: &str, value: Value| fields.insert(key.to_owned(), value);
        set(
            "dataset_id",
            dataset_id(path, input, options, losses)?.into(),
        );
        set("minari_version", MINARI_VERSION.into());
        set("data_format", storage_name(format).into());
        set("jpeg_encoding", encoded.unwrap_or(true).into());
        if let Some(spec) = env_spec {
            set("env_spec", spec.into());
        }
        for (key, score) in [
            ("ref_min_score", input.info.ref_min_score),
            ("ref_max_score", input.info.ref_max_score),
        ] {
            if let Some(score) = score {
                set(key, score.into());
            }
        }
        Ok(Self {
            fields,
            observation,
            action,
        })
    }

    /// Notes rows, for the spaces made from them.
    pub(super) fn see(&mut self, rows: &Rows) {
        self.observation.see(&rows.observations);
        self.action.see(&rows.actions);
    }

    /// Writes the file, once the data are in the folder.
    ///
    /// # Errors
    /// A failed write.
    pub(super) fn write(mut self, data: &Path, fates: &Fates) -> Result<()> {
        let mut set = |key: &str, value: Value| self.fields.insert(key.to_owned(), value);
        set("total_episodes", fates.n_episodes().into());
        set("total_steps", fates.n_steps().into());
        set("observation_space", self.observation.write().into());
        set("action_space", self.action.write().into());
        set("dataset_size", megabytes(data)?.into());
        let mut file =
            File::create(data.join("metadata.json")).map_err(|e| DatasetError::io("create", e))?;
        // The field that holds a word for a number is a number; those that hold text hold no such word.
        file.write_all(json::write(&Value::Object(self.fields)).as_bytes())
            .and_then(|()| file.sync_all())
            .map_err(|e| DatasetError::io("write", e))
    }
}

/// Whether Gymnasium's `EnvSpec.from_json` takes it: it looks for these keys.
fn is_gymnasium_spec(spec: &str) -> bool {
    let spec = serde_json::from_str::<Map<String, Value>>(spec);
    spec.is_ok_and(|spec| spec.contains_key("id") && spec.contains_key("additional_wrappers"))
}

/// The fields of a source that is Minari's; those of others have no place.
fn source_fields(input: &SinkInput<'_>, losses: &mut Vec<Loss>) -> Result<Map<String, Value>> {
    let metadata = input.schema.metadata();
    let format = metadata.get(schema::SOURCE_FORMAT);
    let recorded = metadata.get(schema::SOURCE_METADATA);
    let fields = match recorded.map(|text| json::parse(text, schema::SOURCE_METADATA)) {
        Some(Ok(Value::Object(fields))) => fields,
        Some(Err(error)) => return Err(error),
        _ => Map::new(),
    };
    if format.is_some_and(|name| name.starts_with("minari-")) {
        return Ok(fields);
    }
    if !fields.is_empty() {
        let names: Vec<&str> = fields.keys().map(String::as_str).collect();
        let detail = format!(
            "Minari has no place for the source's own: {}",
            names.join(", ")
        );
        losses.push(Loss::new("metadata", LossEffect::Dropped, detail));
    }
    Ok(Map::new())
}

fn storage_name(format: Format) -> &'static str {
    match format {
        Format::MinariArrow => "arrow",
        Format::MinariParquet => "parquet",
        _ => "hdf5",
    }
}

/// The id that was asked for, else the source's if it is one, else one made from the folder's name.
fn dataset_id(
    path: &Path,
    input: &SinkInput<'_>,
    options: &WriteOptions,
    losses: &mut Vec<Loss>,
) -> Result<String> {
    if let Some(id) = &options.id {
        return match is_id(id) {
            true => Ok(id.clone()),
            false => Err(DatasetError::BadId {
                id: id.clone(),
                reason: "Minari's ids are [namespace/...]name-vN of ASCII letters, digits, \"_\" and \"-\"",
            }),
        };
    }
    let source = &input.info.id;
    if is_id(source) {
        return Ok(source.clone());
    }
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let allowed = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '-');
    let mut id: String = name
        .chars()
        .map(|c| if allowed(c) { c } else { '_' })
        .collect();
    if !is_id(&id) {
        id = format!("{id}-v0");
    }
    let detail = format!("\"{source}\" is no id of Minari's: \"{id}\"");
    losses.push(Loss::new("dataset id", LossEffect::Changed, detail));
    Ok(id)
}

/// `[namespace/...]name-vN` of ASCII letters, digits, `_` and `-`.
fn is_id(id: &str) -> bool {
    let is_part = |part: &str| {
        let allowed = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '-');
        !part.is_empty() && part.chars().all(allowed)
    };
    let Some((name, version)) = id.rsplit_once("-v") else {
        return false;
    };
    let is_version = !version.is_empty() && version.chars().all(|c| c.is_ascii_digit());
    is_version && name.split('/').all(is_part)
}

/// Size of the files in a folder, in 10^6 bytes with one decimal, as Minari counts.
fn megabytes(folder: &Path) -> Result<f64> {
    let mut folders = vec![folder.to_owned()];
    let mut bytes = 0u64;
    while let Some(folder) = folders.pop() {
        let entries = std::fs::read_dir(&folder).map_err(|e| DatasetError::io("list", e))?;
        for entry in entries {
            let entry = entry.map_err(|e| DatasetError::io("list", e))?;
            let about = entry.metadata().map_err(|e| DatasetError::io("list", e))?;
            match about.is_dir() {
                true => folders.push(entry.path()),
                false => bytes += about.len(),
            }
        }
    }
    #[expect(clippy::cast_precision_loss, reason = "rounded to 100 kB")]
    let tenths = (bytes as f64 / 1e5).round();
    Ok(tenths / 10.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ids_are_minaris() {
        for good in ["a-v0", "D4RL/antmaze/large-play-v1", "x_y-v12", "a-v1-v2"] {
            assert!(is_id(good), "{good}");
        }
        for bad in [
            "a", "-v0", "a-v", "a/-v0", "../a-v0", "a//b-v0", "é-v0", "a-v1x", "/a-v0",
        ] {
            assert!(!is_id(bad), "{bad}");
        }
    }
}
