//! Resident memory of this process, as Linux counts it.

use std::fs;

/// Resident memory at a moment, and the peak since then.
#[derive(Debug)]
pub(super) struct PeakMemory {
    before: u64,
}

impl PeakMemory {
    /// Starts over counting the peak. `None` where the system does not say.
    pub(super) fn start() -> Option<Self> {
        // 5 sets the peak (`VmHWM`) back to what is resident now: proc(5).
        fs::write("/proc/self/clear_refs", "5").ok()?;
        let before = status_bytes("VmRSS:")?;
        Some(Self { before })
    }

    /// Bytes by which the peak since the start exceeds what was resident then.
    pub(super) fn rise(&self) -> Option<u64> {
        Some(status_bytes("VmHWM:")?.saturating_sub(self.before))
    }

    /// Bytes that are resident now beyond what was at the start.
    pub(super) fn kept(&self) -> Option<u64> {
        Some(status_bytes("VmRSS:")?.saturating_sub(self.before))
    }
}

fn status_bytes(field: &str) -> Option<u64> {
    let status = fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix(field))?;
    let kib: u64 = line.split_whitespace().next()?.parse().ok()?;
    Some(kib * 1024)
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use super::*;

    #[test]
    fn a_large_allocation_shows() {
        let Some(memory) = PeakMemory::start() else {
            return; // a container may forbid it
        };
        let block = vec![1u8; 64 << 20];
        assert!(block.iter().map(|&b| u64::from(b)).sum::<u64>() > 0);
        assert!(memory.kept().unwrap() > 60 << 20);
        drop(block);
        assert!(memory.rise().unwrap() > 60 << 20);
    }
}
