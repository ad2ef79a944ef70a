"""Loads a dataset folder with the LeRobot library and prints what it finds as JSON.

usage: check_lerobot.py FOLDER

Reads every item once, then windows of three steps of `action` and of one step back of each observation that is
no picture, and compares them with the items they are made of. Exits with 1 if something differs.
"""

import json
import os
import sys
from pathlib import Path

os.environ["HF_HUB_OFFLINE"] = "1"

import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset


def total(value):
    return float(value.to(torch.float64).nan_to_num().sum())


def check_windows(folder, plain, keys):
    fps = plain.fps
    past = {key: [-1 / fps, 0.0] for key in keys if key.startswith("observation")}
    future = {key: [0.0, 1 / fps, 2 / fps] for key in keys if key.startswith("action")}
    windows = LeRobotDataset(f"local/{folder.name}", root=folder, delta_timestamps={**past, **future})
    assert len(windows) == len(plain)
    for i in range(len(windows)):
        item, here = windows[i], plain[i]
        for key in past | future:
            offsets = [-1, 0] if key in past else [0, 1, 2]
            for place, offset in enumerate(offsets):
                j = min(max(i + offset, 0), len(plain) - 1)
                inside = j == i + offset and int(plain[j]["episode_index"]) == int(here["episode_index"])
                assert bool(item[f"{key}_is_pad"][place]) == (not inside), (i, key, place)
                if inside:
                    assert torch.equal(item[key][place], plain[j][key]), (i, key, place)


def main():
    folder = Path(sys.argv[1]).resolve()
    data = LeRobotDataset(f"local/{folder.name}", root=folder)
    numeric = [k for k, f in data.features.items() if f["dtype"] not in ("string", "image", "video")]
    sums, first_tasks, lengths, pictures = dict.fromkeys(numeric, 0.0), {}, {}, {}
    for i in range(len(data)):
        item = data[i]
        episode = int(item["episode_index"])
        assert int(item["index"]) == i and int(item["frame_index"]) == lengths.get(episode, 0)
        lengths[episode] = lengths.get(episode, 0) + 1
        first_tasks.setdefault(episode, item["task"])
        for key in numeric:
            sums[key] += total(item[key])
        for key in data.meta.image_keys:
            pictures[key] = list(item[key].shape)
    windowed = [k for k in numeric if k.startswith(("observation", "action"))]
    check_windows(folder, data, windowed)
    # Statistics must be there for everything that policies normalize.
    stats = {key: [float(x) for x in data.meta.stats[key]["mean"].reshape(-1)] for key in windowed if key in data.meta.stats}
    n_batches = sum(1 for _ in torch.utils.data.DataLoader(data, batch_size=4, num_workers=2))
    report = {
        "n_frames": len(data),
        "n_episodes": data.num_episodes,
        "fps": data.fps,
        "robot_type": data.meta.robot_type,
        "lengths": [lengths[e] for e in sorted(lengths)],
        "tasks": [first_tasks[e] for e in sorted(first_tasks)],
        "sums": sums,
        "means": stats,
        "pictures": pictures,
        "n_batches": n_batches,
    }
    print(json.dumps(report))


if __name__ == "__main__":
    main()
