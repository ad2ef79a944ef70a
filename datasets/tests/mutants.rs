//! Damaged files must give an error or data, never a panic, a crash or a hang.
//!
//! libhdf5 is C, so the mutants are opened in child processes: this very test binary, told by a variable to
//! open a folder of files. A child may take so much memory and no more (on Linux), and so long for a file.
//! `KSIM_MUTANTS` sets the number of mutants (default 400). A new format needs one line in `FILES` or `FOLDERS`.
#![cfg(feature = "hdf5")]
#![expect(clippy::unwrap_used, reason = "tests")]

#[path = "support/mod.rs"]
#[expect(dead_code, reason = "shared with the golden tests")]
mod support;

use std::fs::File;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use ksim_datasets::{
    EpisodePolicy, Format, OpenOptions, Scan, SinkInput, WriteOptions, copy, create, open,
};
use support::{files, golden};

/// Set in the child: the folder of mutants.
const FOLDER: &str = "KSIM_MUTANT_FOLDER";
/// A mutant takes milliseconds; a hang is a fault.
const TIME_LIMIT: Duration = Duration::from_secs(60);
/// Address space of a child, in KiB: what its threads reserve, and room for the bounds that readers document.
const MEMORY_LIMIT: u64 = 4 << 20;
/// Mutants that a child opens.
const AT_ONCE: usize = 2000;
/// Larger samples are passed over.
const LARGEST: u64 = 200_000;
/// Where files that are datasets lie, and how they end.
const FILES: [(&str, &str); 4] = [
    ("formats/hdf5/d4rl", ".hdf5"),
    ("formats/hdf5/robomimic", ".hdf5"),
    ("formats/hdf5/npz", ".npz"),
    ("formats/mcap", ".mcap"),
];
/// Where folders that are datasets lie, and a file that each of them has.
const FOLDERS: [(&str, &str); 2] = [
    ("formats/minari", "data/metadata.json"),
    ("formats/lerobot", "meta/info.json"),
];
/// Formats that a D4RL sample is written to.
const WRITTEN: &[Format] = &[
    Format::Parquet,
    Format::ArrowIpc,
    #[cfg(feature = "mcap")]
    Format::Mcap,
];

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

/// What is mutated: a file, and the folder around it if that is the dataset.
struct Sample {
    file: PathBuf,
    dataset: Option<PathBuf>,
}

fn samples(work: &Path) -> Vec<Sample> {
    let small = |path: &PathBuf| (1..LARGEST).contains(&path.metadata().unwrap().len());
    let mut samples = Vec::new();
    for (folder, ending) in FILES {
        let found = files(&golden(folder), ending).into_iter().filter(small);
        samples.extend(found.map(|file| Sample {
            file,
            dataset: None,
        }));
    }
    for (folder, mark) in FOLDERS {
        for marked in files(&golden(folder), mark) {
            let depth = Path::new(mark).components().count();
            let dataset = marked.ancestors().nth(depth).unwrap().to_owned();
            // The columns are those of the first episode, so its files come first.
            let found = files(&dataset, "").into_iter().filter(small).take(4);
            samples.extend(found.map(|file| Sample {
                file,
                dataset: Some(dataset.clone()),
            }));
        }
    }
    let source = golden("formats/hdf5/d4rl/adroit_like.hdf5");
    if let Ok(source) = open(&source, &OpenOptions::default()) {
        let (schema, episodes) = (source.schema(), source.episodes().unwrap());
        let input = SinkInput {
            schema: &schema,
            info: source.info(),
            episodes: &episodes,
        };
        for &format in WRITTEN {
            let file = work.join(format!("whole.{format}"));
            let mut sink = create(&file, format, &input, &WriteOptions::default()).unwrap();
            copy(source.as_ref(), sink.as_mut()).unwrap();
            sink.finish().unwrap();
            samples.extend((0..6).map(|_| Sample {
                file: file.clone(),
                dataset: None,
            }));
        }
    }
    samples
}

/// Where a mutant finds the mapping of the sample it was made from, if that is a recording.
fn mapping(mutant: &Path) -> Option<PathBuf> {
    let (_, sample) = mutant.file_name()?.to_str()?.split_once('-')?;
    let work = mutant.parent()?.parent()?;
    Some(work.join(format!("{sample}.toml"))).filter(|mapping| mapping.exists())
}

/// Puts a proposed mapping of every recording that has none of its own beside the mutants.
#[cfg(feature = "mcap")]
fn write_mappings(work: &Path, samples: &[Sample]) {
    for sample in samples {
        let proposal = ksim_datasets::mcap::inspect(&sample.file, true).and_then(|i| i.propose());
        if let Ok(toml) = proposal
            && sample.file.parent() != Some(work)
        {
            let name = sample.file.file_name().unwrap().to_string_lossy();
            std::fs::write(work.join(format!("{name}.toml")), toml).unwrap();
        }
    }
}

#[cfg(not(feature = "mcap"))]
fn write_mappings(_work: &Path, _samples: &[Sample]) {}

fn write_mutant(folder: &Path, number: usize, sample: &Sample, random: &mut Random) {
    let mut bytes = std::fs::read(&sample.file).unwrap();
    mutate(&mut bytes, random);
    let of = sample.dataset.as_ref().unwrap_or(&sample.file);
    let name = of.file_name().unwrap().to_string_lossy().into_owned();
    let mutant = folder.join(format!("{number:07}-{name}"));
    let Some(dataset) = &sample.dataset else {
        std::fs::write(mutant, bytes).unwrap();
        return;
    };
    for file in files(dataset, "") {
        let copy = mutant.join(file.strip_prefix(dataset).unwrap());
        std::fs::create_dir_all(copy.parent().unwrap()).unwrap();
        if file == sample.file {
            std::fs::write(copy, &bytes).unwrap();
        } else {
            std::os::unix::fs::symlink(&file, copy).unwrap();
        }
    }
}

/// Reads everything there is to read; errors are fine.
fn read_all(path: &Path) {
    let policies = [None, Some(EpisodePolicy::D4rlQlearning), None];
    for (pass, policy) in policies.into_iter().enumerate() {
        let options = OpenOptions {
            episode_policy: policy,
            force: true,
            recover: pass == 2,
            mapping: mapping(path),
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
    let mut log = File::create(Path::new(&folder).with_extension("log")).unwrap();
    let mut paths: Vec<PathBuf> = std::fs::read_dir(&folder)
        .unwrap()
        .map(|entry| entry.unwrap().path())
        .collect();
    paths.sort();
    for path in paths {
        // Written before opening: the last line names the file that crashed.
        writeln!(log, "{}", path.display()).unwrap();
        read_all(&path);
    }
    writeln!(log, "finished").unwrap();
}

/// This test binary as a child that may not take more memory than it should.
fn child(folder: &Path) -> Command {
    let this = std::env::current_exe().unwrap();
    let mut command = match cfg!(target_os = "linux") {
        true => {
            let mut command = Command::new("sh");
            let limited = format!("ulimit -v {MEMORY_LIMIT} && exec \"$0\" \"$@\"");
            command.arg("-c").arg(limited).arg(this);
            command
        }
        false => Command::new(this),
    };
    command
        .args(["--exact", "open_a_folder_of_mutants", "--nocapture"])
        .env(FOLDER, folder)
        .stdout(Stdio::null());
    command
}

/// Opens the mutants of a folder. Gives what is wrong.
fn run(folder: &Path) -> Result<(), String> {
    let (log, said) = (folder.with_extension("log"), folder.with_extension("err"));
    let mut child = child(folder)
        .stderr(File::create(&said).unwrap())
        .spawn()
        .unwrap();
    let mut start = (Instant::now(), 0);
    let status = loop {
        if let Some(status) = child.try_wait().unwrap() {
            break status;
        }
        let length = log.metadata().map_or(0, |log| log.len());
        if length != start.1 {
            start = (Instant::now(), length);
        }
        if start.0.elapsed() > TIME_LIMIT {
            child.kill().unwrap();
            break child.wait().unwrap();
        }
        std::thread::sleep(Duration::from_millis(20));
    };
    let log = std::fs::read_to_string(log).unwrap_or_default();
    let said = std::fs::read_to_string(said).unwrap_or_default();
    let last = log.lines().last().unwrap_or_default().to_owned();
    match status.success() && last == "finished" {
        true if said.contains("HDF5-DIAG") => Err(format!("libhdf5 prints its errors:\n{said}")),
        true => Ok(()),
        false => Err(format!("{status} on {last}\n{said}")),
    }
}

#[test]
fn damaged_files_never_crash() {
    let n_mutants: usize = std::env::var("KSIM_MUTANTS")
        .ok()
        .and_then(|n| n.parse().ok())
        .unwrap_or(400);
    // In memory, where there is a place for that.
    let memory = Path::new("/dev/shm");
    let work = match memory.is_dir() {
        true => tempfile::tempdir_in(memory).unwrap(),
        false => tempfile::tempdir().unwrap(),
    };
    let samples = samples(work.path());
    assert!(samples.len() >= 10, "only {} samples found", samples.len());
    write_mappings(work.path(), &samples);
    let starts: Vec<usize> = (0..n_mutants).step_by(AT_ONCE).collect();
    let next = AtomicUsize::new(0);
    let work_through = || {
        while let Some(&first) = starts.get(next.fetch_add(1, Ordering::Relaxed)) {
            let folder = work.path().join(format!("mutants{first}"));
            std::fs::create_dir(&folder).unwrap();
            // The same mutants whatever runs beside them.
            let mut random = Random(first as u64 + 1);
            for number in first..n_mutants.min(first + AT_ONCE) {
                let sample = &samples[number % samples.len()];
                write_mutant(&folder, number, sample, &mut random);
            }
            run(&folder)?;
            std::fs::remove_dir_all(&folder).unwrap();
        }
        Ok(())
    };
    let faults: Vec<String> = std::thread::scope(|scope| {
        let n_workers = std::thread::available_parallelism().map_or(1, usize::from);
        let workers: Vec<_> = (0..n_workers).map(|_| scope.spawn(work_through)).collect();
        let results = workers.into_iter().map(|worker| worker.join().unwrap());
        results.filter_map(Result::err).collect()
    });
    if let Some(fault) = faults.first() {
        let kept = work.keep();
        panic!("kept in {}: {fault}", kept.display());
    }
}
