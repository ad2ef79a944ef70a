//! What holds for every tracked file.

use std::path::{Path, PathBuf};

use ksim_tests::{root, tracked_files};

const MAX_FILE_BYTES: u64 = 3 << 20;
const MAX_PLANNER_BYTES: u64 = 20 << 20;
const MAX_FIXTURE_BYTES: u64 = 20 << 20;
const MAX_SOURCE_LINES: usize = 800;

/// Tracked files; none outside a git checkout, where there is nothing to tell them from others.
fn files() -> Vec<PathBuf> {
    tracked_files().unwrap_or_default()
}

fn size(file: &Path) -> u64 {
    let metadata = root().join(file).metadata();
    metadata.map_or(0, |metadata| metadata.len())
}

#[test]
fn no_file_names_a_place_on_someones_machine() {
    let mut places: Vec<String> = ["home", "root", "Users", "tmp"]
        .map(|place| format!("/{place}/"))
        .to_vec();
    places.push(root().display().to_string());
    let mut found = Vec::new();
    for file in files() {
        let bytes = std::fs::read(root().join(&file)).expect("a tracked file is readable");
        // Data files are not read as text.
        let Ok(text) = String::from_utf8(bytes) else {
            continue;
        };
        for (number, line) in text.lines().enumerate() {
            if places.iter().any(|place| names(line, place)) {
                found.push(format!("{}:{}: {line}", file.display(), number + 1));
            }
        }
    }
    assert!(found.is_empty(), "{}", found.join("\n"));
}

/// Whether an absolute path in `line` begins with `place`. The home of a user `x` is no one's: tests
/// of paths may use it.
fn names(line: &str, place: &str) -> bool {
    line.match_indices(place).any(|(at, _)| {
        let before = line[..at].chars().next_back();
        // `a/tmp/b` is relative, `~/tmp` and `$X/tmp` are no one's in particular.
        let is_absolute =
            before.is_none_or(|before| !before.is_alphanumeric() && !"._~}-".contains(before));
        let rest = &line[at + place.len()..];
        is_absolute
            && !["x/", "x\""]
                .iter()
                .any(|fiction| rest.starts_with(fiction))
    })
}

#[test]
fn files_stay_small() {
    // Trained planners have a limit of their own, all together.
    let (planners, files): (Vec<_>, Vec<_>) = files()
        .into_iter()
        .partition(|file| file.starts_with("examples/planners"));
    let total: u64 = planners.iter().map(|file| size(file)).sum();
    assert!(total <= MAX_PLANNER_BYTES, "planners take {total} bytes");
    let large: Vec<_> = files
        .iter()
        .filter(|file| size(file) > MAX_FILE_BYTES)
        .collect();
    assert!(large.is_empty(), "over {MAX_FILE_BYTES} bytes: {large:?}");
    let fixtures = files.iter().filter(|file| {
        let mut folders = file.components().map(|part| part.as_os_str());
        folders.any(|part| part == "fixtures" || part == "demo")
    });
    let total: u64 = fixtures.map(|file| size(file)).sum();
    assert!(total <= MAX_FIXTURE_BYTES, "fixtures take {total} bytes");
}

#[test]
fn source_files_stay_readable_in_one_sitting() {
    let long: Vec<_> = files()
        .into_iter()
        .filter(|file| file.extension().is_some_and(|extension| extension == "rs"))
        .filter_map(|file| {
            let text = std::fs::read_to_string(root().join(&file)).ok()?;
            let lines = text.lines().count();
            (lines > MAX_SOURCE_LINES).then_some((file, lines))
        })
        .collect();
    assert!(long.is_empty(), "over {MAX_SOURCE_LINES} lines: {long:?}");
}
