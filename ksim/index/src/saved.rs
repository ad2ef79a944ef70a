//! An index as it is used.

use std::fs::File;
use std::path::Path;

use bytemuck::Pod;
use ksim::{Buffer, EpisodeRows, KMeans, Matrix, Normalizer, Reference, RoundedRows, Trajectories};

use crate::about::About;
use crate::error::IndexError;
use crate::format::{self, CELLS, Entry, ROWS};
use crate::limit::{LIMIT, Limiter};
use crate::mapping::Mapping;

/// Bytes whose checksum is taken at a time before their memory is given back.
const VERIFIED_AT_A_TIME: usize = 64 << 20;

/// Files up to so many bytes stay in memory once they are looked at.
const KEPT: usize = 1 << 30;

/// An opened index: mapped, its frame checked. Sections are checked when they are asked for.
#[derive(Debug)]
pub struct SavedIndex {
    mapping: Mapping,
    entries: Vec<Entry>,
    about: About,
    /// Of a large file, keeps memory within bounds.
    _limiter: Option<Limiter>,
}

/// A section, for people.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SectionInfo {
    /// Its name.
    pub name: String,
    /// Its bytes.
    pub n_bytes: u64,
}

impl SavedIndex {
    /// Opens an index and checks its frame and what it says about itself.
    ///
    /// # Errors
    /// Another kind of file, another version, one that is truncated or damaged.
    pub fn open(path: &Path) -> Result<Self, IndexError> {
        let file = File::open(path).map_err(IndexError::io("open the index"))?;
        let about = file.metadata().map_err(IndexError::io("open the index"))?;
        if !about.is_file() || about.len() == 0 {
            return Err(IndexError::NotAnIndex);
        }
        let mapping = Mapping::new(&file).map_err(IndexError::io("map the index"))?;
        let entries = format::read(mapping.bytes())?;
        let limiter = (mapping.bytes().len() > KEPT).then(|| Limiter::start(LIMIT));
        if let Some(limiter) = &limiter {
            limiter.add(&mapping);
        }
        let mut index = Self {
            _limiter: limiter,
            mapping,
            entries,
            about: About::default(),
        };
        let json = index.verified("about")?;
        let entry = index.entry("about")?;
        index.about = serde_json::from_slice(json).map_err(|_| damaged(entry))?;
        Ok(index)
    }

    /// What it was made from.
    pub fn about(&self) -> &About {
        &self.about
    }

    /// Its sections, in their order.
    pub fn sections(&self) -> Vec<SectionInfo> {
        let info = |entry: &Entry| SectionInfo {
            name: entry.name.clone(),
            n_bytes: entry.len,
        };
        self.entries.iter().map(info).collect()
    }

    /// Bytes of the file.
    pub fn n_bytes(&self) -> usize {
        self.mapping.bytes().len()
    }

    /// Checks every section against its checksum.
    ///
    /// # Errors
    /// [`IndexError::Damaged`], with the section.
    pub fn verify(&self) -> Result<(), IndexError> {
        self.entries.iter().try_for_each(|entry| self.check(entry))
    }

    /// The normalized reference, checked. Its values stay in the file.
    ///
    /// # Errors
    /// Sections that are missing, damaged, or do not go together.
    pub fn reference(&self) -> Result<Reference, IndexError> {
        let statistics = |mean, std| {
            let (mean, std) = (self.values::<f64>(mean)?, self.values::<f64>(std)?);
            Ok::<_, IndexError>(Normalizer::from_statistics(mean.to_vec(), std.to_vec())?)
        };
        let states = statistics("state.mean", "state.std")?;
        let actions = statistics("action.mean", "action.std")?;
        let matrix = |high, low, normalizer: &Normalizer| {
            let (high, low) = (self.values(high)?, self.values(low)?);
            Ok::<_, IndexError>(Matrix::from_planes(high, low, normalizer.mean().len())?)
        };
        let normalized = Trajectories::from_parts(
            matrix("state.high", "state.low", &states)?,
            matrix("action.high", "action.low", &actions)?,
            self.episodes()?,
        )?;
        Ok(Reference::from_normalized(normalized, (states, actions))?)
    }

    /// Recorded step numbers by row, where they do not count from 0 in every episode.
    ///
    /// # Errors
    /// A section that is damaged or has not one number for each row.
    pub fn numbers(&self) -> Result<Option<Vec<i64>>, IndexError> {
        if !self.has("numbers") {
            return Ok(None);
        }
        let numbers = self.values::<i64>("numbers")?;
        match numbers.len() == self.about.dataset.n_steps {
            true => Ok(Some(numbers.to_vec())),
            false => Err(damaged(self.entry("numbers")?)),
        }
    }

    /// The clusters, checked; `None` if it has none.
    ///
    /// # Errors
    /// Sections that are missing, damaged, or do not go together.
    pub fn clusters(&self) -> Result<Option<KMeans>, IndexError> {
        let Some(about) = &self.about.clusters else {
            return Ok(None);
        };
        let inertia = self.number("inertia")?;
        let fitted = KMeans::from_fit(
            self.values::<f64>("centers")?.to_vec(),
            self.about.state_columns.len(),
            self.values::<u32>("labels")?.to_vec(),
            inertia,
            (about.n_iterations, about.converged),
        )?;
        Ok(Some(fitted))
    }

    /// The states rounded for exact search, checked; `None` if it holds none.
    ///
    /// # Errors
    /// Sections that are missing or damaged.
    pub fn rounded_rows(&self) -> Result<Option<RoundedRows>, IndexError> {
        self.rounded(&ROWS)
    }

    /// The states rounded for the search in clusters, checked; `None` without clusters.
    ///
    /// # Errors
    /// Sections that are missing or damaged.
    pub fn rounded_clusters(&self) -> Result<Option<RoundedRows>, IndexError> {
        self.rounded(&CELLS)
    }

    fn rounded(&self, names: &[&'static str; 8]) -> Result<Option<RoundedRows>, IndexError> {
        let [scale, strips, order, starts, errors, clipped, levels, norm] = *names;
        if !self.has(scale) {
            return Ok(None);
        }
        Ok(Some(RoundedRows {
            scale: self.values::<f64>(scale)?.to_vec(),
            strips: self.values(strips)?,
            order: self.values(order)?,
            block_starts: self.values(starts)?,
            block_errors: self.values(errors)?,
            block_clipped: self.values(clipped)?,
            levels: self.values(levels)?,
            max_norm: self.number(norm)?,
        }))
    }

    /// A section of one number.
    fn number(&self, name: &'static str) -> Result<f64, IndexError> {
        match *self.values::<f64>(name)? {
            [value] => Ok(value),
            _ => Err(damaged(self.entry(name)?)),
        }
    }

    fn episodes(&self) -> Result<Vec<EpisodeRows>, IndexError> {
        let numbers = self.values::<i64>("episodes")?;
        let (episodes, rest) = numbers.as_chunks::<3>();
        let row = |value: i64| usize::try_from(value).ok();
        let read: Option<Vec<EpisodeRows>> = episodes
            .iter()
            .map(|&[episode_index, start, end]| {
                let rows = row(start)?..row(end)?;
                Some(EpisodeRows {
                    episode_index,
                    rows,
                })
            })
            .collect();
        match read {
            Some(read) if rest.is_empty() => Ok(read),
            _ => Err(damaged(self.entry("episodes")?)),
        }
    }

    fn has(&self, name: &str) -> bool {
        self.entries.iter().any(|entry| entry.name == name)
    }

    fn entry(&self, name: &'static str) -> Result<&Entry, IndexError> {
        let found = self.entries.iter().find(|entry| entry.name == name);
        found.ok_or(IndexError::NoSection { name })
    }

    /// A section as numbers, checked.
    fn values<T: Pod>(&self, name: &'static str) -> Result<Buffer<T>, IndexError> {
        let entry = self.entry(name)?;
        self.check(entry)?;
        let bytes = self.mapping.share(range(entry));
        Ok(Buffer::lent(bytes)?)
    }

    fn verified(&self, name: &'static str) -> Result<&[u8], IndexError> {
        let entry = self.entry(name)?;
        self.check(entry)?;
        Ok(&self.mapping.bytes()[range(entry)])
    }

    fn check(&self, entry: &Entry) -> Result<(), IndexError> {
        let mut hasher = blake3::Hasher::new();
        let all = range(entry);
        for start in all.clone().step_by(VERIFIED_AT_A_TIME) {
            let part = start..(start + VERIFIED_AT_A_TIME).min(all.end);
            hasher.update_rayon(&self.mapping.bytes()[part.clone()]);
            if self.n_bytes() > KEPT {
                self.mapping.release(part);
            }
        }
        match *hasher.finalize().as_bytes() == entry.hash {
            true => Ok(()),
            false => Err(damaged(entry)),
        }
    }
}

/// Where a section lies: within the file, as [`format::read`] has checked.
fn range(entry: &Entry) -> std::ops::Range<usize> {
    entry.offset as usize..(entry.offset + entry.len) as usize
}

fn damaged(entry: &Entry) -> IndexError {
    IndexError::Damaged {
        part: format!("section `{}`", entry.name),
        offset: entry.offset,
    }
}
