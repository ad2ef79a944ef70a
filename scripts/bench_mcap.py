#!/usr/bin/env python3
"""Reading an MCAP recording into Arrow, against the official Python reader in the same run.

usage: bench_mcap.py --binary TIME_READ [--work DIR] [--messages N] [--runs N]

TIME_READ is the example `time_read` of ksim-datasets, built with the features `hdf5` and `mcap`. Writes a recording
of N JointState messages (7 joints, zstd chunks), reads it whole with both, and prints the best time of each, the
speed in uncompressed message bytes, and the ratio. Needs mcap and mcap-ros2-support.
"""
import argparse
import math
import subprocess
import tempfile
import time
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap_ros2.decoder import DecoderFactory
from mcap_ros2.writer import Writer

SEPARATOR = "\n" + "=" * 80 + "\n"
JOINT_STATE = SEPARATOR.join(
    [
        "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort",
        "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id",
        "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec",
    ]
)
NAMES = [f"joint{i}" for i in range(1, 8)]
START = 1_700_000_000_000_000_000
MAPPING = """\
[grid]
topic = "/joint_states"
[observation.position]
topic = "/joint_states"
field = "position"
[observation.velocity]
topic = "/joint_states"
field = "velocity"
[action]
topic = "/joint_states"
field = "effort"
"""


def make(path: Path, n_messages: int) -> None:
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=1 << 20, compression=CompressionType.ZSTD)
        schema = writer.register_msgdef("sensor_msgs/msg/JointState", JOINT_STATE)
        for i in range(n_messages):
            now = START + i * 1_000_000
            values = [math.sin(i * 1e-3 + k) for k in range(7)]
            message = {
                "header": {"stamp": {"sec": now // 10**9, "nanosec": now % 10**9}, "frame_id": "base"},
                "name": NAMES,
                "position": values,
                "velocity": values[::-1],
                "effort": values,
            }
            writer.write_message("/joint_states", schema, message, log_time=now, publish_time=now, sequence=i)
        writer.finish()


def read_python(path: Path) -> int:
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        n_rows = 0
        for *_, message in reader.iter_decoded_messages():
            n_rows += len(message.position) > 0
    return n_rows


def message_bytes(path: Path) -> int:
    with path.open("rb") as file:
        return sum(chunk.uncompressed_size for chunk in make_reader(file).get_summary().chunk_indexes)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--binary", required=True, type=Path)
    parser.add_argument("--work", type=Path)
    parser.add_argument("--messages", type=int, default=900_000)
    parser.add_argument("--runs", type=int, default=3)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        work = args.work or Path(temporary)
        work.mkdir(parents=True, exist_ok=True)
        path, mapping = work / f"{args.messages}.mcap", work / "mapping.toml"
        mapping.write_text(MAPPING)
        if not path.exists():
            make(path, args.messages)
        size = message_bytes(path)
        ours = []
        for _ in range(args.runs):
            out = subprocess.run([args.binary, path, "arrow", mapping], check=True, capture_output=True, text=True)
            n_rows, seconds = out.stdout.split()
            assert int(n_rows) == args.messages, n_rows
            ours.append(float(seconds))
        start = time.perf_counter()
        assert read_python(path) == args.messages
        theirs = time.perf_counter() - start
        best = min(ours)
        print(f"{size / 1e6:.0f} MB of messages, {path.stat().st_size / 1e6:.0f} MB file")
        print(f"ksim    {best:8.2f} s  {size / best / 1e6:8.0f} MB/s")
        print(f"python  {theirs:8.2f} s  {size / theirs / 1e6:8.0f} MB/s")
        print(f"ratio   {theirs / best:8.1f}")


if __name__ == "__main__":
    main()
