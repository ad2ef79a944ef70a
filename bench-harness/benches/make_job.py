#!/usr/bin/env python3
"""Inputs of the paper's job, for timing `ksim score` from files: a large Minari dataset and 150,000 rollout steps.

    pip install numpy h5py pyarrow
    python bench-harness/benches/make_job.py --minari large-play-v1 --rollouts *.parquet -o job [--rows 1e6]

Writes OUT/reference/data (Minari HDF5, f64, episodes of the source and copies of them with a jitter of 0.01 standard
deviations) and OUT/rollouts.parquet (the rollouts and copies, jittered likewise). Then

    /usr/bin/time -v ksim score OUT/rollouts.parquet --dataset OUT/reference --threads 2
"""
import argparse
import json
import pathlib
import shutil

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

JITTER = 0.01


def leaves(group, prefix=""):
    for name, item in group.items():
        if isinstance(item, h5py.Dataset):
            yield prefix + name
        else:
            yield from leaves(item, f"{prefix}{name}/")


def deviations(source, names):
    return {
        name: np.concatenate([source[f"episode_{i}/{name}"][:] for i in range(min(len(source), 50))]).std(0)
        for name in names
    }


def reference(minari, out, rows):
    rng = np.random.default_rng(0)
    data = out / "reference" / "data"
    data.mkdir(parents=True, exist_ok=True)
    with h5py.File(minari / "data" / "main_data.hdf5") as source, h5py.File(data / "main_data.hdf5", "w") as target:
        noisy = [name for name in leaves(source["episode_0"]) if name.startswith(("observations", "actions"))]
        spread = deviations(source, noisy)
        done = number = 0
        while done < rows:
            source.copy(f"episode_{number % len(source)}", target, f"episode_{number}")
            episode = target[f"episode_{number}"]
            episode.attrs["id"] = number
            if number >= len(source):
                for name in noisy:
                    values = episode[name][:]
                    episode[name][...] = values + rng.normal(0, JITTER, values.shape) * spread[name]
            done += len(episode["actions"])
            number += 1
    metadata = json.loads((minari / "data" / "metadata.json").read_text())
    metadata.update(total_episodes=number, total_steps=done, dataset_id="ksim/job-v0")
    (data / "metadata.json").write_text(json.dumps(metadata))
    print(f"{data}: {number} episodes, {done:,} steps")


def rollouts(paths, out, steps):
    rng = np.random.default_rng(1)
    parts, done, offset, copy = [], 0, 0, 0
    # Without the rows of last observations, which no action follows.
    tables = [pq.read_table(path, filters=pc.field("action").is_valid()) for path in paths]
    while done < steps:
        for table in tables:
            number = "episode_index" if "episode_index" in table.column_names else "episode_id"
            episodes = table[number].to_numpy()
            columns = {"episode_index": pa.array(episodes + offset)}
            states = [name for name in table.column_names if name.split(".")[0] == "observation"]
            for name in [*states, "action"]:
                values = np.stack(table[name].to_numpy(zero_copy_only=False)).astype("f4")
                if copy:
                    values += (rng.normal(0, JITTER, values.shape) * values.std(0)).astype("f4")
                flat = pa.array(np.ascontiguousarray(values).reshape(-1))
                columns[name] = pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
            offset += int(episodes.max()) + 1
            done += len(episodes)
            parts.append(pa.table(columns))
        copy += 1
    whole = pa.concat_tables(parts).slice(0, steps)
    pq.write_table(whole, out / "rollouts.parquet")
    print(f"{out / 'rollouts.parquet'}: {len(whole):,} steps")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minari", type=pathlib.Path, required=True)
    parser.add_argument("--rollouts", nargs="+", required=True)
    parser.add_argument("-o", "--output", type=pathlib.Path, required=True)
    parser.add_argument("--rows", type=float, default=1e6)
    parser.add_argument("--steps", type=int, default=150_000)
    parser.add_argument("--parts", default="reference,rollouts", help="what to write")
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    if "reference" in args.parts:
        shutil.rmtree(args.output / "reference", ignore_errors=True)
        reference(args.minari, args.output, int(args.rows))
    if "rollouts" in args.parts:
        rollouts(args.rollouts, args.output, args.steps)


main()
