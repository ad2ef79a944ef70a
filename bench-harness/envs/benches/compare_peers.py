#!/usr/bin/env python3
"""Steps per second of our environments against mujoco.rollout and gymnasium's env.step, in the same run.

usage: compare_peers.py --binary TIME_STEP [--seconds S] [--runs N] [ID ...]

TIME_STEP is the example `time_step` of ksim-envs, built with `--release --features mujoco`. All take random steps in
episodes of 100: gymnasium and ours with observations, rewards and resets, the rollout module with states only. A run
takes each of them once, in turn, for about S seconds; ratios are taken within a run, and the median of the runs is
printed. Steps per second are of processor time, so that a machine which others use too does not show, but for the last
two columns: two threads against one by the clock, and how much processor time a step of theirs takes against one
thread's. Needs mujoco, gymnasium and gymnasium-robotics.
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
    "AntMaze_UMaze-v4": {},
    "AntMaze_Medium-v4": {},
    "AntMaze_Large-v4": {},
    "AntMaze_Large-v5": {},
}


class Timer:
    """Steps per second of processor time and of the clock."""

    def __enter__(self):
        self.start = time.process_time(), time.perf_counter()
        return self

    def __exit__(self, *_):
        self.busy, self.clock = time.process_time() - self.start[0], time.perf_counter() - self.start[1]

    def rates(self, n_steps):
        return n_steps / self.busy, n_steps / self.clock


def time_gymnasium(env, n_steps):
    actions = np.random.default_rng(0).uniform(-1, 1, (EPISODE, env.action_space.shape[0]))
    env.reset(seed=0)
    with Timer() as timer:
        for step in range(n_steps):
            *_, terminated, truncated, _ = env.step(actions[step % EPISODE])
            if terminated or truncated:
                env.reset()
    return timer.rates(n_steps)


def time_rollout(env, n_steps):
    inner = getattr(env.unwrapped, "ant_env", env.unwrapped).unwrapped
    model, skip = inner.model, inner.frame_skip
    states = np.zeros((N_ENVIRONMENTS, mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
    for seed, state in enumerate(states):  # where ours start too: in a maze, walls cost time
        env.reset(seed=seed)
        mujoco.mj_getState(model, inner.data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    rng = np.random.default_rng(0)
    control = np.repeat(rng.uniform(-1, 1, (N_ENVIRONMENTS, EPISODE, model.nu)), skip, axis=1)
    data = [mujoco.MjData(model)]
    n_batches = max(1, n_steps // (EPISODE * N_ENVIRONMENTS))
    with mujoco.rollout.Rollout(nthread=0) as rollout, Timer() as timer:
        for _ in range(n_batches):
            rollout.rollout(model, data, states, control)
    return timer.rates(n_batches * EPISODE * N_ENVIRONMENTS)


def time_ours(binary, env_id, kwargs, n_steps, n_threads):
    n_each = max(1, n_steps // N_ENVIRONMENTS)
    command = [binary, env_id, json.dumps(kwargs), str(N_ENVIRONMENTS), str(n_each), str(n_threads)]
    out = subprocess.run(command, check=True, capture_output=True, text=True)
    clock, busy = map(float, out.stdout.split()[:2])
    return n_each * N_ENVIRONMENTS / busy, n_each * N_ENVIRONMENTS / clock


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--binary", required=True)
    parser.add_argument("--seconds", type=float, default=1.0, help="of processor time, for every measurement")
    parser.add_argument("--runs", type=int, default=7)
    parser.add_argument("ids", nargs="*", default=list(TASKS))
    args = parser.parse_args()
    gymnasium.register_envs(gymnasium_robotics)
    print("| environment | gymnasium | rollout | ksim | ksim / rollout | ksim / gymnasium "
          "| 2 threads / 1, clock | 2 threads / 1, processor |")
    print("|---|---|---|---|---|---|---|---|")
    for env_id in args.ids:
        kwargs = TASKS.get(env_id, {})
        env = gymnasium.make(env_id, max_episode_steps=EPISODE, **kwargs)
        n_steps = int(time_gymnasium(env, 500)[0] * args.seconds)
        runs = np.array([
            (
                time_gymnasium(env, n_steps),
                time_rollout(env, n_steps),
                time_ours(args.binary, env_id, kwargs, n_steps, 1),
                time_ours(args.binary, env_id, kwargs, n_steps, 2),
            )
            for _ in range(args.runs)
        ])
        (gym, rollout, one, two), clock = runs[:, :, 0].T, runs[:, :, 1].T
        cells = [f"{np.median(rate):,.0f}" for rate in (gym, rollout, one)]
        ratios = one / rollout, one / gym, clock[3] / clock[2], one / two
        cells += [f"{np.median(ratio):.2f}" for ratio in ratios]
        print("| " + " | ".join([env_id, *cells]) + " |", flush=True)


if __name__ == "__main__":
    main()
