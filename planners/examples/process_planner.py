"""A planner process in Python: pushes a point mass towards 1. Needs pyarrow.

    ksim rollout --planner "process:python3 planners/examples/process_planner.py" --env PointMass-v0 --episodes 5

The protocol: docs/planner-processes.md. Only Arrow goes to stdout; print to stderr.
"""

import json
import random
import sys

import pyarrow as pa

HORIZON = 8


def plan(observation, rng):
    """Actions of one candidate, and how good it is."""
    place, velocity = observation
    force = 2.0 * (1.1 - place) - 0.5 * velocity
    force = max(-1.0, min(1.0, force * rng.uniform(1.0, 1.01)))
    return [force] * HORIZON, -abs(1.1 - place)


def main():
    requests = pa.ipc.open_stream(sys.stdin.buffer)
    meta = requests.schema.metadata
    if meta[b"ksim.planner.protocol"] != b"1":
        sys.exit("another version of the protocol")
    setting = json.loads(meta[b"ksim.planner.setting"])
    if (setting["observation_dim"], setting["action_dim"]) != (2, 1):
        sys.exit(f"this planner is for PointMass-v0, not for {setting['environment']}")

    spec = {"family": "python-push", "observation_dim": 2, "action_dim": 1, "horizon": HORIZON}
    schema = pa.schema(
        [
            ("slot", pa.uint64()),
            ("actions", pa.list_(pa.float32(), HORIZON * 1)),
            ("score", pa.float64()),
            ("novelty", pa.float64()),
            ("chosen", pa.bool_()),
            ("error", pa.string()),
        ],
        metadata={"ksim.planner.protocol": "1", "ksim.planner.spec": json.dumps(spec)},
    )
    with pa.ipc.new_stream(sys.stdout.buffer, schema) as answers:

        def answer(rows):
            answers.write_batch(pa.RecordBatch.from_pylist(rows, schema=schema))
            sys.stdout.buffer.flush()

        answer([])  # the answer to the handshake
        rngs = {}
        for batch in requests:
            rows = []
            for row in batch.to_pylist():
                if row["message"] == "reset":
                    rngs[row["slot"]] = random.Random(row["seed"])
                    continue
                actions, score = plan(row["observation"], rngs[row["slot"]])
                rows.append({"slot": row["slot"], "actions": actions, "score": score, "chosen": True})
            answer(rows)


if __name__ == "__main__":
    main()
