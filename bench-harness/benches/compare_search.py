#!/usr/bin/env python3
"""Times the search beside scikit-learn, FAISS, scipy, hnswlib and usearch: same arrays, same run, in turn.

    pip install numpy scipy scikit-learn faiss-cpu hnswlib usearch h5py pyarrow
    python bench-harness/benches/compare_search.py [--minari FOLDER --rollouts FILE.parquet ...]
        [--parts kmeans,exact,approximate,single,xy,rows,threads] [--rows 1000000] [--threads 2]

With --minari (a Minari dataset of AntMaze: the folder that holds main_data.hdf5) the reference is its states,
normalized; rows beyond those there are come from copies with a jitter of 0.01 standard deviations. The queries are the
rollouts' observations, one kind for each file. Without it, reference and queries are driven oscillators seen through
31 sensors, under the noise of the reference, under more, and under random forces.
Prints Markdown tables for bench-harness/RESULTS.md; ratios above 1 say that ksim is faster.
"""
import argparse
import json
import os
import pathlib
import subprocess
import sys
import tempfile
import time

# Set on some machines for the sake of other builds; they slow a current BLAS down.
for name in ("OPENBLAS_CORETYPE", "OPENBLAS_L2_SIZE"):
    os.environ.pop(name, None)

import numpy as np  # noqa: E402

ROOT = pathlib.Path(__file__).resolve().parents[2]
CLUSTERS, NEIGHBORS, WIDTH = 50, 50, 31
PARTS = ("kmeans", "exact", "approximate", "single", "xy", "rows", "threads")


def oscillators(rows, noise, rng):
    """Episodes of 1000 steps side by side: positions of twelve driven oscillators through WIDTH bent sensors."""
    robot = np.random.default_rng(7)
    policy = robot.normal(0, 12**-0.5, (8, 12))
    sensors, bent = robot.normal(0, 12**-0.5, (WIDTH, 12)), robot.integers(0, 12, WIDTH)
    stiffness = 0.2 + 1.8 * robot.random(12)
    episodes = -(-rows // 1000)
    x, v = rng.normal(0, 1, (episodes, 12)), np.zeros((episodes, 12))
    out = np.empty((episodes, 1000, WIDTH), "f4")
    for step in range(1000):
        out[:, step] = x @ sensors.T + 0.3 * np.sin(2 * x[:, bent]) + 0.05 * (rng.random((episodes, WIDTH)) - 0.5)
        if noise is None:
            action = rng.uniform(-1, 1, (episodes, 8))
        else:
            action = np.tanh(x @ policy.T + rng.normal(0, noise, (episodes, 8)))
        v += 0.1 * (1.5 * action[:, np.arange(12) % 8] - stiffness * x - 0.3 * v)
        x += 0.1 * v
    return out.reshape(-1, WIDTH)[:rows]


def observations(episode):
    """In the order of Minari's AntMaze readers; without the last one, which no action follows."""
    import h5py

    group = episode["observations"]
    if isinstance(group, h5py.Dataset):
        return group[:-1]
    known = ("achieved_goal", "observation", "desired_goal")
    parts = known if set(known) == set(group) else sorted(group)
    return np.concatenate([group[part][:-1] for part in parts], 1)


class Data:
    """The reference, as many rows of it as are wanted, and the queries."""

    def __init__(self, args):
        self.rng = np.random.default_rng(0)
        if not args.minari:
            self.states = None
            kinds = {"in-distribution": 0.2, "noisy": 0.8, "random": None}
            per_kind = args.queries // len(kinds)
            self.queries = {kind: oscillators(per_kind, noise, self.rng) for kind, noise in kinds.items()}
            every = oscillators(20_000, 0.2, np.random.default_rng(1))
            mean, std = every.mean(0), every.std(0)
            self.scale = (mean, std)
            self.queries = {kind: ((rows - mean) / std).astype("f4") for kind, rows in self.queries.items()}
            return
        import h5py
        import pyarrow.parquet as pq

        with h5py.File(pathlib.Path(args.minari) / "main_data.hdf5") as file:
            states = np.concatenate([observations(file[f"episode_{index}"]) for index in range(len(file))])
        mean, std = states.mean(0), states.std(0)
        std[std < 1e-6] = 1
        self.states = (states - mean) / std
        self.queries = {}
        for path in args.rollouts:
            table = pq.read_table(path)
            known = ("achieved_goal", "observation", "desired_goal")
            parts = [f"observation.{part}" for part in known if f"observation.{part}" in table.column_names]
            rows = np.concatenate([np.stack(table[part].to_numpy(zero_copy_only=False)) for part in parts or ["observation"]], 1)
            name = pathlib.Path(path).stem.rsplit("_", 1)[-1]
            self.queries[name] = ((rows - mean) / std).astype("f4")

    def reference(self, rows):
        if self.states is None:
            mean, std = self.scale
            made = oscillators(rows, 0.2, np.random.default_rng(2))
            made -= mean.astype("f4")
            made /= std.astype("f4")
            return made
        rng = np.random.default_rng(3)
        copies = [self.states[:rows].astype("f4")]
        while sum(map(len, copies)) < rows:
            copies.append((self.states + rng.normal(0, 0.01, self.states.shape)).astype("f4"))
        return np.concatenate(copies)[:rows]

    def distinct(self, rows):
        return rows if self.states is None else min(rows, len(self.states))


def timed(call, repeats=3):
    best = float("inf")
    for _ in range(repeats):
        start = time.perf_counter()
        result = call()
        best = min(best, time.perf_counter() - start)
    return best, result


class Ksim:
    """The Rust half, on arrays that lie in files."""

    def __init__(self, folder):
        self.folder = folder
        command = ["cargo", "build", "-q", "--release", "-p", "ksim", "--example", "peer_timings"]
        subprocess.run(command, cwd=ROOT, check=True)
        target = pathlib.Path(os.environ.get("CARGO_TARGET_DIR", ROOT / "target"))
        self.binary = target / "release/examples/peer_timings"

    def write(self, reference, queries):
        reference.tofile(self.folder / "reference.f32")
        self.width, self.files = reference.shape[1], []
        for at, rows in enumerate(queries):
            self.files.append(str(self.folder / f"queries{at}.f32"))
            rows.tofile(self.files[-1])

    def run(self, engines, threads, single=0):
        command = [str(self.binary), str(self.folder / "reference.f32"), str(self.width), str(CLUSTERS)]
        command += [str(NEIGHBORS), str(single), ",".join(engines), *self.files]
        environment = {**os.environ, "RAYON_NUM_THREADS": str(threads)}
        done = subprocess.run(command, env=environment, check=True, capture_output=True)
        return json.loads(done.stdout)


class Table:
    def __init__(self, *header):
        self.rows = [header, ("---",) * len(header)]

    def add(self, *cells):
        self.rows.append(cells)
        print(f"  {' | '.join(cells)}", file=sys.stderr)

    def print(self, title):
        print(f"\n{title}\n")
        for row in self.rows:
            print(f"| {' | '.join(row)} |")


def us(seconds):
    return f"{seconds * 1e6:.3g} µs" if seconds < 1e-3 else f"{seconds * 1e3:.3g} ms"


def ratio(theirs, ours):
    return f"{theirs / ours:.2f}×"


def recall(found, truth):
    hits = [len(np.intersect1d(a, b)) / len(b) for a, b in zip(found, truth)]
    return float(np.mean(hits))


def kmeans(reference, ksim, args):
    import faiss
    from sklearn.cluster import KMeans

    table = Table("k-means, 50 clusters", "peer", "ksim", "ratio")
    ours = ksim.run(["clusters"], args.threads)["kmeans"]
    for dtype in ("f4", "f8"):
        data = reference.astype(dtype)
        seconds, fitted = timed(lambda: KMeans(CLUSTERS, n_init="auto", random_state=0).fit(data), 1)
        difference = ours["inertia"] / fitted.inertia_ - 1
        table.add(
            f"to convergence, {dtype}: {fitted.n_iter_} against {ours['iterations']} iterations, our inertia {difference:+.2%}",
            f"scikit-learn {seconds:.2f} s", f"{ours['s']:.2f} s", ratio(seconds, ours["s"]),
        )
    fit = faiss.Kmeans(WIDTH, CLUSTERS, niter=25, max_points_per_centroid=10**9, seed=0)
    seconds, _ = timed(lambda: fit.train(reference), 1)
    difference = ours["inertia"] / fit.obj[-1] - 1
    table.add(
        f"25 iterations on all rows against ours to convergence, our inertia {difference:+.2%}",
        f"FAISS {seconds:.2f} s", f"{ours['s']:.2f} s", ratio(seconds, ours["s"]),
    )
    table.print("k-means")


def flat_index(reference):
    import faiss

    flat = faiss.IndexFlatL2(reference.shape[1])
    flat.add(reference)
    return flat


def ivf_index(reference, rng):
    import faiss

    index = faiss.IndexIVFFlat(faiss.IndexFlatL2(reference.shape[1]), reference.shape[1], CLUSTERS)
    index.train(reference[rng.permutation(len(reference))[:100_000]])
    index.add(reference)
    index.nprobe = 1
    return index


def some_of(rows, n):
    return np.ascontiguousarray(rows[:: max(1, len(rows) // n)])


def searches(reference, data, ksim, args):
    """Batches: exact against FAISS flat and IVF, clusters against IVF; graphs, which are approximate, beside them."""
    few = [some_of(rows, 500) for rows in data.queries.values()]
    ksim.write(reference, [*data.queries.values(), *few])
    ours = ksim.run(["blocked", "clusters"], args.threads)
    flat, ivf = flat_index(reference), ivf_index(reference, data.rng)
    table = Table("queries", "peer", "peer per query", "peer's recall", "ksim", "ksim per query", "ratio")
    graphs = graph_indexes(reference, args) if "approximate" in args.parts else []
    for at, (kind, rows) in enumerate(data.queries.items()):
        own = {engine: ours[engine]["queries"][at]["query_s"] for engine in ("blocked", "clusters")}
        some = few[at]
        flat.search(some[:50], NEIGHBORS)
        seconds, (distances, truth) = timed(lambda: flat.search(some, NEIGHBORS), 1)
        check(kind, distances, ours["blocked"]["queries"][at + len(few)]["sum"])
        theirs = seconds / len(some)
        table.add(kind, "FAISS flat", us(theirs), "1", "blocked (exact)", us(own["blocked"]), ratio(theirs, own["blocked"]))
        ivf.search(rows[:100], NEIGHBORS)
        seconds, (_, found) = timed(lambda: ivf.search(rows, NEIGHBORS))
        theirs = seconds / len(rows)
        hit = f"{recall(some_of(found, 500), truth):.3f}"
        for engine in ("clusters", "blocked"):
            name = "clusters (one of 50)" if engine == "clusters" else "blocked (exact)"
            table.add(kind, "FAISS IVF, one of 50", us(theirs), hit, name, us(own[engine]), ratio(theirs, own[engine]))
        for name, search in graphs:
            search(some)
            seconds, found = timed(lambda: search(rows))
            theirs = seconds / len(rows)
            hit = f"{recall(some_of(found, 500), truth):.3f}"
            table.add(kind, name, us(theirs), hit, "blocked (exact)", us(own["blocked"]), ratio(theirs, own["blocked"]))
    table.print(f"Batches of {len(next(iter(data.queries.values()))):,} queries, K = {NEIGHBORS}, {args.threads} threads")
    print(f"\nksim: exact index built in {ours['blocked']['build_s']:.2f} s; peak memory of both engines "
          f"{ours['peak_bytes'] / reference.nbytes:.2f} times the reference as f32.")


def check(kind, distances, total):
    """The K-th distances of both add up to the same, but for what f32 can lose: both answered one question."""
    theirs = float(np.sqrt(np.maximum(distances[:, -1], 0)).sum())
    if abs(theirs / total - 1) > 1e-3:
        sys.exit(f"{kind}: K-th distances add up to {theirs} and {total}: not the same answers")


def graph_indexes(reference, args):
    import hnswlib
    from usearch.index import Index

    built = []
    graph = hnswlib.Index("l2", reference.shape[1])
    graph.init_index(len(reference), ef_construction=100, M=16)
    graph.set_num_threads(args.threads)
    seconds, _ = timed(lambda: graph.add_items(reference), 1)
    graph.set_ef(100)
    built.append((f"hnswlib (built in {seconds:.0f} s)", lambda rows: graph.knn_query(rows, NEIGHBORS)[0]))
    other = Index(ndim=reference.shape[1], metric="l2sq", dtype="f32", expansion_search=100)
    keys = np.arange(len(reference))
    seconds, _ = timed(lambda: other.add(keys, reference, threads=args.threads), 1)
    search = lambda rows: other.search(rows, NEIGHBORS, threads=args.threads).keys  # noqa: E731
    built.append((f"usearch (built in {seconds:.0f} s)", search))
    return built


def single(reference, data, ksim, args):
    import faiss

    ours = ksim.run(["blocked", "clusters"], 1, single=300)
    flat, ivf = flat_index(reference), ivf_index(reference, data.rng)
    faiss.omp_set_num_threads(1)
    table = Table("queries", "peer", "peer per query", "ksim", "ksim per query", "ratio")
    for at, (kind, rows) in enumerate(data.queries.items()):
        some = some_of(rows, 100)[:100]
        for name, index, engine in (("FAISS flat", flat, "blocked"), ("FAISS IVF, one of 50", ivf, "clusters")):
            index.search(some[:1], NEIGHBORS)
            seconds, _ = timed(lambda: [index.search(row[None], NEIGHBORS) for row in some], 1)
            own, theirs = ours[engine]["queries"][at]["single_s"], seconds / len(some)
            table.add(kind, name, us(theirs), engine, us(own), ratio(theirs, own))
    faiss.omp_set_num_threads(args.threads)
    table.print("One query at a time, one thread")


def xy(reference, data, ksim, args):
    from scipy.spatial import cKDTree

    narrow, queries = reference[:, :2].copy(), [rows[:, :2].copy() for rows in data.queries.values()]
    ksim.write(narrow, queries)
    ours = ksim.run(["kd-tree", "blocked"], args.threads)
    tree = cKDTree(narrow)
    table = Table("queries", "scipy cKDTree", "kd-tree", "ratio", "blocked", "ratio ")
    for at, (kind, rows) in enumerate(zip(data.queries, queries)):
        tree.query(rows[:100], k=NEIGHBORS, workers=args.threads)
        seconds, _ = timed(lambda: tree.query(rows, k=NEIGHBORS, workers=args.threads))
        theirs = seconds / len(rows)
        own = [ours[engine]["queries"][at]["query_s"] for engine in ("kd-tree", "blocked")]
        cells = [cell for one in own for cell in (us(one), ratio(theirs, one))]
        table.add(kind, us(theirs), *cells)
    table.print(f"Two columns (x, y), K = {NEIGHBORS}, {args.threads} threads")


def growth(data, ksim, args):
    """Cost against rows, on the first kind of queries."""
    kind, rows = next(iter(data.queries.items()))
    table = Table("rows", "distinct", "blocked, build", "blocked, per query", "clusters, build", "clusters, per query",
                  "FAISS flat", "ratio", "FAISS IVF", "ratio ")
    for n in args.growth:
        reference = data.reference(n)
        ksim.write(reference, [rows])
        ours = ksim.run(["blocked", "clusters"], args.threads)
        some = some_of(rows, 200)
        flat = flat_index(reference)
        seconds, _ = timed(lambda: flat.search(some, NEIGHBORS), 1)
        exact = seconds / len(some)
        del flat
        ivf = ivf_index(reference, data.rng)
        ivf.search(some, NEIGHBORS)
        seconds, _ = timed(lambda: ivf.search(rows, NEIGHBORS), 1)
        probe = seconds / len(rows)
        own = {engine: ours[engine]["queries"][0]["query_s"] for engine in ("blocked", "clusters")}
        table.add(f"{n:,}", f"{data.distinct(n):,}", f"{ours['blocked']['build_s']:.2f} s", us(own["blocked"]),
                  f"{ours['clusters']['build_s']:.2f} s", us(own["clusters"]),
                  us(exact), ratio(exact, own["blocked"]), us(probe), ratio(probe, own["clusters"]))
    table.print(f"Growth with the rows: {kind} queries, {args.threads} threads")


def threads(reference, data, ksim, args):
    kind = next(iter(data.queries))
    table = Table("threads", "k-means", "blocked, build", "blocked, per query", "clusters, per query")
    for n in args.thread_counts:
        ours = ksim.run(["blocked", "clusters"], n)
        per_query = [us(ours[engine]["queries"][0]["query_s"]) for engine in ("blocked", "clusters")]
        table.add(str(n), f"{ours['kmeans']['s']:.2f} s", f"{ours['blocked']['build_s']:.2f} s", *per_query)
    table.print(f"Growth with the threads: {kind} queries")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    numbers = lambda text: [int(float(one)) for one in text.split(",")]  # noqa: E731
    parser.add_argument("--minari")
    parser.add_argument("--rollouts", nargs="*", default=[])
    parser.add_argument("--rows", type=lambda text: int(float(text)), default=1_000_000)
    parser.add_argument("--queries", type=int, default=24_000)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--parts", type=lambda text: text.split(","), default=PARTS)
    parser.add_argument("--growth", type=numbers, default=[10**4, 10**5, 10**6, 10**7])
    parser.add_argument("--thread-counts", type=numbers, default=[1, 2])
    args = parser.parse_args()
    if unknown := set(args.parts) - set(PARTS):
        parser.error(f"unknown parts {sorted(unknown)}, expected some of {', '.join(PARTS)}")
    if bool(args.minari) != bool(args.rollouts):
        parser.error("--minari and --rollouts go together")

    import faiss

    faiss.omp_set_num_threads(args.threads)
    data = Data(args)
    with tempfile.TemporaryDirectory() as folder:
        ksim = Ksim(pathlib.Path(folder))
        reference = data.reference(args.rows)
        print(f"{len(reference):,} × {WIDTH} rows ({data.distinct(args.rows):,} distinct), queries "
              f"{', '.join(f'{kind} ({len(rows):,})' for kind, rows in data.queries.items())}.")
        for part, measure in (("kmeans", lambda: kmeans(reference, ksim, args)),
                              ("exact", lambda: searches(reference, data, ksim, args)),
                              ("single", lambda: single(reference, data, ksim, args)),
                              ("threads", lambda: threads(reference, data, ksim, args)),
                              ("xy", lambda: xy(reference, data, ksim, args)),
                              ("rows", lambda: growth(data, ksim, args))):
            if part in args.parts:
                if part not in ("xy", "rows"):
                    ksim.write(reference, data.queries.values())
                measure()
                sys.stdout.flush()


main()
