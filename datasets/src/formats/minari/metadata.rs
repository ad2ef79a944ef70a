//! The dataset's `metadata.json`.

use std::io::ErrorKind;
use std::path::Path;

use serde_json::{Map, Value};

use super::json;
use crate::error::{DatasetError, Result};
use crate::format::Format;
use crate::source::Warning;

/// The largest `metadata.json` that is read; published ones have a few kilobytes, image spaces some megabytes.
const MAX_BYTES: u64 = 256 << 20;

/// How the episodes are stored.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Storage {
    Hdf5,
    Arrow,
    Parquet,
    /// A storage this crate does not read yet, by its name.
    Other(String),
}

impl Storage {
    /// The format of a dataset stored so, if it is read.
    ///
    /// # Errors
    /// [`DatasetError::Unsupported`] naming the storage.
    pub(crate) fn format(&self) -> Result<Format> {
        match self {
            Self::Hdf5 => Ok(Format::MinariHdf5),
            Self::Arrow => Ok(Format::MinariArrow),
            Self::Parquet => Ok(Format::MinariParquet),
            Self::Other(name) => Err(DatasetError::Unsupported {
                what: format!("data_format {name}"),
            }),
        }
    }
}

/// What `metadata.json` says.
#[derive(Debug, Clone)]
pub(crate) struct Metadata {
    pub(crate) id: String,
    pub(crate) version: Option<String>,
    pub(crate) storage: Storage,
    pub(crate) total_episodes: Option<u64>,
    pub(crate) total_steps: Option<u64>,
    pub(crate) observation_space: Option<Value>,
    pub(crate) action_space: Option<Value>,
    pub(crate) env_spec: Option<Value>,
    /// All fields as they stand, but for Python's words for infinities.
    pub(crate) fields: Map<String, Value>,
}

impl Metadata {
    /// Reads `data/metadata.json` of a dataset folder.
    ///
    /// # Errors
    /// The file is missing, too large or no JSON object, or holds a field of the wrong type; each names it.
    pub(crate) fn read(dataset: &Path) -> Result<Self> {
        let path = dataset.join("data").join("metadata.json");
        read_object(&path)
            .and_then(Self::of_fields)
            .map_err(|error| error.in_file(&path))
    }

    #[cfg(test)]
    fn parse(text: &str) -> Result<Self> {
        Self::of_fields(parse_object(text)?)
    }

    fn of_fields(fields: Map<String, Value>) -> Result<Self> {
        let storage = match text_field(&fields, "data_format")?.as_deref() {
            // Datasets older than the field are HDF5.
            None | Some("hdf5") => Storage::Hdf5,
            Some("arrow") => Storage::Arrow,
            Some("parquet") => Storage::Parquet,
            Some(other) => Storage::Other(other.to_owned()),
        };
        Ok(Self {
            id: text_field(&fields, "dataset_id")?.unwrap_or_default(),
            version: text_field(&fields, "minari_version")?,
            storage,
            total_episodes: count_field(&fields, "total_episodes")?,
            total_steps: count_field(&fields, "total_steps")?,
            observation_space: json_field(&fields, "observation_space")?,
            action_space: json_field(&fields, "action_space")?,
            env_spec: json_field(&fields, "env_spec")?,
            fields,
        })
    }

    /// Refuses versions whose layout is unknown, unless forced to try.
    ///
    /// 0.4 and 0.5 are known; other 0.x get a warning, as the layout has been stable; the rest is refused.
    ///
    /// # Errors
    /// [`DatasetError::UnknownVersion`].
    pub(crate) fn check_version(&self, force: bool) -> Result<Option<Warning>> {
        let found = self
            .version
            .clone()
            .unwrap_or_else(|| "an unknown version".to_owned());
        let mut parts = found.split('.').map(str::parse::<u32>);
        match (parts.next(), parts.next()) {
            (Some(Ok(0)), Some(Ok(4 | 5))) => Ok(None),
            (Some(Ok(0)), _) => Ok(Some(Warning::UncheckedVersion { found })),
            _ if force || self.version.is_none() => Ok(Some(Warning::UncheckedVersion { found })),
            _ => Err(DatasetError::UnknownVersion { found }),
        }
    }

    /// A field that is a number.
    pub(crate) fn number(&self, field: &str) -> Option<f64> {
        self.fields.get(field).and_then(Value::as_f64)
    }
}

/// The attributes of an episode in a folder of its own: its `metadata.json`; empty if there is none.
///
/// # Errors
/// The file is damaged.
pub(super) fn episode_attributes(episode: &Path) -> Result<Map<String, Value>> {
    let path = episode.join("metadata.json");
    match read_object(&path) {
        Err(DatasetError::Io { source, .. }) if source.kind() == ErrorKind::NotFound => {
            Ok(Map::new())
        }
        other => other.map_err(|error| error.in_file(&path)),
    }
}

fn read_object(path: &Path) -> Result<Map<String, Value>> {
    let size = std::fs::metadata(path)
        .map_err(|e| DatasetError::io("open", e))?
        .len();
    if size > MAX_BYTES {
        return Err(DatasetError::corrupt(format!("metadata of {size} bytes")));
    }
    let text = std::fs::read_to_string(path).map_err(|e| DatasetError::io("read", e))?;
    parse_object(&text)
}

fn parse_object(text: &str) -> Result<Map<String, Value>> {
    match json::parse(text, "metadata.json")? {
        Value::Object(fields) => Ok(fields),
        _ => Err(DatasetError::corrupt("metadata.json holds no object")),
    }
}

fn wrong(field: &str, value: &Value, expected: &'static str) -> DatasetError {
    const SHOWN: usize = 60;
    let actual: String = value.to_string().chars().take(SHOWN).collect();
    DatasetError::Metadata {
        field: field.to_owned(),
        actual,
        expected,
    }
}

fn text_field(fields: &Map<String, Value>, field: &str) -> Result<Option<String>> {
    match fields.get(field) {
        None | Some(Value::Null) => Ok(None),
        Some(Value::String(text)) => Ok(Some(text.clone())),
        Some(other) => Err(wrong(field, other, "text")),
    }
}

fn count_field(fields: &Map<String, Value>, field: &str) -> Result<Option<u64>> {
    match fields.get(field) {
        None | Some(Value::Null) => Ok(None),
        Some(value) => value
            .as_u64()
            .map(Some)
            .ok_or_else(|| wrong(field, value, "a count")),
    }
}

/// Spaces and environment specifications are JSON in a string.
fn json_field(fields: &Map<String, Value>, field: &str) -> Result<Option<Value>> {
    text_field(fields, field)?
        .map(|text| json::parse(&text, field))
        .transpose()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spaces_in_pythons_dialect_are_read() {
        let text = r#"{"dataset_id": "a-v0", "minari_version": "0.5.4", "total_episodes": 3,
            "observation_space": "{\"type\": \"Box\", \"low\": [-Infinity]}", "x": Infinity}"#;
        let metadata = Metadata::parse(text).unwrap();
        assert_eq!(metadata.total_episodes, Some(3));
        assert_eq!(metadata.observation_space.unwrap()["low"][0], "-Infinity");
        assert_eq!(metadata.storage, Storage::Hdf5);
    }

    #[test]
    fn versions_outside_the_known_ones_are_not_silent() {
        let check = |version: &str, force| {
            let text = format!(r#"{{"minari_version": "{version}"}}"#);
            Metadata::parse(&text).unwrap().check_version(force)
        };
        for known in ["0.4.0", "0.4.3", "0.5.0", "0.5.9"] {
            assert_eq!(check(known, false).unwrap(), None, "{known}");
        }
        assert!(check("0.6.0", false).unwrap().is_some());
        assert!(matches!(
            check("9.0.0", false),
            Err(DatasetError::UnknownVersion { .. })
        ));
        assert!(check("9.0.0", true).unwrap().is_some());
    }

    #[test]
    fn fields_of_the_wrong_type_are_named() {
        for text in [
            r#"{"total_steps": -1}"#,
            r#"{"dataset_id": 3}"#,
            "[]",
            r#"{"env_spec": "{"}"#,
        ] {
            assert!(Metadata::parse(text).is_err(), "{text}");
        }
        let error = Metadata::parse(r#"{"total_steps": "many"}"#)
            .unwrap_err()
            .to_string();
        assert_eq!(
            error,
            "metadata field \"total_steps\" is \"many\", expected a count"
        );
    }
}
