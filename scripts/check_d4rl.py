"""Reads D4RL files with h5py by D4RL's own rules and prints, as JSON, what they hold.

usage: check_d4rl.py FILE...

The output is a list with an object per file: every array (shape, type, SHA-256 of the bytes in C order), the
attributes of the file, the lengths of the episodes that `sequence_dataset` yields, and what `qlearning_dataset` makes
of the rows. The rules are restated from the behavior of these functions; files without time-outs are passed over.
"""

import hashlib
import json
import sys


def arrays(file):
    """Every array of the file by its key."""
    import h5py
    import numpy as np

    found = {}

    def visit(key, item):
        if not isinstance(item, h5py.Dataset):
            return
        value = np.ascontiguousarray(item[()])
        if value.dtype == object:
            data = json.dumps([str(x) for x in value.ravel()]).encode()
        else:
            data = value.astype(value.dtype.newbyteorder("=")).tobytes()
        digest = hashlib.sha256(data).hexdigest()
        compression = [item.compression, item.compression_opts]
        found[key] = {"shape": list(item.shape), "dtype": item.dtype.name, "sha256": digest, "compression": compression}

    file.visititems(visit)
    return found


def sequence_lengths(terminals, timeouts):
    """Lengths of the episodes of `sequence_dataset`: rows after the last end are not yielded."""
    lengths, length = [], 0
    for terminal, timeout in zip(terminals, timeouts, strict=True):
        length += 1
        if terminal or timeout:
            lengths.append(length)
            length = 0
    return lengths


def qlearning(observations, terminals, timeouts):
    """Transitions of `qlearning_dataset`: rows with a time-out and the last row of the file are skipped."""
    import numpy as np

    kept = [i for i in range(len(terminals) - 1) if not timeouts[i]]
    after = np.ascontiguousarray(observations[[i + 1 for i in kept]].astype(np.float32)) if kept else b""
    return {
        "n_transitions": len(kept),
        "n_terminals": sum(bool(terminals[i]) for i in kept),
        "next_sha256": hashlib.sha256(after if kept else b"").hexdigest(),
    }


def read(path):
    """The whole content of a file."""
    import h5py

    with h5py.File(path) as file:
        content = {"arrays": arrays(file), "attributes": {key: str(value) for key, value in file.attrs.items()}}
        if "timeouts" not in file:
            return content
        terminals, timeouts = file["terminals"][:].ravel(), file["timeouts"][:].ravel()
        content["sequence"] = sequence_lengths(terminals, timeouts)
        content["qlearning"] = qlearning(file["observations"][:], terminals, timeouts)
    return content


if __name__ == "__main__":
    json.dump([read(path) for path in sys.argv[1:]], sys.stdout)
