#!/usr/bin/env python3
"""Makes the files that `ksim demo` carries (ksim/cli/demo/*.parquet).

    python3 scripts/make_demo_data.py MINARI_DATASET ROLLOUTS_FOLDER ksim/cli/demo

MINARI_DATASET is an AntMaze dataset folder of Minari (with data/main_data.hdf5); ROLLOUTS_FOLDER holds
antmaze-large-play_{indist,noisy,random}.parquet with columns episode_id, step, observation (31) and
action (8). Needs numpy, h5py and pyarrow. The same input gives the same bytes with the same pyarrow.
"""
import argparse
import pathlib

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

DATASET_EPISODES = 12
ROLLOUT_EPISODES = 4
ROLLOUT_STEPS = 300
ROLLOUTS = {"good": "indist", "noisy": "noisy", "random": "random"}
OBSERVATION = ("achieved_goal", "observation", "desired_goal")  # the order of the 31 columns


def table(episode, step, observation, action):
    """The canonical layout with only the columns that a score reads."""
    return pa.table({
        "episode_index": pa.array(episode, pa.int64()),
        "step_index": pa.array(step, pa.int64()),
        "observation": fixed_size_lists(observation),
        "action": fixed_size_lists(action),
    })


def fixed_size_lists(values):
    values = np.ascontiguousarray(values, np.float32)
    # The name `item` is what Arrow's Rust library calls the values of a list.
    kind = pa.list_(pa.field("item", pa.float32(), nullable=False), values.shape[1])
    return pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1)), type=kind)


def write(rows, path):
    floats = [name + ".list.element" for name in ("observation", "action")]
    pq.write_table(rows, path, compression="zstd", compression_level=19, use_dictionary=False,
                   column_encoding={name: "BYTE_STREAM_SPLIT" for name in floats},
                   store_schema=True, write_statistics=False)
    print(f"{path}: {rows.num_rows} steps, {path.stat().st_size} bytes")


def dataset(folder):
    """The first episodes, whole; the state before every action."""
    episodes, steps, observations, actions = [], [], [], []
    with h5py.File(folder / "data" / "main_data.hdf5") as file:
        for number in range(DATASET_EPISODES):
            group = file[f"episode_{number}"]
            action = group["actions"][:]
            n = len(action)
            observations.append(np.concatenate(
                [group["observations"][name][:n].reshape(n, -1) for name in OBSERVATION], axis=1))
            actions.append(action)
            episodes.append(np.full(n, number))
            steps.append(np.arange(n))
    return table(*(np.concatenate(part) for part in (episodes, steps, observations, actions)))


def rollouts(path):
    """The first steps of the first episodes."""
    rows = pq.read_table(path)
    episode, step = rows["episode_id"].to_numpy(), rows["step"].to_numpy()
    keep = np.flatnonzero((episode < ROLLOUT_EPISODES) & (step < ROLLOUT_STEPS))

    def matrix(name):
        return np.asarray(rows[name].to_pylist(), np.float32)[keep]

    return table(episode[keep], step[keep], matrix("observation"), matrix("action"))


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("minari_dataset", type=pathlib.Path)
    parser.add_argument("rollouts_folder", type=pathlib.Path)
    parser.add_argument("out", type=pathlib.Path)
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    write(dataset(args.minari_dataset), args.out / "dataset.parquet")
    for name, source in ROLLOUTS.items():
        path = args.rollouts_folder / f"antmaze-large-play_{source}.parquet"
        write(rollouts(path), args.out / f"{name}.parquet")


if __name__ == "__main__":
    main()
