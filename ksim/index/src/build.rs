//! Makes an index from staged steps.

use std::fs::File;
use std::io::BufWriter;
use std::ops::Range;
use std::sync::Arc;

use ksim::{
    Blocked, Buffer, Clusters, EpisodeRows, KMeans, KMeansError, KMeansParams, Matrix, Normalizer,
    Reference, RoundedRows, Trajectories,
};
use rayon::prelude::*;

use crate::about::{About, AboutClusters};
use crate::error::IndexError;
use crate::format::{CELLS, Entry, ROWS};
use crate::limit::{LIMIT, Limiter};
use crate::mapping::Mapping;
use crate::staging::StagedSteps;
use crate::writer::SectionWriter;

/// Rows normalized and written at a time.
const CHUNK_ROWS: usize = 1 << 15;

/// What is being done, for a progress line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stage {
    /// Means and deviations, and the fingerprint.
    Statistics,
    /// Normalized values go to the file.
    Normalizing,
    /// The clusters are fitted.
    Clusters,
    /// Rows are rounded to what the search looks at first.
    Rounding,
}

impl Stage {
    /// In words.
    pub fn name(self) -> &'static str {
        match self {
            Self::Statistics => "computing means and deviations",
            Self::Normalizing => "writing normalized values",
            Self::Clusters => "fitting the clusters",
            Self::Rounding => "rounding the rows",
        }
    }
}

/// Clusters to put into an index.
#[derive(Debug, Clone)]
pub enum Clustering {
    /// Fitted, under the name of the k-means that fits them.
    Fit {
        /// How.
        params: KMeansParams,
        /// Its seed.
        seed: u64,
        /// Its name.
        backend: &'static str,
    },
    /// Given centers, row-major, in normalized units.
    Given(Vec<f64>),
}

/// Makes an index of `steps` in `file`, which is empty and open for reading and writing. What `about` says of
/// numbers of steps and episodes, fingerprint and clusters is filled in.
///
/// # Errors
/// No steps, clusters that cannot be made, a disk that is full. The file is no index then.
pub fn write(
    steps: StagedSteps,
    numbers: Option<&[i64]>,
    mut about: About,
    clustering: Option<&Clustering>,
    file: &File,
    say: &mut dyn FnMut(Stage),
) -> Result<About, IndexError> {
    say(Stage::Statistics);
    let (raw, raw_limiter) = steps.into_trajectories()?;
    if raw.n_rows() == 0 {
        return Err(ksim::ScoreError::EmptyReference.into());
    }
    about.dataset.n_steps = raw.n_rows();
    about.dataset.n_episodes = raw.episodes().len();
    about.dataset.fingerprint = raw.fingerprint();
    let mut writer = SectionWriter::new(BufWriter::with_capacity(1 << 20, file))?;
    let normalizers = (
        Normalizer::fit(raw.states()),
        Normalizer::fit(raw.actions()),
    );
    for (name, values) in [
        ("state.mean", normalizers.0.mean()),
        ("state.std", normalizers.0.std()),
        ("action.mean", normalizers.1.mean()),
        ("action.std", normalizers.1.std()),
    ] {
        writer.section(name, &little_endian(values))?;
    }
    writer.section("episodes", &episodes(raw.episodes()))?;
    if let Some(numbers) = numbers {
        writer.section("numbers", bytemuck::cast_slice(numbers))?;
    }
    say(Stage::Normalizing);
    let names = [["state.high", "state.low"], ["action.high", "action.low"]];
    normalized(raw.states(), &normalizers.0, names[0], &mut writer)?;
    normalized(raw.actions(), &normalizers.1, names[1], &mut writer)?;
    let (reference, _limiter) = read_back(&mut writer, file, &raw, normalizers)?;
    // The raw values are needed no more, nor the disk they are on.
    drop((raw_limiter, raw));
    let states = reference.states();
    say(Stage::Rounding);
    write_rounded(
        &Blocked::new(Arc::clone(states)).rounded(),
        &ROWS,
        &mut writer,
    )?;
    if let Some(clustering) = clustering {
        say(Stage::Clusters);
        let fitted = fitted(states, clustering)?;
        about.clusters = Some(write_clusters(&fitted, clustering, &mut writer)?);
        say(Stage::Rounding);
        let rounded = Clusters::new(Arc::clone(states), fitted).rounded();
        write_rounded(&rounded, &CELLS, &mut writer)?;
    }
    let json = serde_json::to_vec_pretty(&about).map_err(std::io::Error::from);
    writer.section("about", &json.map_err(IndexError::io("write the index"))?)?;
    writer.finish()?;
    Ok(about)
}

fn little_endian(values: &[f64]) -> Vec<u8> {
    values
        .iter()
        .flat_map(|value| value.to_le_bytes())
        .collect()
}

fn episodes(episodes: &[EpisodeRows]) -> Vec<u8> {
    let numbers = episodes.iter().flat_map(|one| {
        let rows = [one.rows.start, one.rows.end].map(|row| row as i64);
        [one.episode_index, rows[0], rows[1]]
    });
    numbers.flat_map(i64::to_le_bytes).collect()
}

/// Normalizes chunk by chunk, once for each plane: computing twice costs less than holding on.
fn normalized(
    data: &Matrix,
    normalizer: &Normalizer,
    names: [&str; 2],
    writer: &mut SectionWriter<BufWriter<&File>>,
) -> Result<(), IndexError> {
    const PART_ROWS: usize = 1 << 11;
    for (plane, name) in names.into_iter().enumerate() {
        writer.begin(name)?;
        for start in (0..data.n_rows()).step_by(CHUNK_ROWS) {
            let end = (start + CHUNK_ROWS).min(data.n_rows());
            let parts: Vec<Vec<f32>> = (start..end)
                .into_par_iter()
                .step_by(PART_ROWS)
                .map(|from| {
                    let rows: Range<usize> = from..(from + PART_ROWS).min(end);
                    let values = normalizer.normalized_rows(data, rows);
                    values
                        .into_iter()
                        .map(|value| Matrix::split(value)[plane])
                        .collect()
                })
                .collect();
            for part in parts {
                writer.append(
                    &part
                        .iter()
                        .flat_map(|value| value.to_le_bytes())
                        .collect::<Vec<u8>>(),
                )?;
            }
        }
    }
    Ok(())
}

/// The normalized reference, as it lies in the unfinished file, and what keeps it from filling memory.
fn read_back(
    writer: &mut SectionWriter<BufWriter<&File>>,
    file: &File,
    raw: &Trajectories,
    normalizers: (Normalizer, Normalizer),
) -> Result<(Reference, Limiter), IndexError> {
    writer.flush()?;
    let mapping = Mapping::new(file).map_err(IndexError::io("map the unfinished index"))?;
    let limiter = Limiter::start(LIMIT);
    limiter.add(&mapping);
    let plane = |name| {
        let entry: &Entry = writer.entry(name)?;
        let bytes = mapping.share(entry.offset as usize..(entry.offset + entry.len) as usize);
        Ok::<_, IndexError>(Buffer::<f32>::lent(bytes)?)
    };
    let states = Matrix::from_planes(plane("state.high")?, plane("state.low")?, raw.state_dim())?;
    let actions = Matrix::from_planes(
        plane("action.high")?,
        plane("action.low")?,
        raw.action_dim(),
    )?;
    let normalized = Trajectories::from_parts(states, actions, raw.episodes().to_vec())?;
    Ok((
        Reference::from_normalized(normalized, normalizers)?,
        limiter,
    ))
}

fn fitted(states: &Matrix, clustering: &Clustering) -> Result<KMeans, KMeansError> {
    match clustering {
        Clustering::Fit { params, .. } => params.fit(states),
        Clustering::Given(centers) => KMeans::from_centers(centers, states.n_features(), states),
    }
}

fn write_rounded(
    rounded: &RoundedRows,
    names: &[&'static str; 8],
    writer: &mut SectionWriter<BufWriter<&File>>,
) -> Result<(), IndexError> {
    let [scale, strips, order, starts, errors, clipped, levels, norm] = names;
    writer.section(scale, &little_endian(&rounded.scale))?;
    writer.section(strips, bytemuck::cast_slice(&rounded.strips))?;
    writer.section(order, bytemuck::cast_slice(&rounded.order))?;
    writer.section(starts, bytemuck::cast_slice(&rounded.block_starts))?;
    writer.section(errors, &little_endian(&rounded.block_errors))?;
    writer.section(clipped, &rounded.block_clipped)?;
    writer.section(levels, bytemuck::cast_slice(&rounded.levels))?;
    writer.section(norm, &rounded.max_norm.to_le_bytes())
}

fn write_clusters(
    fitted: &KMeans,
    clustering: &Clustering,
    writer: &mut SectionWriter<BufWriter<&File>>,
) -> Result<AboutClusters, IndexError> {
    writer.section("centers", &little_endian(fitted.centers()))?;
    writer.section("labels", bytemuck::cast_slice(fitted.labels()))?;
    writer.section("inertia", &fitted.inertia().to_le_bytes())?;
    let (backend, seed) = match clustering {
        Clustering::Fit { backend, seed, .. } => (Some((*backend).to_owned()), *seed),
        Clustering::Given(_) => (None, 0),
    };
    Ok(AboutClusters {
        backend,
        seed,
        n_clusters: fitted.n_clusters(),
        n_iterations: fitted.n_iterations(),
        converged: fitted.converged(),
    })
}
