//! Downloads from a server on this machine that answers well, badly and worse.

#![cfg(feature = "download")]

mod d4rl;
mod minari;
mod server;

use std::path::Path;
use std::time::Duration;

use ksim_datasets::SearchRoots;
use ksim_datasets::download::{DownloadOptions, Downloaded, Event, download};

/// A world with folders for datasets and one server.
struct World {
    folder: tempfile::TempDir,
    options: DownloadOptions,
}

impl World {
    fn new(base_url: &str) -> Self {
        let folder = tempfile::tempdir().expect("it works");
        let options = DownloadOptions {
            roots: SearchRoots {
                minari: Some(folder.path().join("minari")),
                d4rl: Some(folder.path().join("d4rl")),
            },
            base_url: Some(base_url.to_owned()),
            max_retries: 3,
            retry_delay: Duration::from_millis(1),
            stall_timeout: Duration::from_secs(20),
            use_proxy: false,
            ..DownloadOptions::default()
        };
        Self { folder, options }
    }

    /// The result and the failures on the way.
    fn download(&self, name: &str) -> (Result<Downloaded, String>, Vec<String>) {
        let mut retries = Vec::new();
        let result = download(name, &self.options, &mut |event| {
            if let Event::Retry { what, .. } = event {
                retries.push(what);
            }
        });
        (result.map_err(|error| chain(&error)), retries)
    }

    #[track_caller]
    fn fetched(&self, name: &str) -> Downloaded {
        self.download(name).0.expect("it works")
    }

    /// Fails with a message that holds every part and leaves nothing behind.
    #[track_caller]
    fn refused(&self, name: &str, parts: &[&str]) {
        let error = self.download(name).0.expect_err("it fails");
        for part in parts {
            assert!(error.contains(part), "no {part:?} in {error}");
        }
        assert_eq!(self.files(), Vec::<String>::new(), "{error}");
    }

    /// Every file below the folder.
    fn files(&self) -> Vec<String> {
        let mut files = Vec::new();
        walk(self.folder.path(), self.folder.path(), &mut files);
        files.sort();
        files
    }

    fn read(&self, file: &str) -> Vec<u8> {
        std::fs::read(self.folder.path().join(file)).expect("it works")
    }
}

fn walk(root: &Path, folder: &Path, files: &mut Vec<String>) {
    for entry in std::fs::read_dir(folder).expect("it works") {
        let path = entry.expect("it works").path();
        match path.is_dir() {
            true => walk(root, &path, files),
            false => files.push(
                path.strip_prefix(root)
                    .expect("it works")
                    .display()
                    .to_string(),
            ),
        }
    }
}

fn chain(error: &dyn std::error::Error) -> String {
    match error.source() {
        Some(source) => format!("{error}: {}", chain(source)),
        None => error.to_string(),
    }
}
