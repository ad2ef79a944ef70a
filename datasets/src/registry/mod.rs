//! Known datasets: where they are published, their sizes, checksums and reference scores.
//!
//! Two tables, compiled in: D4RL's files with the reference scores of D4RL's own tables and, where published, size
//! and SHA-256; Minari's datasets with their counts. Families with too many members to list are a [`Family`].
//! Nothing here touches a network.
//!
//! ```
//! use ksim_datasets::registry;
//!
//! let hopper = registry::find("hopper-medium-v2").expect("D4RL has it");
//! assert_eq!(hopper.file_name(), Some("hopper_medium-v2.hdf5"));
//! assert_eq!((hopper.ref_min_score, hopper.ref_max_score), (Some(-20.272305), Some(3234.3)));
//! ```

mod table;

use std::fmt;
use std::sync::LazyLock;

use table::Tables;

/// Who publishes a dataset, and in which layout.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Store {
    /// One HDF5 file below D4RL's base address.
    D4rl,
    /// A dataset folder in a Hugging Face repository of `farama-minari`.
    Minari,
}

impl Store {
    /// Stable name: `d4rl` or `minari`.
    pub fn name(self) -> &'static str {
        match self {
            Self::D4rl => "d4rl",
            Self::Minari => "minari",
        }
    }

    /// Where the store's datasets are published, without a slash at the end.
    pub fn base_url(self) -> &'static str {
        match self {
            Self::D4rl => "https://rail.eecs.berkeley.edu/datasets/offline_rl",
            Self::Minari => "https://huggingface.co",
        }
    }
}

impl fmt::Display for Store {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// A published dataset.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Known {
    /// Its full id: `hopper-medium-v2` (D4RL), `D4RL/antmaze/large-play-v1` (Minari).
    pub id: &'static str,
    /// Who publishes it.
    pub store: Store,
    /// Path below the store's base address; for Minari the id again.
    pub path: &'static str,
    /// Size of the file, where published.
    pub bytes: Option<u64>,
    /// SHA-256 of the file in lower-case hexadecimal, where published.
    pub sha256: Option<&'static str>,
    /// Number of steps, where published.
    pub n_steps: Option<u64>,
    /// Number of episodes, where published.
    pub n_episodes: Option<u64>,
    /// Return that counts as 0 in normalized scores of its environment.
    pub ref_min_score: Option<f64>,
    /// Return that counts as 1 in normalized scores of its environment.
    pub ref_max_score: Option<f64>,
    /// Whether its authors have replaced it by a newer version.
    pub is_deprecated: bool,
    /// Known faults, or what to use instead.
    pub note: Option<&'static str>,
}

impl Known {
    /// Name of the file in D4RL's folder; `None` for Minari, whose datasets are folders.
    pub fn file_name(&self) -> Option<&'static str> {
        match self.store {
            Store::D4rl => self.path.rsplit('/').next(),
            Store::Minari => None,
        }
    }

    /// Where it is published: the file for D4RL, the folder for people to look at for Minari.
    pub fn url(&self) -> String {
        let base = self.store.base_url();
        match self.store {
            Store::D4rl => format!("{base}/{}", self.path),
            Store::Minari => {
                let (repository, folder) = hub_place(self.id);
                let separator = if folder.is_empty() { "" } else { "/" };
                format!("{base}/datasets/{repository}/tree/main{separator}{folder}")
            }
        }
    }
}

/// Datasets that are published but not listed one by one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Family {
    /// Ids of its members; `*` stands for a part without `/`.
    pub pattern: &'static str,
    /// Who publishes them.
    pub store: Store,
    /// What the members are.
    pub note: &'static str,
}

impl Family {
    /// Whether an id has the form of a member; it may still not exist.
    pub fn matches(&self, id: &str) -> bool {
        matches(self.pattern, id)
    }
}

static TABLES: LazyLock<Tables> = LazyLock::new(Tables::parse);

/// All listed datasets: D4RL's, then Minari's, each in the order of their tables.
pub fn all() -> impl Iterator<Item = &'static Known> {
    TABLES.known.iter()
}

/// All families whose members are not listed.
pub fn families() -> impl Iterator<Item = &'static Family> {
    TABLES.families.iter()
}

/// The dataset of exactly this id.
pub fn find(id: &str) -> Option<&'static Known> {
    all().find(|known| known.id == id)
}

/// The D4RL dataset that is stored under this file name, or was saved as `<id>.hdf5`.
pub fn find_file(file_name: &str) -> Option<&'static Known> {
    let stem = file_name.strip_suffix(".hdf5");
    all().find(|known| {
        known.file_name() == Some(file_name)
            || (known.store == Store::D4rl && stem == Some(known.id))
    })
}

/// Ids of listed datasets one may have meant: other versions, and the same data in the other store; else those spelled
/// most alike, see [`alike`].
pub fn alternatives(id: &str) -> Vec<&'static str> {
    let wanted = words(id);
    let others = || all().map(|known| known.id).filter(|known| *known != id);
    let same: Vec<&str> = others()
        .filter(|known| !wanted.is_empty() && words(known) == wanted)
        .collect();
    if same.is_empty() {
        return alike(id, others());
    }
    same
}

/// Of some ids those that a name differs least from, stores and versions aside: by one slip of the keys in four letters,
/// two at most. In the order given.
pub fn alike<'a>(name: &str, ids: impl IntoIterator<Item = &'a str>) -> Vec<&'a str> {
    const MOST_SLIPS: usize = 2;
    let wanted = words(name).join("-");
    let most = MOST_SLIPS.min(wanted.chars().count() / 4);
    let slips = |id: &str| strsim::osa_distance(&wanted, &words(id).join("-"));
    let ids: Vec<(usize, &str)> = ids.into_iter().map(|id| (slips(id), id)).collect();
    let least = ids.iter().map(|(slips, _)| *slips).min();
    ids.into_iter()
        .filter(|(slips, _)| *slips <= most && Some(*slips) == least)
        .map(|(_, id)| id)
        .collect()
}

/// Whether `id` fits a pattern in which each `*` stands for any characters but `/`.
pub fn matches(pattern: &str, id: &str) -> bool {
    let Some((before, after)) = pattern.split_once('*') else {
        return pattern == id;
    };
    let Some(rest) = id.strip_prefix(before) else {
        return false;
    };
    let reach = rest.find('/').unwrap_or(rest.len());
    rest.char_indices()
        .map(|(at, _)| at)
        .chain([rest.len()])
        .take_while(|at| *at <= reach)
        .any(|at| matches(after, &rest[at..]))
}

/// Repository and folder in it of a Minari id; the folder is empty for an id without a namespace.
pub(crate) fn hub_place(id: &str) -> (String, &str) {
    let (repository, folder) = id.split_once('/').unwrap_or((id, ""));
    (format!("farama-minari/{repository}"), folder)
}

/// What an id says apart from store and version: `["antmaze", "large", "play"]`.
fn words(id: &str) -> Vec<&str> {
    let stem = match id.rsplit_once("-v") {
        Some((stem, digits)) if digits.bytes().all(|b| b.is_ascii_digit()) => stem,
        _ => id,
    };
    let stem = stem.strip_prefix("D4RL/").unwrap_or(stem);
    let stem = stem.strip_prefix("mujoco/").unwrap_or(stem);
    stem.split(['/', '-'])
        .filter(|word| !word.is_empty())
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stores_and_versions_are_alternatives() {
        assert_eq!(
            alternatives("antmaze-large-play-v2"),
            [
                "antmaze-large-play-v1",
                "antmaze-large-play-v0",
                "D4RL/antmaze/large-play-v1"
            ]
        );
        assert_eq!(
            alternatives("D4RL/pen/human-v1"),
            ["pen-human-v1", "pen-human-v0", "D4RL/pen/human-v2"]
        );
        assert!(alternatives("no-such-thing").is_empty());
        assert!(alternatives("").is_empty());
    }

    #[test]
    fn slips_of_the_keys_are_understood() {
        assert_eq!(
            alternatives("D4RL/pen/humna"),
            ["pen-human-v1", "pen-human-v0", "D4RL/pen/human-v2"]
        );
        assert_eq!(alternatives("hoper-medium-v2")[0], "hopper-medium-v2");
        // Too short to tell a slip from another name.
        assert!(alike("ant", ["and", "art"]).is_empty());
        assert_eq!(alike("ants", ["and", "ant", "art"]), ["ant"]);
        assert!(alike("door-human", ["door-cloned", "pen-human"]).is_empty());
    }

    #[test]
    fn a_star_stays_inside_its_part() {
        assert!(matches("atari/*/expert-v0", "atari/gopher/expert-v0"));
        assert!(!matches("atari/*/expert-v0", "atari/a/b/expert-v0"));
        assert!(!matches("atari/*/expert-v0", "atari/gopher/expert-v1"));
        assert!(matches("*hopper*", "hopper-medium-v2"));
        assert!(matches("*", "x"));
        assert!(!matches("hopper", "hopper-medium-v2"));
        assert!(families().any(|family| family.matches("minigrid/BabyAI-GoToObjS4/optimal-v0")));
    }

    #[test]
    fn minari_ids_have_their_place_on_the_hub() {
        assert_eq!(
            hub_place("D4RL/pen/human-v2"),
            ("farama-minari/D4RL".to_owned(), "pen/human-v2")
        );
        assert_eq!(hub_place("x-v0"), ("farama-minari/x-v0".to_owned(), ""));
        let url = find("D4RL/pen/human-v2").map(Known::url);
        let expected = "https://huggingface.co/datasets/farama-minari/D4RL/tree/main/pen/human-v2";
        assert_eq!(url.as_deref(), Some(expected));
    }

    #[test]
    fn files_lead_back_to_their_dataset() {
        for (file, id) in [
            ("hopper_medium_expert-v2.hdf5", "hopper-medium-expert-v2"),
            ("hopper-medium-expert-v2.hdf5", "hopper-medium-expert-v2"),
            ("walker_mixed.hdf5", "walker2d-medium-replay-v0"),
            ("minigrid4rooms.hdf5", "minigrid-fourrooms-v0"),
        ] {
            assert_eq!(find_file(file).map(|known| known.id), Some(id), "{file}");
        }
        assert!(find_file("mine.hdf5").is_none());
    }
}
