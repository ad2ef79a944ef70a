//! Which columns go into which messages, and the mapping that reads them back.

use std::collections::BTreeSet;
use std::fmt::Write;

use arrow::datatypes::{DataType, Field, Schema};

use crate::formats::mcap::mapping::Dtype;
use crate::formats::mcap::numbered::STEP_TOPIC;
use crate::schema;
use crate::sink::{Loss, LossEffect};

/// Columns that are written in one message.
#[derive(Debug, Clone)]
pub(super) struct Group {
    pub(super) topic: &'static str,
    /// Name of the message type.
    pub(super) message: &'static str,
    pub(super) members: Vec<Member>,
}

/// A column in a message.
#[derive(Debug, Clone)]
pub(super) struct Member {
    /// Place in the schema.
    pub(super) place: usize,
    /// Name in the message: letters, digits and `_`.
    pub(super) name: String,
    pub(super) column: String,
    pub(super) value_type: DataType,
    pub(super) is_vector: bool,
    is_nullable: bool,
    /// Section of the mapping that reads it back; empty for the numbers of a row.
    section: String,
    shape: Vec<usize>,
    metadata: Vec<(String, String)>,
}

/// The groups of a table, and what they leave out.
pub(super) fn groups(table: &Schema) -> (Vec<Group>, Vec<Loss>) {
    let mut groups = [
        (STEP_TOPIC, "Step"),
        ("/observation", "Observation"),
        ("/action", "Action"),
        ("/info", "Info"),
        ("/k_sim", "KSim"),
        ("/demonstration", "Demonstration"),
    ]
    .map(|(topic, message)| Group {
        topic,
        message,
        members: Vec::new(),
    });
    let mut losses = Vec::new();
    for (place, field) in table.fields().iter().enumerate() {
        let Some((group, section)) = section(field.name()) else {
            losses.push(dropped(field, "it is no column of the canonical layout"));
            continue;
        };
        let Some(member) = Member::new(place, field, section) else {
            losses.push(dropped(field, "its type has no message field"));
            continue;
        };
        if member.value_type == DataType::Float16 {
            losses.push(Loss {
                item: field.name().clone(),
                effect: LossEffect::Changed,
                detail: "written as float32, which holds every float16 exactly; the mapping in the file turns it back".to_owned(),
                count: None,
            });
        }
        if let Some(group) = groups.get_mut(group) {
            group.add(member);
        }
    }
    let used = groups.into_iter().filter(|group| !group.members.is_empty());
    (used.collect(), losses)
}

fn dropped(field: &Field, why: &str) -> Loss {
    Loss {
        item: field.name().clone(),
        effect: LossEffect::Dropped,
        detail: why.to_owned(),
        count: None,
    }
}

/// The group of a column, and its section in the mapping.
fn section(column: &str) -> Option<(usize, String)> {
    let named = |root: &str| -> Option<String> {
        let rest = column
            .strip_prefix(root)
            .filter(|_| schema::belongs_to(column, root))?;
        let key = toml::Value::String(rest.strip_prefix('.').unwrap_or(rest).to_owned());
        Some(format!("{root}.{key}"))
    };
    // Of what scores record, viewers show every part on a topic of its own.
    for (group, root) in [(4, schema::INFO_K_SIM), (5, schema::INFO_DEMONSTRATION)] {
        if schema::belongs_to(column, root) {
            return Some((group, named(schema::INFO)?));
        }
    }
    match column {
        schema::EPISODE_INDEX | schema::STEP_INDEX | schema::T_NS => Some((0, String::new())),
        schema::REWARD | schema::TERMINATED | schema::TRUNCATED => Some((0, column.to_owned())),
        _ => [
            (1, schema::OBSERVATION),
            (2, schema::ACTION),
            (3, schema::INFO),
            (3, schema::NEXT_OBSERVATION),
        ]
        .into_iter()
        .find_map(|(group, root)| Some((group, named(root)?))),
    }
}

impl Group {
    fn add(&mut self, mut member: Member) {
        // The JSON names of Protobuf fields, which must differ as well, have no underscores.
        let plain = |name: &str| name.replace('_', "").to_ascii_lowercase();
        let members = self.members.iter();
        let taken: BTreeSet<String> = members.map(|member| plain(&member.name)).collect();
        let mut name = member.name.clone();
        let mut n = 2;
        while taken.contains(&plain(&name)) {
            name = format!("{}_{n}", member.name);
            n += 1;
        }
        member.name = name;
        self.members.push(member);
    }
}

impl Member {
    fn new(place: usize, field: &Field, section: String) -> Option<Self> {
        let (value_type, is_vector) = match field.data_type() {
            DataType::FixedSizeList(child, _) => (child.data_type().clone(), true),
            other => (other.clone(), false),
        };
        Dtype::name_of(&value_type)?;
        if is_vector && matches!(value_type, DataType::Utf8 | DataType::Binary) {
            return None;
        }
        let shape = match (is_vector, field.data_type()) {
            (true, DataType::FixedSizeList(_, width)) => {
                let flat = vec![usize::try_from(*width).unwrap_or(0)];
                schema::row_shape(field).map_or(flat, |(_, shape)| shape)
            }
            _ => Vec::new(),
        };
        let mut metadata: Vec<_> = field.metadata().clone().into_iter().collect();
        metadata.retain(|(key, _)| !key.starts_with("ARROW:"));
        metadata.sort();
        Some(Self {
            place,
            name: identifier(field.name()),
            column: field.name().clone(),
            value_type,
            is_vector,
            is_nullable: field.is_nullable(),
            section,
            shape,
            metadata,
        })
    }
}

/// A name that every encoding allows.
fn identifier(column: &str) -> String {
    let roots = [
        schema::OBSERVATION,
        schema::ACTION,
        schema::INFO_K_SIM,
        schema::INFO_DEMONSTRATION,
        schema::INFO,
    ];
    let short = roots
        .iter()
        .find_map(|root| column.strip_prefix(root)?.strip_prefix('.'));
    let mut name: String = short
        .unwrap_or(column)
        .chars()
        .map(|c| if c.is_ascii_alphanumeric() { c } else { '_' })
        .collect();
    if !name.starts_with(|c: char| c.is_ascii_alphabetic()) {
        name.insert_str(0, "v_");
    }
    name
}

/// The mapping that reads the messages back as the same table.
pub(super) fn mapping_toml(groups: &[Group]) -> String {
    let mut toml = String::from(
        "# Written by ksim: how this recording is read back as the table it was made from.\n[index]\n",
    );
    let quoted = |text: &str| toml::Value::String(text.to_owned()).to_string();
    let keys = [
        ("topic", STEP_TOPIC),
        ("episode", schema::EPISODE_INDEX),
        ("step", schema::STEP_INDEX),
        ("t_ns", schema::T_NS),
    ];
    let members = || {
        groups
            .iter()
            .flat_map(|group| group.members.iter().map(move |member| (group, member)))
    };
    let has_time = members().any(|(_, member)| member.column == schema::T_NS);
    for (key, value) in keys.iter().take(3 + usize::from(has_time)) {
        let _ = writeln!(toml, "{key} = {}", quoted(value));
    }
    for (group, member) in members().filter(|(_, member)| !member.section.is_empty()) {
        let _ = writeln!(toml, "\n[{}]", member.section);
        let _ = writeln!(
            toml,
            "topic = {}\nfield = {}",
            quoted(group.topic),
            quoted(&member.name)
        );
        let dtype = Dtype::name_of(&member.value_type).unwrap_or_default();
        let _ = writeln!(toml, "dtype = {}", quoted(dtype));
        if member.is_nullable {
            toml.push_str("missing = \"null\"\n");
        }
        if member.is_vector {
            let _ = writeln!(toml, "shape = {:?}", member.shape);
        }
        if !member.metadata.is_empty() {
            let entries = member
                .metadata
                .iter()
                .map(|(key, value)| format!("{} = {}", quoted(key), quoted(value)));
            let _ = writeln!(
                toml,
                "metadata = {{ {} }}",
                entries.collect::<Vec<_>>().join(", ")
            );
        }
    }
    toml
}
