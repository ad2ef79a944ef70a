//! Arrow IPC files, read a record batch at a time.
//!
//! The `arrow` crate's own decoder trusts what a file says about itself and panics on some of what it does not
//! expect. So a file is checked first: types, the place of every block and buffer, and the lengths of nested
//! columns. Memory is O(one record batch), which is never more than the file has bytes.

mod check;
mod file;

pub(crate) use file::IpcFile;
