//! NumPy's generator and the mazes against recordings under `$KSIM_GOLDEN/environments`, by default a small part of it in
//! the repository; the generator also against a million draws in `fixtures/numpy_rng.json`, made by the script beside it.

#![expect(clippy::unwrap_used, reason = "a test stops where a step fails")]

use std::path::{Path, PathBuf};

use ksim_envs::maze::{Cell, Maze};
use ksim_envs::numpy_rng::Generator;
use ksim_envs::registry::{EnvironmentRequest, for_minari_spec};
use serde_json::Value;

fn golden() -> PathBuf {
    match std::env::var_os("KSIM_GOLDEN") {
        Some(root) => PathBuf::from(root),
        None => Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/fixtures/golden"),
    }
}

fn read(path: &Path) -> Value {
    let text = std::fs::read_to_string(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    serde_json::from_str(&text).unwrap()
}

fn floats(value: &Value) -> Vec<f64> {
    serde_json::from_value(value.clone()).unwrap()
}

/// Bits of the numbers as integers, each times 1, 3, 5, …, summed modulo 2^64.
fn checksum(bits: impl Iterator<Item = u64>) -> u64 {
    (bits.zip((1_u64..).step_by(2))).fold(0, |sum, (bits, weight)| {
        sum.wrapping_add(bits.wrapping_mul(weight))
    })
}

#[test]
fn golden_vectors_of_every_seed() {
    let recorded = read(&golden().join("environments/seeded_resets.json"));
    let seeds = recorded["rng_vectors"].as_object().unwrap();
    assert!(!seeds.is_empty());
    for (seed, vectors) in seeds {
        let generator = Generator::new(seed.parse().unwrap());
        let draws = |list: &str, draw: fn(&mut Generator) -> f64| {
            let mut generator = generator.clone();
            let recorded = floats(&vectors[list]);
            let drawn: Vec<f64> = recorded.iter().map(|_| draw(&mut generator)).collect();
            assert_eq!(drawn, recorded, "seed {seed}: {list}");
        };
        draws("random", Generator::random);
        draws("standard_normal", Generator::standard_normal);
        draws("integers_0_7", |generator| generator.integers(7) as f64);
    }
}

#[test]
fn golden_millions_of_draws() {
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    let recorded = read(&here.join("tests/fixtures/numpy_rng.json"));
    for vectors in recorded["vectors"].as_array().unwrap() {
        let seed = vectors["seed"].as_u64().unwrap();
        let n = vectors["n"].as_u64().unwrap();
        let spacing = usize::try_from(vectors["spacing"].as_u64().unwrap()).unwrap();
        let mut generator = Generator::new(seed);
        let normals: Vec<f64> = (0..n).map(|_| generator.standard_normal()).collect();
        let spaced: Vec<f64> = normals.iter().copied().step_by(spacing).collect();
        assert_eq!(spaced, floats(&vectors["normals"]), "seed {seed}");
        for draw in vectors["tail"].as_array().unwrap() {
            let at = usize::try_from(draw[0].as_u64().unwrap()).unwrap();
            assert_eq!(
                Some(normals[at]),
                draw[1].as_f64(),
                "seed {seed}, draw {at}"
            );
        }
        let expect = |name: &str, found: u64| {
            assert_eq!(Some(found), vectors[name].as_u64(), "seed {seed}: {name}");
        };
        expect(
            "normals_checksum",
            checksum(normals.iter().map(|x| x.to_bits())),
        );
        let mut generator = Generator::new(seed);
        let uniforms = (0..n).map(|_| generator.uniform(-0.25, 0.25).to_bits());
        expect("uniforms_checksum", checksum(uniforms));
        let mut generator = Generator::new(seed);
        let integers = (0..2000).map(|_| generator.integers((1 << 31) + 1));
        expect("rejecting_checksum", checksum(integers));
    }
}

#[test]
fn golden_integers_between_other_draws() {
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    let recorded = read(&here.join("tests/fixtures/numpy_rng.json"));
    for vectors in recorded["vectors"].as_array().unwrap() {
        let mut generator = Generator::new(vectors["seed"].as_u64().unwrap());
        for draw in vectors["integers"].as_array().unwrap() {
            let n = draw[0].as_u64().unwrap();
            let drawn = (generator.integers(n), generator.random());
            let expected = (draw[1].as_u64().unwrap(), draw[2].as_f64().unwrap());
            assert_eq!(drawn, expected, "of {n}");
        }
    }
}

#[test]
fn golden_maze_resets() {
    let recorded = read(&golden().join("environments/seeded_resets.json"));
    let mut n_resets = 0;
    for (id, resets) in recorded["seeded_resets"].as_object().unwrap() {
        let Some(maze) = maze_of(id) else { continue };
        for reset in resets.as_array().unwrap() {
            let mut generator = Generator::new(reset["seed"].as_u64().unwrap_or(0));
            if reset["seed"].is_string() {
                maze.draw_episode(None, None, &mut generator).unwrap();
            }
            let drawn = maze.draw_episode(None, None, &mut generator).unwrap();
            assert_eq!(drawn.goal[..], floats(&reset["goal"]), "{id}: {reset}");
            assert_eq!(
                drawn.start[..],
                floats(&reset["qpos"])[..2],
                "{id}: {reset}"
            );
            n_resets += 1;
        }
    }
    assert!(n_resets > 0);
}

/// The map of a sparse AntMaze id.
fn maze_of(id: &str) -> Option<Maze> {
    let (name, _) = id.strip_prefix("AntMaze_")?.split_once('-')?;
    Some(Maze::published(name).unwrap_or_else(|| panic!("no map {name}")))
}

#[test]
fn golden_maps() {
    let folder = golden().join("environments/model_facts");
    let mut n_maps = 0;
    for entry in std::fs::read_dir(&folder).unwrap() {
        let facts = read(&entry.unwrap().path());
        let id = facts["env_id"].as_str().unwrap();
        let (Some(maze), facts) = (maze_of(id), &facts["maze"]) else {
            continue;
        };
        assert_eq!(maze.to_json(), facts["map"], "{id}");
        assert_eq!(Maze::from_json(&facts["map"]), Ok(maze.clone()), "{id}");
        let centers = |cells: &[Cell]| -> Vec<f64> {
            cells.iter().flat_map(|&cell| maze.center(cell)).collect()
        };
        let places = |list: &Value| -> Vec<f64> {
            list.as_array().unwrap().iter().flat_map(floats).collect()
        };
        assert_eq!(
            centers(maze.goals()),
            places(&facts["goal_locations"]),
            "{id}"
        );
        assert_eq!(
            centers(maze.starts()),
            places(&facts["reset_locations"]),
            "{id}"
        );
        for (cell, center) in facts["cell_centres"].as_object().unwrap() {
            let (row, column) = cell.split_once(',').unwrap();
            let cell = (row.parse().unwrap(), column.parse().unwrap());
            assert_eq!(maze.center(cell)[..], floats(center), "{id}: {cell:?}");
            assert_eq!(maze.cell_at(maze.center(cell)), Some(cell), "{id}");
        }
        let blocks = facts["blocks"].as_array().unwrap().iter();
        let blocks: Vec<&str> = blocks
            .map(|block| block["name"].as_str().unwrap())
            .collect();
        let walls = maze.walls();
        let walls: Vec<String> = (walls.iter().map(|(i, j)| format!("block_{i}_{j}"))).collect();
        assert_eq!(walls, blocks, "{id}");
        n_maps += 1;
    }
    assert!(n_maps > 0, "no maze in {}", folder.display());
}

#[test]
fn golden_evaluation_maps() {
    let folder = golden().join("data_fixtures/minari/D4RL/antmaze");
    let mut n_datasets = 0;
    for entry in std::fs::read_dir(&folder).unwrap() {
        let dataset = entry.unwrap().path();
        let name = dataset.file_name().unwrap().to_string_lossy().into_owned();
        let metadata = dataset.join("data/metadata.json");
        if !metadata.is_file() {
            continue;
        }
        let size = match name.split('-').next() {
            Some("umaze") => "UMaze",
            Some("medium") => "Medium",
            _ => "Large",
        };
        let metadata = read(&metadata);
        let spec = |key: &str| for_minari_spec(&name, &metadata[key]).unwrap();
        let (collection, evaluation) = (spec("env_spec"), spec("eval_env_spec"));
        assert_eq!(collection.id, evaluation.id, "{name}");
        assert!(
            collection.id.starts_with(&format!("AntMaze_{size}")),
            "{name}"
        );
        let map = |request: &EnvironmentRequest| Maze::from_json(&request.kwargs["maze_map"]).ok();
        assert_eq!(map(&collection), maze_of(&collection.id), "{name}");
        assert_eq!(map(&evaluation), Maze::evaluation(size), "{name}");
        n_datasets += 1;
    }
    assert!(n_datasets > 0, "no dataset in {}", folder.display());
}
