# Thin: behind every target stands a command that works alone.

.PHONY: demo test native check

# Builds with the default features and scores the bundled rollouts.
demo: native
	cargo run --release -p ksim-cli -- demo

# Sets up what the tests need and runs them all, doc tests included.
test: native
	cargo test --workspace

# CMake for the static HDF5, if the machine has none that is new enough.
native:
	python3 scripts/native.py

# What CI runs.
check:
	bash .ci/run
