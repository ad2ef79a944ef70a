//! The same transitions give the same score, to the last bit, whatever file they come from and
//! however many threads compute it.

#![expect(clippy::unwrap_used, reason = "a test stops where a step fails")]

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use hdf5_metno::{File, Group, H5Type};
use ksim::{KMeans, KSim, Report, Search, Trajectories};
use ksim_datasets::convert::{ConvertOptions, convert};
use ksim_datasets::{Format, OpenOptions, TransitionOptions, TransitionReader};
use ndarray::{Array2, ArrayView, Dimension};

const STATE_DIM: usize = 12;
const ACTION_DIM: usize = 3;

/// Steps of one episode; the state has one row more, the final observation.
struct Episode {
    states: Array2<f64>,
    actions: Array2<f32>,
}

impl Episode {
    /// Smooth motion with a part that no two episodes share.
    fn new(seed: usize, n_steps: usize) -> Self {
        let noise = |row: usize, column: usize| {
            let mixed = (seed * 7919 + row * 104_729 + column * 1_299_709) % 10_007;
            mixed as f64 / 10_007.0 - 0.5
        };
        Self {
            states: Array2::from_shape_fn((n_steps + 1, STATE_DIM), |(row, column)| {
                let phase = row as f64 * 0.03 + (seed % 5) as f64;
                (phase * (1.0 + column as f64 * 0.1)).sin() + 0.3 * noise(row, column)
            }),
            actions: Array2::from_shape_fn((n_steps, ACTION_DIM), |(row, column)| {
                noise(row, column + STATE_DIM) as f32
            }),
        }
    }

    fn n_steps(&self) -> usize {
        self.actions.nrows()
    }

    /// Flags that are true on the last step only.
    fn ends(&self) -> Vec<bool> {
        (1..=self.n_steps()).map(|n| n == self.n_steps()).collect()
    }
}

/// More reference rows than one chunk of the engine's parallel sums (2048).
fn reference() -> Vec<Episode> {
    (0..12).map(|seed| Episode::new(seed, 700 + seed)).collect()
}

fn rollouts() -> Vec<Episode> {
    (40..43).map(|seed| Episode::new(seed, 150)).collect()
}

fn put<'d, T: H5Type, D: Dimension>(
    group: &Group,
    name: &str,
    data: impl Into<ArrayView<'d, T, D>>,
) {
    group
        .new_dataset_builder()
        .with_data(data)
        .create(name)
        .unwrap();
}

/// One flat file, all episodes behind one another, final observations left out.
fn write_d4rl(episodes: &[Episode], folder: &Path) -> PathBuf {
    let path = folder.join("d4rl.hdf5");
    let file = File::create(&path).unwrap();
    let states: Vec<_> = episodes
        .iter()
        .map(|e| e.states.slice(ndarray::s![..e.n_steps(), ..]))
        .collect();
    let actions: Vec<_> = episodes.iter().map(|e| e.actions.view()).collect();
    let states = ndarray::concatenate(ndarray::Axis(0), &states).unwrap();
    let actions = ndarray::concatenate(ndarray::Axis(0), &actions).unwrap();
    let ends: Vec<bool> = episodes.iter().flat_map(Episode::ends).collect();
    put(&file, "observations", &states);
    put(&file, "actions", &actions);
    put(&file, "rewards", &vec![0.0f32; ends.len()]);
    put(&file, "terminals", &vec![false; ends.len()]);
    put(&file, "timeouts", &ends);
    path
}

/// A dataset folder, one group per episode, N + 1 observations for N actions.
fn write_minari(episodes: &[Episode], folder: &Path) -> PathBuf {
    let dataset = folder.join("agree-v0");
    std::fs::create_dir_all(dataset.join("data")).unwrap();
    let file = File::create(dataset.join("data/main_data.hdf5")).unwrap();
    for (index, episode) in episodes.iter().enumerate() {
        let group = file.create_group(&format!("episode_{index}")).unwrap();
        let n_steps = episode.n_steps();
        for (name, value) in [("id", index), ("total_steps", n_steps)] {
            let attribute = group.new_attr::<i64>().create(name).unwrap();
            attribute.write_scalar(&(value as i64)).unwrap();
        }
        put(&group, "observations", &episode.states);
        put(&group, "actions", &episode.actions);
        put(&group, "rewards", &vec![0.0f64; n_steps]);
        put(&group, "terminations", &vec![false; n_steps]);
        put(&group, "truncations", &episode.ends());
    }
    let space = |dtype: &str, dim: usize| {
        let bound = |word: &str| vec![word; dim].join(", ");
        format!(
            r#"{{"type": "Box", "dtype": "{dtype}", "shape": [{dim}], "low": [{}], "high": [{}]}}"#,
            bound("-Infinity"),
            bound("Infinity")
        )
    };
    let metadata = serde_json::json!({
        "dataset_id": "agree-v0",
        "minari_version": "0.5.4",
        "data_format": "hdf5",
        "total_episodes": episodes.len(),
        "total_steps": episodes.iter().map(Episode::n_steps).sum::<usize>(),
        "observation_space": space("float64", STATE_DIM),
        "action_space": space("float32", ACTION_DIM),
    });
    std::fs::write(dataset.join("data/metadata.json"), metadata.to_string()).unwrap();
    dataset
}

/// What the Minari folder holds, in every format we write.
fn write_converted(minari: &Path, folder: &Path) -> Vec<PathBuf> {
    let formats = [
        (Format::Parquet, "copy.parquet"),
        (Format::ArrowIpc, "copy.arrow"),
        (Format::D4rlHdf5, "copy.hdf5"),
        (Format::MinariHdf5, "hdf5-v0"),
        (Format::MinariArrow, "arrow-v0"),
        (Format::MinariParquet, "parquet-v0"),
        (Format::LeRobot, "lerobot"),
        (Format::Mcap, "copy.mcap"),
    ];
    let source = ksim_datasets::open(minari, &OpenOptions::default()).unwrap();
    let write = |(format, name): (Format, &str)| {
        let path = folder.join(name);
        let options = ConvertOptions::new(format);
        let go_on = &mut |_| ControlFlow::Continue(());
        convert(source.as_ref(), &path, &options, go_on).unwrap();
        path
    };
    formats.into_iter().map(write).collect()
}

/// Every file form of the same episodes.
fn write_all(episodes: &[Episode], folder: &Path) -> Vec<PathBuf> {
    std::fs::create_dir_all(folder).unwrap();
    let minari = write_minari(episodes, folder);
    let mut all = write_converted(&minari, folder);
    all.extend([write_d4rl(episodes, folder), minari]);
    all
}

fn read(path: &Path, state_columns: Option<Vec<usize>>) -> Trajectories {
    let source = ksim_datasets::open(path, &OpenOptions::default()).unwrap();
    let options = TransitionOptions {
        state_columns,
        batch_rows: 1000, // so that episodes span batches
        ..TransitionOptions::default()
    };
    let reader = TransitionReader::new(source.as_ref(), &options).unwrap();
    let mut data = Trajectories::new(reader.state_width(), reader.action_width()).unwrap();
    for batch in reader {
        let batch = batch.unwrap();
        let rows: Vec<usize> = (0..batch.n_rows()).collect();
        for run in rows.chunk_by(|&a, &b| batch.episode_index[a] == batch.episode_index[b]) {
            let (first, end) = (run[0], run[0] + run.len());
            data.push(
                batch.episode_index[first],
                &batch.states[first * batch.state_width..end * batch.state_width],
                &batch.actions[first * batch.action_width..end * batch.action_width],
            )
            .unwrap();
        }
    }
    data
}

fn score(reference: Trajectories, rollouts: &Trajectories, search: Search) -> Report {
    KSim::params()
        .search(search)
        .kmeans(KMeans::params(8))
        .n_resamples(200)
        .fit(reference)
        .unwrap()
        .score(rollouts)
        .unwrap()
}

fn on_threads<R: Send>(n_threads: usize, work: impl FnOnce() -> R + Send) -> R {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(n_threads);
    pool.build().unwrap().install(work)
}

#[test]
fn every_format_gives_the_same_bits() {
    let folder = tempfile::tempdir().unwrap();
    let references = write_all(&reference(), &folder.path().join("reference"));
    let rollouts = write_all(&rollouts(), &folder.path().join("rollouts"));
    let few = Some(vec![0, 1]);
    for (search, columns) in [
        (Search::Blocked, None),
        (Search::Clusters, None),
        (Search::KdTree, few),
    ] {
        let mut first: Option<(String, Report)> = None;
        for (reference, rollouts) in references.iter().zip(&rollouts) {
            let data = read(reference, columns.clone());
            assert_eq!(data.n_rows(), 12 * 700 + 66, "{}", reference.display());
            let queries = read(rollouts, columns.clone());
            let fingerprint = data.fingerprint() + &queries.fingerprint();
            let one = on_threads(1, || score(data.clone(), &queries, search));
            let two = on_threads(2, || score(data, &queries, search));
            assert_eq!(one, two, "{search}: threads, {}", reference.display());
            let (print, report) = first.get_or_insert((fingerprint.clone(), one.clone()));
            assert_eq!(*print, fingerprint, "{}", reference.display());
            assert_eq!(*report, one, "{search}: {}", reference.display());
        }
    }
}
