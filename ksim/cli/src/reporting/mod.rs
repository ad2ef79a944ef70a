//! From scored rollouts to the page of `ksim report`.

mod facts;
mod map;

use std::path::Path;

use anyhow::{Result, bail};
use ksim_bench_harness::figure::Palettes;
use ksim_bench_harness::page::{
    EpisodeFacts, Goals, Group, HeldOut, HeldOutPart, Histogram, Kept, MAX_EPISODES, Page,
    ReferencePart, Scored, StepColumns, stride, worst,
};
use ksim_datasets::DatasetSource;
use ksim_envs::maze::Maze;
use serde_json::Value;

use self::facts::Facts;
use self::map::{Drawn, Fault};
use crate::context::Context;
use crate::document::Document;
use crate::pairing::Listed;
use crate::scoring::{Job, RolloutFile, ScoredRollouts, Session};
use crate::table;

/// What a page is made of.
pub(crate) struct Request<'a> {
    /// The job.
    pub(crate) job: &'a Job,
    /// Its files, and the dataset.
    pub(crate) session: &'a Session,
    /// The maze that the rollouts went through.
    pub(crate) maze: Option<Maze>,
    /// Whether it was asked for, so that it is an error if nothing can be drawn in it.
    pub(crate) needs_positions: bool,
    /// Progress.
    pub(crate) context: &'a Context,
}

/// Whether a page can hold what was opened, before anything is read: its episodes, and positions if they are needed.
pub(crate) fn check(
    dataset: &dyn DatasetSource,
    files: &[RolloutFile],
    (job, needs_positions): (&Job, bool),
) -> Result<()> {
    if needs_positions {
        let listed = Listed::new(&job.rollout_options, &job.dataset_options);
        let sources = files.iter().map(|file| &*file.source).chain([dataset]);
        for source in sources {
            map::positions_of(source, (dataset, listed)).map_err(Fault::in_full)?;
        }
    }
    let mut n_episodes = 0;
    for file in files {
        n_episodes += match file.source.info().n_episodes {
            Some(n_episodes) => usize::try_from(n_episodes)?,
            None => file.source.episodes()?.len(),
        };
        if n_episodes > MAX_EPISODES {
            bail!(
                "{}: with it there are {n_episodes} episodes, a page holds {MAX_EPISODES}: take fewer, \
                 such as by `ksim convert --episodes`",
                file.name
            );
        }
    }
    Ok(())
}

/// Collects everything that the page shows.
///
/// # Errors
/// Step numbers that a page cannot hold; what the readers and the engine object to.
pub(crate) fn page(request: &Request<'_>) -> Result<Page> {
    let session = request.session;
    let numbers = session.reference_numbers().values().unwrap_or_default();
    if let Some(number) = numbers.iter().find(|number| is_too_large(**number)) {
        bail!(
            "{}: a step has number {number}, {EXPECTED_NUMBERS}",
            session.dataset().info().path.display()
        );
    }
    let (rollouts, document) = score(request)?;
    let reference_number =
        |row: usize, position: usize| session.reference_numbers().number(row, position);
    let numbers: Vec<_> = rollouts
        .iter()
        .map(|one| move |row: usize, position: usize| one.steps.number(row, position))
        .collect();
    let scored: Vec<Scored<'_>> = rollouts
        .iter()
        .zip(&numbers)
        .map(|(one, number)| Scored {
            ksim: session.ksim(),
            trajectories: &one.steps.trajectories,
            report: &one.report,
            number,
            reference_number: &reference_number,
        })
        .collect();
    assemble(request, &rollouts, &scored, &document)
}

/// Scripts count in doubles, and charts need room between two numbers.
const MAX_STEP_NUMBER: u64 = 1_000_000_000_000_000;
const EXPECTED_NUMBERS: &str = "a page holds numbers up to 10^15";

fn is_too_large(number: i64) -> bool {
    number.unsigned_abs() > MAX_STEP_NUMBER
}

/// Scores all rollouts, and names the dataset for others to read.
fn score(request: &Request<'_>) -> Result<(Vec<ScoredRollouts>, Document)> {
    let session = request.session;
    let mut rollouts: Vec<ScoredRollouts> = Vec::new();
    let results = session.score(request.job, request.context, &mut |scored| {
        for episode in scored.steps.trajectories.episodes() {
            let mut rows = episode.rows.clone();
            let number = |row: usize| scored.steps.number(row, row - episode.rows.start);
            if let Some(row) = rows.find(|row| is_too_large(number(*row))) {
                bail!(
                    "{}: episode {}: a step has number {}, {EXPECTED_NUMBERS}",
                    session.files()[scored.file].name,
                    episode.episode_index,
                    number(row)
                );
            }
        }
        rollouts.push(scored);
        Ok(())
    })?;
    let mut document = session.document(results, request.context);
    document.dataset.name = document.dataset.public_name();
    Ok((rollouts, document))
}

fn assemble(
    request: &Request<'_>,
    rollouts: &[ScoredRollouts],
    scored: &[Scored<'_>],
    document: &Document,
) -> Result<Page> {
    let Request { job, session, .. } = request;
    let labels = table::labels(&document.results);
    let lengths: Vec<usize> = scored
        .iter()
        .flat_map(|one| one.episodes().map(|episode| episode.rows.len()))
        .collect();
    let stride = stride(&lengths);
    let kept: Vec<Kept> = scored.iter().map(|one| Kept::new(one, stride)).collect();
    let facts = facts::collect(session, rollouts)?;
    let drawn = Drawn::new(request, (scored, &kept), rollouts)?;
    let working = request
        .context
        .spinner("holding out demonstrations".to_owned());
    let held_out = HeldOut::score(session.ksim(), job.settings.seed);
    drop(working);
    let histogram = histogram(scored, held_out.as_ref().ok(), job.settings.gamma);
    let mut reference = ReferencePart::default();
    let group = |(place, one): (usize, &Scored<'_>)| {
        let novelty = facts[place].novelty.as_deref();
        let places = drawn.places(place);
        Group {
            label: labels[place].clone(),
            episodes: episodes(one, &facts[place], drawn.goals(place)),
            histogram: histogram.counts(distances(one)),
            steps: StepColumns::new(one, &kept[place], &places, novelty, &mut reference),
        }
    };
    let groups = scored.iter().enumerate().map(group).collect();
    let mut notes = notes(lengths.iter().sum(), stride);
    notes.extend(drawn.notes.iter().cloned());
    Ok(Page {
        format: Page::FORMAT,
        title: title(&labels, &document.dataset.name),
        document: stripped(document, session)?,
        groups,
        histogram,
        held_out_missing: match &held_out {
            Ok(_) => String::new(),
            Err(why) => format!("No demonstrations are held out to compare with: {why}."),
        },
        held_out: held_out
            .ok()
            .map(|held| held_out_part(&held, &scored[0], job, &histogram)),
        reference,
        map: drawn.map,
        palettes: Palettes::default(),
        worst: worst(scored, session.state_names()),
        notes,
    })
}

/// d/√d of all steps.
fn distances<'a>(scored: &'a Scored<'_>) -> impl Iterator<Item = f64> + 'a {
    scored
        .report
        .steps
        .iter()
        .map(|step| scored.scaled(step)[0])
}

fn histogram(scored: &[Scored<'_>], held_out: Option<&HeldOut>, gamma: f64) -> Histogram {
    let held = held_out.into_iter().flat_map(|held| &held.report.steps);
    let held = held.map(|step| scored[0].scaled(step)[0]);
    Histogram::covering(scored.iter().flat_map(distances).chain(held), gamma)
}

fn held_out_part(
    held: &HeldOut,
    any: &Scored<'_>,
    job: &Job,
    histogram: &Histogram,
) -> HeldOutPart {
    let report = &held.report;
    HeldOutPart {
        n_episodes: report.episodes.len(),
        n_steps: report.steps.len(),
        seed: job.settings.seed,
        k_sim: report.state_action.pooled,
        mean_scaled_distance: report.mean_scaled_distance,
        histogram: histogram.counts(report.steps.iter().map(|step| any.scaled(step)[0])),
    }
}

fn episodes(scored: &Scored<'_>, facts: &Facts, goals: Option<Goals>) -> EpisodeFacts {
    let all = &scored.report.episodes;
    EpisodeFacts {
        episode_index: all.iter().map(|one| one.episode_index).collect(),
        n_steps: all.iter().map(|one| one.n_steps).collect(),
        k_sim: all.iter().map(|one| one.k_sim).collect(),
        k_sim_state: all.iter().map(|one| one.k_sim_state).collect(),
        k_sim_action: all.iter().map(|one| one.k_sim_action).collect(),
        saturated_share: all.iter().map(|one| one.saturated_share).collect(),
        mean_scaled_distance: all.iter().map(|one| one.mean_scaled_distance).collect(),
        total_return: known(&facts.total_return),
        success: known(&facts.success),
        goals,
    }
}

/// The values, if there are any.
fn known<T: Copy>(values: &[Option<T>]) -> Option<Vec<Option<T>>> {
    values.iter().any(Option::is_some).then(|| values.to_vec())
}

/// `K-Sim of a.parquet, b.parquet and 3 more against NAME`.
fn title(labels: &[String], dataset: &str) -> String {
    const NAMED: usize = 4;
    let named = match labels {
        few if few.len() <= NAMED => few.join(", "),
        many => format!(
            "{} and {} more",
            many[..NAMED].join(", "),
            many.len() - NAMED
        ),
    };
    format!("K-Sim of {named} against {dataset}")
}

/// The document without what is elsewhere on the page, what differs from run to run, and places on the machine.
fn stripped(document: &Document, session: &Session) -> Result<Value> {
    let mut value = serde_json::to_value(document)?;
    let sources = session.files().iter().map(|file| &*file.source);
    let sources = sources.chain([session.dataset()]);
    let mut paths: Vec<&Path> = sources.map(|source| &*source.info().path).collect();
    // The folder of one may be a part of another.
    paths.sort_by_key(|path| std::cmp::Reverse(path.as_os_str().len()));
    remove(&mut value, &["threads", "elapsed_s"]);
    for (part, names) in [("dataset", &["path"]), ("search", &["index"])] {
        if let Some(part) = value.get_mut(part) {
            remove(part, names);
        }
    }
    if let Some(Value::String(file)) = value.pointer_mut("/search/clusters/centers_file") {
        *file = last_part(Path::new(file));
    }
    if let Some(texts) = value.pointer_mut("/dataset/warnings") {
        without_folders(texts, &paths);
    }
    let results = value.get_mut("results").and_then(Value::as_array_mut);
    for result in results.into_iter().flatten() {
        remove(result, &["file", "episodes", "elapsed_s"]);
        if let Some(texts) = result.get_mut("warnings") {
            without_folders(texts, &paths);
        }
    }
    Ok(value)
}

fn remove(part: &mut Value, names: &[&str]) {
    if let Some(fields) = part.as_object_mut() {
        fields.retain(|name, _| !names.contains(&name.as_str()));
    }
}

/// Texts in which files are named without where they lie.
fn without_folders(texts: &mut Value, paths: &[&Path]) {
    for text in texts.as_array_mut().into_iter().flatten() {
        if let Value::String(text) = text {
            for path in paths {
                *text = text.replace(&*path.to_string_lossy(), &last_part(path));
            }
        }
    }
}

/// The name of a file without its folder.
fn last_part(path: &Path) -> String {
    let last = path.file_name().unwrap_or(path.as_os_str());
    last.to_string_lossy().into_owned()
}

fn notes(n_steps: usize, stride: usize) -> Vec<String> {
    let mut notes = vec![
        "Tables have the numbers of `ksim score --format json`, shown to four decimals; the full number is \
         behind every cell. Distances of single steps are kept in single precision, and their K-Sim is computed \
         from them. Places on the map are kept to 1/65535 of its width."
            .to_owned(),
    ];
    if stride > 1 {
        notes.push(format!(
            "There are {n_steps} steps, too many for one page: of every {stride} steps of an episode it has the one \
             farthest from the data. Aggregates, histograms and the worst steps are of all steps."
        ));
    }
    notes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn texts_name_files_without_where_they_lie() {
        let mut texts = serde_json::json!(["lost: /srv/set/data/1.parquet: damaged", "other"]);
        let paths = ["/srv/set", "rollouts"].map(Path::new);
        without_folders(&mut texts, &paths);
        assert_eq!(
            texts,
            serde_json::json!(["lost: set/data/1.parquet: damaged", "other"])
        );
    }
}
