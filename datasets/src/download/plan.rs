//! From a name to an address and a place.

use std::path::PathBuf;

use super::error::{DownloadError, known};
use super::http::Client;
use super::{Check, DownloadOptions, Downloaded, Event, hub, minari};
use crate::error::{DatasetError, Result};
use crate::registry::{self, Store};
use crate::resolve;

/// What a download would do.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Plan {
    /// Full id of the dataset.
    pub id: String,
    /// Who publishes it.
    pub store: Store,
    /// Address of the file, or of the listing of a Minari dataset's files.
    pub url: String,
    /// Bytes of it, where known.
    pub bytes: Option<u64>,
    /// The file or folder it will be.
    pub destination: PathBuf,
    /// Whether something is there already.
    pub is_there: bool,
    pub(super) base: String,
    pub(super) root: PathBuf,
    pub(super) sha256: Option<&'static str>,
}

/// What [`download`](super::download) of this name would do. Asks the server for the size of a Minari dataset;
/// writes nothing.
///
/// # Errors
/// Those of [`download`](super::download) before anything is fetched.
pub fn plan(name: &str, options: &DownloadOptions, event: &mut dyn FnMut(Event)) -> Result<Plan> {
    let mut plan = place(name, options)?;
    if plan.store == Store::Minari {
        let client = Client::new(options, &plan.base);
        let files = hub::list(&client, &plan.base, &plan.id, event);
        plan.bytes = Some(minari::bytes(&files.map_err(|error| plan.error(error))?));
    }
    Ok(plan)
}

/// The plan without asking the server.
pub(super) fn place(name: &str, options: &DownloadOptions) -> Result<Plan> {
    let id = full_id(name)?;
    let known = registry::find(&id);
    let store = known.map_or(Store::Minari, |known| known.store);
    let failed = |source| DatasetError::Download {
        what: id.clone(),
        source,
    };
    let base = base(store, options).map_err(failed)?;
    let (root, variable) = match store {
        Store::D4rl => (&options.roots.d4rl, "D4RL_DATASET_DIR"),
        Store::Minari => (&options.roots.minari, "MINARI_DATASETS_PATH"),
    };
    let root = root
        .clone()
        .ok_or_else(|| failed(DownloadError::NoFolder { variable }))?;
    let (url, destination) = match known.and_then(|known| Some((known, known.file_name()?))) {
        Some((known, file_name)) => (format!("{base}/{}", known.path), root.join(file_name)),
        None => (
            hub::listing_url(&base, &id),
            resolve::minari_folder(&root, &id)?,
        ),
    };
    Ok(Plan {
        store,
        url,
        bytes: known.and_then(|known| known.bytes),
        is_there: destination.symlink_metadata().is_ok(),
        destination,
        base,
        root,
        sha256: known.and_then(|known| known.sha256),
        id,
    })
}

/// The id a name stands for: of a listed dataset, or any with a version, which may be published.
fn full_id(name: &str) -> Result<String> {
    // Nothing that is no id gets near a path or an address.
    resolve::check_characters(name)?;
    if let Some(known) = registry::find(name) {
        return Ok(known.id.to_owned());
    }
    match resolve::published(name).first() {
        Some(id) => Ok(id.clone()),
        None if resolve::is_versioned_id(name) && known(name).is_empty() => Ok(name.to_owned()),
        None => Err(DatasetError::Download {
            what: name.to_owned(),
            source: DownloadError::UnknownName {
                alternatives: known(name),
            },
        }),
    }
}

/// The base address, without a slash at the end.
fn base(store: Store, options: &DownloadOptions) -> Result<String, DownloadError> {
    let hub = options.hub_url.as_ref().filter(|_| store == Store::Minari);
    let base = match options.base_url.as_ref().or(hub) {
        Some(base) => base.trim_end_matches('/').to_owned(),
        None => store.base_url().to_owned(),
    };
    let is_http = base.starts_with("http://") || base.starts_with("https://");
    match is_http
        && base
            .parse::<ureq::http::Uri>()
            .is_ok_and(|uri| uri.query().is_none())
    {
        true => Ok(base),
        false => Err(DownloadError::BadBase { base }),
    }
}

impl Plan {
    /// The error of this download, with its address and what else one may have meant.
    pub(super) fn error(&self, error: DownloadError) -> DatasetError {
        DatasetError::Download {
            what: self.url.clone(),
            source: error.or_meant(&self.id),
        }
    }

    /// Makes the folder around the destination, which must be inside of the root.
    pub(super) fn make_parent(&self) -> Result<(), DownloadError> {
        let io = DownloadError::disk("make the folder for it");
        std::fs::create_dir_all(&self.root).map_err(&io)?;
        let root = self.root.canonicalize().map_err(&io)?;
        // Links inside of the root could lead out of it, so each folder is looked at before the next is made.
        let mut folder = root.clone();
        let parent = self
            .destination
            .parent()
            .and_then(|parent| parent.strip_prefix(&self.root).ok());
        for part in parent.into_iter().flat_map(|parent| parent.components()) {
            folder = folder.join(part);
            match std::fs::create_dir(&folder) {
                Err(error) if error.kind() != std::io::ErrorKind::AlreadyExists => {
                    return Err(io(error));
                }
                _ => folder = folder.canonicalize().map_err(&io)?,
            }
            if !folder.starts_with(&root) {
                let error = std::io::Error::other("a link leads out of the folder of datasets");
                return Err(io(error));
            }
        }
        Ok(())
    }

    pub(super) fn downloaded(&self, bytes: u64, fetched: u64, check: Check) -> Downloaded {
        Downloaded {
            id: self.id.clone(),
            path: self.destination.clone(),
            bytes,
            fetched,
            was_there: false,
            check,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn options() -> DownloadOptions {
        DownloadOptions {
            roots: resolve::SearchRoots {
                minari: Some("/m".into()),
                d4rl: Some("/d".into()),
            },
            ..DownloadOptions::default()
        }
    }

    #[test]
    fn names_lead_to_addresses_and_places() {
        let placed = |name: &str| {
            let plan = place(name, &options()).unwrap();
            (
                plan.id,
                plan.url,
                plan.destination.to_string_lossy().into_owned(),
            )
        };
        let text = |parts: [&str; 3]| {
            let [id, url, place] = parts.map(str::to_owned);
            (id, url, place)
        };
        assert_eq!(
            placed("pen-human-v1"),
            text([
                "pen-human-v1",
                "https://rail.eecs.berkeley.edu/datasets/offline_rl/hand_dapg_v1/pen-human-v1.hdf5",
                "/d/pen-human-v1.hdf5",
            ])
        );
        let minari = text([
            "D4RL/antmaze/large-play-v1",
            "https://huggingface.co/api/datasets/farama-minari/D4RL/tree/main/antmaze/large-play-v1",
            "/m/D4RL/antmaze/large-play-v1",
        ]);
        assert_eq!(placed("antmaze-large-play"), minari);
        assert_eq!(placed("D4RL/antmaze/large-play"), minari);
        assert_eq!(placed("mine-v0").2, "/m/mine-v0");
    }

    #[test]
    fn names_that_lead_nowhere_are_refused() {
        let error = |name: &str| {
            let error = place(name, &options()).unwrap_err();
            match std::error::Error::source(&error) {
                Some(source) => format!("{error}: {source}"),
                None => error.to_string(),
            }
        };
        for name in [
            "../x-v0",
            "a/../b-v0",
            "/etc-v0",
            "a\\b-v0",
            "a//b-v0",
            "",
            "x y-v0",
            "a\0-v0",
        ] {
            assert!(
                error(name).contains("is refused"),
                "{name}: {}",
                error(name)
            );
        }
        assert!(
            error("no-such").contains("dataset list --known"),
            "{}",
            error("no-such")
        );
        let fault = error("hopper-full-replay-v0");
        assert!(fault.contains("hopper-full-replay-v2"), "{fault}");
    }

    #[test]
    fn a_mirror_must_be_http() {
        for base in [
            "ftp://x",
            "file:///etc",
            "x.org",
            "http://",
            "https://a b",
            "http://x?y=1",
        ] {
            let options = DownloadOptions {
                base_url: Some(base.to_owned()),
                ..options()
            };
            assert!(place("pen-human-v1", &options).is_err(), "{base}");
        }
        let options = DownloadOptions {
            hub_url: Some("https://mirror/".to_owned()),
            ..options()
        };
        let url = |name| place(name, &options).unwrap().url;
        assert!(url("x-v0").starts_with("https://mirror/api/"));
        assert!(url("pen-human-v1").starts_with("https://rail."));
    }
}
