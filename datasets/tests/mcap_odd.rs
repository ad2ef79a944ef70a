//! Recordings that are odd in ways no sample is: names given twice, times given twice, goals of split episodes.
#![cfg(feature = "mcap")]
#![expect(clippy::unwrap_used, reason = "tests")]

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use ksim_datasets::{DatasetSource, OpenOptions, Result, Scan, open};
use mcap::records::MessageHeader;
use serde_json::{Value, json};
use tempfile::TempDir;

/// A JSON message: topic, log time in ms, content.
type Said = (&'static str, u64, Value);

/// A recording of JSON messages and a mapping beside it.
fn recording(messages: &[Said], mapping: &str) -> (TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.mcap");
    let mut writer = mcap::WriteOptions::new()
        .create(BufWriter::new(File::create(&path).unwrap()))
        .unwrap();
    let list = |of: &str| json!({ "type": "array", "items": { "type": of } });
    let schema = json!({ "type": "object", "properties": {
        "name": list("string"), "position": list("number"), "data": { "type": "string" },
        "episode": { "type": "integer" }, "step": { "type": "integer" },
    } });
    let schema = writer
        .add_schema("Said", "jsonschema", schema.to_string().as_bytes())
        .unwrap();
    let mut channels = BTreeMap::new();
    for (topic, ms, content) in messages {
        let channel_id = *channels.entry(topic).or_insert_with(|| {
            let about = BTreeMap::new();
            writer.add_channel(schema, topic, "json", &about).unwrap()
        });
        let header = MessageHeader {
            channel_id,
            sequence: 0,
            log_time: ms * 1_000_000,
            publish_time: 0,
        };
        let content = content.to_string();
        writer
            .write_to_known_channel(&header, content.as_bytes())
            .unwrap();
    }
    writer.finish().unwrap();
    std::fs::write(folder.path().join("mapping.toml"), mapping).unwrap();
    (folder, path)
}

fn opened(path: &Path) -> Result<Box<dyn DatasetSource>> {
    let mapping = path.with_file_name("mapping.toml");
    let options = OpenOptions {
        mapping: Some(mapping),
        ..OpenOptions::default()
    };
    open(path, &options)
}

/// The whole chain of the first error of a pass.
fn failure(path: &Path) -> String {
    let read = || -> Result<()> {
        for batch in opened(path)?.scan(&Scan::default())? {
            batch?;
        }
        Ok(())
    };
    let error = read().unwrap_err();
    let mut text = error.to_string();
    let mut source = std::error::Error::source(&error);
    while let Some(cause) = source {
        text = format!("{text}: {cause}");
        source = cause.source();
    }
    text
}

const BY_STATE: &str = "[grid]\ntopic = \"/q\"\n";
const STATE: &str = "[observation.q]\ntopic = \"/q\"\nfield = \"position\"\n";

#[test]
fn values_are_not_picked_by_a_name_that_two_have() {
    let content = json!({ "name": ["", ""], "position": [1.0, 2.0] });
    let messages = [("/q", 1, content)];
    let (_folder, path) = recording(&messages, &format!("{BY_STATE}{STATE}"));
    let error = failure(&path);
    assert!(error.contains("has the name \"\" twice"), "{error}");
    let by_place = format!("{BY_STATE}{STATE}names_field = \"\"\n");
    let (_folder, path) = recording(&messages, &by_place);
    assert_eq!(opened(&path).unwrap().info().observation_width(), 2);
}

#[test]
fn only_the_last_part_of_a_split_episode_can_have_reached_the_goal() {
    let mut messages: Vec<Said> = vec![("/episode", 0, json!({ "data": "start" }))];
    for ms in (1..10).filter(|ms| *ms != 5) {
        messages.push(("/q", ms, json!({ "name": ["a"], "position": [0.0] })));
    }
    // Without a command in the last 3 ms, the step at 6 ms is where the episode is cut.
    for ms in [1, 2, 7, 8, 9] {
        messages.push(("/u", ms, json!({ "name": ["a"], "position": [0.0] })));
    }
    messages.push(("/episode", 10, json!({ "data": "end success" })));
    let mapping = format!(
        "{BY_STATE}[episodes]\nby = \"marker\"\ntopic = \"/episode\"\nstart = \"start\"\nend = \"end\"\n\
         success = \"success\"\n{STATE}[action]\ntopic = \"/u\"\nfield = \"position\"\nmax_age_s = 0.003\n"
    );
    let (_folder, path) = recording(&messages, &mapping);
    let episodes = opened(&path).unwrap().episodes().unwrap();
    let found: Vec<_> = episodes.iter().map(|e| (e.length, e.success)).collect();
    assert_eq!(found, [(4, None), (3, Some(true))]);
}

#[test]
fn rows_numbered_at_the_same_time_are_refused() {
    let row = |step: u64| json!({ "episode": 0, "step": step, "position": [step] });
    let mapping = "[index]\ntopic = \"/q\"\nepisode = \"episode\"\nstep = \"step\"\n\
         [observation.q]\ntopic = \"/q\"\nfield = \"position\"\ndtype = \"float64\"\nshape = [1]\n";
    let (_folder, path) = recording(&[("/q", 1, row(0)), ("/q", 2, row(1))], mapping);
    assert_eq!(opened(&path).unwrap().info().n_steps, Some(2));
    let (_folder, path) = recording(&[("/q", 1, row(0)), ("/q", 1, row(1))], mapping);
    let error = failure(&path);
    assert!(error.contains("two rows of episode 0"), "{error}");
}

const NUMBERED: &str = "[index]\ntopic = \"/step\"\nepisode = \"episode\"\nstep = \"step\"\n\
     [observation.q]\ntopic = \"/q\"\nfield = \"position\"\ndtype = \"float64\"\nshape = [1]\n\
     [action.u]\ntopic = \"/u\"\nfield = \"position\"\ndtype = \"float64\"\nshape = [1]\nmissing = \"null\"\n\
     [action.v]\ntopic = \"/v\"\nfield = \"position\"\ndtype = \"float64\"\nshape = [1]\nmissing = \"null\"\n";

/// Three rows of one episode, with messages left out (or left empty).
fn numbered(absent: &[(&str, u64)], empty: &[(&str, u64)]) -> Vec<Said> {
    let mut messages = Vec::new();
    for ms in 1..4 {
        messages.push(("/step", ms, json!({ "episode": 0, "step": ms - 1 })));
        for topic in ["/q", "/u", "/v"] {
            if empty.contains(&(topic, ms)) {
                messages.push((topic, ms, json!({})));
            } else if !absent.contains(&(topic, ms)) {
                messages.push((topic, ms, json!({ "position": [1.0] })));
            }
        }
    }
    messages
}

#[test]
fn rows_without_action_inside_an_episode_are_refused() {
    let last = [("/u", 3), ("/v", 3)];
    for (absent, empty, n_steps) in [(vec![], vec![], 3), (last.to_vec(), vec![], 2)] {
        let (_folder, path) = recording(&numbered(&absent, &empty), NUMBERED);
        let source = opened(&path).unwrap();
        assert_eq!(source.info().n_steps, Some(n_steps));
        let episodes = source.episodes().unwrap();
        assert_eq!((episodes[0].length, episodes[0].n_rows), (n_steps, 3));
    }
    let faults = [
        (
            ("/u", 2),
            "\"action.u\" has no sample for the step at 2000000 ns",
        ),
        (
            ("/v", 1),
            "\"action.v\" has no sample for the step at 1000000 ns",
        ),
        // One of two actions is no final observation.
        (
            ("/u", 3),
            "\"action.u\" has no sample for the step at 3000000 ns",
        ),
        (
            ("/q", 2),
            "\"observation.q\" has no sample for the step at 2000000 ns",
        ),
    ];
    for (place, expected) in faults {
        let (_folder, path) = recording(&numbered(&[place], &[]), NUMBERED);
        let error = failure(&path);
        assert!(
            error.contains(expected) && error.contains(place.0),
            "{error}"
        );
        if place.0 != "/q" {
            let (_folder, path) = recording(&numbered(&[], &[place]), NUMBERED);
            let error = failure(&path);
            assert!(
                error.contains(expected) && error.contains(place.0),
                "{error}"
            );
        }
    }
}
