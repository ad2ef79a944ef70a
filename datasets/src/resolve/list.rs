//! What datasets are on disk.

use std::path::{Path, PathBuf};

use super::{SearchRoots, minari_ids};
use crate::format::{Format, HDF5_MAGIC};
use crate::formats::minari::metadata::Metadata;

/// Folders inside folders are looked through this deep: more than any namespace has.
const MAX_DEPTH: usize = 8;

/// A dataset on disk.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Listed {
    /// The name to give to [`crate::resolve`].
    pub id: String,
    /// Its format.
    pub format: Format,
    /// Where it is.
    pub path: PathBuf,
    /// Number of episodes, where a metadata file says so.
    pub n_episodes: Option<u64>,
    /// Number of steps, where a metadata file says so.
    pub n_steps: Option<u64>,
    /// Why it cannot be read, where that shows without opening the data.
    pub note: Option<String>,
}

/// All datasets under both roots, sorted by id. Only metadata files and the first bytes of D4RL files are
/// read. Links to folders are not followed.
pub fn list(roots: &SearchRoots) -> Vec<Listed> {
    let mut found = Vec::new();
    if let Some(root) = &roots.minari {
        list_minari(root, root, 0, &mut found);
    }
    if let Some(root) = &roots.d4rl {
        list_d4rl(root, &mut found);
    }
    found.sort_by(|a, b| a.id.cmp(&b.id).then_with(|| a.path.cmp(&b.path)));
    found
}

fn list_minari(root: &Path, folder: &Path, depth: usize, found: &mut Vec<Listed>) {
    if depth > MAX_DEPTH {
        return;
    }
    let Ok(entries) = std::fs::read_dir(folder) else {
        return;
    };
    for entry in entries
        .flatten()
        .filter(|entry| entry.file_type().is_ok_and(|kind| kind.is_dir()))
        // A download under way is a hidden folder.
        .filter(|entry| !entry.file_name().as_encoded_bytes().starts_with(b"."))
    {
        let path = entry.path();
        if minari_ids::is_dataset(&path) {
            found.extend(minari_entry(root, path));
        } else {
            list_minari(root, &path, depth + 1, found);
        }
    }
}

fn minari_entry(root: &Path, path: PathBuf) -> Option<Listed> {
    let parts: Option<Vec<&str>> = path
        .strip_prefix(root)
        .ok()?
        .iter()
        .map(|part| part.to_str())
        .collect();
    let id = parts?.join("/");
    let metadata = Metadata::read(&path);
    let format = metadata
        .as_ref()
        .map_or(Ok(Format::MinariHdf5), |metadata| metadata.storage.format());
    let note = match (&metadata, &format) {
        (_, Err(error)) => Some(error.to_string()),
        (Ok(metadata), _) => metadata
            .check_version(false)
            .err()
            .map(|error| error.to_string()),
        (Err(error), _) => Some(error.cause().to_string()),
    };
    let counts = metadata.ok();
    Some(Listed {
        id,
        format: format.unwrap_or(Format::MinariHdf5),
        n_episodes: counts.as_ref().and_then(|metadata| metadata.total_episodes),
        n_steps: counts.as_ref().and_then(|metadata| metadata.total_steps),
        path,
        note,
    })
}

fn list_d4rl(root: &Path, found: &mut Vec<Listed>) {
    let Ok(entries) = std::fs::read_dir(root) else {
        return;
    };
    for entry in entries.flatten() {
        let path = entry.path();
        let is_hdf5 = path.extension().is_some_and(|suffix| suffix == "hdf5");
        let Some(stem) = path
            .file_stem()
            .and_then(|stem| stem.to_str())
            .filter(|_| is_hdf5)
        else {
            continue;
        };
        let note = (!starts_as_hdf5(&path)).then(|| "not an HDF5 file".to_owned());
        found.push(Listed {
            id: id_of_file(stem),
            format: Format::D4rlHdf5,
            n_episodes: None,
            n_steps: None,
            note,
            path: path.clone(),
        });
    }
}

/// `hopper-medium-v2` for `hopper_medium-v2`: an id that resolves back to the file, else the file name.
fn id_of_file(stem: &str) -> String {
    let id = stem.replace('_', "-");
    let resolves = super::d4rl_names::file_names(&id)
        .first()
        .is_some_and(|name| *name == format!("{stem}.hdf5"));
    if resolves { id } else { format!("{stem}.hdf5") }
}

fn starts_as_hdf5(path: &Path) -> bool {
    use std::io::Read;
    let mut head = [0; 8];
    std::fs::File::open(path)
        .and_then(|mut file| file.read_exact(&mut head))
        .is_ok()
        && head == HDF5_MAGIC
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn datasets_of_both_stores_are_listed_in_order() {
        let dir = tempfile::tempdir().unwrap();
        let minari = dir.path().join("minari");
        for (id, text) in [
            (
                "b/c-v0",
                r#"{"minari_version": "0.5.4", "total_episodes": 2, "total_steps": 9}"#,
            ),
            (
                "a-v1",
                r#"{"minari_version": "0.5.4", "data_format": "zarr"}"#,
            ),
            ("bad-v0", "{"),
            (".half-v0.part", "{}"),
        ] {
            let data = minari.join(id).join("data");
            std::fs::create_dir_all(&data).unwrap();
            std::fs::write(data.join("metadata.json"), text).unwrap();
        }
        let d4rl = dir.path().join("d4rl");
        std::fs::create_dir_all(&d4rl).unwrap();
        std::fs::write(d4rl.join("hopper_medium-v2.hdf5"), HDF5_MAGIC).unwrap();
        std::fs::write(d4rl.join("mine.hdf5"), "<html>").unwrap();
        let listed = list(&SearchRoots {
            minari: Some(minari),
            d4rl: Some(d4rl),
        });
        let ids: Vec<&str> = listed.iter().map(|dataset| dataset.id.as_str()).collect();
        assert_eq!(
            ids,
            ["a-v1", "b/c-v0", "bad-v0", "hopper-medium-v2", "mine.hdf5"]
        );
        assert_eq!(
            (
                listed[1].n_episodes,
                listed[1].n_steps,
                listed[1].note.as_deref()
            ),
            (Some(2), Some(9), None)
        );
        assert!(
            listed[0]
                .note
                .as_deref()
                .is_some_and(|note| note.contains("zarr"))
        );
        assert!(listed[2].note.is_some() && listed[3].note.is_none() && listed[4].note.is_some());
        assert!(list(&SearchRoots::default()).is_empty());
    }
}
