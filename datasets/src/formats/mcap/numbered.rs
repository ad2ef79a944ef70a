//! Episodes of rows that carry their numbers ([`Grid::Index`](super::mapping::Grid::Index)), and whether they
//! are whole.

use std::collections::{BTreeMap, BTreeSet};

use super::Metadata;
use super::mapping::{Column, From, Index, Mapping, Missing, Role};
use super::plan::{Episode, Episodes};
use super::survey::{IndexRow, Survey};
use crate::episode::EpisodeRecord;
use crate::error::{DatasetError, Result};
use crate::schema;
use crate::source::Warning;

/// Metadata record of written recordings: which episodes there are, and how long.
pub(crate) const EPISODES_RECORD: &str = "ksim.episodes";
const EPISODES_ENTRY: &str = "json";
/// The topic whose messages are the rows, in written recordings.
pub(crate) const STEP_TOPIC: &str = "/step";
/// Lost episodes named one by one; of more, the number is told.
const MAX_NAMED: usize = 100;

/// Rows and steps of an episode when it was written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct Noted {
    n_rows: u64,
    n_steps: u64,
}

/// The metadata record that tells a reader whether it has all rows: `[[episode, rows, steps], ...]`.
pub(super) fn record(episodes: &[EpisodeRecord]) -> (&'static str, BTreeMap<String, String>) {
    let list: Vec<(i64, u64, u64)> = episodes
        .iter()
        .map(|episode| (episode.episode_index, episode.n_rows, episode.length))
        .collect();
    let text = serde_json::json!(list).to_string();
    let entries = BTreeMap::from([(EPISODES_ENTRY.to_owned(), text)]);
    (EPISODES_RECORD, entries)
}

/// What [`record`] noted, if the rows are those that a written recording numbers.
fn noted(metadata: &[Metadata], index: &Index) -> Result<Option<BTreeMap<i64, Noted>>> {
    if index.topic != STEP_TOPIC || index.episode != schema::EPISODE_INDEX {
        return Ok(None);
    }
    let found = metadata
        .iter()
        .find(|record| record.name == EPISODES_RECORD);
    let Some(text) = found.and_then(|record| record.entries.get(EPISODES_ENTRY)) else {
        return Ok(None);
    };
    let list: Vec<(i64, u64, u64)> =
        serde_json::from_str(text).map_err(|source| DatasetError::Json {
            what: EPISODES_RECORD.to_owned(),
            source,
        })?;
    let with_rows = list.into_iter().filter(|(_, n_rows, _)| *n_rows > 0);
    let notes = with_rows.map(|(number, n_rows, n_steps)| (number, Noted { n_rows, n_steps }));
    Ok(Some(notes.collect()))
}

/// The episodes of a recording whose rows are numbered. With `recover`, those that are not whole are left out.
///
/// # Errors
/// A row without number, numbers that come back, two rows at one time, and without `recover` a row without
/// sample or rows that are missing.
pub(super) fn episodes(
    survey: &Survey,
    mapping: &Mapping,
    index: &Index,
    recover: bool,
) -> Result<Episodes> {
    let noted = match noted(&survey.metadata, index) {
        Err(_) if recover => None,
        noted => noted?,
    };
    let is_lost = |warning: &Warning| matches!(warning, Warning::Lost { .. });
    let judge = Judge {
        survey,
        topics: topics(mapping, index),
        is_damaged: recover && survey.warnings.iter().any(is_lost),
        noted,
    };
    let runs = runs(survey, &index.topic)?;
    let mut out = Episodes::default();
    let mut faults = Vec::new();
    for (place, run) in runs.iter().enumerate() {
        let next = runs.get(place + 1).copied();
        let episode = judge.episode(run)?;
        match judge.check(&episode, run, next) {
            Ok(()) => out.episodes.push(episode),
            Err(fault) if recover => faults.push(format!("{}: {fault}", name(run))),
            Err(fault) => return Err(fault.into_error(run)),
        }
    }
    for (number, noted) in judge.absent(&runs) {
        let what = format!("episode {number}: 0 of {} rows", noted.n_rows);
        if !recover {
            return Err(DatasetError::corrupt(what));
        }
        faults.push(what);
    }
    if judge.is_damaged && judge.noted.is_none() {
        let what = "the recording does not say how many rows its episodes have: what is lost at the end of one may go unseen";
        faults.insert(0, what.to_owned());
    }
    let n_more = faults.len().saturating_sub(MAX_NAMED);
    faults.truncate(MAX_NAMED);
    if n_more > 0 {
        faults.push(format!("{n_more} more episodes"));
    }
    let lost = faults.into_iter().map(|what| Warning::Lost { what });
    out.lost = lost.collect();
    Ok(out)
}

fn name(run: &[IndexRow]) -> String {
    let number = run.first().map_or(0, |row| row.episode);
    format!("episode {number}")
}

/// The rows of each episode.
fn runs<'s>(survey: &'s Survey, topic: &str) -> Result<Vec<&'s [IndexRow]>> {
    let track = survey.tracks.get(topic);
    let n_messages = track.map_or(0, |track| track.times.len());
    if survey.rows.len() != n_messages {
        return Err(DatasetError::corrupt(format!(
            "\"{topic}\" has {n_messages} messages, but only {} number a row",
            survey.rows.len()
        )));
    }
    let mut seen = BTreeSet::new();
    let mut n_rows = 0;
    let mut runs = Vec::new();
    for run in survey.rows.chunk_by(|a, b| a.episode == b.episode) {
        let Some(first) = run.first() else {
            continue;
        };
        if !seen.insert(first.episode) {
            return Err(DatasetError::NonContiguousEpisode {
                column: schema::EPISODE_INDEX.to_owned(),
                row: n_rows,
                episode: first.episode,
            });
        }
        let mut pairs = run.iter().zip(run.iter().skip(1));
        if let Some((a, _)) = pairs.find(|(a, b)| a.time == b.time) {
            return Err(DatasetError::corrupt(format!(
                "two rows of episode {} are numbered at {} ns: columns match by time",
                a.episode, a.time
            )));
        }
        n_rows += run.len() as u64;
        runs.push(run);
    }
    Ok(runs)
}

/// Which rows need a message of a topic.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Need {
    /// A null may have been recorded.
    None,
    /// All but a final observation.
    Steps,
    All,
}

/// A topic beside that of the numbers.
struct Topic<'m> {
    name: &'m str,
    /// One of its columns.
    column: &'m str,
    need: Need,
    has_action: bool,
}

pub(super) fn is_step(column: &Column) -> bool {
    !matches!(column.role, Role::Observation | Role::Info)
}

fn topics<'m>(mapping: &'m Mapping, index: &Index) -> Vec<Topic<'m>> {
    let mut topics: Vec<Topic<'m>> = Vec::new();
    for column in &mapping.columns {
        let From::Topic(fields) = &column.from else {
            continue;
        };
        if fields.topic == index.topic {
            continue;
        }
        let need = match (is_step(column), fields.missing) {
            (true, _) => Need::Steps,
            (false, Missing::Error) => Need::All,
            (false, Missing::Null) => Need::None,
        };
        let has_action = column.role == Role::Action;
        match topics.iter_mut().find(|topic| topic.name == fields.topic) {
            // A topic that an observation and an action share speaks at every row.
            Some(topic) => {
                topic.need = topic.need.max(need);
                topic.has_action |= has_action;
            }
            None => topics.push(Topic {
                name: &fields.topic,
                column: &column.name,
                need,
                has_action,
            }),
        }
    }
    topics
}

/// Why an episode is not whole.
enum Fault {
    Rows(u64, u64),
    Steps(u64, u64),
    NoSample {
        topic: String,
        column: String,
        time: i64,
    },
    Unclear(&'static str),
}

impl std::fmt::Display for Fault {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Rows(found, noted) => write!(f, "{found} of {noted} rows"),
            Self::Steps(found, noted) => write!(f, "{found} of {noted} steps"),
            Self::NoSample { topic, time, .. } => {
                write!(f, "no message of \"{topic}\" at {time} ns")
            }
            Self::Unclear(why) => f.write_str(why),
        }
    }
}

impl Fault {
    fn into_error(self, run: &[IndexRow]) -> DatasetError {
        match self {
            Self::NoSample {
                topic,
                column,
                time,
            } => no_sample(topic, column, time),
            other => DatasetError::corrupt(format!("{}: {other}", name(run))),
        }
    }
}

pub(super) fn no_sample(topic: String, column: String, time_ns: i64) -> DatasetError {
    let source = Box::new(DatasetError::NoSample { column, time_ns });
    DatasetError::Topic { topic, source }
}

/// Tells whether episodes are whole.
struct Judge<'s> {
    survey: &'s Survey,
    topics: Vec<Topic<'s>>,
    /// Whether parts of the file were left out.
    is_damaged: bool,
    noted: Option<BTreeMap<i64, Noted>>,
}

impl Judge<'_> {
    fn noted(&self, run: &[IndexRow]) -> Option<Noted> {
        let noted = self.noted.as_ref()?;
        noted.get(&run.first()?.episode).copied()
    }

    fn episode(&self, run: &[IndexRow]) -> Result<Episode> {
        let (Some(first), Some(last)) = (run.first(), run.last()) else {
            return Err(DatasetError::corrupt("an episode without rows"));
        };
        let steps = || self.topics.iter().filter(|topic| topic.need == Need::Steps);
        let has_action = steps().any(|topic| topic.has_action);
        let mut markers = steps().filter(|topic| topic.has_action || !has_action);
        let noted = self.noted(run);
        let has_final = match steps().next() {
            Some(_) => markers.all(|topic| self.absent_row(topic, &[*last]).is_some()),
            // What marks a final observation is inside the messages.
            None => noted.is_some_and(|noted| {
                noted.n_rows == run.len() as u64 && noted.n_steps < noted.n_rows
            }),
        };
        Ok(Episode {
            number: Some(first.episode),
            start: first.time,
            end: last.time,
            rows: run.iter().map(|row| row.time).collect(),
            has_final,
            recorded: Some(run.iter().map(|row| (row.step, row.t_ns)).collect()),
            success: None,
            task: None,
        })
    }

    /// The first of some rows of an episode at which a topic is silent.
    fn absent_row<'r>(&self, topic: &Topic<'_>, rows: &'r [IndexRow]) -> Option<&'r IndexRow> {
        let (first, last) = (rows.first()?, rows.last()?);
        let Some(track) = self.survey.tracks.get(topic.name) else {
            return Some(first);
        };
        let times = track.times.get(track.range(first.time, last.time));
        let mut times = times.unwrap_or_default().iter().peekable();
        rows.iter().find(|row| {
            while times.next_if(|time| **time < row.time).is_some() {}
            times.peek() != Some(&&row.time)
        })
    }

    fn check(
        &self,
        episode: &Episode,
        run: &[IndexRow],
        next: Option<&[IndexRow]>,
    ) -> Result<(), Fault> {
        match (&self.noted, self.noted(run)) {
            (Some(_), Some(noted)) => {
                if noted.n_rows != run.len() as u64 {
                    return Err(Fault::Rows(run.len() as u64, noted.n_rows));
                }
            }
            (Some(_), None) => return Err(Fault::Unclear("it is not among those written")),
            (None, _) if self.is_damaged => check_steps(run, next)?,
            (None, _) => {}
        }
        self.check_samples(episode, run)?;
        match self.noted(run) {
            Some(noted) if noted.n_steps != episode.n_steps() => {
                Err(Fault::Steps(episode.n_steps(), noted.n_steps))
            }
            _ => Ok(()),
        }
    }

    fn check_samples(&self, episode: &Episode, run: &[IndexRow]) -> Result<(), Fault> {
        let n_steps = run.len() - usize::from(episode.has_final);
        let steps = run.get(..n_steps).unwrap_or_default();
        for topic in &self.topics {
            let rows = match topic.need {
                Need::All => run,
                Need::Steps => steps,
                // Whether a null was recorded or lost cannot be told.
                Need::None if self.is_damaged => steps,
                Need::None => continue,
            };
            if let Some(row) = self.absent_row(topic, rows) {
                return Err(Fault::NoSample {
                    topic: topic.name.to_owned(),
                    column: topic.column.to_owned(),
                    time: row.time,
                });
            }
        }
        Ok(())
    }

    /// Noted episodes of which no row was found.
    fn absent(&self, runs: &[&[IndexRow]]) -> Vec<(i64, Noted)> {
        let numbers = runs.iter().filter_map(|run| run.first());
        let found: BTreeSet<i64> = numbers.map(|row| row.episode).collect();
        let noted = self.noted.iter().flatten();
        let absent = noted.filter(|(number, _)| !found.contains(number));
        absent.map(|(number, noted)| (*number, *noted)).collect()
    }
}

/// Whether the numbers of a damaged recording leave no gap in an episode or after it.
fn check_steps(run: &[IndexRow], next: Option<&[IndexRow]>) -> Result<(), Fault> {
    if !run.iter().zip(0..).all(|(row, step)| row.step == step) {
        return Err(Fault::Unclear("steps are missing"));
    }
    let number = run.first().map(|row| row.episode);
    let follows = |next: &[IndexRow]| {
        let first = next.first();
        first.is_some_and(|row| row.step == 0 && row.episode.checked_sub(1) == number)
    };
    match next.is_some_and(follows) {
        true => Ok(()),
        false => Err(Fault::Unclear("its last steps may be missing")),
    }
}
