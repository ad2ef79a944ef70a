//! Opening a file and listing its groups.

use std::path::Path;
use std::time::Duration;

use hdf5_metno as hdf5;

use super::array::Array;
use crate::error::{DatasetError, LibraryMessage, Result};

/// Bytes of chunk cache per dataset: a batch of rows cuts through chunks, and a chunk should be unpacked
/// once. h5py's automatic chunks are at most 1 MiB, and there is one dataset per column.
const CHUNK_CACHE_BYTES: usize = 16 << 20;
/// Hash slots of the cache: a prime well above the number of chunks that fit.
const CHUNK_CACHE_SLOTS: usize = 12_421;
/// Members listed of one group, at most: more than any dataset has episodes.
const MAX_MEMBERS: usize = 10_000_000;
/// Groups inside groups are listed this deep; hard links can make a group its own member.
pub(crate) const MAX_DEPTH: usize = 16;
/// Members of all groups of an episode, at most: hard links can make few groups look like many.
const MAX_NESTED_MEMBERS: usize = 100_000;

/// An open HDF5 file.
pub(crate) struct H5File {
    file: hdf5::File,
    size: u64,
}

/// What a member of a group is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum MemberKind {
    Group,
    Array,
}

/// A member of a group.
#[derive(Debug, Clone)]
pub(crate) struct Member {
    pub(crate) name: String,
    pub(crate) kind: MemberKind,
}

/// How often a file that somebody else has locked is tried again, and after how long.
const LOCK_ATTEMPTS: usize = 40;
const LOCK_PAUSE: Duration = Duration::from_millis(50);

impl H5File {
    /// Opens a file for reading.
    ///
    /// # Errors
    /// [`DatasetError::Corrupt`] if it is cut off or no HDF5 file.
    pub(crate) fn open(path: &Path) -> Result<Self> {
        let size = std::fs::metadata(path)
            .map_err(|e| DatasetError::io("open", e))?
            .len();
        let mut options = hdf5::FileBuilder::new();
        options.with_fapl(|fapl| fapl.chunk_cache(CHUNK_CACHE_SLOTS, CHUNK_CACHE_BYTES, 1.0));
        let is_locked = |opened: &hdf5::Result<hdf5::File>| {
            let error = opened.as_ref().err();
            error.is_some_and(|error| error.to_string().contains("unable to lock file"))
        };
        let mut file = options.open(path);
        // A process that is being started holds the locks of the one that starts it for a moment.
        for _ in 0..LOCK_ATTEMPTS {
            if !is_locked(&file) {
                break;
            }
            std::thread::sleep(LOCK_PAUSE);
            file = options.open(path);
        }
        let file = file.map_err(|e| {
            DatasetError::corrupt(format!("not a whole HDF5 file ({size} bytes): {e}"))
        })?;
        Ok(Self { file, size })
    }

    /// Bytes of the file on disk.
    pub(crate) fn size(&self) -> u64 {
        self.size
    }

    /// The root group.
    pub(crate) fn root(&self) -> &hdf5::Group {
        &self.file
    }

    /// A group by its path.
    ///
    /// # Errors
    /// It is not there or not readable.
    pub(crate) fn group(&self, key: &str) -> Result<hdf5::Group> {
        self.file.group(key).map_err(failed("open group", key))
    }

    /// An array by its path, checked.
    ///
    /// # Errors
    /// Those of [`Array::open`].
    pub(crate) fn array(&self, key: &str) -> Result<Array> {
        Array::open(&self.file, key, key, self.size)
    }
}

/// The groups and arrays of a group, in the library's order (by name, bytewise).
///
/// # Errors
/// A link that leads out of the file, or a damaged group.
pub(crate) fn members(group: &hdf5::Group, key: &str) -> Result<Vec<Member>> {
    let links = group.links(hdf5::IndexType::Name, hdf5::IterationOrder::Native);
    let links = links.map_err(failed("list group", key))?;
    if links.len() > MAX_MEMBERS {
        return Err(DatasetError::corrupt(format!(
            "group \"{key}\" claims {} members",
            links.len()
        )));
    }
    let mut members = Vec::with_capacity(links.len());
    for (name, link) in links {
        let full = join(key, &name);
        if link.link_type != hdf5::LinkType::Hard {
            return Err(DatasetError::Unsupported {
                what: format!("\"{full}\" is a soft or external link"),
            });
        }
        let kind = match group
            .loc_type_by_name(&name)
            .map_err(failed("open", &full))?
        {
            hdf5::LocationType::Group => MemberKind::Group,
            hdf5::LocationType::Dataset => MemberKind::Array,
            _ => continue,
        };
        members.push(Member { name, kind });
    }
    Ok(members)
}

/// Paths, relative to a group, of all arrays in it and in its groups, in name order. Links that lead out of
/// the file are refused, wherever they are.
///
/// # Errors
/// Such a link, or a damaged group.
pub(crate) fn array_paths(file: &H5File, root: &str) -> Result<Vec<String>> {
    let mut arrays = Vec::new();
    let mut open = vec![(String::new(), 0)];
    let mut n_members = 0;
    while let Some((parent, depth)) = open.pop() {
        let path = if parent.is_empty() {
            root.to_owned()
        } else {
            join(root, &parent)
        };
        let listed = members(&file.group(&path)?, &path)?;
        n_members += listed.len();
        if n_members > MAX_NESTED_MEMBERS {
            return Err(nested_without_end(&path));
        }
        for member in listed {
            let key = join(&parent, &member.name);
            match member.kind {
                MemberKind::Group if depth > MAX_DEPTH => {
                    return Err(nested_without_end(&key));
                }
                MemberKind::Group => open.push((key, depth + 1)),
                MemberKind::Array => arrays.push(key),
            }
        }
    }
    arrays.sort();
    Ok(arrays)
}

/// The error for groups that contain themselves, by hard links, or nearly so.
pub(crate) fn nested_without_end(key: &str) -> DatasetError {
    DatasetError::corrupt(format!("group \"{key}\" is nested without end"))
}

/// `parent/name` without a leading slash.
pub(crate) fn join(parent: &str, name: &str) -> String {
    if parent.is_empty() {
        name.to_owned()
    } else {
        format!("{parent}/{name}")
    }
}

/// Wraps an error of the library with the object it happened on.
pub(crate) fn failed<'k>(
    operation: &'static str,
    key: &'k str,
) -> impl Fn(hdf5::Error) -> DatasetError + 'k {
    move |error| DatasetError::Hdf5 {
        operation,
        key: key.to_owned(),
        source: LibraryMessage(error.to_string()),
    }
}
