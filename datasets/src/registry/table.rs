//! The tables as they are compiled in.

use super::{Family, Known, Store};

const D4RL: &str = include_str!("d4rl.tsv");
const MINARI: &str = include_str!("minari.tsv");

/// The parsed tables.
pub(super) struct Tables {
    pub(super) known: Vec<Known>,
    pub(super) families: Vec<Family>,
}

impl Tables {
    /// Parses both tables. A malformed line is left out; a test sees to it that there is none.
    pub(super) fn parse() -> Self {
        let mut known: Vec<Known> = lines(D4RL).filter_map(d4rl).collect();
        known.extend(
            lines(MINARI)
                .filter(|line| !is_family(line))
                .filter_map(minari),
        );
        let families = lines(MINARI)
            .filter(|line| is_family(line))
            .filter_map(family);
        Self {
            known,
            families: families.collect(),
        }
    }
}

fn lines(table: &'static str) -> impl Iterator<Item = &'static str> {
    table.lines().filter(|line| !line.starts_with('#'))
}

fn is_family(line: &str) -> bool {
    line.contains('*')
}

/// Exactly `N` fields between tabs.
fn fields<const N: usize>(line: &'static str) -> Option<[&'static str; N]> {
    let fields: Vec<&str> = line.split('\t').collect();
    fields.try_into().ok()
}

fn d4rl(line: &'static str) -> Option<Known> {
    let [id, path, bytes, sha256, low, high, deprecated, note] = fields(line)?;
    Some(Known {
        id,
        store: Store::D4rl,
        path,
        bytes: number(bytes)?,
        sha256: text(sha256),
        n_steps: None,
        n_episodes: None,
        ref_min_score: number(low)?,
        ref_max_score: number(high)?,
        is_deprecated: flag(deprecated)?,
        note: text(note),
    })
}

fn minari(line: &'static str) -> Option<Known> {
    let [id, n_steps, n_episodes, deprecated, note] = fields(line)?;
    Some(Known {
        id,
        store: Store::Minari,
        path: id,
        bytes: None,
        sha256: None,
        n_steps: number(n_steps)?,
        n_episodes: number(n_episodes)?,
        ref_min_score: None,
        ref_max_score: None,
        is_deprecated: flag(deprecated)?,
        note: text(note),
    })
}

fn family(line: &'static str) -> Option<Family> {
    let [pattern, _, _, _, note] = fields(line)?;
    Some(Family {
        pattern,
        store: Store::Minari,
        note,
    })
}

fn text(field: &'static str) -> Option<&'static str> {
    (!field.is_empty()).then_some(field)
}

/// An empty field is `Some(None)`, one that is no number `None`.
fn number<T: std::str::FromStr>(field: &str) -> Option<Option<T>> {
    match field {
        "" => Some(None),
        _ => field.parse().ok().map(Some),
    }
}

fn flag(field: &str) -> Option<bool> {
    match field {
        "" => Some(false),
        "deprecated" => Some(true),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn every_line_is_well_formed() {
        let tables = Tables::parse();
        let n_lines = lines(D4RL).count() + lines(MINARI).count();
        assert_eq!(tables.known.len() + tables.families.len(), n_lines);
        for known in &tables.known {
            let id = known.id;
            assert!(crate::resolve::is_versioned_id(id), "{id}");
            assert!(
                known
                    .path
                    .split('/')
                    .all(|part| !part.is_empty() && part != ".."),
                "{id}"
            );
            assert_eq!(known.bytes.is_some(), known.sha256.is_some(), "{id}");
            let is_sha256 = |hash: &str| {
                hash.len() == 64 && hash.bytes().all(|b| matches!(b, b'0'..=b'9' | b'a'..=b'f'))
            };
            assert!(known.sha256.is_none_or(is_sha256), "{id}");
            assert_eq!(
                known.ref_min_score.is_some(),
                known.ref_max_score.is_some(),
                "{id}"
            );
            assert!(
                known.ref_min_score.is_none() || known.ref_min_score < known.ref_max_score,
                "{id}"
            );
            assert_eq!(
                known.path.ends_with(".hdf5"),
                known.store == Store::D4rl,
                "{id}"
            );
        }
    }

    #[test]
    fn ids_and_file_names_are_unique() {
        let tables = Tables::parse();
        let ids: BTreeSet<&str> = tables.known.iter().map(|known| known.id).collect();
        assert_eq!(ids.len(), tables.known.len());
        let files: Vec<&str> = tables.known.iter().filter_map(Known::file_name).collect();
        assert_eq!(files.iter().collect::<BTreeSet<_>>().len(), files.len());
    }

    #[test]
    fn sizes_and_scores_are_those_that_were_published() {
        let tables = Tables::parse();
        let find = |id: &str| tables.known.iter().find(|known| known.id == id).copied();
        let pen = find("pen-human-v1").unwrap();
        assert_eq!(pen.bytes, Some(2_040_573));
        assert_eq!(pen.ref_min_score, Some(96.262799));
        assert_eq!(pen.ref_max_score, Some(3076.8331017826877));
        let n_checked = tables
            .known
            .iter()
            .filter(|known| known.sha256.is_some())
            .count();
        assert_eq!(n_checked, 38);
        assert!(find("antmaze-medium-play-v2").unwrap().sha256.is_none());
        assert!(find("antmaze-large-play-v0").unwrap().is_deprecated);
    }
}
