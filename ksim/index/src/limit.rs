//! Keeps the resident memory of mapped files within bounds.
//!
//! A page of a mapped file stays resident once it was looked at, so that a search through a file larger than
//! memory looks as if it held all of it. Linux takes such pages back when memory is short, but whoever limits or
//! measures this process sees them as its own. So a thread looks at the process's resident memory and gives the
//! pages back when there is too much; they stay in the system's cache and cost little when they are looked at again.

use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use crate::mapping::Mapping;

/// Resident bytes of the process above which pages are given back.
pub(crate) const LIMIT: u64 = 1_400_000_000;

/// Between two looks: pages come back at some gigabytes a second at most.
const PERIOD: Duration = Duration::from_millis(20);

/// Gives pages of mappings back, until it is dropped.
#[derive(Debug)]
pub(crate) struct Limiter {
    mappings: Arc<Mutex<Vec<Mapping>>>,
    stop: Arc<(Mutex<bool>, Condvar)>,
    thread: Option<JoinHandle<()>>,
}

impl Limiter {
    /// Starts. Without effect where the system does not say how much memory is resident, or starts no thread: then
    /// memory is left to the system.
    pub(crate) fn start(limit: u64) -> Self {
        let mappings = Arc::new(Mutex::new(Vec::new()));
        let stop = Arc::new((Mutex::new(false), Condvar::new()));
        let thread = Resident::now().and_then(|_| {
            let (mappings, stop) = (Arc::clone(&mappings), Arc::clone(&stop));
            let thread = std::thread::Builder::new().name("mapped memory".to_owned());
            thread.spawn(move || watch(&mappings, limit, &stop)).ok()
        });
        Self {
            mappings,
            stop,
            thread,
        }
    }

    /// Takes charge of a mapping: before it is looked at, or its pages are in memory already.
    pub(crate) fn add(&self, mapping: &Mapping) {
        let mappings = self.mappings.lock();
        let mut mappings = mappings.unwrap_or_else(PoisonError::into_inner);
        mappings.push(mapping.clone());
    }
}

impl Drop for Limiter {
    fn drop(&mut self) {
        *self.stop.0.lock().unwrap_or_else(PoisonError::into_inner) = true;
        self.stop.1.notify_all();
        if let Some(thread) = self.thread.take() {
            // It cannot have panicked, and if it had, nothing would depend on it.
            let _ = thread.join();
        }
    }
}

fn watch(mappings: &Mutex<Vec<Mapping>>, limit: u64, stop: &(Mutex<bool>, Condvar)) {
    let mut stopped = stop.0.lock().unwrap_or_else(PoisonError::into_inner);
    while !*stopped {
        (stopped, _) = stop
            .1
            .wait_timeout(stopped, PERIOD)
            .unwrap_or_else(PoisonError::into_inner);
        let Some(resident) = Resident::now() else {
            return;
        };
        // Where most of it is not mapped, giving back often would only cost time.
        if resident.total() > limit && resident.of_files > limit / 4 {
            let mappings = mappings.lock().unwrap_or_else(PoisonError::into_inner);
            mappings.iter().for_each(Mapping::release_all);
        }
    }
}

/// Bytes of this process that are in memory.
struct Resident {
    own: u64,
    of_files: u64,
}

impl Resident {
    /// `None` where the system does not say.
    fn now() -> Option<Self> {
        let status = std::fs::read_to_string("/proc/self/status").ok()?;
        let bytes = |name: &str| {
            let line = status.lines().find_map(|line| line.strip_prefix(name))?;
            let kib: u64 = line.split_whitespace().next()?.parse().ok()?;
            Some(kib * 1024)
        };
        Some(Self {
            own: bytes("RssAnon:")?,
            of_files: bytes("RssFile:")?,
        })
    }

    fn total(&self) -> u64 {
        self.own + self.of_files
    }
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use std::io::Write as _;

    use super::*;

    #[test]
    fn a_file_that_is_read_through_takes_little_memory_and_keeps_its_content() {
        let mut file = tempfile::tempfile().unwrap();
        let block: Vec<u8> = (0..1u32 << 20).flat_map(u32::to_le_bytes).collect();
        for _ in 0..64 {
            file.write_all(&block).unwrap();
        }
        let mapping = Mapping::new(&file).unwrap();
        let before = Resident::now().unwrap().total();
        let limiter = Limiter::start(before + (32 << 20));
        limiter.add(&mapping);
        let mut most = 0;
        for (at, part) in mapping.bytes().chunks(block.len()).enumerate() {
            assert!(part == block, "block {at}");
            most = most.max(Resident::now().unwrap().total());
            std::thread::sleep(PERIOD / 4);
        }
        drop(limiter);
        // 256 MB were read.
        assert!(most < before + (160 << 20), "{most} {before}");
    }
}
