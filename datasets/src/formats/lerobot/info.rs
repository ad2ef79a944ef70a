//! `meta/info.json`: what a dataset folder says about itself.

use serde_json::{Map, Value};

use super::root::{PathTemplate, Root};
use crate::error::{DatasetError, Result};
use crate::formats::minari::json;
use crate::source::Warning;

/// Place of the file in the folder.
pub(super) const INFO_PATH: &str = "meta/info.json";
/// Where episode files are by default, since v3.0 and before.
pub(super) const DATA_PATH_V3: &str = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet";
const DATA_PATH_V2: &str = "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet";
const KNOWN_KEYS: [&str; 17] = [
    "codebase_version",
    "robot_type",
    "total_episodes",
    "total_frames",
    "total_tasks",
    "total_videos",
    "total_chunks",
    "chunks_size",
    "data_files_size_in_mb",
    "video_files_size_in_mb",
    "fps",
    "splits",
    "data_path",
    "video_path",
    "features",
    "tools",
    "license",
];
/// Values of one row of a feature, at most.
const MAX_WIDTH: usize = 1 << 28;

/// How the files of a version are laid out.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Layout {
    /// A file per episode, descriptions as JSON lines.
    V2,
    /// Many episodes to a file, descriptions as Parquet.
    V3,
}

/// The file, parsed.
#[derive(Debug)]
pub(super) struct Info {
    /// The text as it is.
    pub(super) text: String,
    pub(super) fields: Map<String, Value>,
    pub(super) layout: Layout,
    /// As recorded, such as `v2.1`.
    pub(super) version: String,
    /// Steps per second; positive.
    pub(super) fps: f64,
    /// Episodes of a chunk, before v3.0.
    pub(super) chunks_size: i64,
    pub(super) data_path: PathTemplate,
    pub(super) features: Vec<Feature>,
    pub(super) warnings: Vec<Warning>,
}

/// One entry of `features`.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Feature {
    pub(super) name: String,
    /// Type as NumPy names it, or `string`, `image`, `video`.
    pub(super) dtype: String,
    pub(super) shape: Vec<usize>,
    /// Names, if they are a flat list (or the only list in an object).
    pub(super) names: Option<Vec<String>>,
    /// What else is recorded about it, under `info`.
    pub(super) info: Map<String, Value>,
}

impl Info {
    /// Reads and checks the file.
    ///
    /// # Errors
    /// It is not there, is no JSON, is of a version that is not read, or lacks what is needed; it is named.
    pub(super) fn read(root: &Root, force: bool) -> Result<Self> {
        let text = root.read_text(INFO_PATH)?;
        Self::parse(text, force).map_err(|error| error.in_file(&root.join(INFO_PATH)))
    }

    fn parse(text: String, force: bool) -> Result<Self> {
        let Value::Object(fields) = json::parse(&text, "the file")? else {
            return Err(wrong("info.json", &Value::Null, "an object"));
        };
        let mut warnings = unknown_keys(&fields);
        let version = text_field(&fields, "codebase_version")?;
        let layout = layout(&version, force, &mut warnings)?;
        let fps = require(&fields, "fps")?;
        let is_rate = |fps: &f64| fps.is_finite() && *fps > 0.0;
        let fps = fps
            .as_f64()
            .filter(is_rate)
            .ok_or_else(|| wrong("fps", fps, "a positive number"))?;
        let chunks_size = match fields.get("chunks_size") {
            None => 1000,
            Some(size) => size
                .as_i64()
                .filter(|size| *size > 0)
                .ok_or_else(|| wrong("chunks_size", size, "a positive integer"))?,
        };
        let (default, known): (&str, &[&str]) = match layout {
            Layout::V2 => (DATA_PATH_V2, &["episode_chunk", "episode_index"]),
            Layout::V3 => (DATA_PATH_V3, &["chunk_index", "file_index"]),
        };
        let data_path = match fields.get("data_path") {
            None | Some(Value::Null) => default,
            Some(Value::String(path)) => path,
            Some(other) => return Err(wrong("data_path", other, "text")),
        };
        let data_path = PathTemplate::parse(data_path, known)?;
        let Value::Object(declared) = require(&fields, "features")? else {
            return Err(wrong("features", &fields["features"], "an object"));
        };
        let features = declared.iter().map(|(name, value)| feature(name, value));
        let features = features.collect::<Result<_>>()?;
        Ok(Self {
            text,
            layout,
            version,
            fps,
            chunks_size,
            data_path,
            features,
            warnings,
            fields,
        })
    }

    /// A count, where it is recorded.
    pub(super) fn count(&self, key: &str) -> Option<u64> {
        self.fields.get(key).and_then(Value::as_u64)
    }
}

fn unknown_keys(fields: &Map<String, Value>) -> Vec<Warning> {
    let unknown = |key: &&String| !KNOWN_KEYS.contains(&key.as_str());
    let keys: Vec<&str> = fields.keys().filter(unknown).map(String::as_str).collect();
    match keys.as_slice() {
        [] => Vec::new(),
        keys => vec![Warning::UnknownKeys {
            file: INFO_PATH,
            keys: keys.join(", "),
        }],
    }
}

fn layout(version: &str, force: bool, warnings: &mut Vec<Warning>) -> Result<Layout> {
    let number = version.strip_prefix('v').and_then(|number| {
        let (major, minor) = number.split_once('.')?;
        Some((major.parse::<u32>().ok()?, minor.parse::<u32>().ok()?))
    });
    match number {
        Some((2, 0 | 1)) => Ok(Layout::V2),
        Some((3, 0)) => Ok(Layout::V3),
        Some((major, _)) if major == 3 || (major > 3 && force) => {
            warnings.push(Warning::NewerVersion {
                found: version.to_owned(),
            });
            Ok(Layout::V3)
        }
        _ => Err(DatasetError::Unsupported {
            what: format!(
                "LeRobot datasets of version \"{}\", only v2.0, v2.1 and v3.x (LeRobot itself can convert it)",
                version.escape_debug()
            ),
        }),
    }
}

fn feature(name: &str, value: &Value) -> Result<Feature> {
    let field = |key: &str| format!("features/{name}/{key}");
    let Value::Object(declared) = value else {
        return Err(wrong(&format!("features/{name}"), value, "an object"));
    };
    let dtype = match declared.get("dtype") {
        Some(Value::String(dtype)) => dtype.clone(),
        other => {
            return Err(wrong(
                &field("dtype"),
                other.unwrap_or(&Value::Null),
                "text",
            ));
        }
    };
    let recorded = declared.get("shape").unwrap_or(&Value::Null);
    let shape: Option<Vec<usize>> = serde_json::from_value(recorded.clone()).ok();
    let fits = |shape: &Vec<usize>| {
        let width = shape.iter().try_fold(1usize, |n, d| n.checked_mul(*d));
        width.is_some_and(|width| width <= MAX_WIDTH)
    };
    let shape = shape.filter(fits);
    let shape = shape.ok_or_else(|| wrong(&field("shape"), recorded, "a list of sizes"))?;
    let info = match declared.get("info").or_else(|| declared.get("video_info")) {
        Some(Value::Object(info)) => info.clone(),
        _ => Map::new(),
    };
    Ok(Feature {
        name: name.to_owned(),
        dtype,
        shape,
        names: declared.get("names").and_then(flat_names),
        info,
    })
}

/// Names as a list; datasets recorded by older versions wrap it as `{"motors": [...]}`.
fn flat_names(names: &Value) -> Option<Vec<String>> {
    let list = match names {
        Value::Object(groups) if groups.len() == 1 => groups.values().next()?,
        other => other,
    };
    serde_json::from_value(list.clone()).ok()
}

fn require<'a>(fields: &'a Map<String, Value>, key: &str) -> Result<&'a Value> {
    fields.get(key).ok_or_else(|| DatasetError::MissingKey {
        key: key.to_owned(),
        found: fields.keys().cloned().collect::<Vec<_>>().join(", "),
    })
}

fn text_field(fields: &Map<String, Value>, key: &str) -> Result<String> {
    match require(fields, key)? {
        Value::String(text) => Ok(text.clone()),
        other => Err(wrong(key, other, "text")),
    }
}

fn wrong(field: &str, actual: &Value, expected: &'static str) -> DatasetError {
    let mut actual = actual.to_string();
    if actual.len() > 60 {
        let end = (0..=60).rev().find(|&at| actual.is_char_boundary(at));
        actual.truncate(end.unwrap_or(0));
        actual.push('…');
    }
    DatasetError::Metadata {
        field: field.to_owned(),
        actual,
        expected,
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn parse(change: impl FnOnce(&mut Value)) -> Result<Info> {
        let mut value = json!({
            "codebase_version": "v3.0", "fps": 30, "robot_type": null, "chunks_size": 1000,
            "features": {"action": {"dtype": "float32", "shape": [2], "names": {"motors": ["a", "b"]}}},
        });
        change(&mut value);
        Info::parse(value.to_string(), false)
    }

    #[test]
    fn versions() {
        let of = |version: &str| parse(|info| info["codebase_version"] = json!(version));
        assert_eq!(of("v2.0").unwrap().layout, Layout::V2);
        assert_eq!(of("v2.1").unwrap().layout, Layout::V2);
        assert_eq!(of("v3.0").unwrap().warnings, []);
        assert_eq!(of("v3.7").unwrap().warnings.len(), 1);
        for refused in ["v1.6", "v2.2", "v4.0", "3.0", "", "v3"] {
            let error = of(refused).unwrap_err();
            assert!(
                matches!(error, DatasetError::Unsupported { .. }),
                "{refused}"
            );
        }
    }

    #[test]
    fn unknown_keys_are_named_and_names_unwrapped() {
        let info = parse(|info| info["x"] = json!(1)).unwrap();
        assert_eq!(
            info.warnings,
            [Warning::UnknownKeys {
                file: INFO_PATH,
                keys: "x".to_owned()
            }]
        );
        let names = info.features[0].names.as_ref().unwrap();
        assert_eq!(names, &["a", "b"]);
    }

    #[test]
    fn bad_fields_are_named() {
        for (pointer, bad) in [
            ("/fps", json!(0)),
            ("/fps", json!("30")),
            ("/chunks_size", json!(-1)),
            ("/features", json!([])),
            ("/features/action", json!(3)),
            ("/features/action/shape", json!([-1])),
            ("/features/action/shape", json!([1u64 << 40, 1u64 << 40])),
            ("/features/action/dtype", json!(null)),
        ] {
            let error = parse(|info| *info.pointer_mut(pointer).unwrap() = bad).unwrap_err();
            let DatasetError::Metadata { field, .. } = &error else {
                panic!("{pointer}: {error:?}")
            };
            assert!(pointer.ends_with(field.as_str()), "{pointer}: {error}");
        }
    }
}
