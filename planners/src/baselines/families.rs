//! The baselines as families: what they keep of a dataset in a run folder.

use std::path::Path;
use std::sync::Arc;

use ksim_datasets::DatasetSource;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value, json};

use super::saved;
use super::{Demonstrations, Nearest, NearestOptions, Random, Replay, ReplayOptions};
use crate::error::PlannerError;
use crate::family::{
    LoadOptions, PlannerFamily, Precision, Preset, TrainObserver, TrainRequest, TrainSummary,
};
use crate::planner::Planner;
use crate::run_folder::DEMONSTRATIONS;

/// The only preset of a baseline.
const PRESETS: &[Preset] = &[Preset {
    name: "default",
    summary: "settings as they are",
}];

/// The family `random`: the action box of a dataset.
#[derive(Debug, Clone, Copy, Default)]
pub struct RandomFamily;

/// The family `nearest`: a dataset and how its demonstrations become plans.
#[derive(Debug, Clone, Copy, Default)]
pub struct NearestFamily;

/// The family `replay`: a dataset and how its episodes are replayed.
#[derive(Debug, Clone, Copy, Default)]
pub struct ReplayFamily;

/// Settings of a run of `random`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct RandomOptions {
    horizon: usize,
    n_candidates: usize,
    /// Of the actions in the dataset; filled in from it.
    action_low: Vec<f32>,
    action_high: Vec<f32>,
}

impl PlannerFamily for RandomFamily {
    fn id(&self) -> &'static str {
        Random::FAMILY
    }

    fn summary(&self) -> &'static str {
        "actions drawn uniformly between the smallest and the largest of the dataset"
    }

    fn presets(&self) -> &[Preset] {
        PRESETS
    }

    fn train(
        &self,
        request: &TrainRequest,
        data: &dyn DatasetSource,
        run: &Path,
        observer: &mut dyn TrainObserver,
    ) -> Result<TrainSummary, PlannerError> {
        saved::check_folder::<RandomOptions>(self.id(), request, run)?;
        let demonstrations = Demonstrations::read(data)?;
        let (action_low, action_high) = demonstrations.action_bounds();
        let defaults = RandomOptions {
            horizon: 32,
            n_candidates: 1,
            action_low,
            action_high,
        };
        let options = settings(self.id(), request, defaults, observer)?;
        let bounds = [options.action_low.clone(), options.action_high.clone()];
        let width = demonstrations.observation_dim();
        Random::new(width, bounds, options.horizon, options.n_candidates)?;
        saved::write(self.id(), request, &options, &demonstrations, run, false)
    }

    fn load(&self, run: &Path, options: &LoadOptions) -> Result<Box<dyn Planner>, PlannerError> {
        let manifest = saved::Manifest::<RandomOptions>::read(run, self.id())?;
        let config = manifest.config;
        let n_candidates = n_candidates(self.id(), options)?.unwrap_or(config.n_candidates);
        Ok(Box::new(Random::new(
            manifest.dataset.observation_dim,
            [config.action_low, config.action_high],
            config.horizon,
            n_candidates,
        )?))
    }
}

impl PlannerFamily for NearestFamily {
    fn id(&self) -> &'static str {
        Nearest::FAMILY
    }

    fn summary(&self) -> &'static str {
        "what the dataset did next in the recorded state nearest to the current one"
    }

    fn presets(&self) -> &[Preset] {
        PRESETS
    }

    fn train(
        &self,
        request: &TrainRequest,
        data: &dyn DatasetSource,
        run: &Path,
        observer: &mut dyn TrainObserver,
    ) -> Result<TrainSummary, PlannerError> {
        let options = settings(self.id(), request, NearestOptions::default(), observer)?;
        saved::check_folder::<NearestOptions>(self.id(), request, run)?;
        let demonstrations = Arc::new(Demonstrations::read(data)?);
        Nearest::new(Arc::clone(&demonstrations), options)?;
        saved::write(self.id(), request, &options, &demonstrations, run, true)
    }

    fn load(&self, run: &Path, options: &LoadOptions) -> Result<Box<dyn Planner>, PlannerError> {
        let manifest = saved::Manifest::<NearestOptions>::read(run, self.id())?;
        let mut config = manifest.config;
        config.n_candidates = n_candidates(self.id(), options)?.unwrap_or(config.n_candidates);
        let demonstrations = saved::read(&run.join(DEMONSTRATIONS))?;
        Ok(Box::new(Nearest::new(Arc::new(demonstrations), config)?))
    }
}

impl PlannerFamily for ReplayFamily {
    fn id(&self) -> &'static str {
        Replay::FAMILY
    }

    fn summary(&self) -> &'static str {
        "the recorded episode that began nearest, without looking again"
    }

    fn presets(&self) -> &[Preset] {
        PRESETS
    }

    fn train(
        &self,
        request: &TrainRequest,
        data: &dyn DatasetSource,
        run: &Path,
        observer: &mut dyn TrainObserver,
    ) -> Result<TrainSummary, PlannerError> {
        let options = settings(self.id(), request, ReplayOptions::default(), observer)?;
        saved::check_folder::<ReplayOptions>(self.id(), request, run)?;
        let demonstrations = Arc::new(Demonstrations::read(data)?);
        Replay::new(Arc::clone(&demonstrations), options)?;
        saved::write(self.id(), request, &options, &demonstrations, run, true)
    }

    fn load(&self, run: &Path, options: &LoadOptions) -> Result<Box<dyn Planner>, PlannerError> {
        let manifest = saved::Manifest::<ReplayOptions>::read(run, self.id())?;
        if let Some(n) = n_candidates(self.id(), options)?.filter(|&n| n != 1) {
            return Err(PlannerError::Request {
                what: "the number of candidates",
                expected: "1 for replay".to_owned(),
                found: n.to_string(),
            });
        }
        let demonstrations = saved::read(&run.join(DEMONSTRATIONS))?;
        Ok(Box::new(Replay::new(
            Arc::new(demonstrations),
            manifest.config,
        )?))
    }
}

/// The settings of a request: defaults, and what replaces them.
fn settings<T: Serialize + DeserializeOwned>(
    family: &'static str,
    request: &TrainRequest,
    defaults: T,
    observer: &mut dyn TrainObserver,
) -> Result<T, PlannerError> {
    if let Some(name) = request
        .preset
        .as_ref()
        .filter(|name| *name != PRESETS[0].name)
    {
        return Err(PlannerError::UnknownPreset {
            family,
            name: name.clone(),
            known: vec![PRESETS[0].name],
        });
    }
    if let Some(base) = &request.base {
        return Err(PlannerError::Request {
            what: "the base",
            expected: format!("nothing for {family}, which has no network"),
            found: base.display().to_string(),
        });
    }
    if request.backend.is_some() || request.device.is_some() {
        observer.notice(&format!(
            "{family} has no network: backend and device have no effect"
        ));
    }
    let json = serde_json::to_value(&defaults).unwrap_or_else(|_| json!({}));
    let Value::Object(mut table) = json else {
        return Ok(defaults);
    };
    for (name, value) in &request.overrides {
        if !table.contains_key(name) {
            return Err(PlannerError::UnknownSetting {
                name: name.clone(),
                known: table.keys().cloned().collect(),
            });
        }
        table.insert(name.clone(), value.clone());
    }
    let of_request = |error: serde_json::Error| PlannerError::Setting {
        name: named(&request.overrides),
        expected: "values of the settings' types".to_owned(),
        found: error.to_string(),
    };
    serde_json::from_value(Value::Object(table)).map_err(of_request)
}

/// The names of some settings.
fn named(settings: &Map<String, Value>) -> String {
    let names: Vec<&str> = settings.keys().map(String::as_str).collect();
    names.join(", ")
}

/// The number of candidates asked for; everything else needs a network.
fn n_candidates(family: &str, options: &LoadOptions) -> Result<Option<usize>, PlannerError> {
    let asked = [
        (
            "the number of sampling steps",
            options.sampling_steps.is_some(),
        ),
        ("the weight of guidance", options.guidance_weight.is_some()),
        (
            "the weight of curiosity",
            options.curiosity_weight.is_some(),
        ),
        ("the temperature", options.temperature.is_some()),
        ("the warm start", options.warm_start.is_some()),
        ("the backend", options.backend.is_some()),
        ("the device", options.device.is_some()),
        ("the precision", options.precision != Precision::F32),
    ];
    match asked.into_iter().find(|(_, is_asked)| *is_asked) {
        None => Ok(options.n_candidates),
        Some((what, _)) => Err(PlannerError::Request {
            what,
            expected: format!("nothing for {family}, which has no network"),
            found: "a value".to_owned(),
        }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::baselines::demonstrations::tests::walks;
    use crate::family::SilentObserver;
    use crate::planner::PlanRequest;

    /// A run of the walks, as `train` would write it.
    fn write<T: Serialize + DeserializeOwned>(
        family: &str,
        options: &T,
        run: &Path,
    ) -> TrainSummary {
        let request = TrainRequest::default();
        saved::write(family, &request, options, &walks(&[5, 4]), run, true).unwrap()
    }

    fn first_plan(planner: &mut dyn Planner) -> crate::planner::Candidates {
        planner.reset(0, 1).unwrap();
        let request = PlanRequest {
            slots: &[0],
            observations: &[0.3, 0.1],
        };
        planner.plan(&request).unwrap()
    }

    #[test]
    fn a_run_plans_as_its_dataset_does() {
        let folder = tempfile::tempdir().unwrap();
        let run = folder.path().join("run");
        let options = NearestOptions {
            horizon: 3,
            n_candidates: 2,
            ..NearestOptions::default()
        };
        let summary = write("nearest", &options, &run);
        assert!(summary.finished);
        let mut loaded = NearestFamily.load(&run, &LoadOptions::default()).unwrap();
        let mut direct = Nearest::new(Arc::new(walks(&[5, 4])), options).unwrap();
        assert_eq!(first_plan(&mut *loaded), first_plan(&mut direct));
        let more = LoadOptions {
            n_candidates: Some(5),
            ..LoadOptions::default()
        };
        let mut more = NearestFamily.load(&run, &more).unwrap();
        assert_eq!(first_plan(&mut *more).n_candidates, 5);
        assert_eq!(crate::family_of(&run).unwrap(), "nearest");
        let error = ReplayFamily
            .load(&run, &LoadOptions::default())
            .map(drop)
            .unwrap_err();
        assert!(
            error.to_string().contains("nearest, expected replay"),
            "{error}"
        );
    }

    #[test]
    fn options_of_networks_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let run = folder.path().join("run");
        write("replay", &ReplayOptions::default(), &run);
        let curious = LoadOptions {
            curiosity_weight: Some(1.0),
            ..LoadOptions::default()
        };
        let error = ReplayFamily
            .load(&run, &curious)
            .map(drop)
            .unwrap_err()
            .to_string();
        assert!(error.contains("weight of curiosity"), "{error}");
        let many = LoadOptions {
            n_candidates: Some(2),
            ..LoadOptions::default()
        };
        assert!(ReplayFamily.load(&run, &many).is_err());
    }

    #[test]
    fn settings_are_checked_by_name_and_type() {
        let with = |name: &str, value: Value| {
            let request = TrainRequest {
                overrides: Map::from_iter([(name.to_owned(), value)]),
                ..TrainRequest::default()
            };
            let defaults = NearestOptions::default();
            settings("nearest", &request, defaults, &mut SilentObserver)
        };
        assert_eq!(with("horizon", json!(8)).unwrap().horizon, 8);
        assert!(
            with("horizon", json!("x"))
                .unwrap_err()
                .to_string()
                .contains("horizon")
        );
        let error = with("horizn", json!(8)).unwrap_err().to_string();
        assert!(error.contains("horizon, n_candidates, choice"), "{error}");
        let request = TrainRequest {
            preset: Some("paper".to_owned()),
            ..TrainRequest::default()
        };
        let defaults = NearestOptions::default();
        assert!(settings("nearest", &request, defaults, &mut SilentObserver).is_err());
    }

    #[test]
    fn another_run_is_not_overwritten_and_a_damaged_one_not_read() {
        let folder = tempfile::tempdir().unwrap();
        let run = folder.path().join("run");
        write("replay", &ReplayOptions::default(), &run);
        let again = saved::write(
            "replay",
            &TrainRequest::default(),
            &ReplayOptions::default(),
            &walks(&[5]),
            &run,
            true,
        );
        let error = again.unwrap_err().to_string();
        assert!(
            error.contains("a run of replay, expected no run"),
            "{error}"
        );
        // Going on with a run does it no harm either.
        let resume = |family: &str, seed, lengths: &[usize]| {
            let request = TrainRequest {
                seed,
                resume: true,
                ..TrainRequest::default()
            };
            let options = ReplayOptions::default();
            let written = saved::write(family, &request, &options, &walks(lengths), &run, true);
            written.map(drop).map_err(|error| error.to_string())
        };
        let manifest = std::fs::read(run.join("manifest.json")).unwrap();
        for (result, expected) in [
            (resume("random", 0, &[5, 4]), "replay, expected random"),
            (resume("replay", 1, &[5, 4]), "the seed of the run is 0"),
            (resume("replay", 0, &[5]), "the dataset of the run"),
        ] {
            let error = result.unwrap_err();
            assert!(error.contains(expected), "{error}");
        }
        resume("replay", 0, &[5, 4]).unwrap();
        assert_eq!(std::fs::read(run.join("manifest.json")).unwrap(), manifest);
        let file = run.join(DEMONSTRATIONS);
        let bytes = std::fs::read(&file).unwrap();
        for damaged in [&bytes[..bytes.len() - 3], &b"nothing"[..], &[]] {
            std::fs::write(&file, damaged).unwrap();
            let error = ReplayFamily
                .load(&run, &LoadOptions::default())
                .map(drop)
                .unwrap_err();
            assert!(error.to_string().contains(DEMONSTRATIONS), "{error}");
        }
    }
}
