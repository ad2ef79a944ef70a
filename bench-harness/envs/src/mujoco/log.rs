//! MuJoCo's messages, kept from the terminal and from `MUJOCO_LOG.TXT`.

use std::cell::RefCell;
use std::io::Write as _;
use std::sync::Once;

use mujoco_rs::logging::set_log_handler;
use mujoco_rs::wrappers::mj_logging::{MjLogMessage, MjtLogLevel};

thread_local! {
    /// Warnings of this thread while [`collect_warnings`] runs on it.
    static WARNINGS: RefCell<Option<Vec<String>>> = const { RefCell::new(None) };
}

/// Runs what may warn, and returns the warnings beside its result. Every use of MuJoCo in this crate begins with one.
///
/// While stepping nothing is collected: the engine counts its warnings in the data, which [`super::MujocoPhysics`]
/// reads.
#[expect(unsafe_code, reason = "MuJoCo's log handler is one global")]
pub(super) fn collect_warnings<R>(run: impl FnOnce() -> R) -> (R, Vec<String>) {
    static INSTALLED: Once = Once::new();
    INSTALLED.call_once(|| {
        // SAFETY: a model can only be had through this function, so no other thread of this crate uses MuJoCo
        // yet; those that come meanwhile wait for the `Once`.
        unsafe { set_log_handler(handle) }
    });
    WARNINGS.set(Some(Vec::new()));
    let result = run();
    (result, WARNINGS.take().unwrap_or_default())
}

/// Runs on the thread that uses MuJoCo, below C frames: must not panic.
fn handle(message: &MjLogMessage) {
    // The accessor panics on text that is not UTF-8, which a name cut off by MuJoCo may be.
    let text = std::panic::catch_unwind(|| message.subject().to_owned())
        .unwrap_or_else(|_| "a message that is not UTF-8".to_owned());
    if message.level() == MjtLogLevel::mjLOG_ERROR {
        // MuJoCo cannot go on, and mujoco-rs ends the process after this: the reason is the last word.
        let _ = writeln!(std::io::stderr(), "MuJoCo: {text}");
    } else if message.level() == MjtLogLevel::mjLOG_WARNING {
        let _ = WARNINGS.try_with(|warnings| {
            if let Some(warnings) = warnings.borrow_mut().as_mut() {
                warnings.push(text);
            }
        });
    }
}
