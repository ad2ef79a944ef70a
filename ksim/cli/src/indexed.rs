//! A saved index in the place of a dataset that is read: whether it fits the request, and what it holds.

use std::fs::Metadata;
use std::path::{Path, PathBuf};
use std::time::UNIX_EPOCH;

use anyhow::{Context as _, Result, bail};
use ksim::{Prepared, Reference, Search};
use ksim_datasets::{DatasetInfo, DatasetSource, ObservationLayout, OpenOptions};
use ksim_index::{About, SavedIndex};

use crate::centers::Centers;
use crate::context::Context;
use crate::load::{self, Columns, StepNumbers};
use crate::settings::Settings;

/// Column names that are written out in a message.
const NAMES: usize = 6;

/// A request that an index is to serve.
pub(crate) struct Request<'a> {
    /// The dataset, opened but not read.
    pub(crate) source: &'a dyn DatasetSource,
    /// How it was opened.
    pub(crate) options: &'a OpenOptions,
    /// The state columns wanted.
    pub(crate) columns: &'a Columns,
    /// The search wanted.
    pub(crate) settings: &'a Settings,
    /// Given centers.
    pub(crate) centers: Option<&'a Centers>,
}

/// What an index holds.
pub(crate) struct Indexed {
    /// The file: it lives as long as the rest is used.
    pub(crate) saved: SavedIndex,
    /// The normalized reference.
    pub(crate) reference: Reference,
    /// What the search takes from the index: the clusters, the rounded rows.
    pub(crate) prepared: Prepared,
    /// Recorded step numbers.
    pub(crate) numbers: StepNumbers,
}

/// Opens an index for a request.
///
/// # Errors
/// An index that is damaged, or of other columns, clusters, data or another version of ksim.
pub(crate) fn open(path: &Path, request: &Request<'_>, context: &Context) -> Result<Indexed> {
    let try_open = || -> Result<Indexed> {
        let saved = SavedIndex::open(path)?;
        let about = saved.about();
        check_version(about)?;
        check_columns(about, request)?;
        let has_clusters = request.settings.search == Search::Clusters;
        if has_clusters {
            check_clusters(about, request)?;
        }
        check_dataset(about, request, context)?;
        let prepared = match request.settings.search {
            Search::Clusters => Prepared {
                clusters: saved.clusters()?,
                rounded: saved.rounded_clusters()?,
            },
            Search::Auto | Search::Blocked => Prepared {
                clusters: None,
                rounded: saved.rounded_rows()?,
            },
            Search::Linear | Search::KdTree => Prepared::default(),
        };
        if let (Some(clusters), Some(centers)) = (&prepared.clusters, request.centers)
            && clusters.centers() != centers.values
        {
            bail!("its centers are not those of --centers: build it again with them");
        }
        let reference = saved.reference()?;
        let numbers = StepNumbers::new(saved.numbers()?);
        Ok(Indexed {
            reference,
            prepared,
            numbers,
            saved,
        })
    };
    try_open().with_context(|| format!("index {}", path.display()))
}

/// Another version may compute other numbers from the same data.
fn check_version(about: &About) -> Result<()> {
    let own = env!("CARGO_PKG_VERSION");
    if about.ksim != own {
        bail!(
            "it was built by ksim {}, this is ksim {own}: build it again with `ksim index build`",
            about.ksim
        );
    }
    Ok(())
}

fn check_columns(about: &About, request: &Request<'_>) -> Result<()> {
    let columns = request.columns;
    if about.state_columns != columns.indices || about.state_column_names != columns.names {
        bail!(
            "it holds the state columns {}, asked for are {}: build one with these columns",
            listed(&about.state_columns, &about.state_column_names),
            listed(&columns.indices, &columns.names)
        );
    }
    let found = action_dim(request.source.info());
    if about.action_dim != found {
        bail!(
            "it holds actions of {} columns, those of the dataset have {found}",
            about.action_dim
        );
    }
    Ok(())
}

fn listed(indices: &[usize], names: &[String]) -> String {
    let shown: Vec<String> = indices
        .iter()
        .zip(names)
        .take(NAMES)
        .map(|(index, name)| format!("{index} ({name})"))
        .collect();
    match indices.len() {
        n if n > NAMES => format!("{}, … ({n} in all)", shown.join(", ")),
        _ => shown.join(", "),
    }
}

fn check_clusters(about: &About, request: &Request<'_>) -> Result<()> {
    let Some(own) = &about.clusters else {
        bail!("it holds no clusters: build it without --no-clusters, or search exactly");
    };
    let settings = request.settings;
    let described = |backend: Option<&str>, n_clusters: usize, seed: u64| match backend {
        Some(backend) => format!("{n_clusters} clusters fitted by {backend} with seed {seed}"),
        None => format!("{n_clusters} clusters of given centers"),
    };
    let found = described(own.backend.as_deref(), own.n_clusters, own.seed);
    let wanted = match request.centers {
        Some(_) => described(None, own.n_clusters, 0),
        None => described(
            Some(settings.backend_name()),
            settings.n_clusters,
            settings.seed,
        ),
    };
    if found != wanted {
        bail!("it holds {found}, asked for are {wanted}: build one with these");
    }
    Ok(())
}

/// Files that look as they did are not read; others are, and their content decides.
fn check_dataset(about: &About, request: &Request<'_>, context: &Context) -> Result<()> {
    let info = request.source.info();
    if stamp(info, request.options, request.columns)? == about.dataset.stamp {
        return Ok(());
    }
    context.note(&format!(
        "{} is not as it was when the index was built, or is read in another way: comparing its content",
        info.path.display()
    ));
    let folder = std::env::temp_dir();
    let (steps, _) = load::staged(request.source, request.columns, &folder, context)?;
    let found = steps.fingerprint()?;
    let (own, path) = (&about.dataset, info.path.display().to_string());
    if found == own.fingerprint {
        return Ok(());
    }
    let what = match path == own.path {
        true => "the dataset has changed".to_owned(),
        false => format!("it is of another dataset, {}", own.name),
    };
    bail!(
        "{what}: {path} has fingerprint {found}, the index was built of {} with fingerprint {}; build it again with `ksim index build`",
        own.path,
        own.fingerprint
    )
}

/// Width of the dataset's actions.
pub(crate) fn action_dim(info: &DatasetInfo) -> usize {
    ObservationLayout::new(&info.action).width()
}

/// A hash over how a dataset's files look from outside (names, lengths, times of change), how they are read, and the
/// columns in use. 16 hexadecimal digits.
pub(crate) fn stamp(
    info: &DatasetInfo,
    options: &OpenOptions,
    columns: &Columns,
) -> Result<String> {
    let mut hasher = blake3::Hasher::new();
    hasher.update(look(&info.path, options.mapping.as_deref())?.as_bytes());
    let reading = OpenOptions {
        mapping: None,
        ..options.clone()
    };
    hasher.update(format!("{reading:?} {:?} {:?}", columns.indices, columns.actions).as_bytes());
    Ok(hasher.finalize().to_hex()[..16].to_owned())
}

/// How the files of a dataset look from outside: a line per file with its name, length and time of change.
pub(crate) fn look(dataset: &Path, mapping: Option<&Path>) -> Result<String> {
    let mut files = Vec::new();
    collect(dataset, &mut files).with_context(|| format!("cannot list {}", dataset.display()))?;
    files.extend(mapping.map(Path::to_owned));
    files.sort();
    let mut seen = String::new();
    for path in &files {
        let name = path.strip_prefix(dataset).unwrap_or(path);
        let metadata = path
            .metadata()
            .with_context(|| format!("cannot look at {}", path.display()))?;
        seen += &format!("{name:?} {} {}\n", metadata.len(), changed_ns(&metadata));
    }
    Ok(seen)
}

/// Time of the last change, in nanoseconds since 1970; 0 where the system does not say.
fn changed_ns(metadata: &Metadata) -> u128 {
    let changed = metadata.modified().ok();
    let since = changed.and_then(|time| time.duration_since(UNIX_EPOCH).ok());
    since.map_or(0, |duration| duration.as_nanos())
}

/// All files of a dataset, which is one or a folder of them.
fn collect(path: &Path, files: &mut Vec<PathBuf>) -> std::io::Result<()> {
    if !path.is_dir() {
        files.push(path.to_owned());
        return Ok(());
    }
    for entry in path.read_dir()? {
        let entry = entry?;
        match entry.file_type()?.is_dir() {
            true => collect(&entry.path(), files)?,
            false => files.push(entry.path()),
        }
    }
    Ok(())
}
