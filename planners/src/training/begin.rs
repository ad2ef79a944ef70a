//! How a training begins: in an empty folder, with networks of another run, or where it was stopped.

use std::fs;
use std::path::Path;

use super::checkpoint::{CHECKPOINT_FILE, Checkpoint};
use super::confidence::ConfidencePhase;
use super::curiosity::CuriosityPhase;
use super::diffusion::DiffusionPhase;
use super::manifest::{MANIFEST_FILE, Manifest};
use super::session::Session;
use crate::config::ConfidenceRule;
use crate::error::PlannerError;
use crate::family::TrainRequest;
use crate::model::{PlannerFile, PlannerMeta};

impl Session<'_> {
    /// What must hold before anything is written.
    pub(super) fn check(&self) -> Result<(), PlannerError> {
        DiffusionPhase::batches(&self.setting)?;
        if let Some(curiosity) = &self.setting.config.curiosity {
            CuriosityPhase::batches(&self.setting, curiosity)?;
        }
        if let Some(confidence) = &self.setting.config.confidence
            && confidence.rule == ConfidenceRule::Windows
        {
            ConfidencePhase::batches(&self.setting, confidence)?;
        }
        for architecture in self.meta.architectures().values() {
            architecture.validate()?;
        }
        Ok(())
    }

    /// Begins a run in an empty folder, or goes on with the one that is there.
    pub(super) fn begin(&mut self, request: &TrainRequest) -> Result<(), PlannerError> {
        let path = self.run.join(MANIFEST_FILE);
        if !path.exists() {
            if request.resume {
                return Err(PlannerError::Mismatch {
                    path,
                    what: "the run to go on with".to_owned(),
                    expected: "a manifest".to_owned(),
                    found: "missing".to_owned(),
                });
            }
            return self.begin_new(request, &path);
        }
        if !request.resume {
            return Err(PlannerError::Mismatch {
                path: self.run.to_owned(),
                what: "the run folder".to_owned(),
                expected: "empty, or a run to go on with (resume)".to_owned(),
                found: "the folder of another training".to_owned(),
            });
        }
        let begun = Manifest::read(&path)?;
        begun.check_same(&self.manifest, &path)?;
        self.manifest = begun;
        let checkpoint = self.run.join(CHECKPOINT_FILE);
        if checkpoint.exists() {
            self.setting.checkpoint = Checkpoint::read(&checkpoint, &self.manifest.run)?;
        }
        Ok(())
    }

    fn begin_new(&mut self, request: &TrainRequest, path: &Path) -> Result<(), PlannerError> {
        fs::create_dir_all(self.run).map_err(|source| PlannerError::File {
            path: self.run.to_owned(),
            action: "make the folder",
            source,
        })?;
        if let Some(base) = &request.base {
            self.manifest.base = Some(self.take_over(base)?);
        }
        self.manifest.identify();
        if self.manifest.base.is_some() {
            // The networks taken over must be there to go on from, whenever the training stops.
            self.write_checkpoint()?;
        }
        self.manifest.write(path)
    }

    /// Takes the networks of the first phase from a finished Diffuser; returns the hash of its file.
    fn take_over(&mut self, base: &Path) -> Result<String, PlannerError> {
        let path = PlannerFile::path(base);
        let planner = PlannerFile::read(&path, "diffuser")?;
        let (found, asked) = (&planner.meta, &self.meta);
        let dims = |meta: &PlannerMeta| {
            let (value_mean, value_std) = (meta.value_mean, meta.value_std);
            format!("{:?} {value_mean} {value_std}", meta.observation_order)
        };
        let pairs = [
            ("finished", found.finished.to_string(), "true".to_owned()),
            (
                "mode",
                format!("{:?}", found.config.mode),
                format!("{:?}", asked.config.mode),
            ),
            (
                "data",
                format!("{:?}", found.config.data),
                format!("{:?}", asked.config.data),
            ),
            (
                "networks",
                format!("{:?}", found.config.networks),
                format!("{:?}", asked.config.networks),
            ),
            (
                "dataset",
                format!("{:?}", found.dataset),
                format!("{:?}", asked.dataset),
            ),
            ("observations and values", dims(found), dims(asked)),
        ];
        if let Some((what, found, expected)) = pairs.into_iter().find(|(_, a, b)| a != b) {
            return Err(PlannerError::Mismatch {
                path,
                what: format!("\"{what}\" of the base"),
                expected,
                found,
            });
        }
        let bytes = fs::read(&path).map_err(|source| PlannerError::File {
            path: path.clone(),
            action: "read",
            source,
        })?;
        let checkpoint = &mut self.setting.checkpoint;
        checkpoint.finished = planner.networks;
        checkpoint.n_updates = planner.meta.n_updates;
        checkpoint.n_phases = 1;
        Ok(blake3::hash(&bytes).to_hex().to_string())
    }
}
