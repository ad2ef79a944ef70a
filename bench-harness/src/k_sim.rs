//! K-Sim of what is played, as it is played.

use ksim::{KSim, Report, ScoreError, Trajectories};
use ksim_datasets::{
    DatasetError, DatasetInfo, DatasetSource, ObservationLayout, TransitionOptions,
    TransitionReader,
};
use ksim_envs::EnvironmentSpec;
use serde::Serialize;

use crate::record::EpisodeTrace;
use crate::stats::{BootstrapOptions, Estimate, bootstrap_mean};

/// Why K-Sim cannot be computed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum KSimError {
    /// The dataset cannot be read.
    #[error(transparent)]
    Dataset(#[from] DatasetError),
    /// Its numbers cannot be used.
    #[error(transparent)]
    Data(#[from] ksim::DataError),
    /// It cannot be scored against.
    #[error(transparent)]
    Score(#[from] ScoreError),
    /// The environment observes or does something else than the dataset holds.
    #[error(
        "dataset \"{dataset}\" has {what} of {found}, environment `{environment}` has {expected}"
    )]
    Columns {
        /// The dataset.
        dataset: String,
        /// The environment.
        environment: String,
        /// `observations` or `actions`.
        what: &'static str,
        /// The environment's parts with their widths.
        expected: String,
        /// The dataset's.
        found: String,
    },
}

/// A dataset that episodes are scored against: the paper's definition, all state columns, exact search.
#[derive(Debug)]
pub struct Reference {
    ksim: KSim,
    /// Id of the dataset.
    dataset: String,
    /// Hash of what the score depends on.
    fingerprint: String,
    /// For every state column of the dataset, its place in an observation of the environment.
    places: Vec<usize>,
    action_dim: usize,
}

/// K-Sim of one episode.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct EpisodeKSim {
    /// Mean of the scores of its steps.
    pub k_sim: f64,
    /// Number of its steps.
    pub n_steps: usize,
    /// Share of its steps with score 1.
    pub saturated_share: f64,
    /// Mean of d/√d, which does not saturate.
    pub mean_scaled_distance: f64,
}

/// K-Sim of several episodes.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct KSimSummary {
    /// Mean over all steps: K-Sim as the paper defines it.
    pub k_sim: f64,
    /// Mean of the episodes' means, with a bootstrap interval over episodes.
    pub k_sim_episode_mean: Estimate,
    /// Share of steps with score 1.
    pub saturated_share: f64,
    /// Mean over all steps of d/√d.
    pub mean_scaled_distance: f64,
}

impl KSimSummary {
    /// Summarizes episodes; `None` if there are none.
    pub fn new(episodes: &[EpisodeKSim]) -> Option<Self> {
        let means: Vec<f64> = episodes.iter().map(|episode| episode.k_sim).collect();
        let n_steps: usize = episodes.iter().map(|episode| episode.n_steps).sum();
        let pooled = |value: fn(&EpisodeKSim) -> f64| {
            let weighted = episodes
                .iter()
                .map(|episode| value(episode) * episode.n_steps as f64);
            weighted.sum::<f64>() / n_steps as f64
        };
        Some(Self {
            k_sim: pooled(|episode| episode.k_sim),
            k_sim_episode_mean: bootstrap_mean(&means, &BootstrapOptions::default())?,
            saturated_share: pooled(|episode| episode.saturated_share),
            mean_scaled_distance: pooled(|episode| episode.mean_scaled_distance),
        })
    }
}

impl Reference {
    /// Reads a dataset and builds the search.
    ///
    /// # Errors
    /// It cannot be read, or does not hold what the environment observes and does.
    pub fn fit(
        source: &dyn DatasetSource,
        environment: &EnvironmentSpec,
    ) -> Result<Self, KSimError> {
        let places = places(source.info(), environment)?;
        let reader = TransitionReader::new(source, &TransitionOptions::default())?;
        let (state_dim, action_dim) = (reader.state_width(), reader.action_width());
        let mut data = Trajectories::new(state_dim, action_dim)?;
        for batch in reader {
            let batch = batch?;
            let mut start = 0;
            for run in batch.episode_index.chunk_by(|a, b| a == b) {
                let end = start + run.len();
                data.push(
                    run[0],
                    &batch.states[start * state_dim..end * state_dim],
                    &batch.actions[start * action_dim..end * action_dim],
                )?;
                start = end;
            }
        }
        let fingerprint = data.fingerprint();
        Ok(Self {
            // Intervals are taken over the episodes of all cells, not here.
            ksim: KSim::params().n_resamples(0).fit(data)?,
            dataset: source.info().id.clone(),
            fingerprint,
            places,
            action_dim,
        })
    }

    /// Id of the dataset.
    pub fn dataset(&self) -> &str {
        &self.dataset
    }

    /// Hash of the dataset's states, actions and episodes.
    pub fn fingerprint(&self) -> &str {
        &self.fingerprint
    }

    /// Scores one episode.
    ///
    /// # Errors
    /// A trace without steps or with numbers that are not finite.
    pub fn score(&self, trace: &EpisodeTrace) -> Result<(EpisodeKSim, Report), KSimError> {
        let n_steps = trace.rewards.len();
        let width = trace.observations.len() / (n_steps + 1);
        let mut states = Vec::with_capacity(n_steps * self.places.len());
        for observation in trace.observations.chunks_exact(width.max(1)).take(n_steps) {
            states.extend(self.places.iter().map(|&place| observation[place]));
        }
        let mut steps = Trajectories::new(self.places.len(), self.action_dim)?;
        steps.push(0, &states, &trace.actions)?;
        let report = self.ksim.score(&steps)?;
        let of_episode = EpisodeKSim {
            k_sim: report.state_action.pooled,
            n_steps,
            saturated_share: report.saturated_share,
            mean_scaled_distance: report.mean_scaled_distance,
        };
        Ok((of_episode, report))
    }
}

/// For every state column of a dataset, its place in an observation of the environment: by the names of its parts, by
/// position where there is a single one on either side.
fn places(info: &DatasetInfo, environment: &EnvironmentSpec) -> Result<Vec<usize>, KSimError> {
    let layout = ObservationLayout::new(&info.observation);
    let actions = ObservationLayout::new(&info.action);
    let refuse = |what, expected, found| KSimError::Columns {
        dataset: info.id.clone(),
        environment: environment.id.clone(),
        what,
        expected,
        found,
    };
    if actions.width() != environment.action_dim() {
        let (expected, found) = (environment.action_dim(), actions.width());
        return Err(refuse("actions", expected.to_string(), found.to_string()));
    }
    let different = || {
        let parts = environment.observation.iter();
        let leaves = layout.leaves().iter();
        let expected = listed(parts.map(|part| (part.name, part.width)));
        let found = listed(leaves.map(|leaf| (leaf.name.as_str(), leaf.width)));
        refuse("observations", expected, found)
    };
    if layout.width() != environment.observation_dim() {
        return Err(different());
    }
    if layout.leaves().len() == 1 || environment.observation.len() == 1 {
        return Ok((0..layout.width()).collect());
    }
    let mut places = Vec::with_capacity(layout.width());
    for leaf in layout.leaves() {
        let mut offset = 0;
        let part = environment.observation.iter().find(|part| {
            let is_it = part.name == leaf.name;
            offset += if is_it { 0 } else { part.width };
            is_it
        });
        match part {
            Some(part) if part.width == leaf.width => places.extend(offset..offset + part.width),
            _ => return Err(different()),
        }
    }
    Ok(places)
}

/// `achieved_goal (2), observation (27)`.
fn listed<'a>(parts: impl Iterator<Item = (&'a str, usize)>) -> String {
    let parts: Vec<String> = parts
        .map(|(name, width)| format!("{name} ({width})").trim_start().to_owned())
        .collect();
    parts.join(", ")
}

#[cfg(test)]
mod tests {
    use arrow::datatypes::DataType;
    use ksim_datasets::{Format, LeafKind, LeafSpec, OpenOptions, WriteOptions};
    use ksim_envs::toy::point_mass;
    use ksim_envs::{Environment as _, Part, ResetOptions};

    use super::*;
    use crate::error::HarnessError;
    use crate::policy::Random;
    use crate::recording::{About, ActionPrecision, Recording};
    use crate::rollout::{Continue, Observer, RolloutConfig, rollout};

    struct Keep(Vec<EpisodeTrace>);

    impl Observer for Keep {
        fn episode(&mut self, trace: EpisodeTrace) -> Result<Continue, HarnessError> {
            self.0.push(trace);
            Ok(Continue::Yes)
        }
    }

    fn played(seed: u64) -> Vec<EpisodeTrace> {
        let one = Box::new(point_mass(None)) as _;
        let mut environments = ksim_envs::vector::VectorEnvironment::new(vec![one]).unwrap();
        let config = RolloutConfig {
            n_episodes: 3,
            n_runs: 1,
            seed,
            discount: 1.0,
            reset: ResetOptions::default(),
            reference: None,
        };
        let mut policy = Random::new(environments.spec());
        let mut keep = Keep(Vec::new());
        rollout(&mut environments, &mut policy, &config, &mut keep).unwrap();
        keep.0
    }

    #[test]
    fn the_recorded_episodes_themselves_score_1_and_others_less() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("data.parquet");
        let environment = point_mass(None);
        let spec = environment.spec();
        let mut recording =
            Recording::start(spec, &[], ActionPrecision::Double, folder.path()).unwrap();
        let own = played(0);
        for trace in &own {
            recording.add(trace).unwrap();
        }
        let options = WriteOptions::default();
        recording
            .finish(&file, Format::Parquet, &About::default(), &options)
            .unwrap();
        let source = ksim_datasets::open(&file, &OpenOptions::default()).unwrap();
        let reference = Reference::fit(source.as_ref(), spec).unwrap();
        let (score, report) = reference.score(&own[1]).unwrap();
        assert_eq!((score.k_sim, score.saturated_share), (1.0, 1.0));
        assert_eq!(score.n_steps, own[1].rewards.len());
        assert_eq!(report.steps.len(), score.n_steps);
        let others: Vec<EpisodeKSim> = played(50)
            .iter()
            .map(|trace| reference.score(trace).unwrap().0)
            .collect();
        assert!(others.iter().all(|score| score.mean_scaled_distance > 0.0));
        let summary = KSimSummary::new(&others).unwrap();
        let n_steps: usize = others.iter().map(|score| score.n_steps).sum();
        let pooled: f64 = others
            .iter()
            .map(|score| score.k_sim * score.n_steps as f64)
            .sum();
        assert!((summary.k_sim - pooled / n_steps as f64).abs() < 1e-12);
        assert_eq!(KSimSummary::new(&[]), None);
    }

    fn leaf(column: &str, width: usize) -> LeafSpec {
        LeafSpec {
            column: column.to_owned(),
            kind: LeafKind::Box,
            shape: vec![width],
            data_type: DataType::Float64,
        }
    }

    #[test]
    fn columns_go_together_by_the_names_of_their_parts() {
        let environment = point_mass(None);
        let mut spec = environment.spec().clone();
        let part = |name, width| Part { name, width };
        spec.observation = vec![part("achieved_goal", 2), part("observation", 3)];
        let mut info = DatasetInfo {
            id: "maze".to_owned(),
            format: Format::Parquet,
            path: "maze".into(),
            n_episodes: None,
            n_steps: None,
            observation: vec![
                leaf("observation.observation", 3),
                leaf("observation.achieved_goal", 2),
            ],
            action: vec![leaf("action", 1)],
            episode_rule: String::new(),
            boundaries_inferred: false,
            env_spec: None,
            metadata: serde_json::Map::new(),
            ref_min_score: None,
            ref_max_score: None,
            warnings: Vec::new(),
        };
        assert_eq!(places(&info, &spec).unwrap(), [2, 3, 4, 0, 1]);
        info.observation = vec![leaf("observation", 5)];
        assert_eq!(places(&info, &spec).unwrap(), [0, 1, 2, 3, 4]);
        info.observation = vec![
            leaf("observation.goal", 2),
            leaf("observation.observation", 3),
        ];
        let error = places(&info, &spec).unwrap_err().to_string();
        assert!(
            error.contains("observations of goal (2), observation (3)"),
            "{error}"
        );
        info.action = vec![leaf("action", 2)];
        assert!(
            places(&info, &spec)
                .unwrap_err()
                .to_string()
                .contains("actions of 2")
        );
    }
}
