//! A folder of files, listed by the hub.

use ksim_datasets::download::{Check, Event, plan};
use serde_json::{Value, json};
use sha2::{Digest, Sha256};

use crate::World;
use crate::server::{Reply, Request, Server};

const ID: &str = "D4RL/pen/human-v2";
const METADATA: &str = r#"{"minari_version": "0.5.4", "data_format": "hdf5", "total_episodes": 2}"#;
const LISTING: &str = "/api/datasets/farama-minari/D4RL/tree/main/pen/human-v2?recursive=true";
const FILES: &str = "/datasets/farama-minari/D4RL/resolve/main/pen/human-v2/data";

fn data() -> Vec<u8> {
    (0..100_000_u32).flat_map(u32::to_le_bytes).collect()
}

fn sha256(bytes: &[u8]) -> String {
    Sha256::digest(bytes)
        .iter()
        .map(|byte| format!("{byte:02x}"))
        .collect()
}

fn file(path: &str, size: usize) -> Value {
    json!({ "type": "file", "oid": "0123", "size": size, "path": path })
}

fn large(path: &str, bytes: &[u8]) -> Value {
    let lfs = json!({ "oid": sha256(bytes), "size": bytes.len(), "pointerSize": 134 });
    json!({ "type": "file", "oid": "0123", "size": bytes.len(), "path": path, "lfs": lfs })
}

fn listing() -> Vec<Value> {
    vec![
        json!({ "type": "directory", "oid": "0", "size": 0, "path": "pen/human-v2/data" }),
        large("pen/human-v2/data/main_data.hdf5", &data()),
        file("pen/human-v2/data/metadata.json", METADATA.len()),
    ]
}

/// What the hub answers.
fn hub(request: &Request) -> Reply {
    let path = request.path.as_str();
    let body = match path {
        LISTING => serde_json::to_vec(&listing()).expect("it works"),
        "/datasets/farama-minari/D4RL/resolve/main/namespace_metadata.json" => {
            br#"{"description": "d"}"#.to_vec()
        }
        _ => match path.strip_prefix(FILES) {
            Some("/main_data.hdf5") => return Reply::file(request, "\"h\"", &data()),
            Some("/metadata.json") => METADATA.into(),
            _ => return Reply::new(404, ""),
        },
    };
    Reply::ok(body)
}

#[test]
fn a_dataset_lands_where_minari_looks() {
    let server = Server::start(|request, _| hub(request));
    let world = World::new(&server.url);
    let got = world.fetched("pen-human");
    assert_eq!(got.id, ID);
    assert_eq!(got.bytes, (data().len() + METADATA.len()) as u64);
    assert_eq!(got.check, Check::Sha256);
    assert_eq!(
        world.files(),
        [
            "minari/D4RL/namespace_metadata.json",
            "minari/D4RL/pen/human-v2/data/main_data.hdf5",
            "minari/D4RL/pen/human-v2/data/metadata.json",
            "minari/D4RL/pen/namespace_metadata.json",
        ]
    );
    assert_eq!(
        world.read("minari/D4RL/pen/human-v2/data/main_data.hdf5"),
        data()
    );
    assert_eq!(
        world.read("minari/D4RL/namespace_metadata.json"),
        br#"{"description": "d"}"#
    );
    assert_eq!(world.read("minari/D4RL/pen/namespace_metadata.json"), b"{}");
    let found = ksim_datasets::resolve("pen-human", &world.options.roots).unwrap();
    assert_eq!(found.path, got.path);

    let again = world.fetched(ID);
    assert_eq!(
        (again.was_there, again.fetched, again.check),
        (true, 0, Check::Sha256)
    );
    let file = world
        .folder
        .path()
        .join("minari/D4RL/pen/human-v2/data/main_data.hdf5");
    let mut bytes = data();
    bytes[5] ^= 1;
    std::fs::write(&file, bytes).unwrap();
    let error = world.download(ID).0.unwrap_err();
    assert!(
        error.contains("main_data.hdf5") && error.contains("SHA-256"),
        "{error}"
    );
    let mut world = world;
    world.options.force = true;
    assert!(!world.fetched(ID).was_there);
    assert_eq!(std::fs::read(&file).unwrap(), data());
    assert_eq!(world.files().len(), 4);
    // Without a network, what is there is kept.
    world.options.force = false;
    world.options.base_url = Some("http://127.0.0.1:1".to_owned());
    assert_eq!(world.fetched(ID).check, Check::NotChecked);
}

#[test]
fn an_interrupted_dataset_is_taken_up() {
    let server = Server::start(|request, n| match n {
        1 => hub(request).cut_to(1000),
        // Metadata, at the first call.
        3 => Reply::new(500, ""),
        _ => hub(request),
    });
    let mut world = World::new(&server.url);
    world.options.max_retries = 1;
    let (got, retries) = world.download(ID);
    assert_eq!(got.unwrap().fetched, (data().len() + METADATA.len()) as u64);
    assert_eq!(retries.len(), 2, "{retries:?}");
    assert_eq!(server.asked()[2].range_start(), Some(1000));

    let server = Server::start(|request, n| match n {
        2 => Reply::new(403, ""),
        _ => hub(request),
    });
    let world = World::new(&server.url);
    assert!(world.download(ID).0.unwrap_err().contains("403"));
    assert!(ksim_datasets::list(&world.options.roots).is_empty());
    assert!(
        world
            .files()
            .iter()
            .all(|file| file.contains("/.human-v2.part/"))
    );
    // The large file is complete: only the rest is asked for.
    assert_eq!(world.fetched(ID).fetched, METADATA.len() as u64);
    let asked = server.asked();
    assert_eq!(
        asked
            .iter()
            .filter(|request| request.path.ends_with(".hdf5"))
            .count(),
        1
    );
}

#[test]
fn listings_go_on_over_pages() {
    let server = Server::start(|request, _| {
        let mut entries = listing();
        let first = entries.remove(1);
        match request.path.as_str() {
            LISTING => {
                let link = "<https://huggingface.co/api/x?recursive=true&cursor=2>; rel=\"next\"";
                Reply::ok(json!([first]).to_string()).header("Link", link)
            }
            path if path.ends_with("recursive=true&cursor=2") => {
                Reply::ok(json!(entries).to_string())
            }
            _ => hub(request),
        }
    });
    let world = World::new(&server.url);
    let mut event = |_: Event| {};
    let planned = plan(ID, &world.options, &mut event).unwrap();
    assert_eq!(planned.bytes, Some((data().len() + METADATA.len()) as u64));
    assert_eq!(world.files(), Vec::<String>::new());
    assert_eq!(world.fetched(ID).bytes, planned.bytes.unwrap());
}

#[test]
fn listings_that_cannot_be_trusted_are_refused() {
    let with = |path: &str| {
        let mut entries = listing();
        entries.push(file(path, 3));
        json!(entries).to_string()
    };
    let cases = [
        (with("pen/human-v2/../../../evil"), "\"..\""),
        (with("/etc/passwd"), "outside of"),
        (with("pen/human-v2//x"), "empty part"),
        (with("pen/human-v2/a\\b"), "characters"),
        (with("pen/human-v1/data/x"), "outside of"),
        (with("pen/human-v2/data/metadata.json"), "twice"),
        (json!([listing()[1]]).to_string(), "not a Minari dataset"),
        ("[]".to_owned(), "not a Minari dataset"),
        ("<html>".to_owned(), "no list of files"),
        (json!({"error": "x"}).to_string(), "no list of files"),
    ];
    for (body, part) in cases {
        let reply = body.clone();
        let server = Server::start(move |_, _| Reply::ok(reply.clone()));
        World::new(&server.url).refused(ID, &["refused", part]);
        assert_eq!(server.asked().len(), 1, "{body}");
    }
}

#[test]
fn a_wrong_file_of_a_dataset_never_appears() {
    let server = Server::start(|request, _| match request.path.ends_with(".hdf5") {
        true => Reply::ok(vec![0; data().len()]),
        false => hub(request),
    });
    World::new(&server.url).refused(ID, &["SHA-256"]);
    let server = Server::start(
        |request, _| match request.path.ends_with("data/metadata.json") {
            true => Reply::ok(vec![b' '; METADATA.len()]),
            false => hub(request),
        },
    );
    let world = World::new(&server.url);
    let error = world.download(ID).0.unwrap_err();
    assert!(error.contains("expected a Minari dataset"), "{error}");
    assert!(
        !world
            .folder
            .path()
            .join("minari/D4RL/pen/human-v2")
            .exists()
    );
}

#[test]
fn an_unknown_dataset_leaves_no_folder() {
    let server = Server::start(|_, _| Reply::new(404, ""));
    let world = World::new(&server.url);
    world.refused("D4RL/pen/human-v7", &["404", "D4RL/pen/human-v2"]);
    assert!(!world.folder.path().join("minari").exists());
}

#[cfg(unix)]
#[test]
fn a_link_out_of_the_root_is_not_followed() {
    let server = Server::start(|request, _| hub(request));
    let world = World::new(&server.url);
    let (root, outside) = (
        world.folder.path().join("minari"),
        world.folder.path().join("outside"),
    );
    std::fs::create_dir_all(&root).unwrap();
    std::fs::create_dir(&outside).unwrap();
    std::os::unix::fs::symlink(&outside, root.join("D4RL")).unwrap();
    let error = world.download(ID).0.unwrap_err();
    assert!(error.contains("leads out"), "{error}");
    assert_eq!(std::fs::read_dir(&outside).unwrap().count(), 0);
}
