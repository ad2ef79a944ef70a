//! Listing and checking the demonstrations of a file.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::Arc;

use super::shift::is_shifted;
use crate::error::{DatasetError, Result};
use crate::formats::hdf5::{
    Array, ColumnSource, Element, EpisodeRows, H5File, MemberKind, RowRule, StepColumn,
    array_paths, join, members,
};
use crate::schema;
use crate::source::Warning;

pub(super) const DATA: &str = "data";
const DEMO: &str = "demo_";
pub(super) const OBS: &str = "obs/";
pub(super) const NEXT_OBS: &str = "next_obs/";
const ACTIONS: &str = "actions";
const REWARDS: &str = "rewards";
const DONES: &str = "dones";
const STATES: &str = "states";

/// A demonstration.
pub(super) struct Demo {
    /// `demo_3`.
    pub(super) name: String,
    /// Its group: `data/demo_3`.
    pub(super) group: String,
    pub(super) rows: EpisodeRows,
}

/// Whether a file has demonstrations.
pub(crate) fn is_robomimic(path: &Path) -> bool {
    let has_demos = || -> Result<bool> {
        let file = H5File::open(path)?;
        if !file.root().link_exists(DATA) {
            return Ok(false);
        }
        let listed = members(&file.group(DATA)?, DATA)?;
        Ok(listed
            .iter()
            .any(|member| member.kind == MemberKind::Group && number(&member.name).is_some()))
    };
    has_demos().unwrap_or(false)
}

/// The number of a demonstration, by its name.
fn number(name: &str) -> Option<i64> {
    let number: i64 = name.strip_prefix(DEMO)?.parse().ok()?;
    (number >= 0 && format!("{DEMO}{number}") == name).then_some(number)
}

/// The demonstrations and their columns.
#[derive(Default)]
pub(super) struct Demos {
    pub(super) list: Vec<Demo>,
    pub(super) columns: Vec<StepColumn>,
    pub(super) warnings: Vec<Warning>,
    /// Paths of the arrays that columns are made of, and of the next observations.
    keys: BTreeSet<String>,
    /// Episodes whose next observations are not those of the next row, by path.
    unshifted: BTreeMap<String, u64>,
    /// Paths that only some demonstrations have.
    extra: BTreeSet<String>,
}

impl Demos {
    /// Lists a file. With `recover`, demonstrations that are damaged are left out.
    ///
    /// # Errors
    /// There is none, or one is damaged.
    pub(super) fn new(file: &H5File, recover: bool) -> Result<Self> {
        let mut demos = Self::default();
        let names = demos.names(file)?;
        for (number, name) in names {
            let group = join(DATA, &name);
            let added = demos.add(file, number, &name, &group);
            match added {
                Err(error) if recover => demos.warnings.push(Warning::Lost {
                    what: format!("{name} ({error})"),
                }),
                other => other?,
            }
        }
        if demos.columns.is_empty() {
            return Err(DatasetError::MissingKey {
                key: format!("{DATA}/{DEMO}0"),
                found: "no demonstration that can be read".to_owned(),
            });
        }
        demos.finish(file)
    }

    /// The demonstrations by number: numbers may have gaps, and the library has `demo_10` before `demo_2`.
    fn names(&mut self, file: &H5File) -> Result<Vec<(i64, String)>> {
        let mut names = Vec::new();
        for member in members(&file.group(DATA)?, DATA)? {
            match number(&member.name).filter(|_| member.kind == MemberKind::Group) {
                Some(number) => names.push((number, member.name)),
                None => self.left_out(join(DATA, &member.name), "it is no demonstration"),
            }
        }
        names.sort_unstable();
        Ok(names)
    }

    fn left_out(&mut self, column: String, reason: &'static str) {
        self.warnings
            .push(Warning::ColumnLeftOut { column, reason });
    }

    fn add(&mut self, file: &H5File, episode_index: i64, name: &str, group: &str) -> Result<()> {
        let paths: BTreeSet<String> = array_paths(file, group)?.into_iter().collect();
        let found = || {
            paths
                .iter()
                .map(String::as_str)
                .collect::<Vec<_>>()
                .join(", ")
        };
        let missing = |key: &str| DatasetError::MissingKey {
            key: join(group, key),
            found: found(),
        };
        if !paths.contains(ACTIONS) {
            return Err(missing(ACTIONS));
        }
        let n_steps = Array::length(file.root(), &join(group, ACTIONS))?;
        if self.columns.is_empty() {
            if !paths.iter().any(|path| path.starts_with(OBS)) {
                return Err(missing("obs"));
            }
            check_lengths(
                file,
                group,
                paths.iter().filter(|path| has_steps(path)),
                n_steps,
            )?;
            self.structure(file, group, &paths, n_steps)?;
        }
        if let Some(key) = self
            .keys
            .difference(&paths)
            .find(|key| !key.starts_with(NEXT_OBS))
        {
            return Err(missing(key));
        }
        check_lengths(file, group, self.keys.intersection(&paths), n_steps)?;
        for path in self.unshifted_in(file, group, &paths)? {
            *self.unshifted.entry(path).or_default() += 1;
        }
        self.extra.extend(paths.difference(&self.keys).cloned());
        let has_next = |key: &str| {
            let next = format!("{NEXT_OBS}{key}");
            paths.contains(&next) && self.keys.contains(&next)
        };
        let has_final_obs = self
            .keys
            .iter()
            .filter_map(|key| key.strip_prefix(OBS))
            .all(has_next);
        self.list.push(Demo {
            name: name.to_owned(),
            group: group.to_owned(),
            rows: EpisodeRows {
                episode_index,
                n_steps,
                has_final_obs,
            },
        });
        Ok(())
    }

    /// The next observations of a demonstration that are not those of the next row.
    fn unshifted_in(
        &self,
        file: &H5File,
        group: &str,
        paths: &BTreeSet<String>,
    ) -> Result<Vec<String>> {
        let known = self.keys.intersection(paths);
        let mut unshifted = Vec::new();
        for path in known.filter(|path| path.starts_with(NEXT_OBS)) {
            if !is_shifted(file, group, path)? {
                unshifted.push(path.clone());
            }
        }
        Ok(unshifted)
    }

    /// The columns, as the first demonstration has them; next observations are decided on at the end.
    fn structure(
        &mut self,
        file: &H5File,
        group: &str,
        paths: &BTreeSet<String>,
        n_steps: u64,
    ) -> Result<()> {
        let (mut columns, mut keys) = (Vec::new(), BTreeSet::new());
        let mut others = Vec::new();
        for path in paths {
            let (name, rule) = match path.strip_prefix(OBS) {
                Some(key) => (nested(schema::OBSERVATION, key), RowRule::Observation),
                None if path == ACTIONS => (schema::ACTION.to_owned(), RowRule::Step),
                None if path == REWARDS => (schema::REWARD.to_owned(), RowRule::Step),
                None if path == DONES => (nested(schema::INFO, "done"), RowRule::Step),
                None if path.starts_with(NEXT_OBS) => {
                    keys.insert(path.clone());
                    continue;
                }
                None => (nested(schema::INFO, path), RowRule::Step),
            };
            let is_info = schema::belongs_to(&name, schema::INFO);
            let column = match column(file, group, path, name, rule) {
                Err(DatasetError::WrongType { .. } | DatasetError::ShapeMismatch { .. })
                    if is_info =>
                {
                    self.left_out(path.clone(), "its type or shape cannot be a column");
                    continue;
                }
                column => column?,
            };
            if Array::length(file.root(), &join(group, path))? != n_steps {
                self.left_out(path.clone(), "it does not have one row per step");
                continue;
            }
            keys.insert(path.clone());
            if is_info { &mut others } else { &mut columns }.push(column);
        }
        // Observations first, then action and reward.
        columns.sort_by_key(|column: &StepColumn| column.source.rule != RowRule::Observation);
        columns.append(&mut others);
        (self.columns, self.keys) = (columns, keys);
        Ok(())
    }

    /// Adds columns for the next observations that say more than the observations do.
    fn finish(mut self, file: &H5File) -> Result<Self> {
        let is_final = |demo: &Demo| demo.rows.has_final_obs;
        let n_without = self.list.iter().filter(|demo| !is_final(demo)).count() as u64;
        let next: Vec<String> = self
            .keys
            .iter()
            .filter(|key| key.starts_with(NEXT_OBS))
            .cloned()
            .collect();
        let first = self.list.first().map(|demo| demo.group.clone());
        let (Some(first), false) = (first, next.is_empty()) else {
            return Ok(self.without_extra());
        };
        if n_without > 0 {
            self.warnings.push(Warning::NoFinalObservation {
                n_episodes: n_without,
            });
        }
        let mut columns = Vec::new();
        for path in next {
            let n_episodes = self.unshifted.get(&path).copied().unwrap_or(0);
            if n_episodes == 0 && n_without == 0 {
                continue;
            }
            let name = nested(
                schema::NEXT_OBSERVATION,
                path.strip_prefix(NEXT_OBS).unwrap_or(&path),
            );
            if n_episodes > 0 {
                let column = name.clone();
                self.warnings
                    .push(Warning::NextObservationDiffers { column, n_episodes });
            }
            columns.push(column(file, &first, &path, name, RowRule::Info)?);
        }
        let place = self
            .columns
            .iter()
            .position(|column| schema::belongs_to(column.field.name(), schema::INFO));
        let place = place.unwrap_or(self.columns.len());
        self.columns.splice(place..place, columns);
        Ok(self.without_extra())
    }

    fn without_extra(mut self) -> Self {
        for path in std::mem::take(&mut self.extra) {
            let told =
                |w: &Warning| matches!(w, Warning::ColumnLeftOut { column, .. } if *column == path);
            if !self.warnings.iter().any(told) {
                self.left_out(path, "the first demonstration does not have it");
            }
        }
        self
    }
}

/// Whether an array must have a row per step, in any file.
fn has_steps(path: &str) -> bool {
    path.starts_with(OBS)
        || path.starts_with(NEXT_OBS)
        || [ACTIONS, REWARDS, DONES, STATES].contains(&path)
}

/// `root.a.b` for `a/b`.
fn nested(root: &str, path: &str) -> String {
    path.split('/').fold(root.to_owned(), |parent, part| {
        schema::join_key(&parent, part)
    })
}

fn column(
    file: &H5File,
    group: &str,
    path: &str,
    name: String,
    rule: RowRule,
) -> Result<StepColumn> {
    let array = file.array(&join(group, path))?;
    let shape_error = |expected: &str| DatasetError::ShapeMismatch {
        key: array.key().to_owned(),
        actual: array.row_shape().to_vec(),
        expected: expected.to_owned(),
    };
    let element = array.element();
    if element == Element::Bytes || (element == Element::Text && !array.row_shape().is_empty()) {
        return Err(DatasetError::WrongType {
            key: array.key().to_owned(),
            actual: element.numpy_name().to_owned(),
            expected: "numbers, flags or one text a row",
        });
    }
    if array.width() == 0 {
        return Err(shape_error("at least one value a row"));
    }
    let is_reward = name == schema::REWARD;
    if is_reward && !array.is_column() {
        return Err(shape_error("one value a row"));
    }
    let shape: &[usize] = if is_reward { &[] } else { array.row_shape() };
    let nullable = rule != RowRule::Observation;
    Ok(StepColumn {
        field: Arc::new(schema::leaf_field(
            &name,
            element.data_type(),
            shape,
            nullable,
        )),
        source: ColumnSource {
            key: path.to_owned(),
            element,
            width: array.width(),
            rule,
        },
    })
}

fn check_lengths<'p>(
    file: &H5File,
    group: &str,
    paths: impl IntoIterator<Item = &'p String>,
    expected: u64,
) -> Result<()> {
    for path in paths {
        let key = join(group, path);
        let actual = Array::length(file.root(), &key)?;
        if actual != expected {
            return Err(DatasetError::LengthMismatch {
                key,
                actual,
                expected,
            });
        }
    }
    Ok(())
}
