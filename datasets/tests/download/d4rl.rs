//! One file: breaks, lies, and what is there already.

use std::time::Duration;

use ksim_datasets::download::Check;

use crate::World;
use crate::server::{Reply, Server};

/// A dataset that is published without a checksum.
const OPEN: &str = "kitchen-complete-v0";
const OPEN_FILE: &str = "d4rl/mini_kitchen_microwave_kettle_light_slider-v0.hdf5";
/// One with a checksum, and its size.
const CHECKED: &str = "pen-human-v1";
const CHECKED_BYTES: usize = 2_040_573;

/// An HDF5 file, as good as any that has a valid beginning where HDF5 is not built in.
fn file() -> Vec<u8> {
    let fixtures = concat!(
        env!("CARGO_MANIFEST_DIR"),
        "/../tests/fixtures/golden/data_fixtures"
    );
    let mut files = std::fs::read_dir(format!("{fixtures}/d4rl"))
        .expect("it works")
        .map(|entry| entry.expect("it works").path())
        .filter(|path| path.extension().is_some_and(|suffix| suffix == "hdf5"))
        .filter(|path| {
            ksim_datasets::open(path, &Default::default()).is_ok() || !cfg!(feature = "hdf5")
        })
        .collect::<Vec<_>>();
    files.sort();
    std::fs::read(files.first().expect("a readable file")).expect("it works")
}

#[test]
fn a_file_is_fetched_once() {
    let bytes = file();
    let server = Server::start(move |request, _| Reply::file(request, "\"a\"", &file()));
    let world = World::new(&format!("{}/mirror/", server.url));
    let got = world.fetched(OPEN);
    assert_eq!(
        (got.bytes, got.fetched),
        (bytes.len() as u64, bytes.len() as u64)
    );
    assert_eq!((got.was_there, got.check), (false, Check::Opened));
    assert_eq!(world.files(), [OPEN_FILE]);
    assert_eq!(world.read(OPEN_FILE), bytes);
    let again = world.fetched(OPEN);
    assert_eq!((again.was_there, again.fetched), (true, 0));
    let asked = server.asked();
    assert_eq!(asked.len(), 1);
    assert!(
        asked[0].path.starts_with("/mirror/kitchen/mini_kitchen"),
        "{}",
        asked[0].path
    );
    assert_eq!(asked[0].header("accept-encoding"), Some("identity"));
    let mut forced = world;
    forced.options.force = true;
    assert!(!forced.fetched(OPEN).was_there);
}

#[test]
fn a_dropped_connection_is_taken_up_where_it_broke() {
    let bytes = file();
    let cut = bytes.len() / 3;
    let server = Server::start(move |request, n| match n {
        0 => Reply::file(request, "\"a\"", &file()).cut_to(cut),
        _ => Reply::file(request, "\"a\"", &file()),
    });
    let world = World::new(&server.url);
    let (got, retries) = world.download(OPEN);
    assert_eq!(got.unwrap().fetched, bytes.len() as u64);
    assert_eq!(retries.len(), 1, "{retries:?}");
    assert_eq!(world.read(OPEN_FILE), bytes);
    let asked = server.asked();
    assert_eq!(asked.len(), 2);
    assert_eq!(asked[1].range_start(), Some(cut));
    assert_eq!(asked[1].header("if-range"), Some("\"a\""));
}

#[test]
fn a_later_call_goes_on_from_an_earlier_one() {
    let bytes = file();
    let server = Server::start(move |request, n| match n {
        0 => Reply::file(request, "\"a\"", &file()).cut_to(1000),
        _ => Reply::file(request, "\"a\"", &file()),
    });
    let mut world = World::new(&server.url);
    world.options.max_retries = 0;
    let error = world.download(OPEN).0.unwrap_err();
    assert!(
        error.contains("gave up") && error.contains("1000"),
        "{error}"
    );
    let left = world.files();
    assert!(
        !left.is_empty() && left.iter().all(|file| file.contains(".part/")),
        "{left:?}"
    );
    assert_eq!(world.fetched(OPEN).fetched, bytes.len() as u64 - 1000);
    assert_eq!(world.files(), [OPEN_FILE]);
    assert_eq!(world.read(OPEN_FILE), bytes);
}

#[test]
fn a_server_without_ranges_starts_over() {
    let bytes = file();
    let server = Server::start(move |_, n| {
        let reply = Reply::ok(file()).header("ETag", "\"a\"");
        if n == 0 { reply.cut_to(1000) } else { reply }
    });
    let world = World::new(&server.url);
    assert_eq!(world.fetched(OPEN).fetched, bytes.len() as u64 + 1000);
    assert_eq!(world.read(OPEN_FILE), bytes);
    assert_eq!(server.asked()[1].range_start(), Some(1000));
}

#[test]
fn a_file_that_changed_is_not_stitched() {
    let bytes = file();
    for honest in [true, false] {
        let server = Server::start(move |request, n| {
            let old = vec![b'x'; 5000];
            match n {
                0 => Reply::file(request, "\"old\"", &old).cut_to(1000),
                _ if honest => Reply::file(request, "\"new\"", &file()),
                // Takes up another file as if it were the same.
                1 => Reply::file(
                    request,
                    request.header("if-range").unwrap_or("\"new\""),
                    &file(),
                ),
                _ => Reply::file(request, "\"new\"", &file()),
            }
        });
        let world = World::new(&server.url);
        world.fetched(OPEN);
        assert_eq!(world.read(OPEN_FILE), bytes, "honest: {honest}");
    }
}

#[test]
fn a_weak_tag_is_no_ground_to_go_on() {
    let server = Server::start(move |request, n| {
        let reply = Reply::file(request, "W/\"a\"", &file());
        if n == 0 { reply.cut_to(1000) } else { reply }
    });
    let world = World::new(&server.url);
    world.fetched(OPEN);
    assert_eq!(server.asked()[1].range_start(), None);
}

#[test]
fn a_wrong_length_is_refused() {
    let server = Server::start(|_, _| Reply::ok("short"));
    let world = World::new(&server.url);
    world.refused(
        CHECKED,
        &["the server has 5 bytes, expected 2040573", "hand_dapg_v1"],
    );
    assert_eq!(server.asked().len(), 1);
    // Without a declared length, all that comes is counted.
    let long = vec![0; CHECKED_BYTES + 10];
    let server = Server::start(move |_, _| Reply::ok(long.clone()).declaring(None));
    World::new(&server.url).refused(CHECKED, &["bytes, expected 2040573"]);
}

#[test]
fn a_length_that_never_comes_ends_in_an_error() {
    let server = Server::start(|_, _| Reply::ok(file()).declaring(Some(1 << 20)));
    let world = World::new(&server.url);
    let (error, retries) = world.download(OPEN);
    let error = error.unwrap_err();
    assert!(
        error.contains("gave up after 4") && error.contains("of 1048576"),
        "{error}"
    );
    assert_eq!(retries.len(), 3);
    assert!(!world.folder.path().join(OPEN_FILE).exists());
}

#[test]
fn a_wrong_file_never_appears() {
    let server = Server::start(|_, _| Reply::ok(vec![0; CHECKED_BYTES]));
    let sha = "209e345b2150b633f30a11612612c60f49e941f127ce6c4dc0cd790501c46f9f";
    World::new(&server.url).refused(CHECKED, &["SHA-256 is", "expected", sha]);
    // Nor one that is no HDF5 file where no checksum is known.
    for body in ["<!DOCTYPE html><p>soon back", "", "\x7fELF"] {
        let server = Server::start(move |_, _| Reply::ok(body));
        World::new(&server.url).refused(OPEN, &["expected an HDF5 file"]);
    }
}

#[test]
fn a_web_page_is_no_data() {
    let page = |_: &crate::server::Request, _| {
        Reply::ok("<html>moved").header("Content-Type", "text/html; charset=utf-8")
    };
    let server = Server::start(page);
    World::new(&server.url).refused(OPEN, &["web page", &server.url]);
    let server = Server::start(|_, _| Reply::ok("x").header("Content-Encoding", "gzip"));
    World::new(&server.url).refused(OPEN, &["gzip"]);
}

#[test]
fn refusals_are_explained() {
    let server = Server::start(|_, _| Reply::new(404, "no"));
    World::new(&server.url).refused(
        "antmaze-large-play-v2",
        &[
            "404",
            "hardest-maze",
            &server.url,
            "D4RL/antmaze/large-play-v1",
        ],
    );
    assert_eq!(server.asked().len(), 1);
    for status in [401, 403] {
        let server = Server::start(move |_, _| Reply::new(status, "no"));
        World::new(&server.url).refused(OPEN, &[&status.to_string(), "gated"]);
    }
}

#[test]
fn a_busy_server_is_asked_again_within_reason() {
    let server = Server::start(|request, n| match n {
        0 => Reply::new(503, "wait").header("Retry-After", "0"),
        1 => Reply::new(429, "wait"),
        _ => Reply::file(request, "\"a\"", &file()),
    });
    let world = World::new(&server.url);
    let (got, retries) = world.download(OPEN);
    got.unwrap();
    assert_eq!(
        retries,
        ["the server answers 503", "the server answers 429"]
    );
    let server = Server::start(|_, _| Reply::new(500, "broken"));
    World::new(&server.url).refused(OPEN, &["gave up after 4", "500"]);
    let server = Server::start(|_, _| Reply::new(503, "wait").header("Retry-After", "9999"));
    World::new(&server.url).refused(OPEN, &["503", "come back in 9999 s"]);
    assert_eq!(server.asked().len(), 1);
}

#[test]
fn a_silent_server_is_left() {
    let bytes = file();
    let server = Server::start(|request, n| match n {
        0 => Reply::file(request, "\"a\"", &file())
            .cut_to(1000)
            .stalling(),
        _ => Reply::file(request, "\"a\"", &file()),
    });
    let mut world = World::new(&server.url);
    world.options.stall_timeout = Duration::from_millis(300);
    let (got, retries) = world.download(OPEN);
    got.unwrap();
    assert_eq!(retries.len(), 1, "{retries:?}");
    assert_eq!(server.asked()[1].range_start(), Some(1000));
    assert_eq!(world.read(OPEN_FILE), bytes);
}

#[test]
fn redirections_are_followed_but_not_forever() {
    let bytes = file();
    let server = Server::start(|request, n| match n {
        0 | 2 => Reply::new(302, "").header("Location", "/elsewhere?x=1"),
        1 => Reply::file(request, "\"a\"", &file()).cut_to(1000),
        _ => Reply::file(request, "\"a\"", &file()),
    });
    let world = World::new(&server.url);
    world.fetched(OPEN);
    assert_eq!(world.read(OPEN_FILE), bytes);
    let asked = server.asked();
    assert_eq!(asked[1].path, "/elsewhere?x=1");
    assert_eq!(asked[3].range_start(), Some(1000));
    let server = Server::start(|_, _| Reply::new(302, "").header("Location", "/again"));
    World::new(&server.url).refused(OPEN, &["too many redirections"]);
    let server = Server::start(|_, _| Reply::new(302, "").header("Location", "file:///etc/passwd"));
    World::new(&server.url).refused(OPEN, &["file:///etc/passwd"]);
}

#[test]
fn without_a_network_it_is_said_at_once() {
    let closed = {
        let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        format!("http://{}", listener.local_addr().unwrap())
    };
    let world = World::new(&closed);
    let (error, retries) = world.download(OPEN);
    let error = error.unwrap_err();
    assert!(
        error.contains("cannot reach the server") && error.contains(&closed),
        "{error}"
    );
    assert_eq!((retries, world.files()), (Vec::new(), Vec::new()));
}

#[test]
fn what_is_too_large_is_refused_before_it_comes() {
    let server = Server::start(|_, _| Reply::ok(file()));
    let mut world = World::new(&server.url);
    world.options.max_bytes = 100;
    world.refused(OPEN, &["over the limit of 100"]);
}

#[test]
fn a_file_that_is_not_the_published_one_is_not_taken_for_it() {
    let server = Server::start(|_, _| Reply::new(404, ""));
    let world = World::new(&server.url);
    let folder = world.folder.path().join("d4rl");
    std::fs::create_dir(&folder).unwrap();
    std::fs::write(folder.join("pen-human-v1.hdf5"), "mine").unwrap();
    let error = world.download(CHECKED).0.unwrap_err();
    assert!(
        error.contains("has 4 bytes, expected 2040573") && error.contains("force"),
        "{error}"
    );
    assert_eq!(world.read("d4rl/pen-human-v1.hdf5"), b"mine");
    assert_eq!(server.asked().len(), 0);
}

#[test]
fn two_processes_do_not_write_into_each_other() {
    let server = Server::start(|request, _| Reply::file(request, "\"a\"", &file()));
    let world = World::new(&server.url);
    let partial = format!(
        "{}/.{}.part",
        world.folder.path().join("d4rl").display(),
        &OPEN_FILE[5..]
    );
    std::fs::create_dir_all(&partial).unwrap();
    let lock = std::fs::File::create(format!("{partial}/lock")).unwrap();
    lock.lock().unwrap();
    let error = world.download(OPEN).0.unwrap_err();
    assert!(error.contains("another process"), "{error}");
    drop(lock);
    world.fetched(OPEN);
    assert_eq!(world.files(), [OPEN_FILE]);
}
