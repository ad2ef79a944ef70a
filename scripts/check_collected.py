"""Opens Minari datasets with Minari, makes their environments with Gymnasium, and prints what it finds as JSON.

Usage: check_collected.py ID ...    ($MINARI_DATASETS_PATH is the folder with the datasets)
"""

import json
import sys

import gymnasium
import gymnasium_robotics
import minari
import numpy


def flat(observation, row=None):
    """All numbers of an observation, or of one row of many."""
    parts = [observation[key] for key in sorted(observation)] if isinstance(observation, dict) else [observation]
    return numpy.concatenate([part if row is None else part[row] for part in parts])


def check(dataset):
    """What Minari finds in a dataset."""
    episodes = list(dataset.iterate_episodes())
    seeds = [metadata["seed"] for metadata in dataset.storage.get_episode_metadata(range(len(episodes)))]
    environments = [dataset.recover_environment(), dataset.recover_environment(eval_env=True)]
    first, _ = environments[0].reset(seed=seeds[0])
    return {
        "environments": [environment.spec.id for environment in environments],
        "seeds": seeds,
        "n_steps": int(dataset.total_steps),
        "infos": sorted(episodes[0].infos),
        "n_successful": sum(bool(numpy.any(episode.infos.get("success", False))) for episode in episodes),
        "actions_fit": all(dataset.action_space.contains(action) for episode in episodes for action in episode.actions),
        "first_observation_error": float(numpy.abs(flat(first) - flat(episodes[0].observations, 0)).max()),
    }


gymnasium.register_envs(gymnasium_robotics)
print(json.dumps([check(minari.load_dataset(name)) for name in sys.argv[1:]]))
