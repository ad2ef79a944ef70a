#!/usr/bin/env python3
"""Puts the steps of several D4RL files into one, in the order given.

    pip install h5py numpy
    python scripts/join_d4rl.py sac.hdf5 tqc.hdf5 -o hopper_medium_expert-v2.hdf5

Takes what all of them have with one row per step, and the attributes of the first.
"""
import argparse

import h5py
import numpy as np


def steps(file):
    """Names of the datasets with a row per step."""
    names = []

    def visit(name, item):
        if isinstance(item, h5py.Dataset) and item.shape[:1] == file["rewards"].shape:
            names.append(name)

    file.visititems(visit)
    return names


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", nargs="+")
    parser.add_argument("-o", "--output", required=True)
    args = parser.parse_args()
    files = [h5py.File(path) for path in args.files]
    with h5py.File(args.output, "x") as out:
        out.attrs.update(files[0].attrs)
        for name in steps(files[0]):
            if all(name in steps(file) for file in files):
                out.create_dataset(name, data=np.concatenate([file[name][:] for file in files]), compression="gzip")
        print(f"{args.output}: {len(out['rewards']):,} steps")


main()
