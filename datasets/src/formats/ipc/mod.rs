//! Arrow IPC files ("Feather version 2"), read a record batch at a time.
//!
//! The `arrow` crate's own decoder trusts what a file says about itself and panics on some of what it does not
//! expect. So a file is checked first: types, the place of every block and buffer, and the lengths of nested
//! columns. Memory is O(one record batch): its bytes in the file, or, where it is packed (lz4, zstd, dictionaries),
//! 64 MiB and 1100 times those bytes at most, which is checked before anything is unpacked. Dictionaries are held
//! as long as a file is open.

mod check;
mod file;
mod messages;
mod read;
mod rows;
mod write;

pub(crate) use file::IpcFile;
pub(crate) use read::open;
pub(crate) use rows::IpcRows;
pub(crate) use write::create;
