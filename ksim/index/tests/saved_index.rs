//! A saved index gives what was saved, and nothing once it is damaged.

#![expect(clippy::unwrap_used, reason = "a test stops where a step fails")]

use std::fs::{self, File};
use std::path::Path;
use std::sync::OnceLock;

use ksim::{KMeans, KSim, KdTree, Prepared, Report, Search, Trajectories};
use ksim_index::{About, AboutDataset, Clustering, IndexError, SavedIndex, StagedSteps, VERSION};
use proptest::prelude::*;

/// More than a k-d tree takes.
const STATE_DIM: usize = 11;
const N_CLUSTERS: usize = 7;

/// Enough for a search to look at rounded rows.
const N_STEPS: usize = 4651;

/// Episodes of unequal length; some values need both planes.
fn episodes() -> Vec<(i64, Vec<f64>, Vec<f64>)> {
    [(3, 400), (0, 1), (9, N_STEPS - 401)]
        .map(|(number, n): (i64, usize)| {
            let value = |i: usize| ((i as f64 + number as f64) * 0.37).sin() * 3.0 + 1.0;
            let states = (0..n * STATE_DIM).map(value).collect();
            let actions = (0..n * 2).map(|i| (i as f64 * 0.11).cos()).collect();
            (number, states, actions)
        })
        .into()
}

fn in_memory() -> Trajectories {
    let mut data = Trajectories::new(STATE_DIM, 2).unwrap();
    for (number, states, actions) in episodes() {
        data.push(number, &states, &actions).unwrap();
    }
    data
}

fn fit() -> Clustering {
    Clustering::Fit {
        params: KMeans::params(N_CLUSTERS).seed(4),
        seed: 4,
        backend: "ksim",
    }
}

fn build(path: &Path, clustering: Option<&Clustering>, numbers: Option<&[i64]>) -> About {
    let folder = path.parent().unwrap();
    let mut staged = StagedSteps::new(folder, STATE_DIM, 2).unwrap();
    for (number, states, actions) in episodes() {
        staged.push(number, &states, &actions).unwrap();
    }
    let about = About {
        ksim: "test".to_owned(),
        dataset: AboutDataset {
            name: "walk".to_owned(),
            ..AboutDataset::default()
        },
        state_columns: (0..STATE_DIM).collect(),
        state_column_names: (0..STATE_DIM).map(|i| format!("x[{i}]")).collect(),
        action_dim: 2,
        clusters: None,
    };
    let options = || {
        File::options()
            .read(true)
            .write(true)
            .create(true)
            .truncate(true)
            .to_owned()
    };
    let file = options().open(path).unwrap();
    ksim_index::write(staged, numbers, about, clustering, &file, &mut |_| ()).unwrap()
}

/// Scores of some steps near the data, and of some far from them.
fn score(ksim: &KSim) -> Report {
    let mut rollouts = Trajectories::new(STATE_DIM, 2).unwrap();
    let states: Vec<f64> = (0..60 * STATE_DIM)
        .map(|i| (i as f64 * 0.7).sin() * 4.0)
        .collect();
    let actions: Vec<f64> = (0..120).map(|i| f64::from(i) * 0.01).collect();
    rollouts.push(0, &states, &actions).unwrap();
    ksim.score(&rollouts).unwrap()
}

#[test]
fn scores_with_the_index_are_those_without_to_the_last_bit() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("walk.ksimidx");
    let numbers: Vec<i64> = (0..N_STEPS as i64).map(|i| i * 2).collect();
    let about = build(&path, Some(&fit()), Some(&numbers));
    let saved = SavedIndex::open(&path).unwrap();
    saved.verify().unwrap();
    assert_eq!(*saved.about(), about);
    assert_eq!(about.dataset.fingerprint, in_memory().fingerprint());
    assert_eq!(about.dataset.n_steps, N_STEPS);
    assert_eq!(about.dataset.n_episodes, 3);
    assert_eq!(saved.numbers().unwrap(), Some(numbers));
    for search in Search::ALL {
        if search == Search::KdTree {
            const { assert!(STATE_DIM > KdTree::MAX_FEATURES) };
            continue;
        }
        let params = KSim::params().search(search).n_neighbors(9);
        let params = params.kmeans(KMeans::params(N_CLUSTERS).seed(4));
        let own = params.clone().fit(in_memory()).unwrap();
        let prepared = match search {
            Search::Clusters => Prepared {
                clusters: saved.clusters().unwrap(),
                rounded: Some(saved.rounded_clusters().unwrap().unwrap()),
            },
            Search::Blocked => Prepared {
                clusters: None,
                rounded: Some(saved.rounded_rows().unwrap().unwrap()),
            },
            _ => Prepared::default(),
        };
        let indexed = params
            .fit_prepared(saved.reference().unwrap(), prepared)
            .unwrap();
        assert_eq!(score(&own), score(&indexed), "{search}");
        if search == Search::Clusters {
            let (own, indexed) = (
                own.index().kmeans().unwrap(),
                indexed.index().kmeans().unwrap(),
            );
            assert_eq!(own.labels(), indexed.labels());
            assert_eq!(own.inertia().to_bits(), indexed.inertia().to_bits());
            assert_eq!(own.n_iterations(), indexed.n_iterations());
        }
    }
}

#[test]
fn given_centers_and_no_clusters() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("walk.ksimidx");
    let centers: Vec<f64> = (0..2 * STATE_DIM).map(|i| i as f64 * 0.3 - 1.0).collect();
    let about = build(&path, Some(&Clustering::Given(centers.clone())), None);
    assert_eq!(about.clusters.unwrap().backend, None);
    let saved = SavedIndex::open(&path).unwrap();
    assert_eq!(saved.clusters().unwrap().unwrap().centers(), centers);
    assert_eq!(saved.numbers().unwrap(), None);
    build(&path, None, None);
    let saved = SavedIndex::open(&path).unwrap();
    assert!(saved.clusters().unwrap().is_none());
    assert!(
        saved
            .sections()
            .iter()
            .all(|section| section.name != "labels")
    );
}

#[test]
fn the_same_data_give_the_same_bytes() {
    let folder = tempfile::tempdir().unwrap();
    let bytes = |name: &str| {
        let path = folder.path().join(name);
        build(&path, Some(&fit()), None);
        fs::read(path).unwrap()
    };
    assert!(bytes("a") == bytes("b"));
}

#[test]
fn nothing_to_index_and_unwritable_folders_are_errors() {
    let folder = tempfile::tempdir().unwrap();
    let empty = StagedSteps::new(folder.path(), 1, 1).unwrap();
    let file = tempfile::tempfile().unwrap();
    let error =
        ksim_index::write(empty, None, About::default(), None, &file, &mut |_| ()).unwrap_err();
    assert!(matches!(
        error,
        IndexError::Score(ksim::ScoreError::EmptyReference)
    ));
    let missing = StagedSteps::new(&folder.path().join("none"), 1, 1).unwrap_err();
    assert!(missing.to_string().contains("temporary file"), "{missing}");
}

#[test]
fn other_files_and_other_versions_say_what_they_are() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("walk.ksimidx");
    let open = |bytes: &[u8]| {
        fs::write(&path, bytes).unwrap();
        SavedIndex::open(&path).unwrap_err()
    };
    for bytes in [&b""[..], b"PAR1", b"\x89KSIM"] {
        assert!(matches!(open(bytes), IndexError::NotAnIndex), "{bytes:?}");
    }
    assert!(matches!(
        SavedIndex::open(folder.path()),
        Err(IndexError::NotAnIndex | IndexError::Io { .. })
    ));
    build(&path, None, None);
    let mut bytes = fs::read(&path).unwrap();
    bytes[8] += 1;
    assert!(matches!(
        open(&bytes),
        IndexError::Version { found, expected: VERSION } if found == VERSION + 1
    ));
}

/// Opens and reads everything there is.
fn read_all(path: &Path) -> Result<SavedIndex, IndexError> {
    let saved = SavedIndex::open(path)?;
    saved.reference()?;
    saved.clusters()?;
    saved.rounded_rows()?;
    saved.rounded_clusters()?;
    saved.numbers()?;
    saved.verify()?;
    Ok(saved)
}

/// Where the directory begins, and how many sections it has.
fn directory(bytes: &[u8]) -> (usize, usize) {
    let foot = &bytes[bytes.len() - 64..];
    let number = |at: usize| u32::from_le_bytes(foot[at..at + 4].try_into().unwrap()) as usize;
    (number(0), number(8))
}

/// Makes all checksums right again.
fn seal(bytes: &mut [u8]) {
    let (start, n_sections) = directory(bytes);
    for entry in (start..).step_by(64).take(n_sections) {
        let number = |at: usize| {
            let field = bytes[entry + at..entry + at + 8].try_into().unwrap();
            usize::try_from(u64::from_le_bytes(field)).unwrap_or(usize::MAX)
        };
        let end = number(16).saturating_add(number(24));
        let section = bytes.get(number(16)..end).unwrap_or_default();
        let hash = *blake3::hash(section).as_bytes();
        bytes[entry + 32..entry + 64].copy_from_slice(&hash);
    }
    let foot = bytes.len() - 64;
    let framed = [&bytes[..64], &bytes[start..foot]].concat();
    let hash = *blake3::hash(&framed).as_bytes();
    bytes[foot + 16..foot + 48].copy_from_slice(&hash);
}

/// Reads an index and asks it, by every search that it prepares.
fn ask(path: &Path) -> Result<(), Box<dyn std::error::Error>> {
    let saved = read_all(path)?;
    let searches = [
        (Search::Blocked, None, saved.rounded_rows()?),
        (
            Search::Clusters,
            saved.clusters()?,
            saved.rounded_clusters()?,
        ),
    ];
    for (search, clusters, rounded) in searches {
        let params = KSim::params().search(search).n_neighbors(9);
        let params = params.kmeans(KMeans::params(N_CLUSTERS));
        let reference = saved.reference()?;
        let ksim = params.fit_prepared(reference, Prepared { clusters, rounded })?;
        let mut rollouts = Trajectories::new(STATE_DIM, 2)?;
        rollouts.push(0, &[0.4; 3 * STATE_DIM], &[0.1; 6])?;
        // Few steps are searched for in another way than many.
        ksim.score(&rollouts)?;
        let states: Vec<f64> = (0..90 * STATE_DIM).map(|i| (i as f64).sin()).collect();
        rollouts.push(1, &states, &[0.3; 180])?;
        ksim.score(&rollouts)?;
    }
    Ok(())
}

#[test]
fn every_length_but_the_whole_is_incomplete() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("walk.ksimidx");
    build(&path, Some(&fit()), None);
    let whole = fs::read(&path).unwrap();
    read_all(&path).unwrap();
    for length in (8..whole.len())
        .step_by(9973)
        .chain(whole.len() - 65..whole.len())
    {
        fs::write(&path, &whole[..length]).unwrap();
        let error = read_all(&path).unwrap_err();
        assert!(
            matches!(error, IndexError::Truncated { .. }),
            "{length}: {error}"
        );
    }
    fs::write(&path, [&whole[..], b"more"].concat()).unwrap();
    assert!(matches!(read_all(&path), Err(IndexError::Truncated { .. })));
}

#[test]
fn a_forger_who_changes_nothing_is_believed() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("walk.ksimidx");
    build(&path, Some(&fit()), None);
    let whole = fs::read(&path).unwrap();
    let mut sealed = whole.clone();
    seal(&mut sealed);
    assert!(sealed == whole);
    ask(&path).unwrap();
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]

    /// What somebody has made on purpose, checksums and all, is refused or answers, and never panics.
    #[test]
    fn forged_files_are_survived(
        section in 0usize..40,
        place in 0.0f64..1.0,
        value in prop::sample::select(vec![0u64, 1, 127, 128, 0x7FF0 << 48, u64::MAX, 1 << 40]),
        n_bytes in prop::sample::select(vec![1usize, 4, 8]),
        in_directory in any::<bool>(),
    ) {
        static WHOLE: OnceLock<Vec<u8>> = OnceLock::new();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("walk.ksimidx");
        let whole = WHOLE.get_or_init(|| {
            build(&path, Some(&fit()), None);
            fs::read(&path).unwrap()
        });
        let mut bytes = whole.clone();
        let (start, n_sections) = directory(&bytes);
        let entry = start + section % n_sections * 64;
        let field = |at: usize| {
            u64::from_le_bytes(bytes[entry + at..entry + at + 8].try_into().unwrap()) as usize
        };
        // Of the entry, name, place and size: the checksum is made anew anyway.
        let (from, length) = if in_directory { (entry, 32) } else { (field(16), field(24)) };
        let at = from + (place * length as f64) as usize / n_bytes * n_bytes;
        bytes[at..at + n_bytes].copy_from_slice(&value.to_le_bytes()[..n_bytes]);
        seal(&mut bytes);
        fs::write(&path, &bytes).unwrap();
        let _ = ask(&path);
    }

    /// No byte of the file can change without being noticed, wherever it stands.
    #[test]
    fn damage_anywhere_is_noticed(place in 0.0f64..1.0, flip in 1u8..=255) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("walk.ksimidx");
        build(&path, Some(&Clustering::Given(vec![0.5; STATE_DIM])), None);
        let mut bytes = fs::read(&path).unwrap();
        let at = (place * bytes.len() as f64) as usize;
        bytes[at] ^= flip;
        fs::write(&path, &bytes).unwrap();
        prop_assert!(read_all(&path).is_err(), "byte {} of {}", at, bytes.len());
    }
}
