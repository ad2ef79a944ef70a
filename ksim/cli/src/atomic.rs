//! Files that appear whole or not at all.

use std::fs::{File, Permissions};
use std::io::{self, BufWriter, Seek, Write};
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context as _, Result, bail};

/// Held while a finished file is put in place: an interrupt waits for it.
static PUBLISHING: Mutex<()> = Mutex::new(());

/// Exit code after Ctrl-C, as shells have it.
const INTERRUPTED: i32 = 130;

/// Whether the work in hand cleans up by itself when it sees [`is_interrupted`].
static COOPERATIVE: AtomicBool = AtomicBool::new(false);
static INTERRUPT: AtomicBool = AtomicBool::new(false);

/// Work that looks at [`is_interrupted`] and ends by itself while this lives. A second Ctrl-C does not wait.
pub(crate) struct Cooperative;

impl Cooperative {
    /// From now on.
    pub(crate) fn begin() -> Self {
        COOPERATIVE.store(true, Ordering::SeqCst);
        Self
    }
}

impl Drop for Cooperative {
    fn drop(&mut self) {
        COOPERATIVE.store(false, Ordering::SeqCst);
        if is_interrupted() {
            // The work finished all the same or has cleaned up; the wish to stop stands.
            std::process::exit(INTERRUPTED);
        }
    }
}

/// Whether Ctrl-C was pressed.
pub(crate) fn is_interrupted() -> bool {
    INTERRUPT.load(Ordering::SeqCst)
}

/// Makes Ctrl-C and SIGTERM wait for a file that is just being put in place, then exit.
pub(crate) fn leave_nothing_behind_on_interrupt() -> Result<()> {
    ctrlc::set_handler(|| {
        if !INTERRUPT.swap(true, Ordering::SeqCst) && COOPERATIVE.load(Ordering::SeqCst) {
            return;
        }
        let _publishing = PUBLISHING.lock();
        std::process::exit(INTERRUPTED);
    })
    .context("cannot take over Ctrl-C")
}

/// A file in the making. Until [`publish`](Self::publish) it has no name, so nothing is left behind
/// however the process ends.
#[derive(Debug)]
pub(crate) struct AtomicFile {
    target: PathBuf,
    staged: BufWriter<File>,
}

impl AtomicFile {
    /// Starts a file that will stand at `target`.
    pub(crate) fn create(target: &Path) -> Result<Self> {
        check_target(target)?;
        let staged = tempfile::tempfile_in(folder(target))
            .with_context(|| format!("cannot write into {}", folder(target).display()))?;
        Ok(Self {
            target: target.to_owned(),
            staged: BufWriter::new(staged),
        })
    }

    /// The file itself, open for reading and writing too, with everything in it that was written so far.
    pub(crate) fn file(&mut self) -> io::Result<&File> {
        self.staged.flush()?;
        Ok(self.staged.get_ref())
    }

    /// Puts the file in its place, replacing one that is there.
    pub(crate) fn publish(self) -> Result<()> {
        let Self { target, staged } = self;
        let publish = || -> io::Result<()> {
            let mut staged = staged
                .into_inner()
                .map_err(io::IntoInnerError::into_error)?;
            staged.rewind()?;
            let _publishing = PUBLISHING.lock();
            let mut named = named(folder(&target))?;
            io::copy(&mut staged, named.as_file_mut())?;
            named.persist(&target)?;
            Ok(())
        };
        publish().with_context(|| format!("cannot write {}", target.display()))
    }
}

impl Write for AtomicFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.staged.write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.staged.flush()
    }
}

/// Writes a whole file.
pub(crate) fn write(target: &Path, bytes: &[u8]) -> Result<()> {
    let mut file = AtomicFile::create(target)?;
    let written = file.write_all(bytes);
    written.with_context(|| format!("cannot write {}", target.display()))?;
    file.publish()
}

/// Refuses a target that could not be written in the end, before anything is computed.
pub(crate) fn check_target(target: &Path) -> Result<()> {
    if target.is_dir() {
        bail!(
            "{} is a folder, expected the name of a file to write",
            target.display()
        );
    }
    // Replacing a device or a pipe would not write into it, but take its place.
    if target.metadata().is_ok_and(|found| !found.is_file()) {
        bail!(
            "{} is not a regular file, expected the name of a file to write",
            target.display()
        );
    }
    if target.file_name().is_none() {
        bail!("{} is not the name of a file", target.display());
    }
    let folder = folder(target);
    if !folder.is_dir() {
        bail!(
            "cannot write {}: there is no folder {}",
            target.display(),
            folder.display()
        );
    }
    Ok(())
}

/// Refuses a target that is one of the files to read, by whatever name, inside a folder to read, or a folder around
/// one of them.
pub(crate) fn check_not_an_input<'a>(
    target: &Path,
    inputs: impl IntoIterator<Item = &'a Path>,
) -> Result<()> {
    let Ok(found) = target.canonicalize() else {
        return Ok(()); // nothing is there yet
    };
    for input in inputs {
        let nested = input
            .canonicalize()
            .is_ok_and(|input| found.starts_with(&input) || input.starts_with(&found));
        if nested || is_same_file(&found, input) {
            bail!(
                "{} would replace what is read from {}: choose another file to write",
                target.display(),
                input.display()
            );
        }
    }
    Ok(())
}

/// Whether two paths lead to the same file, by hard links too.
#[cfg(unix)]
fn is_same_file(one: &Path, other: &Path) -> bool {
    use std::os::unix::fs::MetadataExt;
    let id = |path: &Path| path.metadata().map(|found| (found.dev(), found.ino())).ok();
    id(one).is_some_and(|one| id(other) == Some(one))
}

/// Canonical paths are compared already.
#[cfg(not(unix))]
fn is_same_file(_one: &Path, _other: &Path) -> bool {
    false
}

/// A temporary file beside the target, with the permissions of any new file.
fn named(folder: &Path) -> io::Result<tempfile::NamedTempFile> {
    let mut builder = tempfile::Builder::new();
    builder.prefix(".ksim-").suffix(".unfinished");
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        builder.permissions(Permissions::from_mode(0o666)); // less the umask
    }
    builder.tempfile_in(folder)
}

fn folder(target: &Path) -> &Path {
    match target.parent() {
        Some(parent) if parent != Path::new("") => parent,
        _ => Path::new("."),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(folder: &Path) -> Vec<String> {
        let mut names: Vec<String> = std::fs::read_dir(folder)
            .unwrap()
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        names.sort();
        names
    }

    #[test]
    fn nothing_is_visible_before_the_end() {
        let folder = tempfile::tempdir().unwrap();
        let target = folder.path().join("out.bin");
        write(&target, b"old").unwrap();
        let mut file = AtomicFile::create(&target).unwrap();
        file.write_all(b"new").unwrap();
        assert_eq!(std::fs::read(&target).unwrap(), b"old");
        assert_eq!(names(folder.path()), ["out.bin"]);
        file.publish().unwrap();
        assert_eq!(std::fs::read(&target).unwrap(), b"new");
        assert_eq!(names(folder.path()), ["out.bin"]);
    }

    #[test]
    fn a_target_that_cannot_be_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        assert!(AtomicFile::create(folder.path()).is_err());
        let error = AtomicFile::create(&folder.path().join("none/out")).unwrap_err();
        assert!(error.to_string().contains("there is no folder"), "{error}");
        assert!(names(folder.path()).is_empty());
    }

    #[test]
    fn an_input_is_no_target_by_any_name() {
        let folder = tempfile::tempdir().unwrap();
        let input = folder.path().join("in");
        std::fs::write(&input, "data").unwrap();
        std::fs::create_dir(folder.path().join("sub")).unwrap();
        let check = |target: &str| check_not_an_input(&folder.path().join(target), [&*input]);
        let error = check("sub/../in").unwrap_err().to_string();
        assert!(error.contains("would replace what is read"), "{error}");
        check("out").unwrap();
        #[cfg(unix)]
        {
            std::os::unix::fs::symlink(&input, folder.path().join("soft")).unwrap();
            std::fs::hard_link(&input, folder.path().join("hard")).unwrap();
            assert!(check("soft").is_err() && check("hard").is_err());
        }
        assert!(check_not_an_input(&input, [folder.path()]).is_err());
        assert!(check_not_an_input(folder.path(), [&*input]).is_err());
    }

    #[cfg(unix)]
    #[test]
    fn a_device_is_no_target() {
        let folder = tempfile::tempdir().unwrap();
        let link = folder.path().join("link");
        std::os::unix::fs::symlink("/dev/null", &link).unwrap();
        for target in [Path::new("/dev/null"), &link] {
            let error = check_target(target).unwrap_err().to_string();
            assert!(error.contains("is not a regular file"), "{error}");
        }
    }
}
