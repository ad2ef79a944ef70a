//! What a D4RL file says of itself, and what of the source it cannot say.

use hdf5_metno as hdf5;
use serde_json::{Map, Value};

use super::walk::METADATA;
use super::write_plan::{Next, Plan};
use crate::episode::EpisodeEnd;
use crate::error::{DatasetError, Result};
use crate::formats::hdf5::{join, write_attribute, write_scalar};
use crate::schema;
use crate::sink::{Loss, LossEffect, SinkInput, WriteOptions};

/// Attributes of episodes that say what the rows say.
const DERIVED: [&str; 3] = ["id", "total_steps", "seed"];

/// Whether the source is a D4RL file.
pub(super) fn is_d4rl(input: &SinkInput<'_>) -> bool {
    let format = input.schema.metadata().get(schema::SOURCE_FORMAT);
    format.map(String::as_str) == Some(crate::format::Format::D4rlHdf5.name())
}

/// Whether there must be time-outs: D4RL's rules count steps where there are none. A D4RL file that had none
/// gets none, unless an episode in it would be joined to the next.
pub(super) fn needs_timeouts(input: &SinkInput<'_>, plan: &Plan) -> bool {
    let before_last = input
        .episodes
        .split_last()
        .map_or(&[][..], |(_, rest)| rest);
    let unflagged = before_last
        .iter()
        .any(|episode| episode.end != EpisodeEnd::Terminated);
    plan.truncated.is_some() || !is_d4rl(input) || unflagged
}

/// What of episodes the format does not hold.
pub(super) fn note_episodes(
    input: &SinkInput<'_>,
    options: &WriteOptions,
    plan: &Plan,
    losses: &mut Vec<Loss>,
) {
    let mut lost = |item: &str, effect, detail: &str, count: Option<u64>| {
        if count != Some(0) {
            let mut loss = Loss::new(item, effect, detail);
            loss.count = count;
            losses.push(loss);
        }
    };
    let count = |is: &dyn Fn(&crate::episode::EpisodeRecord) -> bool| {
        Some(input.episodes.iter().filter(|episode| is(episode)).count() as u64)
    };
    let n_final = count(&|episode| episode.has_final_obs);
    match plan.next {
        Next::Recorded(_) => {
            let detail = "the source's own next observations are kept in their place";
            lost("final observations", LossEffect::Dropped, detail, n_final);
        }
        _ => {
            let detail = "they are the last next_observations of their episodes";
            lost("final observations", LossEffect::Changed, detail, n_final);
        }
    }
    let no_place = "D4RL has no place for them";
    let n_seeds = count(&|episode| episode.seed.is_some());
    lost("seeds", LossEffect::Dropped, no_place, n_seeds);
    let has_more = |attributes: &Map<String, Value>| {
        attributes
            .keys()
            .any(|key| !DERIVED.contains(&key.as_str()))
    };
    let n_attributes = count(&|episode| has_more(&episode.attributes));
    lost(
        "episode attributes",
        LossEffect::Dropped,
        no_place,
        n_attributes,
    );
    let n_renumbered = (0i64..)
        .zip(input.episodes)
        .filter(|(number, episode)| *number != episode.episode_index)
        .count() as u64;
    let counted = "D4RL counts episodes from 0";
    lost(
        "episode numbers",
        LossEffect::Changed,
        counted,
        Some(n_renumbered),
    );
    if plan.reward.is_none() {
        let detail = "D4RL demands rewards: all are 0";
        lost(schema::REWARD, LossEffect::Invented, detail, None);
    }
    if plan.terminated.is_none() {
        let detail = "D4RL demands terminals: none of the steps is one";
        lost(schema::TERMINATED, LossEffect::Invented, detail, None);
    }
    let has = |key: &str| input.schema.metadata().contains_key(key);
    if has(schema::SPACE_OBSERVATION) || has(schema::SPACE_ACTION) {
        lost("spaces", LossEffect::Dropped, no_place, None);
    }
    if input.info.env_spec.is_some() || has(schema::ENV_SPEC) {
        lost("env_spec", LossEffect::Dropped, no_place, None);
    }
    if options.id.is_some() {
        let detail = "D4RL files are named by their file";
        lost("dataset id", LossEffect::Dropped, detail, None);
    }
}

/// Writes the order of joined leaves as attributes of the file, and what a D4RL source says in `metadata`.
///
/// # Errors
/// A failed write, or metadata that are no JSON.
pub(super) fn describe(
    file: &hdf5::File,
    input: &SinkInput<'_>,
    plan: &Plan,
    losses: &mut Vec<Loss>,
) -> Result<()> {
    for (name, concat) in [
        ("observations_layout", &plan.observation),
        ("actions_layout", &plan.action),
    ] {
        if let Some(layout) = concat.layout() {
            write_attribute(file, name, &Value::from(layout.to_string()))?;
        }
    }
    let Some(text) = input.schema.metadata().get(schema::SOURCE_METADATA) else {
        return Ok(());
    };
    let metadata = match serde_json::from_str(text) {
        Ok(Value::Object(metadata)) => metadata,
        // Recordings have a list, one entry for each file.
        Ok(_) => {
            let detail = "only single values of D4RL's own are kept";
            losses.push(Loss::new(METADATA, LossEffect::Dropped, detail));
            return Ok(());
        }
        Err(source) => {
            let what = schema::SOURCE_METADATA.to_owned();
            return Err(DatasetError::Json { what, source });
        }
    };
    let mut left_out = Vec::new();
    match is_d4rl(input) {
        true => write_metadata(file, METADATA, &metadata, &mut left_out)?,
        false => left_out.extend(metadata.keys().cloned()),
    }
    if !left_out.is_empty() {
        let detail = format!(
            "only single values of D4RL's own are kept; not {}",
            left_out.join(", ")
        );
        losses.push(Loss::new(METADATA, LossEffect::Dropped, detail));
    }
    Ok(())
}

/// Writes single values, nested as they were; notes the others.
fn write_metadata(
    file: &hdf5::File,
    key: &str,
    fields: &Map<String, Value>,
    left_out: &mut Vec<String>,
) -> Result<()> {
    for (name, value) in fields {
        let path = join(key, name);
        match value {
            // An array that is too large to be read as metadata is described by its shape.
            Value::Object(inner) if inner.keys().ne(["shape"]) => {
                write_metadata(file, &path, inner, left_out)?;
            }
            value => {
                if !write_scalar(file, &path, value)? {
                    left_out.push(path);
                }
            }
        }
    }
    Ok(())
}
