//! How a training begins: in an empty folder, with networks of another run, or where it was stopped.

use std::fs;
use std::path::{Path, PathBuf};

use super::checkpoint::{CHECKPOINT_FILE, Checkpoint};
use super::confidence::ConfidencePhase;
use super::curiosity::CuriosityPhase;
use super::diffusion::DiffusionPhase;
use super::manifest::{DatasetEntry, MANIFEST_FILE, Manifest};
use super::session::Session;
use crate::config::ConfidenceRule;
use crate::error::PlannerError;
use crate::family::TrainRequest;
use crate::model::{PlannerFile, PlannerMeta, network};
use crate::run_folder::refuse_leftovers;

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

    /// Whether a checkpoint is of this run's phases and networks.
    fn check_checkpoint(&self, checkpoint: &Checkpoint, path: &Path) -> Result<(), PlannerError> {
        let mismatch = |what: &str, expected: String, found: String| PlannerError::Mismatch {
            path: path.to_owned(),
            what: what.to_owned(),
            expected,
            found,
        };
        let (n_phases, lengths) = (checkpoint.n_phases, self.lengths());
        if n_phases > lengths.len() {
            let expected = format!("at most {}", lengths.len());
            return Err(mismatch(
                "the number of phases done",
                expected,
                n_phases.to_string(),
            ));
        }
        // An update more would be the next phase.
        let most = lengths.get(n_phases).map_or(0, |length| length - 1);
        if checkpoint.update > most {
            let found = checkpoint.update.to_string();
            return Err(mismatch(
                "the number of updates",
                format!("at most {most}"),
                found,
            ));
        }
        let (mut finished, mut learning, mut drawn) = (Vec::new(), Vec::new(), Vec::new());
        for (number, kind) in self.kinds.iter().enumerate().take(n_phases + 1) {
            let (trained, fixed) = kind.networks();
            match number < n_phases {
                true => finished.extend(trained.iter().chain(fixed)),
                false if checkpoint.update > 0 => {
                    learning.extend(trained);
                    finished.extend(fixed);
                }
                // What a phase draws before its first update need not be there.
                false => drawn.extend(fixed),
            }
        }
        let has = |name: &str, known: &[&str]| known.contains(&name);
        let missing = finished
            .iter()
            .find(|name| !checkpoint.finished.contains_key(**name))
            .or_else(|| {
                learning
                    .iter()
                    .find(|name| !checkpoint.learning.contains_key(**name))
            });
        if let Some(name) = missing {
            return Err(mismatch(
                "a network",
                format!("\"{name}\""),
                "missing".to_owned(),
            ));
        }
        let superfluous = (checkpoint.finished.keys())
            .find(|name| !has(name, &finished) && !has(name, &drawn))
            .or_else(|| {
                checkpoint
                    .learning
                    .keys()
                    .find(|name| !has(name, &learning))
            });
        if let Some(name) = superfluous {
            let expected = "one of the phases so far".to_owned();
            return Err(mismatch("a network", expected, format!("\"{name}\"")));
        }
        for (name, architecture) in self.meta.architectures() {
            let in_file = |source: PlannerError| source.in_file(path, Some(name));
            if let Some(weights) = checkpoint.finished.get(name) {
                architecture.check_weights(weights).map_err(in_file)?;
            }
            let Some(state) = checkpoint.learning.get(name) else {
                continue;
            };
            for part in [
                &state.weights,
                &state.ema,
                &state.first_moment,
                &state.second_moment,
            ] {
                architecture.check_weights(part).map_err(in_file)?;
            }
            let n_updates = match name {
                network::REWARD => checkpoint
                    .update
                    .div_ceil(self.setting.config.reward.interval),
                _ => checkpoint.update,
            };
            if state.n_updates != n_updates {
                let what = format!("the number of updates of network \"{name}\"");
                return Err(mismatch(
                    &what,
                    n_updates.to_string(),
                    state.n_updates.to_string(),
                ));
            }
        }
        Ok(())
    }

    /// Begins a run in an empty folder, or goes on with the one that [`check_folder`] found.
    pub(super) fn begin(&mut self, found: Found) -> Result<(), PlannerError> {
        let path = self.run.join(MANIFEST_FILE);
        let begun = match found {
            Found::Nothing(base) => return self.begin_new(base, &path),
            Found::Run(begun) => *begun,
        };
        begun.check_same(&self.manifest, &path)?;
        self.manifest = begun;
        let path = self.run.join(CHECKPOINT_FILE);
        if path.exists() {
            let checkpoint = Checkpoint::read(&path, &self.manifest.run)?;
            self.check_checkpoint(&checkpoint, &path)?;
            self.setting.checkpoint = checkpoint;
        } else if self.manifest.base.is_some() {
            return Err(PlannerError::Mismatch {
                path,
                what: "the checkpoint of a run that began with a base".to_owned(),
                expected: "there".to_owned(),
                found: "missing".to_owned(),
            });
        }
        Ok(())
    }

    fn begin_new(&mut self, base: Option<Box<Base>>, path: &Path) -> Result<(), PlannerError> {
        let base = match base {
            Some(base) => Some(self.take_over(*base)?),
            None => None,
        };
        fs::create_dir_all(self.run).map_err(|source| PlannerError::File {
            path: self.run.to_owned(),
            action: "make the folder",
            source,
        })?;
        self.manifest.base = base;
        self.manifest.identify();
        if self.manifest.base.is_some() {
            // The networks taken over must be there to go on from, whenever the training stops.
            self.write_checkpoint()?;
        }
        self.manifest.write(path)
    }

    /// Takes the networks of the first phase from a finished Diffuser; returns the hash of its file.
    fn take_over(&mut self, base: Base) -> Result<String, PlannerError> {
        let Base {
            path,
            planner,
            hash,
        } = base;
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
        let checkpoint = &mut self.setting.checkpoint;
        checkpoint.finished = planner.networks;
        checkpoint.n_updates = planner.meta.n_updates;
        checkpoint.n_phases = 1;
        Ok(hash)
    }
}

/// A finished run whose networks are taken over.
pub(super) struct Base {
    path: PathBuf,
    planner: PlannerFile,
    hash: String,
}

impl Base {
    fn read(run: &Path) -> Result<Self, PlannerError> {
        let path = PlannerFile::path(run);
        Ok(Self {
            planner: PlannerFile::read(&path, "diffuser")?,
            hash: hash(&path)?,
            path,
        })
    }
}

fn hash(path: &Path) -> Result<String, PlannerError> {
    let bytes = fs::read(path).map_err(|source| PlannerError::File {
        path: path.to_owned(),
        action: "read",
        source,
    })?;
    Ok(blake3::hash(&bytes).to_hex().to_string())
}

/// What is in the folder of a run.
pub(super) enum Found {
    /// Nothing yet; the base to begin with.
    Nothing(Option<Box<Base>>),
    /// A run to go on with.
    Run(Box<Manifest>),
}

/// What can be said about the folder before the dataset is read: it is empty, or holds the run that was asked for.
pub(super) fn check_folder(
    request: &TrainRequest,
    run: &Path,
    asked: impl FnOnce(DatasetEntry) -> Manifest,
) -> Result<Found, PlannerError> {
    let path = run.join(MANIFEST_FILE);
    let mismatch = |path: PathBuf, what: &str, expected: String, found: String| {
        let what = what.to_owned();
        PlannerError::Mismatch {
            path,
            what,
            expected,
            found,
        }
    };
    if !path.exists() {
        if request.resume {
            let (expected, found) = ("a manifest".to_owned(), "missing".to_owned());
            return Err(mismatch(path, "the run to go on with", expected, found));
        }
        refuse_leftovers(run)?;
        let base = request.base.as_deref().map(Base::read).transpose()?;
        return Ok(Found::Nothing(base.map(Box::new)));
    }
    if !request.resume {
        let found = "the folder of another training".to_owned();
        let expected = "empty, or a run to go on with (resume)";
        return Err(PlannerError::occupied(run, expected, found));
    }
    let begun = Manifest::read(&path)?;
    // Which dataset it is remains to be seen.
    begun.check_same(&asked(begun.dataset.clone()), &path)?;
    if let Some(base) = &request.base {
        let asked = hash(&PlannerFile::path(base))?;
        if begun.base.as_ref() != Some(&asked) {
            let found = begun.base.unwrap_or_else(|| "none".to_owned());
            let expected = format!("{asked}, that of {}", base.display());
            return Err(mismatch(path, "the base of the run", expected, found));
        }
    }
    Ok(Found::Run(Box::new(begun)))
}
