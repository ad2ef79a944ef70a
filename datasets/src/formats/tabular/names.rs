//! The names of columns, given or usual.

use crate::schema;

/// Names of the columns of a Parquet or Arrow IPC file. Episode ids may be integers, or text: then episodes are numbered from
/// 0 as they appear and the text is kept under `info`. What is left empty is detected by the usual names:
/// `episode_index|episode_id|episode`, `step_index|step|frame_index|timestep`,
/// `observation|observations|obs|state` or all of `observation.*`, `action|actions|act` or all of `action.*`,
/// `reward|rewards`, `terminated|terminals|terminations|done`, `truncated|timeouts|truncations`.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct ColumnNames {
    /// Observation columns, concatenated in this order.
    pub observation: Vec<String>,
    /// Action columns, concatenated in this order.
    pub action: Vec<String>,
    /// Episode number.
    pub episode: Option<String>,
    /// Step inside the episode.
    pub step: Option<String>,
    /// Reward.
    pub reward: Option<String>,
    /// Flag: the task ended.
    pub terminated: Option<String>,
    /// Flag: the episode was cut.
    pub truncated: Option<String>,
}

pub(super) const EPISODE: &[&str] = &[schema::EPISODE_INDEX, "episode_id", "episode"];
pub(super) const STEP: &[&str] = &[schema::STEP_INDEX, "step", "frame_index", "timestep"];
pub(super) const OBSERVATION: &[&str] = &[schema::OBSERVATION, "observations", "obs"];
pub(super) const OBSERVATION_LAST: &[&str] = &["state"];
pub(super) const ACTION: &[&str] = &[schema::ACTION, "actions", "act"];
pub(super) const REWARD: &[&str] = &[schema::REWARD, "rewards"];
pub(super) const TERMINATED: &[&str] = &[schema::TERMINATED, "terminals", "terminations", "done"];
pub(super) const TRUNCATED: &[&str] = &[schema::TRUNCATED, "timeouts", "truncations"];
