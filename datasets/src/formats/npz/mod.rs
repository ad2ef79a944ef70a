//! NumPy archives of flat arrays, as OGBench and D4RL-like projects publish them.
//!
//! An archive with `rewards` or `timeouts` is cut into episodes as D4RL files are, by an
//! [`crate::EpisodePolicy`]. Any other is OGBench's: there `terminals` marks the last row of a trajectory (in
//! compact archives `valids` does, and `terminals` marks the last two), whose observation comes after the last
//! step and whose action stands for nothing. So that row is a final-observation row, its action null, and the
//! step before it is `truncated`. Rows after the last mark are steps without a final observation.
//!
//! Entries that are packed are unpacked in order by each pass, only those of the columns asked for, side by side.
//! Memory is a batch, a row and some buffers per column (about 1.2 MiB); an array in Fortran order is held whole
//! (twice while it is read) and may have 1 GiB. Before anything is unpacked, declared sizes are bounded by the
//! bytes that are there. Checksums are compared when a pass reaches the end of an entry.

mod archive;
mod array;
mod ogbench;
mod read;
#[cfg(test)]
mod tests;

pub(crate) use read::open;
