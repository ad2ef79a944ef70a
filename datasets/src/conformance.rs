//! What every [`DatasetSource`] and [`DatasetSink`] must hold to. For tests.
