#!/usr/bin/env python3
"""Puts under .native/ what the build needs and a fresh machine may lack.

  .native/cmake/bin/cmake   CMake >= 3.26, which builds the static HDF5: a link to the machine's
                            own (or to $CMAKE) if it is new enough, else the one that pip fetches
  .native/mujoco/lib        libmujoco, out of its Python wheel, for the feature `mujoco`; a
                            MUJOCO_DYNAMIC_LINK_DIR of your own wins over it
  .native/libtorch          with `--torch`: the CPU part of libtorch, out of its Python wheel, for
                            the feature `torch`; a LIBTORCH of your own wins over it

Standard library and pip only. Runs from any folder, again at no cost, and twice at once: every
result is made in a folder of its own and renamed into place when it is whole. Wheels stay in
.native/wheels, or in $NATIVE_WHEELS.
"""
import contextlib
import os
import pathlib
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import zipfile

CMAKE = "3.31.10"  # the last 3.x
CMAKE_AT_LEAST = (3, 26)  # what hdf5-metno-src asks for; Debian 12 has 3.25
MUJOCO = "3.17.0"  # what mujoco-rs binds, to the last digit of the version
# Which of the wheels to take: all hold the same library, whatever Python runs this.
MUJOCO_WHEEL = ("--python-version", "3.11", "--implementation", "cp", "--abi", "cp311")
TORCH = "2.13.0"  # what torch-sys binds
CUDA_RUNTIME, CUDA_CUPTI = "13.0.96", "13.0.85"  # two libraries that libtorch_cpu of that wheel names
TORCH_WHEEL = ("--python-version", "3.11", "--implementation", "cp", "--abi", "cp311", "--abi", "none",
               "--platform", "manylinux_2_28_x86_64", "--platform", "manylinux_2_25_x86_64",
               "--platform", "manylinux2014_x86_64")
# All that a CPU needs of the wheels: the other gigabytes are for CUDA.
TORCH_LIBRARIES = {"libtorch_cpu.so", "libc10.so", "libgomp.so.1", "libcudart.so.13", "libcupti.so.13"}
NATIVE = pathlib.Path(__file__).resolve().parents[1] / ".native"
WHEELS = pathlib.Path(os.environ.get("NATIVE_WHEELS") or NATIVE / "wheels")


def cmake_version(cmake):
    """(major, minor) of a CMake that runs, else None."""
    try:
        out = subprocess.run([cmake, "--version"], capture_output=True, text=True).stdout
    except OSError:
        return None
    found = re.match(r"cmake version (\d+)\.(\d+)", out)
    return (int(found[1]), int(found[2])) if found else None


def new_enough(cmake):
    version = cmake_version(cmake)
    return version is not None and version >= CMAKE_AT_LEAST


@contextlib.contextmanager
def workspace(beside):
    """A folder beside the result, on the same disk so that a rename is all it takes."""
    beside.mkdir(parents=True, exist_ok=True)
    path = pathlib.Path(tempfile.mkdtemp(prefix=".partial-", dir=beside))
    try:
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)


def put(made, place, is_good):
    """Renames `made` to `place`, unless a good one came there meanwhile."""
    with contextlib.suppress(OSError):
        made.rename(place)
        return
    if not is_good():
        with workspace(place.parent) as away:
            place.rename(away / "old")
            made.rename(place)


def pip_download(requirement, into, *source):
    """The wheel that pip chose for this machine, or None."""
    command = [sys.executable, "-m", "pip", "download", "--no-deps", "--only-binary=:all:",
               "--disable-pip-version-check", "-q", "-d", str(into), *source, requirement]
    offline = "--no-index" in source
    done = subprocess.run(command, stderr=subprocess.DEVNULL if offline else None)
    return next(into.glob("*.whl"), None) if done.returncode == 0 else None


def wheel(requirement, into, *which):
    """A wheel of this machine's platform, from the cache or the package index."""
    WHEELS.mkdir(parents=True, exist_ok=True)
    cached = pip_download(requirement, into, *which, "--no-index", "--find-links", str(WHEELS))
    if cached:
        return cached
    fetched = pip_download(requirement, into, *which)
    if not fetched:
        sys.exit(f"native.py: pip could not fetch {requirement} (its message is above)")
    with workspace(WHEELS) as partial:
        shutil.copy(fetched, partial)
        os.replace(partial / fetched.name, WHEELS / fetched.name)
    return fetched


def unpack(archive, marker, into):
    """Copies the folder of the wheel that holds `marker`, keeping executable bits."""
    with zipfile.ZipFile(archive) as z:
        prefix = next(n for n in z.namelist() if n.endswith(f"/{marker}")).removesuffix(marker)
        for info in z.infolist():
            if info.is_dir() or not info.filename.startswith(prefix):
                continue
            out = into / info.filename[len(prefix):]
            out.parent.mkdir(parents=True, exist_ok=True)
            with z.open(info) as source, open(out, "wb") as target:
                shutil.copyfileobj(source, target, 1 << 20)
            out.chmod(0o755 if info.external_attr >> 16 & 0o100 else 0o644)


def provide_cmake():
    place = NATIVE / "cmake"
    ours = place / "bin" / "cmake"
    if new_enough(ours):
        return
    with workspace(NATIVE) as partial:
        made = partial / "cmake"
        own = shutil.which(os.environ.get("CMAKE") or "cmake")
        if own and new_enough(own):
            (made / "bin").mkdir(parents=True)
            (made / "bin" / "cmake").symlink_to(pathlib.Path(own).absolute())
            told = f"linked CMake {own}"
        else:
            require_pip()
            unpack(wheel(f"cmake=={CMAKE}", partial), "bin/cmake", made)
            told = f"fetched CMake {CMAKE}"
        put(made, place, lambda: new_enough(ours))
    if not new_enough(ours):
        sys.exit(f"native.py: {ours} does not run on this machine; "
                 "install CMake >= 3.26 and run this again")
    print(f"native.py: {told}")


def provide_mujoco():
    place = NATIVE / "mujoco"
    linux, mac = f"libmujoco.so.{MUJOCO}", f"libmujoco.{MUJOCO}.dylib"
    whole = lambda: any((place / "lib" / name).exists() for name in (linux, mac))
    if whole():
        return
    with workspace(NATIVE) as partial:
        require_pip()
        archive = wheel(f"mujoco=={MUJOCO}", partial, *MUJOCO_WHEEL)
        lib = partial / "mujoco" / "lib"
        lib.mkdir(parents=True)
        with zipfile.ZipFile(archive) as z:
            member = next((n for n in z.namelist() if pathlib.PurePath(n).name in (linux, mac)), None)
            if member is None:
                sys.exit(f"native.py: the wheel {archive.name} holds no libmujoco {MUJOCO}")
            library = lib / pathlib.PurePath(member).name
            with z.open(member) as source, open(library, "wb") as target:
                shutil.copyfileobj(source, target, 1 << 20)
        library.chmod(0o755)
        # The name that the linker asks for.
        plain = "libmujoco.so" if library.name == linux else "libmujoco.dylib"
        (lib / plain).symlink_to(library.name)
        put(partial / "mujoco", place, whole)
    print(f"native.py: fetched MuJoCo {MUJOCO}")


def provide_torch():
    place = NATIVE / "libtorch"
    version = place / "build-version"  # written last, and what torch-sys asks for
    whole = lambda: version.exists() and version.read_text().strip() == TORCH
    if whole():
        return
    if (platform.system(), platform.machine()) != ("Linux", "x86_64"):
        sys.exit(f"native.py: fetches libtorch for Linux on x86-64 only; here, point LIBTORCH at a libtorch {TORCH} "
                 "of your own (that of a `pip install torch` will do)")
    with workspace(NATIVE) as partial:
        require_pip()
        made = partial / "libtorch"
        for requirement in (f"nvidia-cuda-runtime=={CUDA_RUNTIME}", f"nvidia-cuda-cupti=={CUDA_CUPTI}",
                            f"torch=={TORCH}"):
            (download := partial / "wheel").mkdir()
            take_torch(wheel(requirement, download, *TORCH_WHEEL), made)
            shutil.rmtree(download)
        missing = TORCH_LIBRARIES - {path.name for path in (made / "lib").iterdir()}
        if missing:
            sys.exit(f"native.py: the wheels hold no {', '.join(sorted(missing))}")
        # torch-sys links `torch`, and the wheel's libtorch.so asks for libtorch_cuda: a linker script takes its place.
        (made / "lib" / "libtorch.so").write_text("INPUT(-ltorch_cpu)\n")
        (made / "build-version").write_text(TORCH + "\n")
        put(made, place, whole)
    print(f"native.py: fetched libtorch {TORCH}")


def take_torch(archive, made):
    """Copies the libraries that a CPU needs, and the headers."""
    with zipfile.ZipFile(archive) as z:
        for info in z.infolist():
            path = pathlib.PurePosixPath(info.filename)
            if info.is_dir():
                continue
            if path.name in TORCH_LIBRARIES:
                out = made / "lib" / path.name
            elif path.parts[:2] == ("torch", "include"):
                out = made.joinpath(*path.parts[1:])
            else:
                continue
            out.parent.mkdir(parents=True, exist_ok=True)
            with z.open(info) as source, open(out, "wb") as target:
                shutil.copyfileobj(source, target, 1 << 20)


def require_pip():
    if subprocess.run([sys.executable, "-m", "pip", "--version"], capture_output=True).returncode:
        sys.exit(f"native.py: {sys.executable} has no pip, which fetches CMake {CMAKE}, MuJoCo {MUJOCO} and libtorch {TORCH}.\n"
                 "Install pip (Debian and Ubuntu: apt install python3-pip), or provide a CMake >= 3.26 "
                 "and a libmujoco of your own in .native/mujoco/lib, and run this again.")


unknown = set(sys.argv[1:]) - {"--torch"}
if unknown:
    sys.exit(f"native.py: knows no {', '.join(sorted(unknown))}; the one option is --torch")
provide_cmake()
provide_mujoco()
if "--torch" in sys.argv[1:]:
    provide_torch()
