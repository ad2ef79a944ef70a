//! The formats this crate reads: telling them apart, opening them.

use std::fmt;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use crate::error::{DatasetError, Result};
use crate::formats::d4rl::EpisodePolicy;
use crate::formats::minari::{self, metadata::Metadata};
use crate::formats::parquet;
use crate::formats::tabular::ColumnNames;
use crate::formats::{hdf5_reading, ipc, lerobot, mcap_files, npz};
use crate::source::DatasetSource;

/// A dataset format.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Format {
    /// A Parquet file: the canonical layout, or any with list or scalar columns.
    Parquet,
    /// A D4RL HDF5 file: flat arrays with episodes one after another.
    D4rlHdf5,
    /// A Minari dataset folder with the HDF5 backend.
    MinariHdf5,
    /// A Minari dataset folder with an Arrow IPC file per episode.
    MinariArrow,
    /// A Minari dataset folder with a Parquet file per episode.
    MinariParquet,
    /// An Arrow IPC file ("Feather version 2") in the canonical layout.
    ArrowIpc,
    /// A LeRobot dataset folder.
    LeRobot,
    /// An MCAP recording, or a folder of them.
    Mcap,
    /// A NumPy archive of flat arrays, as OGBench publishes them.
    Npz,
    /// A robomimic HDF5 file.
    Robomimic,
}

impl Format {
    /// All formats.
    pub const ALL: [Self; 10] = [
        Self::Parquet,
        Self::ArrowIpc,
        Self::D4rlHdf5,
        Self::MinariHdf5,
        Self::MinariArrow,
        Self::MinariParquet,
        Self::LeRobot,
        Self::Mcap,
        Self::Npz,
        Self::Robomimic,
    ];

    /// Stable name: `parquet`, `arrow-ipc`, `d4rl-hdf5`, `minari-hdf5`, `minari-arrow`, `minari-parquet`,
    /// `lerobot`, `mcap`, `npz` or `robomimic`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Parquet => "parquet",
            Self::D4rlHdf5 => "d4rl-hdf5",
            Self::MinariHdf5 => "minari-hdf5",
            Self::MinariArrow => "minari-arrow",
            Self::MinariParquet => "minari-parquet",
            Self::ArrowIpc => "arrow-ipc",
            Self::LeRobot => "lerobot",
            Self::Mcap => "mcap",
            Self::Npz => "npz",
            Self::Robomimic => "robomimic",
        }
    }

    /// Whether a dataset of this format is a folder of its own.
    pub fn is_folder(self) -> bool {
        use Format::{LeRobot, MinariArrow, MinariHdf5, MinariParquet};
        matches!(self, LeRobot | MinariArrow | MinariHdf5 | MinariParquet)
    }
}

impl fmt::Display for Format {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// How to open a dataset. The default opens well-formed files of every format.
#[derive(Debug, Clone, Default)]
pub struct OpenOptions {
    /// Column names of a Parquet file that is not in the canonical layout.
    pub columns: ColumnNames,
    /// How a D4RL file is cut into episodes; `None` chooses by the file name (see
    /// [`EpisodePolicy::default_for`]), which a warning then says.
    pub episode_policy: Option<EpisodePolicy>,
    /// Step limit of the environment, for D4RL files without `timeouts`.
    pub max_episode_steps: Option<u64>,
    /// `terminate_on_end` of D4RL's `qlearning_dataset`; for [`EpisodePolicy::D4rlQlearning`] only.
    pub terminate_on_end: bool,
    /// Open Minari datasets written by an unknown version.
    pub force: bool,
    /// The mapping of an MCAP recording: a TOML file that says which fields are observation and action.
    pub mapping: Option<PathBuf>,
    /// Read what is whole of a damaged MCAP, LeRobot, Arrow IPC or robomimic dataset; what is lost is a
    /// [`crate::Warning::Lost`]. The other formats fail as they do without it.
    pub recover: bool,
}

/// The eight bytes an HDF5 file has at offset 0, 512, 1024, 2048, ...
pub(crate) const HDF5_MAGIC: [u8; 8] = *b"\x89HDF\r\n\x1a\n";
const PARQUET_MAGIC: [u8; 4] = *b"PAR1";
const IPC_MAGIC: [u8; 6] = *b"ARROW1";
const ZIP_MAGIC: [u8; 4] = *b"PK\x03\x04";
const MCAP_MAGIC: [u8; 8] = *b"\x89MCAP0\r\n";
/// What a path to a dataset may be.
const EXPECTED: &str = "a Parquet, Arrow IPC, npz or MCAP file, a D4RL or robomimic HDF5 file, \
     a Minari folder (with data/metadata.json) or a LeRobot folder (with meta/info.json)";

/// Tells the format by the content, never by the name.
///
/// A folder is a Minari dataset if it has `data/metadata.json`, which names the storage; the `data` folder
/// itself and its `main_data.hdf5` count as the dataset too.
///
/// # Errors
/// What is wrong with that file, or [`DatasetError::Unsupported`] for a storage that is not read.
/// [`DatasetError::NotADataset`] for other folders and files, [`DatasetError::Corrupt`] for an empty file,
/// [`DatasetError::Io`] if nothing can be read; each names the path.
pub fn detect(path: &Path) -> Result<Format> {
    locate(path)
        .map(|(format, _)| format)
        .map_err(|error| error.in_file(path))
}

/// Opens a dataset, telling the format by the content.
///
/// # Errors
/// Those of [`detect`], and what the reader finds wrong; the path is in the error.
pub fn open(path: &Path, options: &OpenOptions) -> Result<Box<dyn DatasetSource>> {
    let opened = locate(path).and_then(|(format, path)| match format {
        Format::Parquet => parquet::open(&path, &options.columns),
        Format::D4rlHdf5 => hdf5_reading::open_d4rl(&path, options),
        Format::MinariHdf5 => hdf5_reading::open_minari(&path, options),
        Format::Robomimic => hdf5_reading::open_robomimic(&path, options),
        Format::ArrowIpc => ipc::open(&path, options),
        Format::LeRobot => lerobot::open(&path, options),
        Format::Mcap => mcap_files::open(&path, options),
        Format::Npz => npz::open(&path, options),
        Format::MinariArrow | Format::MinariParquet => {
            let source = minari::ColumnarSource::open(&path, format, options)?;
            Ok(Box::new(source) as Box<dyn DatasetSource>)
        }
    });
    opened.map_err(|error| error.in_file(path))
}

/// The format and the path its reader wants: a file, or the dataset folder of Minari.
fn locate(path: &Path) -> Result<(Format, PathBuf)> {
    let metadata = std::fs::metadata(path).map_err(|e| DatasetError::io("open", e))?;
    if metadata.is_dir() {
        return locate_folder(path);
    }
    let head = head(path)?;
    if head.is_empty() {
        return Err(DatasetError::corrupt("the file is empty (0 bytes)"));
    }
    if head.starts_with(&PARQUET_MAGIC) {
        return Ok((Format::Parquet, path.to_owned()));
    }
    if head.starts_with(&IPC_MAGIC) {
        return Ok((Format::ArrowIpc, path.to_owned()));
    }
    if head.starts_with(&ZIP_MAGIC) {
        return Ok((Format::Npz, path.to_owned()));
    }
    if head.starts_with(&MCAP_MAGIC) {
        return Ok((Format::Mcap, path.to_owned()));
    }
    if head.starts_with(&HDF5_MAGIC) {
        let folder = path.parent();
        let in_minari = folder.is_some_and(|data| data.join("metadata.json").is_file());
        return match folder.and_then(Path::parent) {
            Some(dataset) if in_minari => Ok((Format::MinariHdf5, dataset.to_owned())),
            _ if hdf5_reading::is_robomimic(path) => Ok((Format::Robomimic, path.to_owned())),
            _ => Ok((Format::D4rlHdf5, path.to_owned())),
        };
    }
    let found = describe_head(&head);
    match path.extension().and_then(|e| e.to_str()) {
        Some("hdf5" | "h5" | "parquet" | "arrow" | "mcap" | "npz") => Err(DatasetError::corrupt(
            format!("the file starts with {found} at offset 0, not with its magic"),
        )),
        _ => Err(DatasetError::NotADataset {
            expected: EXPECTED,
            found,
        }),
    }
}

fn locate_folder(path: &Path) -> Result<(Format, PathBuf)> {
    let minari = |path: &Path| Ok((Metadata::read(path)?.storage.format()?, path.to_owned()));
    if path.join("data").join("metadata.json").is_file() {
        return minari(path);
    }
    if path.join("meta").join("info.json").is_file() {
        return Ok((Format::LeRobot, path.to_owned()));
    }
    if holds_mcap(path) {
        return Ok((Format::Mcap, path.to_owned()));
    }
    let parent = path
        .parent()
        .filter(|_| path.ends_with("data") && path.join("metadata.json").is_file());
    if let Some(dataset) = parent {
        return minari(dataset);
    }
    Err(DatasetError::NotADataset {
        expected: EXPECTED,
        found: describe_folder(path),
    })
}

/// Whether a folder has a recording in it, as rosbag2 writes them.
fn holds_mcap(path: &Path) -> bool {
    std::fs::read_dir(path).is_ok_and(|mut entries| {
        entries.any(|entry| entry.is_ok_and(|e| e.path().extension().is_some_and(|e| e == "mcap")))
    })
}

fn head(path: &Path) -> Result<Vec<u8>> {
    let file = File::open(path).map_err(|e| DatasetError::io("open", e))?;
    let mut head = Vec::with_capacity(16);
    file.take(16)
        .read_to_end(&mut head)
        .map_err(|e| DatasetError::io("read", e))?;
    Ok(head)
}

fn describe_head(head: &[u8]) -> String {
    format!("\"{}\"", head.escape_ascii())
}

fn describe_folder(path: &Path) -> String {
    const SHOWN: usize = 5;
    let Ok(entries) = std::fs::read_dir(path) else {
        return "a folder that cannot be listed".to_owned();
    };
    let mut names: Vec<String> = entries
        .flatten()
        .map(|entry| entry.file_name().to_string_lossy().into_owned())
        .collect();
    names.sort();
    match names.len() {
        0 => "an empty folder".to_owned(),
        n if n <= SHOWN => format!("a folder with {}", names.join(", ")),
        n => format!(
            "a folder with {} and {} more",
            names[..SHOWN].join(", "),
            n - SHOWN
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_that_is_no_dataset_says_what_was_found() {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join("notes.txt"), "x").unwrap();
        let error = detect(dir.path()).unwrap_err();
        let DatasetError::NotADataset { found, .. } = error.cause() else {
            panic!("{error:?}")
        };
        assert_eq!(found, "a folder with notes.txt");
    }

    #[test]
    fn content_decides_not_the_name() {
        let dir = tempfile::tempdir().unwrap();
        let html = dir.path().join("hopper.hdf5");
        std::fs::write(&html, "<html>404").unwrap();
        assert!(matches!(
            detect(&html).unwrap_err().cause(),
            DatasetError::Corrupt { .. }
        ));
        let empty = dir.path().join("empty.parquet");
        std::fs::write(&empty, "").unwrap();
        assert!(matches!(
            detect(&empty).unwrap_err().cause(),
            DatasetError::Corrupt { .. }
        ));
        let parquet = dir.path().join("odd.bin");
        std::fs::write(&parquet, "PAR1....").unwrap();
        assert_eq!(detect(&parquet).unwrap(), Format::Parquet);
        assert!(matches!(
            detect(&dir.path().join("none")).unwrap_err().cause(),
            DatasetError::Io { .. }
        ));
    }
}
