//! Parsing `ros1msg` and `ros2msg`: the text of the message's definition, then those of the types it uses,
//! each after a line of `=` and a line `MSG: package/Type`.

use std::collections::BTreeMap;

use super::types::{Clock, Count, Field, Flavor, Kind, Primitive, Types};
use crate::error::{DatasetError, Result};

/// Types nested deeper than this are refused.
const MAX_DEPTH: usize = 64;
/// Length of the line between two definitions.
const SEPARATOR: usize = 80;

/// Parses the schema of a message type.
///
/// # Errors
/// [`DatasetError::Unsupported`] for what is known but not read (`wstring`, IDL),
/// [`DatasetError::Corrupt`] for what is not a definition, names a type that is missing, or holds itself.
pub(crate) fn parse(name: &str, data: &[u8], flavor: Flavor) -> Result<Types> {
    // Comments may be in any encoding.
    let text = String::from_utf8_lossy(data);
    let mut resolver = Resolver {
        blocks: blocks(name, &text)?,
        places: BTreeMap::new(),
        types: Types {
            flavor,
            structs: Vec::new(),
        },
    };
    resolver.resolve(&short(name), 0)?;
    Ok(resolver.types)
}

/// `pkg/msg/Type` and `pkg/Type` are the same.
fn short(name: &str) -> String {
    match name.split('/').collect::<Vec<_>>()[..] {
        [package, "msg" | "srv" | "action", name] => format!("{package}/{name}"),
        _ => name.to_owned(),
    }
}

/// The definitions by name.
fn blocks(name: &str, text: &str) -> Result<BTreeMap<String, Vec<String>>> {
    let mut blocks: BTreeMap<String, Vec<String>> = BTreeMap::new();
    let mut current = Some(short(name));
    let mut lines: Vec<String> = Vec::new();
    let text = text.strip_prefix('\u{feff}').unwrap_or(text);
    for line in text.lines().map(str::trim) {
        if line.len() >= SEPARATOR && line.bytes().all(|byte| byte == b'=') {
            close(&mut blocks, current.take(), &mut lines)?;
        } else if line.is_empty() || line.starts_with('#') {
            // Neither belongs to a definition.
        } else if current.is_some() {
            lines.push(line.to_owned());
        } else if let Some(next) = line.strip_prefix("MSG:") {
            current = Some(short(next.trim()));
        } else if line.starts_with("IDL:") {
            return Err(DatasetError::Unsupported {
                what: format!("message type \"{name}\", which is partly described in IDL"),
            });
        } else {
            return Err(bad(name, line, "is not `MSG: package/Type`"));
        }
    }
    close(&mut blocks, current, &mut lines)?;
    Ok(blocks)
}

fn close(
    blocks: &mut BTreeMap<String, Vec<String>>,
    name: Option<String>,
    lines: &mut Vec<String>,
) -> Result<()> {
    let lines = std::mem::take(lines);
    let Some(name) = name else { return Ok(()) };
    match blocks.get(&name) {
        Some(known) if *known != lines => Err(DatasetError::corrupt(format!(
            "message type \"{name}\" is defined twice, differently"
        ))),
        _ => {
            blocks.insert(name, lines);
            Ok(())
        }
    }
}

fn bad(name: &str, line: &str, reason: &str) -> DatasetError {
    DatasetError::corrupt(format!(
        "the definition of message type \"{name}\": \"{}\" {reason}",
        line.escape_debug()
    ))
}

struct Resolver {
    blocks: BTreeMap<String, Vec<String>>,
    /// Of the types that are resolved; none for those that are being resolved.
    places: BTreeMap<String, Option<usize>>,
    types: Types,
}

impl Resolver {
    fn resolve(&mut self, name: &str, depth: usize) -> Result<usize> {
        match self.places.get(name) {
            Some(Some(place)) => return Ok(*place),
            None if depth < MAX_DEPTH => {}
            _ => {
                return Err(DatasetError::corrupt(format!(
                    "message type \"{name}\" holds itself, or more than {MAX_DEPTH} types in each other"
                )));
            }
        }
        self.places.insert(name.to_owned(), None);
        let mut fields: Vec<Field> = Vec::new();
        for line in self.lines(name)? {
            if let Some(field) = self.field(name, &line, depth)? {
                if fields.iter().any(|other| other.name == field.name) {
                    return Err(bad(name, &line, "names a field that is there already"));
                }
                fields.push(field);
            }
        }
        let clock = clock(name, &fields);
        let place = self.types.add(name.to_owned(), fields, clock);
        self.places.insert(name.to_owned(), Some(place));
        Ok(place)
    }

    fn lines(&self, name: &str) -> Result<Vec<String>> {
        if let Some(lines) = self.blocks.get(name) {
            return Ok(lines.clone());
        }
        let (ros1, ros2) = (Flavor::Ros1, Flavor::Ros2);
        let lines: &[&str] = match (name, self.types.flavor) {
            ("time", flavor) if flavor == ros1 => &["uint32 secs", "uint32 nsecs"],
            ("duration", flavor) if flavor == ros1 => &["int32 secs", "int32 nsecs"],
            ("std_msgs/Header", flavor) if flavor == ros1 => {
                &["uint32 seq", "time stamp", "string frame_id"]
            }
            ("std_msgs/Header", _) => &["builtin_interfaces/Time stamp", "string frame_id"],
            ("builtin_interfaces/Time" | "builtin_interfaces/Duration", flavor)
                if flavor == ros2 =>
            {
                &["int32 sec", "uint32 nanosec"]
            }
            _ => {
                return Err(DatasetError::corrupt(format!(
                    "message type \"{name}\" is not defined in the schema"
                )));
            }
        };
        Ok(lines.iter().map(|&line| line.to_owned()).collect())
    }

    /// A field, or nothing for a constant. Defaults and comments behind it are of no meaning here.
    fn field(&mut self, of: &str, line: &str, depth: usize) -> Result<Option<Field>> {
        let Some((type_name, rest)) = line.split_once([' ', '\t']) else {
            return Err(bad(of, line, "is not a type and a name"));
        };
        let rest = rest.trim_start();
        let is_name = |c: char| c.is_ascii_alphanumeric() || c == '_';
        let end = rest.find(|c| !is_name(c)).unwrap_or(rest.len());
        let (name, rest) = rest.split_at(end);
        if name.is_empty() || !rest.is_empty() && !rest.starts_with([' ', '\t', '=', '#']) {
            return Err(bad(of, line, "has no good field name"));
        }
        if rest.trim_start().starts_with('=') {
            return Ok(None);
        }
        let (base, count) =
            array(type_name).ok_or_else(|| bad(of, line, "has no good array length"))?;
        let kind = self.kind(of, line, base, depth)?;
        Ok(Some(Field {
            name: name.into(),
            kind,
            count,
        }))
    }

    fn kind(&mut self, of: &str, line: &str, base: &str, depth: usize) -> Result<Kind> {
        if let Some(primitive) = Primitive::named(base, self.types.flavor) {
            return Ok(Kind::Primitive(primitive));
        }
        let (name, bound) = match base.split_once("<=") {
            Some((name, bound)) => {
                let bound = bound
                    .parse()
                    .map_err(|_| bad(of, line, "has no good length"))?;
                (name, Some(bound))
            }
            None => (base, None),
        };
        match (name, bound) {
            ("string", bound) => return Ok(Kind::Text(bound)),
            ("wstring", _) => {
                return Err(DatasetError::Unsupported {
                    what: format!(
                        "`wstring` (in message type \"{of}\"), written differently by vendor"
                    ),
                });
            }
            (_, Some(_)) => return Err(bad(of, line, "bounds what is no string")),
            _ => {}
        }
        let is_type = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '/';
        if name.is_empty() || !name.chars().all(is_type) {
            return Err(bad(of, line, "has no good type"));
        }
        let name = self.full_name(of, name);
        self.resolve(&name, depth + 1).map(Kind::Struct)
    }

    /// A name without a package is of the same package, or one of the old builtin ones.
    fn full_name(&self, of: &str, name: &str) -> String {
        let name = short(name);
        if name.contains('/')
            || self.types.flavor == Flavor::Ros1 && matches!(&*name, "time" | "duration")
        {
            return name;
        }
        let package = of.split_once('/').map_or("", |(package, _)| package);
        let near = format!("{package}/{name}");
        let ending = format!("/{name}");
        let mut others = self.blocks.keys().filter(|known| known.ends_with(&ending));
        if self.blocks.contains_key(&near) {
            near
        } else if name == "Header" {
            "std_msgs/Header".to_owned()
        } else {
            match (others.next(), others.next()) {
                (Some(only), None) => only.clone(),
                _ => near,
            }
        }
    }
}

/// `T`, `T[]`, `T[5]` or `T[<=5]`.
fn array(name: &str) -> Option<(&str, Count)> {
    let Some((base, length)) = name.split_once('[') else {
        return Some((name, Count::One));
    };
    let length = length.strip_suffix(']')?;
    let count = match length.strip_prefix("<=") {
        Some(bound) => Count::Bounded(bound.parse().ok()?),
        None if length.is_empty() => Count::Any,
        None => Count::Fixed(length.parse().ok()?),
    };
    Some((base, count))
}

/// Whether it is a builtin time: by its name, and by its fields, which the file could define otherwise.
fn clock(name: &str, fields: &[Field]) -> Option<Clock> {
    let clock = match name {
        "builtin_interfaces/Time" | "time" => Clock::Time,
        "builtin_interfaces/Duration" | "duration" => Clock::Duration,
        _ => return None,
    };
    let is_word = |field: &Field| {
        field.count == Count::One
            && matches!(field.kind, Kind::Primitive(Primitive::I32 | Primitive::U32))
    };
    (fields.len() == 2 && fields.iter().all(is_word)).then_some(clock)
}
