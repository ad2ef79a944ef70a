//! A mapping to start from, guessed by the types and names of topics.

use std::fmt::Write;

use super::describe::{MAPPING_ENTRY, MAPPING_RECORD};
use super::guess::{Shape, is_gripper, shape, slug};
use super::inspect::{Inspection, TopicInspection};
use crate::error::{DatasetError, Result};

/// Words in the names of topics that carry commands.
const COMMAND_WORDS: [&str; 10] = [
    "cmd", "command", "commands", "target", "desired", "action", "goal", "ctrl", "leader", "master",
];
/// A silence that looks like the pause between two episodes [s].
const PAUSE_S: f64 = 1.0;

impl Inspection {
    /// A commented TOML mapping that opens the recording: the one that it brings along, or a guess to be checked by someone
    /// who knows the robot.
    ///
    /// # Errors
    /// [`DatasetError::Empty`] if no topic has numbers or pictures that can be decoded.
    pub fn propose(&self) -> Result<String> {
        let own = self.metadata.iter().find(|one| one.name == MAPPING_RECORD);
        if let Some(own) = own.and_then(|record| record.entries.get(MAPPING_ENTRY)) {
            return Ok(own.clone());
        }
        let mut proposal = Proposal::new(self);
        proposal.columns();
        if proposal.observation.is_empty() && proposal.action.is_empty() {
            return Err(DatasetError::Empty);
        }
        Ok(proposal.toml())
    }
}

/// A section of the mapping.
struct Section {
    name: String,
    lines: Vec<String>,
}

struct Proposal<'i> {
    inspection: &'i Inspection,
    observation: Vec<Section>,
    action: Vec<Section>,
    /// Rates of the topics that tell the pace.
    action_rate: Option<f64>,
    state_rate: Option<f64>,
    joints: Option<String>,
}

impl<'i> Proposal<'i> {
    fn new(inspection: &'i Inspection) -> Self {
        Self {
            inspection,
            observation: Vec::new(),
            action: Vec::new(),
            action_rate: None,
            state_rate: None,
            joints: None,
        }
    }

    /// The busiest topics first, so that the main joint states get the plain name.
    fn columns(&mut self) {
        let mut topics: Vec<&TopicInspection> = self
            .inspection
            .topics
            .iter()
            .filter(|topic| topic.n_messages > 0 && topic.undecodable.is_none())
            .collect();
        topics.sort_by_key(|topic| std::cmp::Reverse(topic.n_messages));
        let is_marker = |topic: &TopicInspection| {
            self.marker()
                .is_some_and(|marker| marker.topic == topic.topic)
        };
        topics.retain(|topic| !is_marker(topic));
        for topic in &topics {
            match shape(topic) {
                Shape::Nothing => {}
                // Beside joints and poses, loose numbers (diagnostics, torques) are no state by themselves.
                Shape::Numbers(_) if !self.is_command(topic) && !is_gripper(&topic.topic) => {}
                shape => self.add(topic, &shape),
            }
        }
        if self.joints.is_none()
            && self
                .observation
                .iter()
                .all(|section| section.lines.iter().any(|line| line.contains("image")))
        {
            let loose = topics
                .iter()
                .find(|topic| !self.is_command(topic) && matches!(shape(topic), Shape::Numbers(_)));
            if let Some(topic) = loose {
                self.add(topic, &shape(topic));
            }
        }
    }

    fn is_command(&self, topic: &TopicInspection) -> bool {
        let name = topic.topic.to_lowercase();
        let has_word = name
            .split(|c: char| !c.is_ascii_alphanumeric())
            .any(|word| COMMAND_WORDS.contains(&word));
        // AgileX: the follower's states are called `joint_states_single…`, the leader's `joint_states…`.
        let follower = name.replace("joint_states", "joint_states_single");
        let has_follower = !name.contains("single")
            && follower != name
            && self
                .inspection
                .topics
                .iter()
                .any(|other| other.topic.to_lowercase() == follower);
        has_word || has_follower
    }

    fn add(&mut self, topic: &TopicInspection, shape: &Shape) {
        let is_command = self.is_command(topic);
        let rate = if is_command {
            &mut self.action_rate
        } else {
            &mut self.state_rate
        };
        if !matches!(shape, Shape::Picture) && rate.is_none() {
            *rate = topic.rate_hz;
        }
        let mut name = slug(&topic.topic);
        if let (Shape::Joints { .. }, false, None) = (shape, is_command, &self.joints) {
            "joints".clone_into(&mut name);
            self.joints = Some(name.clone());
        }
        let sections = sections(topic, shape, &name);
        let all = if is_command {
            &mut self.action
        } else {
            &mut self.observation
        };
        for mut section in sections {
            let taken = |name: &str| all.iter().any(|other: &Section| other.name == name);
            let stem = section.name.clone();
            let mut n = 2;
            while taken(&section.name) {
                section.name = format!("{stem}_{n}");
                n += 1;
            }
            all.push(section);
        }
    }

    fn marker(&self) -> Option<&'i TopicInspection> {
        self.inspection.topics.iter().find(|topic| {
            let last = topic
                .topic
                .rsplit('/')
                .next()
                .unwrap_or_default()
                .to_lowercase();
            let is_named =
                ["episode", "episodes", "marker", "markers", "trial"].contains(&last.as_str());
            is_named && topic.texts.iter().any(|text| text.starts_with("start"))
        })
    }

    fn toml(&self) -> String {
        let mut out = String::from(
            "# Proposed by `ksim dataset inspect` from the names and types of the topics.\n\
             # Check every line: which topics are state and which are command, units, joints that do not turn.\n\
             # docs/mcap-mapping.md describes every key.\n\n\
             clock = \"log\" # when the recorder got a message; or \"publish\", or \"header\" (the stamp inside it)\n\n",
        );
        let _ = writeln!(
            out,
            "[grid]\nrate_hz = {} # steps per second; or `topic`, whose messages are the steps",
            self.rate()
        );
        self.write_episodes(&mut out);
        self.write_recorded(&mut out);
        for section in &self.observation {
            write_section(&mut out, "observation", section);
        }
        if self.action.is_empty() {
            match &self.joints {
                Some(joints) => {
                    let _ = writeln!(
                        out,
                        "\n# No topic looks like a command: the action is the next state.\n[action]\nnext_of = {}",
                        quoted(joints)
                    );
                }
                None => out.push_str("\n# No topic looks like a command: add an [action.NAME].\n"),
            }
        }
        for section in &self.action {
            write_section(&mut out, "action", section);
        }
        out
    }

    fn rate(&self) -> u64 {
        let rate = self.action_rate.or(self.state_rate).unwrap_or(30.0);
        // In range: clamped.
        rate.round().clamp(1.0, 1000.0) as u64
    }

    fn write_episodes(&self, out: &mut String) {
        if let Some(marker) = self.marker() {
            let has = |start: &str| marker.texts.iter().any(|text| text.starts_with(start));
            let _ = writeln!(
                out,
                "\n[episodes]\nby = \"marker\"\ntopic = {}\nfield = \"data\"\nstart = \"start\"",
                quoted(&marker.topic)
            );
            for end in ["end", "stop"].into_iter().filter(|end| has(end)).take(1) {
                let _ = writeln!(out, "end = {}", quoted(end));
                if marker
                    .texts
                    .iter()
                    .any(|text| text.split_whitespace().any(|word| word == "success"))
                {
                    out.push_str("success = \"success\" # a word in the end text\n");
                }
            }
            return;
        }
        out.push_str("\n[episodes]\nby = \"file\" # or \"gap\" (silences of a topic), or \"marker\" (messages that begin and end episodes)\n");
        let pauses = |topic: &&TopicInspection| {
            let typical = topic.rate_hz.map_or(f64::INFINITY, |rate| 20.0 / rate);
            topic
                .largest_gap_s
                .is_some_and(|gap| gap > PAUSE_S && gap > typical)
        };
        if let Some(topic) = self.inspection.topics.iter().find(pauses) {
            let gap = topic.largest_gap_s.unwrap_or(0.0);
            let _ = writeln!(
                out,
                "# \"{}\" is silent for up to {gap:.1} s: `by = \"gap\"`, `topic`, `gap_s = {PAUSE_S:.1}` would cut there.",
                escaped(&topic.topic)
            );
        }
    }

    fn write_recorded(&self, out: &mut String) {
        for key in ["task", "success"] {
            let mut records = self.inspection.metadata.iter();
            if let Some(record) = records.find(|record| record.entries.contains_key(key)) {
                let _ = writeln!(
                    out,
                    "\n[{key}]\nmetadata = {}\nkey = \"{key}\"",
                    quoted(&record.name)
                );
            }
        }
    }
}

fn write_section(out: &mut String, root: &str, section: &Section) {
    let _ = writeln!(out, "\n[{root}.{}]", section.name);
    for line in &section.lines {
        out.push_str(line);
        out.push('\n');
    }
}

fn sections(topic: &TopicInspection, shape: &Shape, name: &str) -> Vec<Section> {
    let section = |name: String, rest: Vec<String>| {
        let mut lines = vec![format!("topic = {}", quoted(&topic.topic))];
        lines.extend(rest);
        Section { name, lines }
    };
    match shape {
        Shape::Nothing => Vec::new(),
        Shape::Picture => vec![section(
            name.to_owned(),
            vec!["kind = \"image\"".to_owned()],
        )],
        Shape::Numbers(paths) => {
            let paths = paths
                .iter()
                .map(|path| quoted(path))
                .collect::<Vec<_>>()
                .join(", ");
            vec![section(
                name.to_owned(),
                vec![format!("field = [{paths}] # unit? kind?")],
            )]
        }
        Shape::Pose { prefix } => vec![
            section(
                format!("{name}_position"),
                vec![
                    format!("field = {}", quoted(&format!("{prefix}position"))),
                    "unit = \"m\"".to_owned(),
                ],
            ),
            section(
                format!("{name}_orientation"),
                vec![
                    format!("field = {}", quoted(&format!("{prefix}orientation"))),
                    "kind = \"quaternion_xyzw\"".to_owned(),
                ],
            ),
        ],
        Shape::Joints { values } => {
            let (grippers, joints): (Vec<&String>, Vec<&String>) =
                topic.names.iter().partition(|name| is_gripper(name));
            let list = |names: &[&String]| {
                let names = names
                    .iter()
                    .map(|name| quoted(name))
                    .collect::<Vec<_>>()
                    .join(", ");
                format!("names = [{names}]")
            };
            let field = || format!("field = {}", quoted(values));
            let mut sections = Vec::new();
            if !joints.is_empty() {
                let kind = "kind = \"angle\" # joints that turn".to_owned();
                let lines = vec![field(), list(&joints), "unit = \"rad\"".to_owned(), kind];
                sections.push(section(name.to_owned(), lines));
            }
            if !grippers.is_empty() {
                let lines = vec![field(), list(&grippers), "unit = \"m\" # or rad".to_owned()];
                sections.push(section(format!("{name}_gripper"), lines));
            }
            sections
        }
    }
}

/// As a TOML string.
fn quoted(text: &str) -> String {
    toml::Value::String(text.to_owned()).to_string()
}

/// For a comment.
fn escaped(text: &str) -> String {
    text.escape_debug().to_string()
}
