#!/usr/bin/env python3
"""Steps per second of our environments against mujoco.rollout and gymnasium's env.step, in the same run.

usage: compare_peers.py --binary TIME_STEP [--steps N] [--runs N] [ID ...]

TIME_STEP is the example `time_step` of ksim-envs, built with `--release --features mujoco`. All take 16 × N random
steps in episodes of 100 steps: gymnasium and ours with observations, rewards and resets, the rollout module with states
only. Every run takes each of them once, in turn, and the best counts. Needs mujoco, gymnasium and gymnasium-robotics.
"""
import argparse
import json
import subprocess
import time

import gymnasium
import gymnasium_robotics
import mujoco.rollout
import numpy as np

N_ENVIRONMENTS, EPISODE = 16, 100
STAND = {"terminate_when_unhealthy": False}
TASKS = {
    "HalfCheetah-v5": {},
    "Hopper-v5": STAND,
    "Walker2d-v5": STAND,
    "Ant-v5": STAND,
    "AntMaze_Large-v4": {},
    "AntMaze_Large-v5": {},
}


def time_gymnasium(env, n_steps):
    actions = np.random.default_rng(0).uniform(-1, 1, (EPISODE, env.action_space.shape[0]))
    env.reset(seed=0)
    start = time.perf_counter()
    for step in range(n_steps):
        *_, terminated, truncated, _ = env.step(actions[step % EPISODE])
        if terminated or truncated:
            env.reset()
    return n_steps / (time.perf_counter() - start)


def simulator(env):
    inner = env.unwrapped
    return getattr(inner, "ant_env", inner).unwrapped


def time_rollout(env, n_steps, n_threads):
    inner = simulator(env)
    model, skip = inner.model, inner.frame_skip
    datas = [mujoco.MjData(model) for _ in range(n_threads)]
    env.reset(seed=0)
    state = np.zeros(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    mujoco.mj_getState(model, inner.data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    states = np.tile(state, (N_ENVIRONMENTS, 1))
    rng = np.random.default_rng(0)
    control = np.repeat(rng.uniform(-1, 1, (N_ENVIRONMENTS, EPISODE, model.nu)), skip, axis=1)
    n_episodes = max(1, n_steps // EPISODE)
    with mujoco.rollout.Rollout(nthread=n_threads if n_threads > 1 else 0) as rollout:
        start = time.perf_counter()
        for _ in range(n_episodes):
            rollout.rollout(model, datas, states, control)
        return n_episodes * EPISODE * N_ENVIRONMENTS / (time.perf_counter() - start)


def time_ours(binary, env_id, kwargs, n_steps, n_threads):
    command = [binary, env_id, json.dumps(kwargs), str(N_ENVIRONMENTS), str(n_steps), str(n_threads)]
    out = subprocess.run(command, check=True, capture_output=True, text=True)
    return n_steps * N_ENVIRONMENTS / float(out.stdout.split()[0])


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--binary", required=True)
    parser.add_argument("--steps", type=int, default=1000, help="of every environment")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("ids", nargs="*", default=list(TASKS))
    args = parser.parse_args()
    gymnasium.register_envs(gymnasium_robotics)
    print("| environment | gymnasium | rollout, 1 thread | ksim, 1 thread | rollout, 2 | ksim, 2 "
          "| ksim / rollout | ksim / gymnasium | 2 threads / 1 |")
    print("|---|---|---|---|---|---|---|---|---|")
    for env_id in args.ids:
        kwargs = TASKS[env_id]
        env = gymnasium.make(env_id, max_episode_steps=EPISODE, **kwargs)
        env.reset(seed=0)
        measures = [
            lambda: time_gymnasium(env, args.steps * 4),
            lambda: time_rollout(env, args.steps, 1),
            lambda: time_ours(args.binary, env_id, kwargs, args.steps, 1),
            lambda: time_rollout(env, args.steps, 2),
            lambda: time_ours(args.binary, env_id, kwargs, args.steps, 2),
        ]
        gym, one, ours, two, ours_two = np.max([[m() for m in measures] for _ in range(args.runs)], axis=0)
        cells = [f"{v:,.0f}" for v in (gym, one, ours, two, ours_two)]
        ratios = [f"{ours / one:.2f}", f"{ours / gym:.2f}", f"{ours_two / ours:.2f}"]
        print("| " + " | ".join([env_id, *cells, *ratios]) + " |", flush=True)


if __name__ == "__main__":
    main()
