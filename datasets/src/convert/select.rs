//! Which columns and episodes to keep.

use std::ops::Range;
use std::sync::Arc;

use arrow::datatypes::{Schema, SchemaRef};

use super::space;
use crate::episode::EpisodeRecord;
use crate::error::{DatasetError, Result};
use crate::schema;

/// The columns that are kept.
pub(super) struct Selected {
    /// Their schema, with the spaces cut to the leaves that are left.
    pub(super) schema: SchemaRef,
    pub(super) names: Vec<String>,
    pub(super) left_out: Vec<String>,
}

/// # Errors
/// A name that is neither a column nor the root of one.
pub(super) fn columns(schema: &SchemaRef, wanted: Option<&[String]>) -> Result<Selected> {
    let Some(wanted) = wanted else {
        return Ok(Selected {
            schema: Arc::clone(schema),
            names: schema::all_names(schema),
            left_out: Vec::new(),
        });
    };
    for name in wanted {
        let fields = schema.fields();
        if !fields.iter().any(|f| schema::belongs_to(f.name(), name)) {
            return Err(DatasetError::MissingColumn {
                role: "dataset",
                name: format!("\"{name}\""),
                found: schema::column_names(schema),
            });
        }
    }
    let always = [schema::EPISODE_INDEX, schema::STEP_INDEX];
    let (names, left_out): (Vec<String>, Vec<String>) =
        schema::all_names(schema).into_iter().partition(|name| {
            always.contains(&name.as_str()) || wanted.iter().any(|w| schema::belongs_to(name, w))
        });
    let (projected, _) = schema::project(schema, Some(&names))?;
    let mut metadata = projected.metadata().clone();
    for column in &left_out {
        space::remove(&mut metadata, column);
    }
    let fields = projected.fields().clone();
    Ok(Selected {
        schema: Arc::new(Schema::new_with_metadata(fields, metadata)),
        names,
        left_out,
    })
}

/// # Errors
/// A range that holds no episode of the dataset.
pub(super) fn episodes(
    all: Vec<EpisodeRecord>,
    wanted: Option<&[Range<i64>]>,
) -> Result<Vec<EpisodeRecord>> {
    let Some(wanted) = wanted else {
        return Ok(all);
    };
    for range in wanted {
        if !all.iter().any(|e| range.contains(&e.episode_index)) {
            let (first, last) = (all.first(), all.last());
            return Err(DatasetError::NoSuchEpisode {
                wanted: range.clone(),
                found: match (first, last) {
                    (Some(first), Some(last)) => format!(
                        "{} episodes, {} to {}",
                        all.len(),
                        first.episode_index,
                        last.episode_index
                    ),
                    _ => "no episodes".to_owned(),
                },
            });
        }
    }
    let is_wanted = |e: &EpisodeRecord| wanted.iter().any(|r| r.contains(&e.episode_index));
    Ok(all.into_iter().filter(is_wanted).collect())
}
