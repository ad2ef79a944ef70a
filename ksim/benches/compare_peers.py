#!/usr/bin/env python3
"""Times the engine beside scikit-learn, FAISS and scipy on the same arrays, in the same run.

    pip install numpy scipy scikit-learn faiss-cpu h5py pyarrow
    python ksim/benches/compare_peers.py [--minari FOLDER --rollouts FILE.parquet ...]

With --minari (a Minari AntMaze dataset: the folder that holds main_data.hdf5) the reference is its
states, normalized and repeated with a jitter of 0.01 standard deviations up to --rows, and the
queries are the rollouts' observations. Without it, both are mean-reverting random walks.
Prints a Markdown table; ratios above 1 say that ksim is faster.
"""
import argparse
import json
import os
import pathlib
import subprocess
import tempfile
import time

# Set on some machines for the sake of other builds; they slow a current BLAS down.
for name in ("OPENBLAS_CORETYPE", "OPENBLAS_L2_SIZE"):
    os.environ.pop(name, None)

import numpy as np  # noqa: E402

ROOT = pathlib.Path(__file__).resolve().parents[2]
CLUSTERS, NEIGHBORS = 50, 50


def random_walk(rows, width, rng):
    out = np.empty((rows, width), "f4")
    for start in range(0, rows, 1000):
        at = rng.normal(0, 1.5, width)
        for row in range(start, min(start + 1000, rows)):
            out[row] = at
            at = 0.95 * at + rng.normal(0, 0.3, width)
    return out


def antmaze(folder, rollouts, rows, rng):
    import h5py
    import pyarrow.parquet as pq

    states = []
    with h5py.File(pathlib.Path(folder) / "main_data.hdf5") as file:
        for index in range(len(file)):
            observations = file[f"episode_{index}"]["observations"]
            parts = ("achieved_goal", "observation", "desired_goal")
            states.append(np.concatenate([observations[part][:-1] for part in parts], 1))
    states = np.concatenate(states)
    mean, std = states.mean(0), states.std(0)
    std[std < 1e-6] = 1
    states = (states - mean) / std
    copies = [states]
    while sum(map(len, copies)) < rows:
        copies.append(states + rng.normal(0, 0.01, states.shape))
    queries = [
        np.stack(pq.read_table(path)["observation"].to_numpy(zero_copy_only=False)) for path in rollouts
    ]
    queries = (np.concatenate(queries) - mean) / std
    return np.concatenate(copies)[:rows].astype("f4"), queries.astype("f4")


def timed(call, repeats=1):
    best = float("inf")
    for _ in range(repeats):
        start = time.perf_counter()
        result = call()
        best = min(best, time.perf_counter() - start)
    return best, result


def ksim(folder, reference, queries, engines, threads):
    reference.tofile(folder / "reference.f32")
    queries.tofile(folder / "queries.f32")
    command = ["cargo", "run", "-q", "--release", "-p", "ksim", "--example", "peer_timings", "--"]
    command += [str(folder / "reference.f32"), str(folder / "queries.f32")]
    command += [str(reference.shape[1]), str(CLUSTERS), str(NEIGHBORS), *engines]
    environment = {**os.environ, "RAYON_NUM_THREADS": str(threads)}
    done = subprocess.run(command, cwd=ROOT, env=environment, check=True, capture_output=True)
    return json.loads(done.stdout)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minari")
    parser.add_argument("--rollouts", nargs="*", default=[])
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--queries", type=int, default=24_000)
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()

    import faiss
    from scipy.spatial import cKDTree
    from sklearn.cluster import KMeans

    faiss.omp_set_num_threads(args.threads)
    rng = np.random.default_rng(0)
    if args.minari:
        reference, queries = antmaze(args.minari, args.rollouts, args.rows, rng)
    else:
        reference, queries = (random_walk(n, 31, rng) for n in (args.rows, args.queries))
    lines = []

    def row(what, peer, theirs, ours, unit, scale):
        lines.append(
            f"| {what} | {peer} {theirs * scale:.3g} {unit} | {ours * scale:.3g} {unit} "
            f"| {theirs / ours:.2f}× |"
        )

    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        wide = ksim(folder, reference, queries, ["clusters", "blocked"], args.threads)
        for dtype in ("f4", "f8"):
            data = reference.astype(dtype)
            seconds, fitted = timed(lambda: KMeans(CLUSTERS, n_init="auto", random_state=0).fit(data))
            difference = wide["inertia"] / fitted.inertia_ - 1
            row(
                f"k-means, {dtype}: {fitted.n_iter_} against {wide['kmeans_iterations']} iterations, "
                f"our inertia {difference:+.2%}",
                "scikit-learn", seconds, wide["kmeans_s"], "s", 1,
            )
            del data, fitted
        quantizer = faiss.IndexFlatL2(reference.shape[1])
        index = faiss.IndexIVFFlat(quantizer, reference.shape[1], CLUSTERS)
        index.train(reference[rng.permutation(len(reference))[:100_000]])
        index.add(reference)
        index.nprobe = 1
        index.search(queries[:100], NEIGHBORS)
        seconds, _ = timed(lambda: index.search(queries, NEIGHBORS), 3)
        row("one probe of 50 cells, k = 50, per query", "FAISS IVF",
            seconds / len(queries), wide["clusters"]["query_s"], "µs", 1e6)
        flat = faiss.IndexFlatL2(reference.shape[1])
        flat.add(reference)
        some = queries[:: max(1, len(queries) // 500)]
        seconds, _ = timed(lambda: flat.search(some, NEIGHBORS))
        row("exact, k = 50, per query", "FAISS flat",
            seconds / len(some), wide["blocked"]["query_s"], "µs", 1e6)
        memory = wide["peak_bytes"] / reference.nbytes
        xy, xy_queries = reference[:, :2].copy(), queries[:, :2].copy()
        narrow = ksim(folder, xy, xy_queries, ["kd-tree"], args.threads)
        tree = cKDTree(xy)
        tree.query(xy_queries[:100], k=NEIGHBORS, workers=args.threads)
        seconds, _ = timed(lambda: tree.query(xy_queries, k=NEIGHBORS, workers=args.threads), 3)
        row("exact in two columns, k = 50, per query", "scipy cKDTree",
            seconds / len(queries), narrow["kd-tree"]["query_s"], "µs", 1e6)

    print(f"{len(reference):,} x {reference.shape[1]} rows, {len(queries):,} queries, {args.threads} threads\n")
    print("| what | peer | ksim | ratio |\n|---|---|---|---|")
    print("\n".join(lines))
    print(f"\nPeak memory of the 31-column run: {memory:.2f}x the reference as f32.")


main()
