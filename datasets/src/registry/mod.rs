//! Known datasets: where they are published, their sizes, checksums and reference scores.
