//! A Minari dataset: a folder of files, and the metadata of the namespaces it is in.

use std::path::{Path, PathBuf};

use super::error::DownloadError;
use super::fetch::{Watch, fetch};
use super::http::{Client, get_small};
use super::hub::{self, RemoteFile};
use super::partial::{Partial, sha256};
use super::plan::Plan;
use super::{Check, DownloadOptions, Downloaded, Event, differs_by};

/// File beside the datasets of a namespace, as Minari makes it.
const NAMESPACE_METADATA: &str = "namespace_metadata.json";
const MAX_NAMESPACE_BYTES: u64 = 1 << 20;

/// Bytes of all files.
pub(super) fn bytes(files: &[RemoteFile]) -> u64 {
    files
        .iter()
        .fold(0, |sum, file| sum.saturating_add(file.bytes))
}

/// Fetches the dataset, or checks the one that is there.
pub(super) fn download(
    plan: &Plan,
    client: &Client<'_>,
    options: &DownloadOptions,
    event: &mut dyn FnMut(Event),
) -> Result<Downloaded, DownloadError> {
    let is_kept = || !options.force && plan.destination.symlink_metadata().is_ok();
    let files = match hub::list(client, &plan.base, &plan.id, event) {
        // Without a network, what is there is better than an error.
        Err(DownloadError::Offline { .. }) if is_kept() && holds_dataset(&plan.destination) => {
            return Ok(kept(plan, on_disk(&plan.destination), Check::NotChecked));
        }
        files => files?,
    };
    let (found, limit) = (bytes(&files), options.max_bytes);
    if found > limit {
        return Err(DownloadError::TooLarge { found, limit });
    }
    if is_kept() {
        return check_there(plan, &files);
    }
    plan.make_parent()?;
    let partial = Partial::begin(&plan.destination)?;
    if is_kept() {
        // Another process has just put it there.
        return check_there(plan, &files);
    }
    let fetched = fetch_files(client, options, &files, &partial, event)?;
    opens(&partial.files())?;
    fetch_namespaces(plan, client, event)?;
    partial.place_files(&plan.destination)?;
    partial.finish()?;
    Ok(plan.downloaded(found, fetched, check_of(&files)))
}

fn kept(plan: &Plan, bytes: u64, check: Check) -> Downloaded {
    Downloaded {
        was_there: true,
        ..plan.downloaded(bytes, 0, check)
    }
}

fn check_of(files: &[RemoteFile]) -> Check {
    match files.iter().any(|file| file.wanted.sha256.is_some()) {
        true => Check::Sha256,
        false => Check::Opened,
    }
}

fn holds_dataset(folder: &Path) -> bool {
    folder.join(hub::METADATA).is_file()
}

/// Bytes of the data files that are there.
fn on_disk(folder: &Path) -> u64 {
    let entries = std::fs::read_dir(folder.join("data")).into_iter().flatten();
    let sizes = entries.filter_map(|entry| entry.ok()?.metadata().ok());
    sizes.map(|file| file.len()).sum()
}

/// Compares every file with what is published.
fn check_there(plan: &Plan, files: &[RemoteFile]) -> Result<Downloaded, DownloadError> {
    for file in files {
        let path = plan.destination.join(&file.path);
        if !path.is_file() {
            let what = format!("{} is missing", file.path);
            return Err(DownloadError::Differs {
                path: plan.destination.clone(),
                what,
            });
        }
        differs_by(&path, file.bytes, file.wanted.sha256.as_deref())?;
    }
    Ok(kept(plan, bytes(files), check_of(files)))
}

/// Fetches all files into the partial folder; gives the bytes that came over the network.
fn fetch_files(
    client: &Client<'_>,
    options: &DownloadOptions,
    files: &[RemoteFile],
    partial: &Partial,
    event: &mut dyn FnMut(Event),
) -> Result<u64, DownloadError> {
    let mut watch = Watch {
        event,
        before: 0,
        total: Some(bytes(files)),
        fetched: 0,
    };
    for file in files {
        let target = partial.files().join(&file.path);
        if !is_complete(file, &target)? {
            fetch(client, options, &file.wanted, partial, &mut watch)?;
            let folder = target.parent().unwrap_or(&target);
            std::fs::create_dir_all(folder).map_err(DownloadError::disk("make a folder"))?;
            partial.place_current(&target)?;
        }
        watch.before += file.bytes;
    }
    Ok(watch.fetched)
}

/// Whether an earlier call has fetched the file. Without a hash it could be of an older edition.
fn is_complete(file: &RemoteFile, target: &Path) -> Result<bool, DownloadError> {
    match &file.wanted.sha256 {
        Some(expected) if target.is_file() => Ok(sha256(target)? == *expected),
        _ => Ok(false),
    }
}

/// Whether the metadata reads and names a storage that is there.
fn opens(folder: &Path) -> Result<(), DownloadError> {
    match crate::format::detect(folder) {
        Ok(_) => Ok(()),
        Err(error) => match error.cause() {
            // A storage this crate does not read is none of the download's business.
            crate::DatasetError::Unsupported { .. } => Ok(()),
            cause => Err(DownloadError::WrongContent {
                found: cause.to_string(),
                expected: "a Minari dataset",
            }),
        },
    }
}

/// Sees to it that each namespace around the dataset has its metadata file, without which Minari does not list it.
fn fetch_namespaces(
    plan: &Plan,
    client: &Client<'_>,
    event: &mut dyn FnMut(Event),
) -> Result<(), DownloadError> {
    let parts: Vec<&str> = plan.id.split('/').collect();
    for n in 1..parts.len() {
        let folder = plan.root.join(parts[..n].join("/"));
        let path = folder.join(NAMESPACE_METADATA);
        if path.symlink_metadata().is_ok() {
            continue;
        }
        // The first part is the repository.
        let inside: String = parts[1..n].iter().map(|part| format!("{part}/")).collect();
        let url = hub::file_url(
            &plan.base,
            &plan.id,
            &format!("{inside}{NAMESPACE_METADATA}"),
        );
        let text = get_small(client, &url, MAX_NAMESPACE_BYTES, event)?
            .map(|small| small.bytes)
            .filter(|text| is_object(text))
            .unwrap_or_else(|| b"{}".to_vec());
        write_new(&path, &text).map_err(DownloadError::disk("write the namespace's metadata"))?;
    }
    Ok(())
}

fn is_object(text: &[u8]) -> bool {
    serde_json::from_slice::<serde_json::Map<String, serde_json::Value>>(text).is_ok()
}

/// Writes a small file that appears whole.
fn write_new(path: &Path, text: &[u8]) -> std::io::Result<()> {
    let temporary: PathBuf =
        path.with_file_name(format!(".{NAMESPACE_METADATA}.{}", std::process::id()));
    std::fs::write(&temporary, text)?;
    std::fs::rename(&temporary, path)
}
