//! From a dataset's name to its place on disk.
//!
//! A name is, in this order: a **path** (it exists, starts with `.`, `/` or `~`, or ends in `.hdf5`, `.h5`,
//! `.parquet`, `.arrow`, `.feather`, `.mcap` or `.npz`); a **Minari id** such as `D4RL/antmaze/large-play-v1`; a **D4RL name** such as
//! `hopper-medium-expert-v2`, looked for among D4RL's files first and in Minari then; a **short name** such as
//! `antmaze-large-play`, taken as the newest version of the Minari dataset `D4RL/antmaze/large-play`.

mod d4rl_names;
mod list;
mod minari_ids;

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use crate::error::{DatasetError, Result};
use crate::registry;

pub use list::{Listed, list};

/// The folders datasets live in.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct SearchRoots {
    /// Root of Minari datasets.
    pub minari: Option<PathBuf>,
    /// Folder of D4RL files.
    pub d4rl: Option<PathBuf>,
}

impl SearchRoots {
    /// The roots of this process: `$MINARI_DATASETS_PATH` or `~/.minari/datasets`, and `$D4RL_DATASET_DIR` or
    /// `~/.d4rl/datasets`.
    pub fn from_env() -> Self {
        let home = std::env::home_dir();
        Self::from_vars(
            std::env::var_os("MINARI_DATASETS_PATH"),
            std::env::var_os("D4RL_DATASET_DIR"),
            home,
        )
    }

    /// As [`Self::from_env`] with the variables given. Empty variables count as unset.
    pub fn from_vars(
        minari: Option<OsString>,
        d4rl: Option<OsString>,
        home: Option<PathBuf>,
    ) -> Self {
        let root = |variable: Option<OsString>, default: &str| match variable
            .filter(|value| !value.is_empty())
        {
            Some(value) => Some(PathBuf::from(value)),
            None => home
                .as_ref()
                .map(|home| home.join(default).join("datasets")),
        };
        Self {
            minari: root(minari, ".minari"),
            d4rl: root(d4rl, ".d4rl"),
        }
    }
}

/// A name and where it is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Resolved {
    /// The full id or path that was found.
    pub name: String,
    /// Where it is, for [`crate::open`].
    pub path: PathBuf,
}

/// Finds a dataset by path or name; see the rules above. Nothing is downloaded.
///
/// # Errors
/// [`DatasetError::NotFound`] naming every place that was tried and how to get the dataset,
/// [`DatasetError::BadId`] for an id with `..`, a backslash, NUL or other characters no id has.
pub fn resolve(name: &str, roots: &SearchRoots) -> Result<Resolved> {
    if name.contains('\0') {
        return Err(bad(name, "it holds a NUL"));
    }
    if is_path(name) {
        return path_on_disk(name);
    }
    let mut looked_at = Vec::new();
    let candidates = match candidates(name, roots) {
        // What cannot be a name may still be a relative path; not by way of `..`, though, which
        // belongs at the start of a path or nowhere.
        Err(_) if !name.split('/').any(|part| part == "..") && Path::new(name).exists() => {
            return path_on_disk(name);
        }
        candidates => candidates?,
    };
    for candidate in candidates {
        match candidate.find(roots, &mut looked_at)? {
            Some(found) => return Ok(found),
            None => continue,
        }
    }
    if Path::new(name).exists() {
        return path_on_disk(name);
    }
    Err(DatasetError::NotFound {
        name: name.to_owned(),
        looked_at,
        help: help(name, roots),
    })
}

fn bad(id: &str, reason: &'static str) -> DatasetError {
    DatasetError::BadId {
        id: id.to_owned(),
        reason,
    }
}

/// Whether a name is meant as a path whatever the datasets are called.
fn is_path(name: &str) -> bool {
    let suffix = Path::new(name)
        .extension()
        .and_then(|suffix| suffix.to_str());
    name.starts_with("./")
        || name.starts_with("../")
        || name == "."
        || name == ".."
        || name.starts_with(['/', '~'])
        || matches!(
            suffix,
            Some("hdf5" | "h5" | "parquet" | "arrow" | "feather" | "mcap" | "npz")
        )
}

fn path_on_disk(name: &str) -> Result<Resolved> {
    let path = PathBuf::from(name);
    match std::fs::metadata(&path) {
        Ok(_) => Ok(Resolved {
            name: name.to_owned(),
            path,
        }),
        Err(error) => Err(DatasetError::io("open", error).in_file(&path)),
    }
}

/// One reading of a name.
enum Candidate {
    /// A file in the D4RL folder.
    D4rl { file: String },
    /// A Minari id with its version.
    Minari { id: String },
    /// A Minari id without version: the newest on disk.
    MinariNewest { stem: String },
}

/// The readings of a name, best first.
fn candidates(name: &str, roots: &SearchRoots) -> Result<Vec<Candidate>> {
    minari_ids::check_characters(name)?;
    let mut candidates = Vec::new();
    if roots.d4rl.is_some() && !name.contains('/') {
        candidates.extend(
            d4rl_names::file_names(name)
                .into_iter()
                .map(|file| Candidate::D4rl { file }),
        );
    }
    if roots.minari.is_some() {
        let is_versioned = minari_ids::version(name).is_some();
        candidates.push(match is_versioned {
            true => Candidate::Minari {
                id: name.to_owned(),
            },
            false => Candidate::MinariNewest {
                stem: name.to_owned(),
            },
        });
        for stem in minari_ids::expand(minari_ids::without_version(name)) {
            candidates.push(match minari_ids::version(name) {
                Some(version) => Candidate::Minari {
                    id: format!("{stem}-v{version}"),
                },
                None => Candidate::MinariNewest { stem },
            });
        }
    }
    Ok(candidates)
}

impl Candidate {
    fn find(&self, roots: &SearchRoots, looked_at: &mut Vec<PathBuf>) -> Result<Option<Resolved>> {
        let found = match self {
            Self::D4rl { file } => {
                let Some(root) = &roots.d4rl else {
                    return Ok(None);
                };
                let path = root.join(file);
                looked_at.push(path.clone());
                path.is_file().then(|| (file.clone(), root, path))
            }
            Self::Minari { id } => {
                let Some(root) = &roots.minari else {
                    return Ok(None);
                };
                let path = minari_ids::folder(root, id)?;
                looked_at.push(path.clone());
                minari_ids::is_dataset(&path).then(|| (id.clone(), root, path))
            }
            Self::MinariNewest { stem } => {
                let Some(root) = &roots.minari else {
                    return Ok(None);
                };
                looked_at.push(root.join(format!("{stem}-v*")));
                minari_ids::newest(root, stem)?.map(|(id, path)| (id, root, path))
            }
        };
        let Some((name, root, path)) = found else {
            return Ok(None);
        };
        // The characters were checked, but a link inside the root may still lead out of it.
        let inside = path.canonicalize().ok().zip(root.canonicalize().ok());
        if inside.is_none_or(|(path, root)| !path.starts_with(root)) {
            return Err(bad(&name, "it leads out of the folder of datasets"));
        }
        Ok(Some(Resolved { name, path }))
    }
}

/// Names to download for a name: a D4RL dataset, or the newest Minari datasets it may stand for.
pub(crate) fn published(name: &str) -> Vec<String> {
    match d4rl_names::known(name) {
        Some(known) => vec![known.id.to_owned()],
        None => minari_ids::published(name),
    }
}

/// Whether a name can be a dataset's id with its version; such a name is safe to join to a root.
#[cfg(any(feature = "download", test))]
pub(crate) fn is_versioned_id(name: &str) -> bool {
    minari_ids::check_characters(name).is_ok() && minari_ids::version(name).is_some()
}

/// Checks that a name has only the characters of an id.
///
/// # Errors
/// [`DatasetError::BadId`] for a name that could leave the root.
#[cfg(feature = "download")]
pub(crate) fn check_characters(name: &str) -> Result<()> {
    minari_ids::check_characters(name)
}

/// The folder of a Minari id under its root.
///
/// # Errors
/// [`DatasetError::BadId`] for an id that could leave the root.
#[cfg(feature = "download")]
pub(crate) fn minari_folder(root: &Path, id: &str) -> Result<PathBuf> {
    minari_ids::folder(root, id)
}

/// How to get what is not there.
fn help(name: &str, roots: &SearchRoots) -> String {
    let mut lines: Vec<String> = published(name)
        .iter()
        .map(|id| format!("ksim dataset download {id}"))
        .collect();
    if let Some(known) = d4rl_names::known(name) {
        // For machines where something else has to fetch it.
        lines.push(format!(
            "or put {} into $D4RL_DATASET_DIR (default ~/.d4rl/datasets)",
            known.url()
        ));
    }
    if !lines.is_empty() {
        return format!("to get it:\n  {}", lines.join("\n  "));
    }
    let here = list(roots);
    let here = registry::alike(name, here.iter().map(|dataset| dataset.id.as_str()));
    if !here.is_empty() {
        return format!("on this machine, did you mean:\n  {}", here.join("\n  "));
    }
    let published = registry::alternatives(name);
    if !published.is_empty() {
        return format!(
            "nor is it published; did you mean:\n  {}",
            published.join("\n  ")
        );
    }
    "no published dataset of this name is known; `ksim dataset list --known` shows those that are"
        .to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A pair of roots with some datasets in them.
    fn roots(minari: &[&str], d4rl: &[&str]) -> (tempfile::TempDir, SearchRoots) {
        let dir = tempfile::tempdir().unwrap();
        let roots = SearchRoots {
            minari: Some(dir.path().join("minari")),
            d4rl: Some(dir.path().join("d4rl")),
        };
        for id in minari {
            let data = dir.path().join("minari").join(id).join("data");
            std::fs::create_dir_all(&data).unwrap();
            std::fs::write(data.join("metadata.json"), "{}").unwrap();
        }
        std::fs::create_dir_all(dir.path().join("d4rl")).unwrap();
        for file in d4rl {
            std::fs::write(dir.path().join("d4rl").join(file), "").unwrap();
        }
        (dir, roots)
    }

    fn found(name: &str, roots: &SearchRoots) -> String {
        resolve(name, roots).map_or_else(|error| error.to_string(), |found| found.name)
    }

    #[test]
    fn short_names_take_the_newest_minari_version() {
        let (_dir, roots) = roots(
            &[
                "D4RL/antmaze/large-play-v1",
                "D4RL/pen/human-v2",
                "D4RL/pen/human-v10",
                "mujoco/hopper/medium-v0",
            ],
            &["hopper_medium-v2.hdf5"],
        );
        assert_eq!(
            found("antmaze-large-play", &roots),
            "D4RL/antmaze/large-play-v1"
        );
        assert_eq!(
            found("D4RL/antmaze/large-play-v1", &roots),
            "D4RL/antmaze/large-play-v1"
        );
        assert_eq!(
            found("D4RL/antmaze/large-play", &roots),
            "D4RL/antmaze/large-play-v1"
        );
        assert_eq!(found("pen-human", &roots), "D4RL/pen/human-v10");
        assert_eq!(found("pen-human-v2", &roots), "D4RL/pen/human-v2");
        assert_eq!(found("hopper-medium", &roots), "mujoco/hopper/medium-v0");
        assert_eq!(found("hopper-medium-v2", &roots), "hopper_medium-v2.hdf5");
    }

    #[test]
    fn a_versioned_name_of_both_stores_is_d4rls() {
        let (_dir, both) = roots(&["D4RL/pen/human-v1"], &["pen-human-v1.hdf5"]);
        assert_eq!(found("pen-human-v1", &both), "pen-human-v1.hdf5");
        let (_dir, one) = roots(&["D4RL/pen/human-v1"], &[]);
        assert_eq!(found("pen-human-v1", &one), "D4RL/pen/human-v1");
    }

    #[test]
    fn what_is_not_there_is_looked_for_and_explained() {
        let (_dir, roots) = roots(&[], &[]);
        let error = found("antmaze-large-play", &roots);
        assert!(
            error.contains("ksim dataset download D4RL/antmaze/large-play-v1"),
            "{error}"
        );
        assert!(error.contains("D4RL/antmaze/large-play-v*"), "{error}");
        let error = found("hopper-medium-expert-v2", &roots);
        assert!(
            error.contains("gym_mujoco_v2/hopper_medium_expert-v2.hdf5"),
            "{error}"
        );
        let error = found("no-such-thing", &roots);
        assert!(
            error.contains("no published dataset of this name is known"),
            "{error}"
        );
    }

    #[test]
    fn a_slip_of_the_keys_is_answered_by_what_is_here_then_by_what_is_published() {
        let (_dir, roots) = roots(&["lab/pick-cubes-v3"], &[]);
        let error = found("lab/pick-cubse", &roots);
        assert!(
            error.contains("did you mean:\n  lab/pick-cubes-v3"),
            "{error}"
        );
        let error = found("antmaze-large-pley", &roots);
        assert!(error.contains("D4RL/antmaze/large-play-v1"), "{error}");
    }

    #[test]
    fn ids_that_could_leave_the_root_are_refused() {
        let (_dir, roots) = roots(&["a/b-v0"], &[]);
        for id in [
            "a/../b-v0",
            "D4RL/../../x-v1",
            "a\\b-v0",
            "a//b-v0",
            "a/b-v0/",
            "caf\u{e9}-v0",
            "a b-v0",
            "",
            "x/..",
            "a/.-v0",
        ] {
            assert!(
                matches!(resolve(id, &roots), Err(DatasetError::BadId { .. })),
                "{id}: {:?}",
                resolve(id, &roots)
            );
        }
        assert!(matches!(
            resolve("a\0-v0", &roots),
            Err(DatasetError::BadId { .. })
        ));
        // These are paths, and as such looked for as they are.
        for path in ["../x-v0", "/etc/x-v0", "./x"] {
            assert!(
                matches!(
                    resolve(path, &roots).unwrap_err().cause(),
                    DatasetError::Io { .. }
                ),
                "{path}"
            );
        }
    }

    #[cfg(unix)]
    #[test]
    fn a_link_out_of_the_root_is_refused() {
        let (dir, roots) = roots(&["inside-v0"], &[]);
        let outside = dir.path().join("outside");
        std::fs::create_dir_all(outside.join("data")).unwrap();
        std::fs::write(outside.join("data/metadata.json"), "{}").unwrap();
        std::os::unix::fs::symlink(&outside, dir.path().join("minari/linked-v0")).unwrap();
        assert!(matches!(
            resolve("linked-v0", &roots),
            Err(DatasetError::BadId { .. })
        ));
    }

    #[test]
    fn the_variables_win_over_the_home() {
        let home = Some(PathBuf::from("/home/x"));
        let roots = SearchRoots::from_vars(Some("/data".into()), Some("".into()), home);
        assert_eq!(roots.minari, Some(PathBuf::from("/data")));
        assert_eq!(roots.d4rl, Some(PathBuf::from("/home/x/.d4rl/datasets")));
        assert_eq!(
            SearchRoots::from_vars(None, None, None),
            SearchRoots::default()
        );
    }
}
