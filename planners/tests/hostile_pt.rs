//! Checkpoint files that are damaged, or made to do harm: an error that says what and where, never a panic, never
//! much memory.
//!
//! `KSIM_MUTANTS` sets the number of mutants of each kind (default 4000; a fifth of it for pickles). One test at a time: the allocator counts
//! for the whole process.
#![allow(
    clippy::unwrap_used,
    reason = "a test that cannot make its files fails"
)]
#![expect(unsafe_code, reason = "a global allocator that counts")]

use std::alloc::{GlobalAlloc, Layout, System};
use std::io::{Cursor, Write as _};
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use ksim_planners::import::read_state_dicts;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipArchive, ZipWriter};

struct Counting;

static NOW: AtomicUsize = AtomicUsize::new(0);
static PEAK: AtomicUsize = AtomicUsize::new(0);

// SAFETY: hands everything on to the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let now = NOW.fetch_add(layout.size(), Ordering::Relaxed) + layout.size();
        PEAK.fetch_max(now, Ordering::Relaxed);
        // SAFETY: the caller's promises are the system's.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        NOW.fetch_sub(layout.size(), Ordering::Relaxed);
        // SAFETY: as above.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;
static ALONE: Mutex<()> = Mutex::new(());

/// Bytes that reading a file of `length` bytes may take: buffers, the directory, and the numbers while a list of
/// them grows.
fn limit(length: usize) -> usize {
    (1 << 20) + 16 * length
}

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
    match random.below(12) {
        0 => bytes.truncate(random.below(bytes.len())),
        1 => {
            let (at, n) = (random.below(bytes.len()), random.below(40));
            bytes.drain(at..bytes.len().min(at + n));
        }
        2 => {
            let (from, n) = (random.below(bytes.len()), random.below(200));
            let copied = bytes[from..bytes.len().min(from + n)].to_vec();
            let at = random.below(bytes.len());
            bytes.splice(at..at, copied);
        }
        _ => {}
    }
    // What an archive holds stands at its end.
    let near = [bytes.len(), bytes.len(), 8192, 200][random.below(4)].min(bytes.len());
    for _ in 0..random.below(6) {
        let at = bytes.len() - near + random.below(near);
        let Some(byte) = bytes.get_mut(at) else { break };
        match random.below(4) {
            0 => *byte = 0xFF,
            1 => *byte = u8::try_from(random.below(256)).unwrap(),
            _ => *byte ^= 1 << random.below(8),
        }
    }
}

fn n_mutants() -> u64 {
    let number = std::env::var("KSIM_MUTANTS").ok();
    number.map_or(4000, |number| number.parse().unwrap())
}

fn sample() -> Vec<u8> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/golden/planners");
    std::fs::read(folder.join("ckpt_tiny_rnd_classifier_target.pt")).unwrap()
}

/// A place for one file, which goes with the test.
struct Place(PathBuf);

impl Place {
    fn new(name: &str) -> Self {
        let folder = Path::new(env!("CARGO_TARGET_TMPDIR"));
        Self(folder.join(format!("{name}-{}.pt", std::process::id())))
    }

    /// What reading such a file says, and that it stays within bounds.
    fn read(&self, bytes: &[u8]) -> Result<usize, String> {
        std::fs::write(&self.0, bytes).unwrap();
        let before = NOW.load(Ordering::Relaxed);
        PEAK.store(before, Ordering::Relaxed);
        let found = read_state_dicts(&self.0);
        let taken = PEAK.load(Ordering::Relaxed) - before;
        assert!(
            taken < limit(bytes.len()),
            "{taken} bytes for {}",
            bytes.len()
        );
        match found {
            Ok(dicts) => Ok(dicts.model.n_parameters()),
            Err(error) => {
                let text = error.to_string();
                let path = self.0.display().to_string();
                let rest = text.strip_prefix(&path).unwrap_or_else(|| panic!("{text}"));
                assert!(rest.len() < 1000, "{text}");
                Err(rest.trim_start_matches(": ").to_owned())
            }
        }
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.0);
    }
}

/// Entries of an archive, as name and contents.
type Entries = Vec<(String, Vec<u8>)>;

fn entries(bytes: &[u8]) -> Entries {
    let mut archive = ZipArchive::new(Cursor::new(bytes)).unwrap();
    let mut entries = Vec::new();
    for index in 0..archive.len() {
        let mut entry = archive.by_index(index).unwrap();
        let mut contents = Vec::new();
        std::io::copy(&mut entry, &mut contents).unwrap();
        entries.push((entry.name().unwrap().into_owned(), contents));
    }
    entries
}

fn archive(entries: &Entries, method: CompressionMethod) -> Vec<u8> {
    let mut writer = ZipWriter::new(Cursor::new(Vec::new()));
    let options = SimpleFileOptions::default().compression_method(method);
    for (name, contents) in entries {
        writer.start_file(name.as_str(), options).unwrap();
        writer.write_all(contents).unwrap();
    }
    writer.finish().unwrap().into_inner()
}

/// A checkpoint of one pickle and one storage of four numbers.
fn checkpoint(pickle: &[u8]) -> Vec<u8> {
    let numbers = [1f32, 2.0, 3.0, 4.0].map(f32::to_le_bytes).concat();
    let entries = [
        ("c/data.pkl", pickle.to_vec()),
        ("c/version", b"3\n".to_vec()),
        ("c/data/0", numbers),
    ];
    let entries = entries.map(|(name, contents)| (name.to_owned(), contents));
    archive(&entries.to_vec(), CompressionMethod::Stored)
}

/// A pickle of a dict with the tensor `w`: offset, sizes and strides of a storage that is declared to have `n`
/// numbers of some type.
fn tensor(kind: &str, n: i32, offset: i32, sizes: &[i32], strides: &[i32]) -> Vec<u8> {
    let mut pickle = b"\x80\x02}X\x01\0\0\0wctorch._utils\n_rebuild_tensor_v2\n(".to_vec();
    pickle.extend(b"(X\x07\0\0\0storage");
    pickle.extend(format!("ctorch\n{kind}\n").bytes());
    pickle.extend(b"X\x01\0\0\x000X\x03\0\0\0cpu");
    let int = |pickle: &mut Vec<u8>, n: i32| {
        pickle.push(b'J');
        pickle.extend(n.to_le_bytes());
    };
    int(&mut pickle, n);
    pickle.extend(b"tQ");
    int(&mut pickle, offset);
    for numbers in [sizes, strides] {
        pickle.push(b'(');
        numbers.iter().for_each(|&n| int(&mut pickle, n));
        pickle.push(b't');
    }
    pickle.extend(b"\x89ccollections\nOrderedDict\n)RtRs.");
    pickle
}

#[test]
fn damaged_files_give_errors() {
    let _alone = ALONE.lock();
    let place = Place::new("damaged");
    let whole = sample();
    place.read(&whole).unwrap();
    let mut n_errors = 0;
    for seed in 0..n_mutants() {
        let mut bytes = whole.clone();
        mutate(&mut bytes, &mut Random(seed));
        n_errors += u64::from(place.read(&bytes).is_err());
    }
    // The rest changed what nobody reads.
    assert!(n_errors > n_mutants() / 2, "{n_errors}");
}

#[test]
fn damaged_pickles_give_errors() {
    let _alone = ALONE.lock();
    let place = Place::new("pickles");
    let mut entries = entries(&sample());
    let index = entries
        .iter()
        .position(|(name, _)| name.ends_with("/data.pkl"));
    let index = index.unwrap();
    let whole = entries[index].1.clone();
    // Packing takes longer than reading.
    let n = n_mutants().div_ceil(5);
    let mut n_errors = 0;
    for seed in 0..n {
        let mut pickle = whole.clone();
        mutate(&mut pickle, &mut Random(seed));
        entries[index].1 = pickle;
        // Checksums are right, so the pickle is what is refused.
        let bytes = archive(&entries, CompressionMethod::Stored);
        n_errors += u64::from(place.read(&bytes).is_err());
    }
    assert!(n_errors > n / 2, "{n_errors}");
}

#[test]
fn nothing_is_executed() {
    let _alone = ALONE.lock();
    let place = Place::new("executed");
    let cases: [(&[u8], &str); 11] = [
        (
            b"\x80\x02cposix\nsystem\nX\x02\0\0\0ls\x85R.",
            "data.pkl, byte 2: the name \"posix.system\" is refused: no file of tensors needs it",
        ),
        (
            b"\x80\x02c__builtin__\neval\n)R.",
            "data.pkl, byte 2: the name \"__builtin__.eval\" is refused: no file of tensors needs it",
        ),
        (
            b"\x80\x02(X\x02\0\0\0lsiposix\nsystem\n.",
            "data.pkl, byte 10: the instruction INST (0x69) is refused: no file of tensors needs it",
        ),
        (
            b"\x80\x02\x8c\x05posix\x8c\x06system\x93.",
            "data.pkl, byte 2: the instruction SHORT_BINUNICODE (0x8c) is refused: no file of tensors needs it",
        ),
        (
            b"\x80\x02}(\x93.",
            "data.pkl, byte 4: the instruction STACK_GLOBAL (0x93) is refused: no file of tensors needs it",
        ),
        (b"\x80\x04}.", "data.pkl, byte 0: protocol 4, expected 2"),
        (
            b"\x80\x02ccollections\nOrderedDict\nK\x01\x85R.",
            "data.pkl, byte 30: an OrderedDict of 1 arguments, expected none",
        ),
        (b"\x80\x02K\x01)R.", "data.pkl, byte 5: calls a number"),
        (
            b"\x80\x02}h\x07s.",
            "data.pkl, byte 3: nothing was stored as 7",
        ),
        (
            b"\x80\x02}}.",
            "data.pkl, byte 4: it ends with more than one result",
        ),
        (b"\x80\x02}.}", "data.pkl, byte 3: 1 bytes after its end"),
    ];
    for (pickle, expected) in cases {
        assert_eq!(place.read(&checkpoint(pickle)).unwrap_err(), expected);
    }
}

#[test]
fn tensors_lie_within_their_storage() {
    let _alone = ALONE.lock();
    let place = Place::new("tensors");
    let read = |pickle: Vec<u8>| place.read(&checkpoint(&pickle));
    assert_eq!(read(tensor("FloatStorage", 4, 0, &[2, 2], &[2, 1])), Ok(4));
    assert_eq!(read(tensor("HalfStorage", 8, 0, &[8], &[1])), Ok(8));
    assert_eq!(read(tensor("DoubleStorage", 2, 1, &[1, 1], &[7, 7])), Ok(1));
    let float = |offset, sizes: &[i32], strides: &[i32]| {
        read(tensor("FloatStorage", 4, offset, sizes, strides)).unwrap_err()
    };
    let cases = [
        (
            float(1, &[2, 2], &[2, 1]),
            "lead out of a storage of 4 numbers",
        ),
        (float(0, &[4], &[2]), "lead out of a storage of 4 numbers"),
        (
            float(i32::MAX, &[1], &[1]),
            "lead out of a storage of 4 numbers",
        ),
        (float(-1, &[1], &[1]), "an offset of -1"),
        (float(0, &[4], &[0]), "meet a number twice"),
        (float(0, &[2, 2], &[1, 1]), "meet a number twice"),
        (float(0, &[2, -2], &[1, 1]), "a size of -2"),
        (
            float(0, &[i32::MAX; 5], &[0; 5]),
            "on a storage of 4 numbers",
        ),
        (float(0, &[4], &[]), "1 sizes and 0 strides"),
        (float(0, &[1; 9], &[1; 9]), "9 sizes and 9 strides"),
        (
            read(tensor("FloatStorage", i32::MAX, 0, &[4], &[1])).unwrap_err(),
            "\"c/data/0\" has 16 bytes, its pickle says 8589934588",
        ),
        (
            read(tensor("FloatStorage", -4, 0, &[4], &[1])).unwrap_err(),
            "a storage of -4 numbers",
        ),
        (
            read(tensor("LongStorage", 2, 0, &[2], &[1])).unwrap_err(),
            "\"torch.LongStorage\" is refused",
        ),
    ];
    for (found, expected) in cases {
        assert!(found.contains(expected), "{found}, expected {expected}");
    }
}

#[test]
fn numbers_are_finite() {
    let _alone = ALONE.lock();
    let place = Place::new("finite");
    let mut entries = entries(&checkpoint(&tensor("FloatStorage", 4, 0, &[4], &[1])));
    entries[2].1[8..12].copy_from_slice(&f32::NAN.to_le_bytes());
    let found = place.read(&archive(&entries, CompressionMethod::Stored));
    assert_eq!(
        found.unwrap_err(),
        "tensor \"w\": its number 2 is NaN as f32"
    );
}

#[test]
fn containers_are_as_pytorch_writes_them() {
    let _alone = ALONE.lock();
    let place = Place::new("containers");
    let whole = tensor("FloatStorage", 4, 0, &[4], &[1]);
    let read = |change: &dyn Fn(&mut Entries)| {
        let mut entries = entries(&checkpoint(&whole));
        change(&mut entries);
        place.read(&archive(&entries, CompressionMethod::Stored))
    };
    assert_eq!(read(&|_| {}), Ok(4));
    let without = |name: &str| read(&|e| e.retain(|(found, _)| found != name)).unwrap_err();
    let order = |order: &str| {
        read(&|e| e.push(("c/byteorder".to_owned(), order.as_bytes().to_vec()))).unwrap_err()
    };
    let packed = archive(&entries(&checkpoint(&whole)), CompressionMethod::Deflated);
    let cases = [
        (place.read(b"").unwrap_err(), "not a zip archive"),
        (
            place.read(b"\x80\x02\x8a\x0al\xfc").unwrap_err(),
            "PyTorch before 1.6 wrote it",
        ),
        (
            place.read(b"PK\x03\x04").unwrap_err(),
            "not a whole zip archive",
        ),
        (place.read(&packed).unwrap_err(), "\"c/data.pkl\" is packed"),
        (without("c/data.pkl"), "no folder/data.pkl in it"),
        (without("c/version"), "\"c/version\" is missing"),
        (
            without("c/data/0"),
            "\"c/data/0\" is missing, which its pickle names",
        ),
        (order("big"), "byte order \"big\", expected \"little\""),
        (
            read(&|e| e[1].1 = b"77\n".to_vec()).unwrap_err(),
            "\"version\" is \"77\\n\"",
        ),
        (
            read(&|e| e.push(("d/data.pkl".to_owned(), Vec::new()))).unwrap_err(),
            "two checkpoints in it",
        ),
        (
            read(&|e| e[0].1 = vec![0x80; 2 << 20]).unwrap_err(),
            "bytes, expected 1048576 at most",
        ),
    ];
    for (found, expected) in cases {
        assert!(found.contains(expected), "{found}, expected {expected}");
    }
    let missing = read_state_dicts(Path::new("no/such.pt")).unwrap_err();
    assert_eq!(missing.to_string(), "no/such.pt: cannot open it");
}

/// The second entry's record is given the place and the name length of the first.
#[test]
fn overlapping_entries_are_refused() {
    let _alone = ALONE.lock();
    let place = Place::new("overlap");
    let mut entries = entries(&checkpoint(&tensor("FloatStorage", 4, 0, &[4], &[1])));
    let copy = entries[2].1.clone();
    entries.push(("c/data/1".to_owned(), copy));
    let mut bytes = archive(&entries, CompressionMethod::Stored);
    let records: Vec<usize> = (0..bytes.len() - 4)
        .filter(|&at| bytes[at..].starts_with(b"PK\x01\x02"))
        .collect();
    let start = |record: usize| record + 42..record + 46;
    let third = bytes[start(records[2])].to_vec();
    bytes[start(records[3])].copy_from_slice(&third);
    let found = place.read(&bytes).unwrap_err();
    assert!(found.contains("claim the same bytes"), "{found}");
}

/// Objects that hold one another many times over, or themselves, are data like any other.
#[test]
fn nesting_does_not_multiply() {
    let _alone = ALONE.lock();
    let place = Place::new("nesting");
    let mut doubling = b"\x80\x02)q\x00".to_vec();
    for _ in 0..200_000 {
        doubling.extend(b"h\x00\x86q\x00");
    }
    doubling.push(b'.');
    let found = place.read(&checkpoint(&doubling)).unwrap_err();
    assert_eq!(found, "data.pkl, byte 327682: more than 65536 objects");
    let marks = [&b"\x80\x02"[..], &[b'('; 100_000], b"."].concat();
    let found = place.read(&checkpoint(&marks)).unwrap_err();
    assert_eq!(found, "data.pkl, byte 66: more than 64 open marks");
    // A long key, over and over.
    let mut keys = b"\x80\x02}q\x00X\xf0\0\0\0".to_vec();
    keys.extend([b'k'; 240]);
    keys.extend(b"q\x01");
    keys.extend(b"K\x00s".iter());
    (0..100_000).for_each(|_| keys.extend(b"h\x01h\x01s"));
    keys.push(b'.');
    let found = place.read(&checkpoint(&keys)).unwrap_err();
    assert!(found.ends_with("is in it twice"), "{}", found.len());
    let itself = b"\x80\x02}q\x00X\x05\0\0\0modelh\x00s.";
    let found = place.read(&checkpoint(itself)).unwrap_err();
    assert_eq!(found, "\"model.model\" is a dict, expected a tensor");
    // Twice the same storage.
    let one = tensor("FloatStorage", 4, 0, &[4], &[1]);
    let body = &one[3..one.len() - 1];
    let mut twice = one[..one.len() - 1].to_vec();
    twice.extend(body);
    twice.push(b'.');
    let at = twice.len() - body.len() - 1 + 5;
    twice[at] = b'v';
    let found = place.read(&checkpoint(&twice)).unwrap_err();
    assert_eq!(found, "tensor \"w\": shares the storage \"0\" with another");
}
