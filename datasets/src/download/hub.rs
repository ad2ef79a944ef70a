//! The files of a Minari dataset on the Hugging Face hub.

use serde::Deserialize;

use super::Event;
use super::error::DownloadError;
use super::fetch::Wanted;
use super::http::{Client, get_small};
use crate::registry::hub_place;

/// A page of a listing is never larger.
const MAX_PAGE_BYTES: u64 = 16 << 20;
/// Files of one dataset, at most: Minari's Arrow storage has two for each episode.
const MAX_FILES: usize = 1 << 20;
/// The longest name a file may have: most file systems' limit.
const MAX_NAME: usize = 255;
/// Makes a folder a Minari dataset; fetched last.
pub(super) const METADATA: &str = "data/metadata.json";

/// A file of the dataset.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct RemoteFile {
    /// Path in the dataset's folder: checked parts between slashes.
    pub(super) path: String,
    pub(super) bytes: u64,
    pub(super) wanted: Wanted,
}

/// An entry of the hub's answer to `/api/datasets/<repository>/tree/main/<folder>`.
#[derive(Debug, Deserialize)]
struct Entry {
    #[serde(rename = "type")]
    kind: String,
    path: String,
    #[serde(default)]
    size: u64,
    lfs: Option<LargeFile>,
}

/// Of a file kept in large file storage: its SHA-256 and size.
#[derive(Debug, Deserialize)]
struct LargeFile {
    oid: String,
    size: u64,
}

/// Address of a file in the dataset's repository.
pub(super) fn file_url(base: &str, id: &str, path_in_repository: &str) -> String {
    let (repository, _) = hub_place(id);
    let path = percent_encoded(path_in_repository);
    format!("{base}/datasets/{repository}/resolve/main/{path}")
}

/// Address of the listing of the dataset's files.
pub(super) fn listing_url(base: &str, id: &str) -> String {
    let (repository, folder) = hub_place(id);
    let separator = if folder.is_empty() { "" } else { "/" };
    format!("{base}/api/datasets/{repository}/tree/main{separator}{folder}")
}

/// All files of the dataset, metadata last.
pub(super) fn list(
    client: &Client<'_>,
    base: &str,
    id: &str,
    event: &mut dyn FnMut(Event),
) -> Result<Vec<RemoteFile>, DownloadError> {
    let url = listing_url(base, id);
    let mut query = "recursive=true".to_owned();
    let mut files = Vec::new();
    loop {
        let page = get_small(client, &format!("{url}?{query}"), MAX_PAGE_BYTES, event)?
            .ok_or_else(|| DownloadError::status(404))?;
        let entries: Vec<Entry> = serde_json::from_slice(&page.bytes)
            .map_err(|error| refused(format!("it is no list of files ({error})")))?;
        let is_empty = entries.is_empty();
        for entry in entries {
            files.extend(remote_file(base, id, entry)?);
        }
        if files.len() > MAX_FILES {
            return Err(refused(format!("it has over {MAX_FILES} files")));
        }
        match page.link.as_deref().and_then(next_query) {
            // A page without a file would be followed by others without end.
            Some(next) if !is_empty && next != query => query = next,
            _ => break,
        }
    }
    files.sort_by(|a, b| (a.path == METADATA, &a.path).cmp(&(b.path == METADATA, &b.path)));
    check(&files)?;
    Ok(files)
}

fn refused(what: String) -> DownloadError {
    DownloadError::BadListing { what }
}

fn check(files: &[RemoteFile]) -> Result<(), DownloadError> {
    if files.last().is_none_or(|file| file.path != METADATA) {
        return Err(refused(format!(
            "it has no {METADATA}: not a Minari dataset"
        )));
    }
    let twice = files.windows(2).find(|pair| pair[0].path == pair[1].path);
    match twice {
        Some(pair) => Err(refused(format!("it has \"{}\" twice", pair[0].path))),
        None => Ok(()),
    }
}

/// The file of an entry, if it belongs to the dataset.
fn remote_file(base: &str, id: &str, entry: Entry) -> Result<Option<RemoteFile>, DownloadError> {
    if entry.kind != "file" {
        return Ok(None);
    }
    let (_, folder) = hub_place(id);
    let shown = entry.path.escape_debug().to_string();
    let inside = match folder {
        "" => Some(entry.path.as_str()),
        _ => entry
            .path
            .strip_prefix(folder)
            .and_then(|rest| rest.strip_prefix('/')),
    };
    let path = inside.ok_or_else(|| refused(format!("\"{shown}\" is outside of {folder}")))?;
    check_path(path).map_err(|reason| refused(format!("path \"{shown}\" {reason}")))?;
    // What belongs to the repository, not to the dataset.
    if path.starts_with('.') {
        return Ok(None);
    }
    let (bytes, sha256) = match entry.lfs {
        Some(large) if is_sha256(&large.oid) => (large.size, Some(large.oid)),
        Some(large) => {
            let oid = large.oid.escape_debug().to_string();
            return Err(refused(format!(
                "\"{shown}\" has the hash \"{oid}\", expected a SHA-256"
            )));
        }
        None => (entry.size, None),
    };
    Ok(Some(RemoteFile {
        path: path.to_owned(),
        bytes,
        wanted: Wanted {
            url: file_url(base, id, &entry.path),
            bytes: Some(bytes),
            sha256,
        },
    }))
}

fn is_sha256(hash: &str) -> bool {
    hash.len() == 64 && hash.bytes().all(|b| matches!(b, b'0'..=b'9' | b'a'..=b'f'))
}

/// A path from a server is joined to a folder of this machine: it must not leave it.
fn check_path(path: &str) -> Result<(), &'static str> {
    let is_odd =
        |c: char| c.is_control() || matches!(c, '\\' | ':' | '*' | '?' | '"' | '<' | '>' | '|');
    for part in path.split('/') {
        if part.is_empty() {
            return Err("is absolute or has an empty part");
        }
        if part == "." || part == ".." {
            return Err("has a part \".\" or \"..\"");
        }
        if part.len() > MAX_NAME {
            return Err("has a part that is too long");
        }
        if part.contains(is_odd) || part.ends_with(['.', ' ']) {
            return Err("has characters that no file name should have");
        }
    }
    Ok(())
}

/// The query of the next page, from a header such as `<https://…?cursor=x>; rel="next"`. Only the query is taken:
/// the next page comes from the same server, and a mirror may pass on the links of the original.
fn next_query(link: &str) -> Option<String> {
    let next = link.split(',').find(|part| part.contains("rel=\"next\""))?;
    let (_, rest) = next.split_once('<')?;
    let (url, _) = rest.split_once('>')?;
    let (_, query) = url.split_once('?')?;
    let is_plain = query.bytes().all(|b| b.is_ascii_graphic() && b != b'#');
    is_plain.then(|| query.to_owned())
}

fn percent_encoded(path: &str) -> String {
    let mut encoded = String::new();
    for byte in path.bytes() {
        match byte {
            b'A'..=b'Z' | b'a'..=b'z' | b'0'..=b'9' | b'-' | b'_' | b'.' | b'~' | b'/' => {
                encoded.push(char::from(byte));
            }
            _ => encoded.push_str(&format!("%{byte:02X}")),
        }
    }
    encoded
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entry(path: &str) -> Entry {
        Entry {
            kind: "file".to_owned(),
            path: path.to_owned(),
            size: 3,
            lfs: None,
        }
    }

    #[test]
    fn paths_that_could_leave_the_folder_are_refused() {
        let id = "A/b-v0";
        for path in [
            "../x",
            "b-v0/../../x",
            "b-v0//x",
            "/etc/passwd",
            "b-v0/a\\b",
            "b-v0/C:x",
            "b-v0/a\0b",
            "b-v0/.",
            "b-v0/",
            "b-v0/x ",
            "b-v1/data/x",
            "b-v0",
        ] {
            assert!(remote_file("http://h", id, entry(path)).is_err(), "{path}");
        }
        assert!(remote_file("http://h", id, entry(&format!("b-v0/{}", "x".repeat(300)))).is_err());
        let file = remote_file("http://h", id, entry("b-v0/data/a b.json"))
            .unwrap()
            .unwrap();
        assert_eq!(file.path, "data/a b.json");
        assert_eq!(
            file.wanted.url,
            "http://h/datasets/farama-minari/A/resolve/main/b-v0/data/a%20b.json"
        );
        let hidden = remote_file("http://h", "x-v0", entry(".gitattributes")).unwrap();
        assert_eq!(hidden, None);
    }

    #[test]
    fn the_next_page_is_asked_of_the_same_server() {
        let link = r#"<https://elsewhere/api/x?recursive=true&cursor=aGk%3D>; rel="next""#;
        assert_eq!(
            next_query(link).as_deref(),
            Some("recursive=true&cursor=aGk%3D")
        );
        assert_eq!(next_query(r#"<https://x?a=b>; rel="prev""#), None);
        assert_eq!(next_query("nonsense"), None);
    }
}
