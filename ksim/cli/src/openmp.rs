//! How the threads of libtorch wait for one another.

/// Starts the program anew with `OMP_WAIT_POLICY=PASSIVE`, unless the variable says something already.
///
/// Threads of OpenMP otherwise spin while they wait, on cores that simulators and other networks could use, and several
/// times as long in all. OpenMP reads its environment when it is loaded with libtorch, which is before `main`: setting
/// the variable here would be too late. Loading libtorch once more takes a third of a second.
#[cfg(all(feature = "torch", unix))]
pub(crate) fn wait_passively() {
    use std::env;
    use std::os::unix::process::CommandExt as _;
    use std::process::Command;

    const POLICY: &str = "OMP_WAIT_POLICY";
    if env::var_os(POLICY).is_some() {
        return;
    }
    let Ok(program) = env::current_exe() else {
        return;
    };
    let mut arguments = env::args_os();
    let mut command = Command::new(program);
    if let Some(name) = arguments.next() {
        command.arg0(name);
    }
    // It comes back only if it fails. Spinning threads are slower, not wrong.
    let _ = command.args(arguments).env(POLICY, "PASSIVE").exec();
}

/// Nothing is to be done: there is no OpenMP in this build, or it is not this kind of it.
#[cfg(not(all(feature = "torch", unix)))]
pub(crate) fn wait_passively() {}
