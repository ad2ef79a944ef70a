# Thin: behind every target stands a command that works alone.

.PHONY: demo test native native-torch peers peers-lerobot miri check

# Builds with the default features and scores the bundled rollouts.
demo: native
	cargo run --release -p ksim-cli -- demo

# Sets up what the tests need and runs them all, doc tests included; those of MuJoCo's environments too.
# FEATURES=mujoco,torch takes libtorch along, after `make native-torch`.
FEATURES ?= mujoco
test: native
	cargo test --workspace --features $(FEATURES)

# CMake for the static HDF5, if the machine has none that is new enough, and libmujoco.
native:
	python3 scripts/native.py

# libtorch too (half a gigabyte), for the feature `torch`.
native-torch:
	python3 scripts/native.py --torch

# The libraries of other people's formats, for the tests that have them read our files:
# KSIM_PYTHON=target/peers/bin/python make test.
peers:
	python3 -m venv target/peers
	target/peers/bin/pip install --quiet "minari[hdf5]==0.5.4" gymnasium-robotics==1.4.2 mujoco==3.17.0 pillow pyarrow \
		mcap mcap-protobuf-support mcap-ros2-support

# LeRobot too, which brings gigabytes.
peers-lerobot: peers
	timeout 900 target/peers/bin/pip install --quiet --no-cache-dir lerobot

# The vector instructions of this machine under Miri (needs `rustup component add miri --toolchain nightly`): minutes.
miri:
	MIRIFLAGS=-Zmiri-disable-isolation RUSTFLAGS="-C target-feature=+avx2" CARGO_TARGET_DIR=target/miri \
		cargo +nightly miri test -p ksim --lib lanes

# What CI runs.
check:
	bash .ci/run
