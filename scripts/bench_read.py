#!/usr/bin/env python3
"""Reading into Arrow, against h5py and pyarrow in the same run. Needs numpy, h5py and pyarrow.

usage: bench_read.py MINARI_FOLDER [--steps N] [--work DIR] [--binary PATH] [--runs N]

Repeats the episodes of MINARI_FOLDER to N steps, writes the same rows as a D4RL file (gzip) and with pyarrow as
Parquet (zstd), and prints the best time of each reader and the ratio.
"""
import argparse
import json
import subprocess
import tempfile
import time
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq


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


def make_parquet(d4rl: Path, target: Path) -> None:
    with h5py.File(d4rl) as f:
        rows = {key: f[key][()] for key in ("observations", "actions", "rewards", "terminals", "timeouts")}
    ends = rows["terminals"] | rows["timeouts"]
    table = {"episode_index": np.concatenate([[0], np.cumsum(ends)[:-1]]).astype(np.int64)}
    names = {"observations": "observation", "actions": "action", "rewards": "reward"}
    for key, values in rows.items():
        flat = pa.array(values.ravel())
        column = flat if values.ndim == 1 else pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
        table[names.get(key, key)] = column
    pq.write_table(pa.table(table), target, compression="zstd", use_dictionary=["episode_index"])


def read_parquet(path: Path) -> int:
    return pq.read_table(path, columns=["episode_index", "observation", "action"]).num_rows


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
    parquet = args.work / "table.parquet"
    if not parquet.exists():
        make_parquet(d4rl, parquet)
    print(f"{'format':8}{'peer s':>10}{'arrow s':>10}{'ratio':>8}{'matrix s':>10}")
    formats = (("minari", minari, read_minari), ("d4rl", d4rl, read_d4rl), ("parquet", parquet, read_parquet))
    for name, path, read in formats:
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
