#!/usr/bin/env python3
"""Reading HDF5 into Arrow, against h5py in the same run. Needs numpy and h5py.

usage: bench_read.py MINARI_FOLDER [--steps N] [--work DIR] [--binary PATH] [--runs N]

Repeats the episodes of MINARI_FOLDER to N steps, writes the same rows as a D4RL file (gzip), and prints the
best time of each reader and the ratio.
"""
import argparse
import json
import subprocess
import tempfile
import time
from pathlib import Path

import h5py
import numpy as np


def make_minari(source: Path, target: Path, n_steps: int) -> None:
    (target / "data").mkdir(parents=True, exist_ok=True)
    metadata = json.loads((source / "data/metadata.json").read_text())
    with h5py.File(source / "data/main_data.hdf5") as a, h5py.File(
        target / "data/main_data.hdf5", "w", track_order=True
    ) as b:
        done = episode = 0
        while done < n_steps:
            group = a[f"episode_{episode % metadata['total_episodes']}"]
            a.copy(group, b, f"episode_{episode}")
            done += group["rewards"].shape[0]
            episode += 1
    metadata.update(total_episodes=episode, total_steps=done)
    (target / "data/metadata.json").write_text(json.dumps(metadata))


def arrays(group: h5py.Group) -> list[h5py.Dataset]:
    """Observation and action arrays of an episode."""
    observations = group["observations"]
    leaves = list(observations.values()) if isinstance(observations, h5py.Group) else [observations]
    return [*leaves, group["actions"]]


def make_d4rl(source: Path, target: Path) -> None:
    rows = {"observations": [], "actions": [], "rewards": [], "terminals": [], "timeouts": []}
    with h5py.File(source / "data/main_data.hdf5") as f:
        for episode in range(len(f)):
            group = f[f"episode_{episode}"]
            *observations, actions = arrays(group)
            n = actions.shape[0]
            rows["observations"].append(np.concatenate([o[:n] for o in observations], 1).astype(np.float32))
            rows["actions"].append(actions[()])
            rows["rewards"].append(group["rewards"][()].astype(np.float32))
            rows["terminals"].append(group["terminations"][()])
            rows["timeouts"].append(group["truncations"][()])
    with h5py.File(target, "w") as f:
        for key, parts in rows.items():
            f.create_dataset(key, data=np.concatenate(parts), compression="gzip")


def read_minari(path: Path) -> int:
    n = 0
    with h5py.File(path / "data/main_data.hdf5") as f:
        for episode in range(len(f)):
            n += [array[()] for array in arrays(f[f"episode_{episode}"])][0].shape[0]
    return n


def read_d4rl(path: Path) -> int:
    with h5py.File(path) as f:
        # The reader under test also has to read the flags, to know the episodes.
        return [f[key][()] for key in ("observations", "actions", "terminals", "timeouts")][0].shape[0]


def timed(run) -> float:
    start = time.perf_counter()
    run()
    return time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("--work", type=Path, default=Path(tempfile.gettempdir()) / "ksim_bench_read")
    parser.add_argument("--binary", type=Path, default=Path("target/release/examples/time_read"))
    parser.add_argument("--runs", type=int, default=5)
    args = parser.parse_args()
    minari, d4rl = args.work / "minari-v0", args.work / "d4rl.hdf5"
    if not (minari / "data/metadata.json").exists():
        make_minari(args.dataset, minari, args.steps)
    if not d4rl.exists():
        make_d4rl(minari, d4rl)
    print(f"{'format':8}{'h5py s':>10}{'arrow s':>10}{'ratio':>8}{'matrix s':>10}")
    for name, path, read in (("minari", minari, read_minari), ("d4rl", d4rl, read_d4rl)):
        ours = {"arrow": [], "matrix": []}
        theirs = []
        # Alternating, so that a busy machine is unfair to neither.
        for _ in range(args.runs):
            theirs.append(timed(lambda: read(path)))
            for into, times in ours.items():
                out = subprocess.run([args.binary, path, into], check=True, capture_output=True, text=True)
                times.append(float(out.stdout.split()[1]))
        best = {into: min(times) for into, times in ours.items()}
        ratio = best["arrow"] / min(theirs)
        print(f"{name:8}{min(theirs):10.3f}{best['arrow']:10.3f}{ratio:8.2f}{best['matrix']:10.3f}")


if __name__ == "__main__":
    main()
