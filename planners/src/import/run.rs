//! A run folder of the reference's files.

use std::fs::{self, File};
use std::io::Read as _;
use std::path::Path;

use blake3::Hasher;
use ksim_datasets::DatasetSource;
use serde::Serialize;
use serde_json::{Map, Value};

use super::error::ImportError;
use super::planner::{Assembled, ReferenceImport, assemble, file_name};
use crate::error::PlannerError;
use crate::model::{PLANNER_FILE, PlannerMeta};
use crate::run_folder::refuse_leftovers;
use crate::tensor_file::write_atomically;
use crate::training::{MANIFEST_FILE, MANIFEST_FORMAT, Program};

/// Bytes that are read in one go.
const PIECE: usize = 1 << 16;

/// The manifest of an imported planner: that of a training without what only a training has.
#[derive(Serialize)]
struct Manifest<'a> {
    format: u32,
    family: &'a str,
    preset: &'a str,
    config: Map<String, Value>,
    dataset: Dataset<'a>,
    imported: Vec<Imported>,
    program: Program,
}

/// The dataset that gave statistics and bounds.
#[derive(Serialize)]
struct Dataset<'a> {
    id: &'a str,
    format: String,
    fingerprint: Option<&'a str>,
    observation_dim: usize,
    action_dim: usize,
    n_episodes: usize,
    n_steps: usize,
}

/// Where a network is from.
#[derive(Serialize)]
struct Imported {
    network: &'static str,
    file: String,
    blake3: String,
}

/// Makes a run folder of the reference's files, which [`crate::PlannerFamily::load`] takes; nothing can train on in it.
/// The manifest names the files with their hashes.
///
/// # Errors
/// Those of [`super::reference_planner`]; the folder holds a run already, or cannot be written.
pub fn import_run(
    import: &ReferenceImport<'_>,
    data: &dyn DatasetSource,
    run: &Path,
) -> Result<PlannerMeta, PlannerError> {
    let path = run.join(MANIFEST_FILE);
    if path.exists() {
        let found = "the folder of another run".to_owned();
        return Err(PlannerError::occupied(run, "empty", found));
    }
    refuse_leftovers(run)?;
    let Assembled {
        planner,
        episodes,
        sources,
    } = assemble(import, data)?;
    let mut imported = Vec::with_capacity(sources.len());
    for (network, file) in sources {
        imported.push(Imported {
            network,
            file: file_name(&file),
            blake3: hash(&file)?,
        });
    }
    let manifest = Manifest {
        format: MANIFEST_FORMAT,
        family: &planner.meta.family,
        preset: import.preset,
        config: planner.meta.config.to_json(),
        dataset: Dataset {
            id: &data.info().id,
            format: data.info().format.to_string(),
            fingerprint: planner.meta.dataset.as_deref(),
            observation_dim: episodes.observation_dim,
            action_dim: episodes.action_dim,
            n_episodes: episodes.spans.len(),
            n_steps: episodes.n_rows(),
        },
        imported,
        program: Program::this(),
    };
    let json = serde_json::to_string_pretty(&manifest).map_err(|source| PlannerError::Json {
        path: path.clone(),
        source,
    })?;
    fs::create_dir_all(run).map_err(|source| PlannerError::File {
        path: run.to_owned(),
        action: "make the folder",
        source,
    })?;
    planner.write(&run.join(PLANNER_FILE))?;
    // Last: a folder without one is no run.
    write_atomically(&path, |file| fs::write(file, json + "\n"))?;
    Ok(planner.meta)
}

fn hash(path: &Path) -> Result<String, ImportError> {
    let failed = |source| ImportError::io(path, "read", source);
    let mut file = File::open(path).map_err(failed)?;
    let mut hasher = Hasher::new();
    let mut piece = vec![0; PIECE];
    loop {
        match file.read(&mut piece).map_err(failed)? {
            0 => return Ok(hasher.finalize().to_hex().to_string()),
            n => hasher.update(&piece[..n]),
        };
    }
}
