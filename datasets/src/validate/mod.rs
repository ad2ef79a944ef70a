//! Finding faults in datasets.
