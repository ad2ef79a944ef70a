"""Loads Minari datasets with the minari library and prints, as JSON, what it finds.

usage: check_minari.py DATASET...

DATASET is a dataset folder (with data/metadata.json). The output is a list with an object per dataset: its spaces and
environment as the library restores them, counts, and for every episode its metadata and a description of every array
(shape, type, SHA-256 of the bytes in C order), so that two datasets hold the same if their outputs are equal.
"""

import hashlib
import json
import os
import sys
import warnings
from pathlib import Path


def describe(value):
    """Shape, type and hash of the arrays in nested values."""
    import numpy as np

    if value is None:
        return None
    if isinstance(value, dict):
        return {key: describe(part) for key, part in sorted(value.items())}
    if isinstance(value, tuple):
        return [describe(part) for part in value]
    if isinstance(value, list):
        text = json.dumps(value).encode()
        return {"len": len(value), "sha256": hashlib.sha256(text).hexdigest()}
    array = np.ascontiguousarray(value)
    if array.dtype == object:
        text = json.dumps([x.decode() if isinstance(x, bytes) else str(x) for x in array]).encode()
        return {"len": len(array), "sha256": hashlib.sha256(text).hexdigest()}
    digest = hashlib.sha256(array.tobytes()).hexdigest()
    return {"shape": list(array.shape), "dtype": str(array.dtype), "sha256_c_order": digest}


def plain(value):
    """NumPy's numbers and arrays as Python's, for JSON."""
    if isinstance(value, dict):
        return {key: plain(part) for key, part in sorted(value.items())}
    return value.tolist() if hasattr(value, "tolist") else value


def load(folder):
    """The whole content of a dataset."""
    import minari

    root = Path(folder).resolve()
    os.environ["MINARI_DATASETS_PATH"] = str(root.parent)
    dataset = minari.load_dataset(root.name)
    storage = dataset.storage
    indices = range(dataset.total_episodes)
    metadata = list(storage.get_episode_metadata(indices))
    episodes = []
    for episode, about in zip(dataset.iterate_episodes(), metadata, strict=True):
        parts = ("observations", "actions", "rewards", "terminations", "truncations", "infos")
        content = {part: describe(getattr(episode, part)) for part in parts}
        # A dataset without infos has none, or an empty group of them.
        content["infos"] = content["infos"] or None
        episodes.append({"id": int(episode.id), "length": len(episode.rewards), "metadata": plain(about), **content})
    return {
        "dataset_id": dataset.spec.dataset_id,
        "data_format": storage.FORMAT,
        "observation_space": repr(dataset.observation_space),
        "action_space": repr(dataset.action_space),
        "env_spec": dataset.env_spec.to_json() if dataset.env_spec else None,
        "total_episodes": int(dataset.total_episodes),
        "total_steps": int(dataset.total_steps),
        "episodes": episodes,
    }


def main():
    warnings.filterwarnings("ignore")
    json.dump([load(folder) for folder in sys.argv[1:]], sys.stdout, default=str)


if __name__ == "__main__":
    main()
