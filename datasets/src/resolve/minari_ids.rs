//! Minari's dataset ids: `[namespace/...]name-vN`.

use std::path::{Path, PathBuf};

use crate::error::Result;
use crate::registry;

use super::bad;

/// Namespaces whose datasets have short names: `family-set` means `<namespace>/family/set`.
const NAMESPACES: [&str; 2] = ["D4RL", "mujoco"];

/// Checks an id before it is joined to a path. Minari itself does not, so its ids can leave the root.
///
/// # Errors
/// [`crate::DatasetError::BadId`] unless the id is non-empty parts of ASCII letters, digits, `_` and `-`.
pub(super) fn check_characters(id: &str) -> Result<()> {
    let allowed = |c: char| c.is_ascii_alphanumeric() || matches!(c, '_' | '-' | '/');
    if id.split('/').any(|part| part == "..") {
        return Err(bad(id, "it holds \"..\""));
    }
    if id.split('/').any(str::is_empty) {
        return Err(bad(id, "it is empty or has an empty part"));
    }
    if !id.chars().all(allowed) {
        return Err(bad(
            id,
            "only ASCII letters, digits, \"_\", \"-\" and \"/\" are allowed",
        ));
    }
    Ok(())
}

/// The version number of an id that ends in `-vN`.
pub(super) fn version(id: &str) -> Option<u32> {
    let (stem, digits) = id.rsplit_once("-v")?;
    let is_number =
        !stem.is_empty() && !stem.ends_with('/') && digits.bytes().all(|b| b.is_ascii_digit());
    if is_number { digits.parse().ok() } else { None }
}

/// The id without `-vN`.
pub(super) fn without_version(id: &str) -> &str {
    match version(id) {
        Some(_) => id.rsplit_once("-v").map_or(id, |(stem, _)| stem),
        None => id,
    }
}

/// The full ids, without version, a short name may stand for.
pub(super) fn expand(stem: &str) -> Vec<String> {
    let Some((family, set)) = stem.split_once('-').filter(|_| !stem.contains('/')) else {
        return Vec::new();
    };
    let folders = NAMESPACES.map(|namespace| format!("{namespace}/{family}/"));
    folders
        .into_iter()
        .filter(|folder| registry::all().any(|known| known.id.starts_with(folder)))
        .map(|folder| format!("{folder}{set}"))
        .collect()
}

/// Full ids with version to download for a name, where such are published; the newest for a name without.
pub(super) fn published(name: &str) -> Vec<String> {
    if name.contains('/') && version(name).is_some() {
        return vec![name.to_owned()];
    }
    let stem = without_version(name);
    let mut stems = expand(stem);
    if stem.contains('/') {
        stems.push(stem.to_owned());
    }
    let newest = |stem: &String| {
        let of_stem = registry::all().filter(|known| without_version(known.id) == stem);
        of_stem.filter_map(|known| version(known.id)).max()
    };
    let known = stems.iter().filter_map(|stem| Some((stem, newest(stem)?)));
    known
        .map(|(stem, newest)| format!("{stem}-v{}", version(name).unwrap_or(newest)))
        .collect()
}

/// The folder of an id under the root.
///
/// # Errors
/// Those of [`check_characters`].
pub(super) fn folder(root: &Path, id: &str) -> Result<PathBuf> {
    check_characters(id)?;
    Ok(root.join(id))
}

/// Whether a folder is a dataset: it has metadata among its data.
pub(super) fn is_dataset(folder: &Path) -> bool {
    folder.join("data").join("metadata.json").is_file()
}

/// The dataset `stem-vN` with the largest N.
///
/// # Errors
/// Those of [`check_characters`].
pub(super) fn newest(root: &Path, stem: &str) -> Result<Option<(String, PathBuf)>> {
    let folder = folder(root, stem)?;
    let Some(name) = folder.file_name().and_then(|name| name.to_str()) else {
        return Ok(None);
    };
    let Some(entries) = folder
        .parent()
        .and_then(|parent| std::fs::read_dir(parent).ok())
    else {
        return Ok(None);
    };
    let versions = entries.flatten().filter_map(|entry| {
        let file_name = entry.file_name();
        let entry_name = file_name.to_str()?;
        (without_version(entry_name) == name && is_dataset(&entry.path()))
            .then(|| version(entry_name))?
    });
    // The number is written back, so `-v01` is not taken for `-v1`.
    let Some(newest) = versions.max() else {
        return Ok(None);
    };
    let id = format!("{stem}-v{newest}");
    let path = root.join(&id);
    Ok(is_dataset(&path).then_some((id, path)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn versions_are_taken_off_the_end_only() {
        assert_eq!(version("D4RL/pen/human-v2"), Some(2));
        assert_eq!(version("pen-v2-human"), None);
        assert_eq!(version("x-v"), None);
        assert_eq!(version("-v1"), None);
        assert_eq!(version("x-v99999999999"), None);
        assert_eq!(without_version("a-v1-v2"), "a-v1");
    }

    #[test]
    fn short_names_of_known_families_expand() {
        assert_eq!(expand("antmaze-large-play"), ["D4RL/antmaze/large-play"]);
        assert_eq!(expand("hopper-medium"), ["mujoco/hopper/medium"]);
        assert!(expand("other-thing").is_empty());
        assert_eq!(
            published("pointmaze-umaze-dense"),
            ["D4RL/pointmaze/umaze-dense-v2"]
        );
    }
}
