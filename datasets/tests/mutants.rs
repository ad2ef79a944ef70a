//! Damaged files must give an error or data, never a panic, a crash or a hang.
//!
//! libhdf5 is C, so the mutants are opened in a child process: this very test binary, told by a variable to
//! open a folder of files. `KSIM_MUTANTS` sets the number of mutants (default 300).
#![cfg(feature = "hdf5")]
#![expect(clippy::unwrap_used, reason = "tests")]

#[path = "support/mod.rs"]
#[expect(dead_code, reason = "shared with the golden tests")]
mod support;

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use ksim_datasets::{DatasetSink, EpisodePolicy, OpenOptions, ParquetSink, Scan, copy, open};
use support::{files, golden};

/// Set in the child: the folder of mutants.
const FOLDER: &str = "KSIM_MUTANT_FOLDER";
/// All mutants together take a few seconds; a hang is a fault.
const TIME_LIMIT: Duration = Duration::from_secs(300);

/// `SplitMix64`: mutants are the same on every run.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    fn below(&mut self, n: usize) -> usize {
        usize::try_from(self.next() % n.max(1) as u64).unwrap()
    }
}

fn mutate(bytes: &mut Vec<u8>, random: &mut Random) {
    if random.below(10) == 0 {
        bytes.truncate(random.below(bytes.len()));
        return;
    }
    // The structure of an HDF5 file sits mostly at its start (h5py scatters the rest), that of columnar
    // files at their end.
    let near = bytes.len().min(8192);
    let (start, reach) = match random.below(4) {
        0 => (0, near),
        1 => (bytes.len() - near, near),
        2 => (bytes.len() - bytes.len().min(1024), bytes.len().min(1024)),
        _ => (0, bytes.len()),
    };
    for _ in 0..=random.below(8) {
        let at = start + random.below(reach);
        match random.below(4) {
            0 => bytes[at] = 0xFF,
            1 => bytes[at] = u8::try_from(random.below(256)).unwrap(),
            _ => bytes[at] ^= 1 << random.below(8),
        }
    }
}

/// A sample: its path, and the Minari dataset around it if it is the data of one.
fn samples(work: &Path) -> Vec<(PathBuf, Option<PathBuf>)> {
    const LARGEST: u64 = 200_000;
    let small = |path: &PathBuf| path.metadata().unwrap().len() < LARGEST;
    let mut samples: Vec<_> = files(&golden("formats/hdf5/d4rl"), ".hdf5")
        .into_iter()
        .filter(small)
        .map(|path| (path, None))
        .collect();
    for metadata in files(&golden("formats/minari"), "metadata.json") {
        if metadata.ends_with("data/metadata.json") {
            let dataset = metadata.parent().and_then(Path::parent).unwrap();
            for ending in [".hdf5", ".arrow", ".parquet"] {
                // The columns are those of the first episode.
                let data = files(dataset, ending).into_iter().next();
                samples.extend(data.map(|data| (data, Some(dataset.to_owned()))));
            }
        }
    }
    let source = open(
        &golden("formats/hdf5/d4rl/adroit_like.hdf5"),
        &OpenOptions::default(),
    );
    if let Ok(source) = source {
        let parquet = work.join("whole.parquet");
        let mut sink = ParquetSink::create(&parquet, source.schema()).unwrap();
        copy(source.as_ref(), &mut sink).unwrap();
        Box::new(sink).finish().unwrap();
        samples.extend((0..6).map(|_| (parquet.clone(), None)));
    }
    samples
}

fn write_mutants(folder: &Path, n_mutants: usize, samples: &[(PathBuf, Option<PathBuf>)]) {
    let mut random = Random(1);
    for number in 0..n_mutants {
        let (path, dataset) = &samples[number % samples.len()];
        let mut bytes = std::fs::read(path).unwrap();
        mutate(&mut bytes, &mut random);
        match dataset {
            None => {
                let suffix = path.extension().unwrap().to_string_lossy().into_owned();
                let stem = path.file_stem().unwrap().to_string_lossy().into_owned();
                std::fs::write(folder.join(format!("{number:05}-{stem}.{suffix}")), bytes).unwrap();
            }
            Some(dataset) => {
                let name = dataset.file_name().unwrap().to_string_lossy().into_owned();
                let mutant = folder.join(format!("{number:05}-{name}"));
                for file in files(dataset, "") {
                    let copy = mutant.join(file.strip_prefix(dataset).unwrap());
                    std::fs::create_dir_all(copy.parent().unwrap()).unwrap();
                    if file == *path {
                        std::fs::write(copy, &bytes).unwrap();
                    } else {
                        std::fs::copy(&file, copy).unwrap();
                    }
                }
            }
        }
    }
}

/// Reads everything there is to read; errors are fine.
fn read_all(path: &Path) {
    for policy in [None, Some(EpisodePolicy::D4rlQlearning)] {
        let options = OpenOptions {
            episode_policy: policy,
            force: true,
            ..OpenOptions::default()
        };
        let Ok(source) = open(path, &options) else {
            continue;
        };
        let _ = source.episodes();
        if let Ok(batches) = source.scan(&Scan {
            batch_rows: 64,
            ..Scan::default()
        }) {
            // A reader that failed ends its pass.
            let n_errors = batches.filter(Result::is_err).count();
            assert!(n_errors <= 1, "{} fails {n_errors} times", path.display());
        }
    }
}

/// The child: does nothing unless told to.
#[test]
fn open_a_folder_of_mutants() {
    let Some(folder) = std::env::var_os(FOLDER) else {
        return;
    };
    let mut paths: Vec<PathBuf> = std::fs::read_dir(&folder)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .collect();
    paths.sort();
    let log = Path::new(&folder).join("log");
    let mut lines = String::new();
    for path in paths {
        // Written before opening: the last line names the file that crashed.
        let _ = writeln!(lines, "{}", path.display());
        std::fs::write(&log, &lines).unwrap();
        read_all(&path);
    }
    std::fs::write(&log, lines + "finished").unwrap();
}

#[test]
fn damaged_files_never_crash() {
    let n_mutants = std::env::var("KSIM_MUTANTS")
        .ok()
        .and_then(|n| n.parse().ok())
        .unwrap_or(300);
    let work = tempfile::tempdir().unwrap();
    let folder = work.path().join("mutants");
    std::fs::create_dir(&folder).unwrap();
    let samples = samples(work.path());
    assert!(samples.len() >= 10, "only {} samples found", samples.len());
    write_mutants(&folder, n_mutants, &samples);
    let mut child = Command::new(std::env::current_exe().unwrap())
        .args(["--exact", "open_a_folder_of_mutants", "--nocapture"])
        .env(FOLDER, &folder)
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let start = Instant::now();
    let status = loop {
        if let Some(status) = child.try_wait().unwrap() {
            break status;
        }
        if start.elapsed() > TIME_LIMIT {
            child.kill().unwrap();
            break child.wait().unwrap();
        }
        std::thread::sleep(Duration::from_millis(20));
    };
    let log = std::fs::read_to_string(folder.join("log")).unwrap_or_default();
    let stderr = std::io::read_to_string(child.stderr.take().unwrap()).unwrap();
    let last = log.lines().last().unwrap_or_default().to_owned();
    if !(status.success() && last == "finished") {
        let kept = work.keep();
        panic!("{status} on {last} (kept in {})\n{stderr}", kept.display());
    }
    assert!(
        !stderr.contains("HDF5-DIAG"),
        "libhdf5 prints its errors:\n{stderr}"
    );
}
