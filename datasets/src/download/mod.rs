//! Fetching datasets.
