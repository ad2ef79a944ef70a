#!/usr/bin/env python3
"""Fetches what the build needs and a fresh machine may lack, under .native/ (stdlib + pip only).

  .native/cmake/   CMake >= 3.26, for the static HDF5 build

Idempotent: a stamp file says what is there. Wheels are cached in .native/wheels or $NATIVE_WHEELS.
"""
import os
import pathlib
import platform
import shutil
import subprocess
import sys
import zipfile

CMAKE = "3.31.10"  # the last 3.x; hdf5-metno-src needs >= 3.26, Debian 12 has 3.25
ROOT = pathlib.Path(__file__).resolve().parents[1]
NATIVE = ROOT / ".native"
WHEELS = pathlib.Path(os.environ.get("NATIVE_WHEELS", NATIVE / "wheels"))
STAMP = f"cmake={CMAKE} v1\n"


def wheel(name, version):
    """The wheel of this machine's platform, from the cache or the package index."""
    pattern = f"{name}-{version}-*{platform.machine()}*.whl"
    if not list(WHEELS.glob(pattern)):
        WHEELS.mkdir(parents=True, exist_ok=True)
        subprocess.run(
            [sys.executable, "-m", "pip", "download", "--no-deps", "--only-binary=:all:",
             "-q", "-d", str(WHEELS), f"{name}=={version}"],
            check=True,
        )
    found = sorted(WHEELS.glob(pattern))
    if not found:
        sys.exit(f"no {name} {version} wheel for {platform.machine()} in {WHEELS}")
    return found[0]


def extract(archive, prefix, destination):
    """Copies every file below `prefix`, keeping the executable bit."""
    with zipfile.ZipFile(archive) as z:
        for info in z.infolist():
            if info.is_dir() or not info.filename.startswith(prefix):
                continue
            out = destination / info.filename[len(prefix):]
            out.parent.mkdir(parents=True, exist_ok=True)
            with z.open(info) as source, open(out, "wb") as target:
                shutil.copyfileobj(source, target, 1 << 20)
            out.chmod(0o755 if info.external_attr >> 16 & 0o100 else 0o644)


def main():
    stamp = NATIVE / "stamp"
    if stamp.exists() and stamp.read_text() == STAMP:
        print("native.py: .native is up to date")
        return
    shutil.rmtree(NATIVE / "cmake", ignore_errors=True)
    archive = wheel("cmake", CMAKE)
    extract(archive, "cmake/data/", NATIVE / "cmake")
    stamp.write_text(STAMP)
    print("native.py: wrote CMake", CMAKE, "to .native/cmake")


main()
