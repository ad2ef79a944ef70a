//! robomimic HDF5 files: a group per demonstration.
//!
//! | in `data/demo_<n>` | column | rows |
//! |---|---|---|
//! | `obs/<key>` | `observation.<key>` | N, and the last of `next_obs/<key>` if all keys have it |
//! | `actions` | `action` | N |
//! | `rewards` | `reward` | N |
//! | `next_obs/<key>` | `next_observation.<key>`, only where it is not `obs/<key>` one row on | N |
//! | `dones` | `info.done` | N |
//! | anything else with N rows, as `states` | `info.<path>` | N |
//!
//! `dones` gives no `terminated`: robomimic's converters write success, the end of the demonstration, or both
//! into it, and the file does not say which. Opening compares all of `next_obs` with `obs`, so it reads them
//! once. The filters of `mask` are an attribute of the episodes, `mask`, beside those of the groups.

mod demos;
mod read;
mod shift;
#[cfg(test)]
mod tests;

pub(crate) use demos::is_robomimic;
pub(crate) use read::open;
