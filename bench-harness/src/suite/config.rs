//! What is to be played.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use ksim_planners::{LoadOptions, Precision};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value};

use super::error::SuiteError;
use crate::planner_source::PlannerSource;
use crate::policy::PolicySpec;

/// A benchmark, as its TOML file says.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Suite {
    /// What it is called.
    pub name: String,
    /// Episodes of every run, at least 1.
    pub episodes: usize,
    /// Repetitions over which seeds go on, at least 1.
    #[serde(default = "one")]
    pub runs: usize,
    /// Seed of the first episode.
    #[serde(default)]
    pub seed: u64,
    /// Discount of the discounted return.
    #[serde(default = "discount")]
    pub discount: f64,
    /// Where to play.
    #[serde(rename = "environment")]
    pub environments: Vec<EnvironmentEntry>,
    /// Who plays.
    #[serde(rename = "planner")]
    pub planners: Vec<PlannerEntry>,
    /// Folder that the paths of runs start from: that of the file.
    #[serde(skip)]
    pub folder: PathBuf,
}

/// An environment of a benchmark.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EnvironmentEntry {
    /// What it is called in tables and file names.
    pub name: String,
    /// Id of the environment; without one, that on which the dataset's policies are judged.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub env: Option<String>,
    /// Dataset that K-Sim is measured against; also gives reference returns, and the environment if none is named.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub dataset: Option<String>,
    /// Whether to measure K-Sim; needs a dataset.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub k_sim: Option<bool>,
    /// Keyword arguments of the environment.
    #[serde(default, skip_serializing_if = "Map::is_empty")]
    pub env_args: Map<String, Value>,
    /// Time limit in steps.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub max_steps: Option<usize>,
    /// Maze cell (row, column) of the goal.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub goal_cell: Option<(usize, usize)>,
    /// Maze cell (row, column) of the start.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reset_cell: Option<(usize, usize)>,
    /// Name of the task in the paper's tables, such as `antmaze-medium-play`; by default as the dataset is called.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub paper: Option<String>,
}

/// A planner, or a policy, of a benchmark. `{environment}` and `{dataset}` in its source stand for the environment's.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlannerEntry {
    /// What it is called in tables and file names.
    pub name: String,
    /// As `--planner` of `ksim rollout` takes it; paths of runs start from the folder of the suite.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub source: Option<String>,
    /// As `--policy` takes it, instead of a source.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub policy: Option<String>,
    /// Environments that it plays in; all if there are none.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub environments: Vec<String>,
    /// Steps between two plans.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub replan_interval: Option<std::num::NonZeroUsize>,
    /// Candidates of every plan.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub candidates: Option<usize>,
    /// Weight of guidance.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub guidance: Option<f64>,
    /// Weight of curiosity.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub curiosity: Option<f64>,
    /// Denoising steps.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sampling_steps: Option<usize>,
    /// Factor of the initial noise.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub temperature: Option<f64>,
    /// Share of the diffusion time at which a plan starts from the one before.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub warm_start: Option<f64>,
    /// Who computes the networks.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub backend: Option<String>,
    /// Where.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub device: Option<String>,
    /// How numbers are computed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub precision: Option<Precision>,
}

fn one() -> usize {
    1
}

fn discount() -> f64 {
    0.99
}

impl Suite {
    /// Reads and checks a file.
    ///
    /// # Errors
    /// It cannot be read, is no TOML, has unknown fields, or entries that make no sense.
    pub fn read(path: &Path) -> Result<Self, SuiteError> {
        let text = std::fs::read_to_string(path).map_err(|source| SuiteError::Read {
            path: path.to_owned(),
            source,
        })?;
        let mut suite: Self = toml::from_str(&text).map_err(|source| SuiteError::Toml {
            path: path.to_owned(),
            source,
        })?;
        suite.folder = path.parent().map(Path::to_owned).unwrap_or_default();
        suite.check()?;
        Ok(suite)
    }

    /// Checks counts, names and sources.
    ///
    /// # Errors
    /// The first entry that makes no sense.
    pub fn check(&self) -> Result<(), SuiteError> {
        for (place, count) in [
            ("episodes", self.episodes),
            ("runs", self.runs),
            ("environment", self.environments.len()),
            ("planner", self.planners.len()),
        ] {
            if count == 0 {
                return Err(entry(place.to_owned(), "at least 1", "0"));
            }
        }
        if !(0.0..=1.0).contains(&self.discount) {
            let found = self.discount.to_string();
            return Err(entry("discount".to_owned(), "0 to 1", &found));
        }
        let names = |names: &mut dyn Iterator<Item = &String>, kind: &str| {
            let mut seen = BTreeSet::new();
            for name in names {
                check_name(kind, name)?;
                if !seen.insert(file_name(name)) {
                    return Err(entry(kind.to_owned(), "different names", name));
                }
            }
            Ok(())
        };
        names(
            &mut self.environments.iter().map(|entry| &entry.name),
            "environment",
        )?;
        names(
            &mut self.planners.iter().map(|entry| &entry.name),
            "planner",
        )?;
        for environment in &self.environments {
            environment.check()?;
        }
        for planner in &self.planners {
            planner.check(&self.environments)?;
        }
        Ok(())
    }
}

fn entry(place: String, expected: &str, found: &str) -> SuiteError {
    SuiteError::Entry {
        place,
        expected: expected.to_owned(),
        found: found.to_owned(),
    }
}

/// Names become parts of file names and cells of tables.
fn check_name(kind: &str, name: &str) -> Result<(), SuiteError> {
    let is_fine = !name.trim().is_empty()
        && name.len() <= 80
        && !name.chars().any(|c| c.is_control() || c == '|');
    match is_fine {
        true => Ok(()),
        false => Err(entry(
            kind.to_owned(),
            "a name of 1 to 80 bytes without control characters and |",
            &format!("{name:?}"),
        )),
    }
}

/// A name with everything replaced that does not belong into the name of a file.
pub(crate) fn file_name(name: &str) -> String {
    let fits = |c: char| c.is_alphanumeric() || matches!(c, '-' | '_' | '.' | '=' | '+');
    let name: String = name
        .chars()
        .map(|c| if fits(c) { c } else { '_' })
        .collect();
    // No hidden files, and no way up.
    match name.strip_prefix('.') {
        Some(rest) => format!("_{rest}"),
        None => name,
    }
}

impl EnvironmentEntry {
    fn check(&self) -> Result<(), SuiteError> {
        let place = || format!("environment \"{}\"", self.name);
        if self.env.is_none() && self.dataset.is_none() {
            return Err(entry(place(), "env or dataset", "neither"));
        }
        if self.max_steps == Some(0) {
            return Err(entry(place(), "max_steps of at least 1", "0"));
        }
        if self.k_sim == Some(true) && self.dataset.is_none() {
            return Err(entry(place(), "a dataset for K-Sim", "none"));
        }
        Ok(())
    }

    /// Whether K-Sim is measured.
    pub(crate) fn measures_k_sim(&self) -> bool {
        self.dataset.is_some() && self.k_sim.unwrap_or(true)
    }
}

impl PlannerEntry {
    fn check(&self, environments: &[EnvironmentEntry]) -> Result<(), SuiteError> {
        let place = || format!("planner \"{}\"", self.name);
        for name in &self.environments {
            if !environments
                .iter()
                .any(|environment| environment.name == *name)
            {
                return Err(entry(place(), "names of environments of the suite", name));
            }
        }
        match (&self.source, &self.policy) {
            (Some(source), None) => PlannerSource::parse(source).map(drop)?,
            (None, Some(policy)) => {
                PolicySpec::parse(policy)?;
                let plain = LoadOptions {
                    n_threads: Some(1),
                    ..LoadOptions::default()
                };
                if self.load_options(1) != plain || self.replan_interval.is_some() {
                    return Err(entry(
                        place(),
                        "no options of planning",
                        "a policy with some",
                    ));
                }
            }
            (Some(_), Some(_)) => return Err(entry(place(), "source or policy", "both")),
            (None, None) => return Err(entry(place(), "source or policy", "neither")),
        }
        Ok(())
    }

    /// Whether it plays in an environment.
    pub(crate) fn plays_in(&self, environment: &EnvironmentEntry) -> bool {
        self.environments.is_empty() || self.environments.contains(&environment.name)
    }

    /// How its planner is loaded.
    pub(crate) fn load_options(&self, n_threads: usize) -> LoadOptions {
        LoadOptions {
            backend: self.backend.clone(),
            device: self.device.clone(),
            n_threads: Some(n_threads),
            precision: self.precision.unwrap_or_default(),
            n_candidates: self.candidates,
            sampling_steps: self.sampling_steps,
            guidance_weight: self.guidance,
            curiosity_weight: self.curiosity,
            temperature: self.temperature,
            warm_start: self.warm_start,
            replan_interval: None,
        }
    }

    /// Its source in an environment, with the path of a run made to start from the folder of the suite.
    pub(crate) fn source_in(
        &self,
        environment: &EnvironmentEntry,
        folder: &Path,
    ) -> Result<Option<PlannerSource>, SuiteError> {
        let Some(source) = &self.source else {
            return Ok(None);
        };
        let dataset = environment.dataset.as_deref();
        if source.contains("{dataset}") && dataset.is_none() {
            let place = format!("planner \"{}\"", self.name);
            let found = format!("none in environment \"{}\"", environment.name);
            return Err(entry(place, "a dataset for {dataset}", &found));
        }
        let text = source
            .replace("{environment}", &environment.name)
            .replace("{dataset}", dataset.unwrap_or_default());
        Ok(Some(match PlannerSource::parse(&text)? {
            PlannerSource::Run(path) => PlannerSource::Run(folder.join(path)),
            other => other,
        }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SUITE: &str = r#"
        name = "toy"
        episodes = 2
        runs = 3

        [[environment]]
        name = "point mass"
        env = "PointMass-v0"
        max_steps = 20

        [[planner]]
        name = "Run"
        source = "runs/{environment}/a"
        curiosity = 10

        [[planner]]
        name = "zero"
        policy = "zero"
    "#;

    fn read(text: &str) -> Result<Suite, SuiteError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("suite.toml");
        std::fs::write(&path, text).unwrap();
        Suite::read(&path)
    }

    #[test]
    fn a_file_becomes_a_suite() {
        let suite = read(SUITE).unwrap();
        assert_eq!((suite.episodes, suite.runs, suite.seed), (2, 3, 0));
        assert_eq!(suite.environments[0].max_steps, Some(20));
        assert_eq!(suite.planners[0].curiosity, Some(10.0));
        let source = suite.planners[0].source_in(&suite.environments[0], Path::new("there"));
        let expected = PlannerSource::Run("there/runs/point mass/a".into());
        assert_eq!(source.unwrap(), Some(expected));
        assert_eq!(file_name("../point mass: λ=1e3"), "_._point_mass__λ=1e3");
    }

    #[test]
    fn what_is_unknown_or_makes_no_sense_is_refused() {
        for (from, to, part) in [
            ("runs = 3", "runs = 0", "runs: expected at least 1"),
            ("runs = 3", "rusn = 3", "unknown field `rusn`"),
            (
                "max_steps = 20",
                "max_stesp = 20",
                "unknown field `max_stesp`",
            ),
            ("env = \"PointMass-v0\"", "", "expected env or dataset"),
            (
                "name = \"zero\"",
                "name = \"Run\"",
                "expected different names, found Run",
            ),
            ("policy = \"zero\"", "policy = \"nobody\"", "unknown policy"),
            (
                "policy = \"zero\"",
                "",
                "expected source or policy, found neither",
            ),
            (
                "curiosity = 10",
                "environments = [\"x\"]",
                "names of environments of the suite, found x",
            ),
            ("curiosity = 10", "candidates = -1", "invalid value"),
            (
                "policy = \"zero\"",
                "policy = \"zero\"\ncandidates = 3",
                "a policy with some",
            ),
            ("max_steps = 20", "k_sim = true", "a dataset for K-Sim"),
            ("max_steps = 20", "max_steps = 0", "max_steps of at least 1"),
            ("runs = 3", "discount = nan", "discount: expected 0 to 1"),
        ] {
            assert!(SUITE.contains(from));
            let error = read(&SUITE.replace(from, to)).unwrap_err();
            let text = format!(
                "{error}: {:?}",
                std::error::Error::source(&error).map(ToString::to_string)
            );
            assert!(text.contains(part), "{part}: {text}");
        }
        assert!(read("x").is_err());
    }
}
