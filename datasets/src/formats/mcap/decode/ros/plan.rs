//! Taking some fields out of ROS messages.

use super::cursor::Cursor;
use super::types::{Clock, Count, Kind, Primitive, Struct, Types};
use crate::error::{DatasetError, Result};
use crate::formats::mcap::decode::extract::Slot;
use crate::formats::mcap::decode::fault::Fault;
use crate::formats::mcap::decode::path::{FieldPath, PathStep};

/// What is wanted of a field or element.
#[derive(Debug, Clone, Default)]
struct Want {
    /// Slots for the value as a whole.
    whole: Vec<usize>,
    /// Of its members; either none or up to the last of which something is wanted.
    members: Vec<Want>,
    /// Of its elements, in order.
    elements: Vec<(usize, Want)>,
    /// Of every element.
    each: Option<Box<Want>>,
}

impl Want {
    fn is_nothing(&self) -> bool {
        let rest = self.members.is_empty() && self.elements.is_empty();
        self.whole.is_empty() && rest && self.each.is_none()
    }
}

/// The fields wanted of a type of messages.
#[derive(Debug, Clone)]
pub(crate) struct RosPlan {
    types: std::sync::Arc<Types>,
    root: Want,
}

impl RosPlan {
    pub(crate) fn new(types: std::sync::Arc<Types>, paths: &[FieldPath]) -> Result<Self> {
        let mut root = Want::default();
        for (slot, path) in paths.iter().enumerate() {
            let compile = Compile {
                types: &types,
                path,
                slot,
            };
            let place = types.structs.len().checked_sub(1);
            let place = place.ok_or(DatasetError::Empty)?;
            compile.value(&mut root, Kind::Struct(place), &path.steps, false)?;
        }
        Ok(Self { types, root })
    }

    /// Fills the slots.
    pub(crate) fn extract(
        &self,
        data: &[u8],
        slots: &mut [Slot],
    ) -> std::result::Result<(), Fault> {
        let cursor = Cursor::new(data, self.types.flavor)?;
        let mut run = Run {
            types: &self.types,
            cursor,
            slots,
        };
        match self.types.root() {
            // What comes after the last wanted member is not looked at.
            Some(root) => run.members(root, &self.root),
            None => Ok(()),
        }
    }
}

struct Compile<'a> {
    types: &'a Types,
    path: &'a FieldPath,
    slot: usize,
}

impl Compile<'_> {
    fn missing(&self, of: Option<&Struct>) -> DatasetError {
        let names = of.map(|of| of.fields.iter().map(|f| &*f.name).collect::<Vec<_>>());
        DatasetError::MissingKey {
            key: self.path.to_string(),
            found: match (of, names) {
                (Some(of), Some(names)) => format!("{} with {}", of.name, names.join(", ")),
                _ => "no members there".to_owned(),
            },
        }
    }

    fn wrong(&self, actual: &str, expected: &'static str) -> DatasetError {
        DatasetError::WrongType {
            key: self.path.to_string(),
            actual: actual.to_owned(),
            expected,
        }
    }

    /// A path that goes on in a single value.
    fn value(&self, want: &mut Want, kind: Kind, steps: &[PathStep], each: bool) -> Result<()> {
        let of = match kind {
            Kind::Struct(place) => self.types.get(place),
            _ => None,
        };
        match steps {
            [] => {
                if let Some(of) = of {
                    let clock = of.clock.filter(|_| !each);
                    clock.ok_or_else(|| self.wrong(&of.name, "a field with a value"))?;
                }
                want.whole.push(self.slot);
                Ok(())
            }
            [PathStep::Member(name), rest @ ..] => {
                let place = of.and_then(|of| of.fields.iter().position(|f| *f.name == **name));
                let field = place.and_then(|place| Some((place, of?.fields.get(place)?)));
                let (place, field) = field.ok_or_else(|| self.missing(of))?;
                if want.members.len() <= place {
                    want.members.resize_with(place + 1, Want::default);
                }
                let Some(member) = want.members.get_mut(place) else {
                    return Err(self.missing(of));
                };
                match field.count {
                    Count::One => self.value(member, field.kind, rest, each),
                    _ if each => Err(self.wrong("an array in an array", "a single value")),
                    count => self.array(member, field.kind, count, rest),
                }
            }
            _ => Err(self.wrong("no array", "an array")),
        }
    }

    /// A path that goes on in an array.
    fn array(&self, want: &mut Want, kind: Kind, count: Count, steps: &[PathStep]) -> Result<()> {
        match steps {
            [] if !matches!(kind, Kind::Struct(_)) => {
                want.whole.push(self.slot);
                Ok(())
            }
            [] | [PathStep::Member(_), ..] => {
                Err(self.wrong("an array of structs", "one of them, or `[]` for all"))
            }
            [PathStep::Each, rest @ ..] => {
                let each = want.each.get_or_insert_default();
                self.value(each, kind, rest, true)
            }
            [PathStep::Index(index), rest @ ..] => {
                if let Count::Fixed(n) | Count::Bounded(n) = count
                    && *index >= n
                {
                    return Err(self.wrong(&format!("an array of {n}"), "a longer array"));
                }
                let place = match want.elements.binary_search_by_key(index, |(i, _)| *i) {
                    Ok(place) => place,
                    Err(place) => {
                        want.elements.insert(place, (*index, Want::default()));
                        place
                    }
                };
                match want.elements.get_mut(place) {
                    Some((_, element)) => self.value(element, kind, rest, false),
                    None => Ok(()),
                }
            }
        }
    }
}

struct Run<'a, 'data> {
    types: &'a Types,
    cursor: Cursor<'data>,
    slots: &'a mut [Slot],
}

type Done = std::result::Result<(), Fault>;

impl Run<'_, '_> {
    /// The members up to the last wanted one.
    fn members(&mut self, of: &Struct, want: &Want) -> Done {
        for (field, want) in of.fields.iter().zip(&want.members) {
            let done = match field.count {
                _ if want.is_nothing() => {
                    self.cursor.skip_field(self.types, field.kind, field.count)
                }
                Count::One => self.value(field.kind, want),
                count => self.array(field.kind, count, want),
            };
            done.map_err(|fault| fault.in_member(&field.name))?;
        }
        Ok(())
    }

    /// A single value, to its end.
    fn value(&mut self, kind: Kind, want: &Want) -> Done {
        match kind {
            Kind::Primitive(primitive) => {
                let start = self.cursor.clone();
                self.cursor.skip(self.types, kind)?;
                for &slot in &want.whole {
                    if let Some(slot) = self.slots.get_mut(slot) {
                        start.clone().numbers(primitive, 1, slot.numbers_mut())?;
                    }
                }
                Ok(())
            }
            Kind::Text(bound) => {
                let text = self.cursor.text(bound)?;
                self.put(want, |slot| slot.add_text(text));
                Ok(())
            }
            Kind::Struct(place) => {
                let Some(of) = self.types.get(place) else {
                    return Ok(());
                };
                if let Some(clock) = of.clock.filter(|_| !want.whole.is_empty()) {
                    let ns = self.cursor.clone().time(of, clock)?;
                    // A stamp of zero was never set.
                    let is_set = ns != 0 || clock == Clock::Duration;
                    self.put(want, |slot| slot.set_time(is_set.then_some(ns)));
                }
                if of.fields.is_empty() {
                    return self.cursor.skip(self.types, kind);
                }
                self.members(of, want)?;
                let rest = of.fields.iter().skip(want.members.len());
                for field in rest {
                    self.cursor
                        .skip_field(self.types, field.kind, field.count)
                        .map_err(|fault| fault.in_member(&field.name))?;
                }
                Ok(())
            }
        }
    }

    fn put(&mut self, want: &Want, act: impl Fn(&mut Slot)) {
        for &slot in &want.whole {
            if let Some(slot) = self.slots.get_mut(slot) {
                act(slot);
            }
        }
    }

    /// An array, to its end.
    fn array(&mut self, kind: Kind, count: Count, want: &Want) -> Done {
        let n = self.cursor.count(count, self.types.min_size(kind))?;
        let start = self.cursor.clone();
        for &slot in &want.whole {
            self.cursor = start.clone();
            self.whole(kind, n, slot)?;
        }
        if let Some(each) = &want.each {
            self.cursor = start.clone();
            mark_present(each, self.slots);
            for _ in 0..n {
                self.value(kind, each)?;
            }
        }
        if want.elements.is_empty() {
            return Ok(());
        }
        self.cursor = start;
        let mut at = 0;
        for (index, want) in want.elements.iter().filter(|(index, _)| *index < n) {
            self.cursor.skip_many(self.types, kind, index - at)?;
            self.value(kind, want)?;
            at = index + 1;
        }
        self.cursor.skip_many(self.types, kind, n - at)
    }

    /// All values of an array into a slot.
    fn whole(&mut self, kind: Kind, n: usize, slot: usize) -> Done {
        let Some(slot) = self.slots.get_mut(slot) else {
            return Ok(());
        };
        slot.mark_present();
        match kind {
            Kind::Primitive(Primitive::U8) => slot.set_bytes(self.cursor.byte_array(n)?),
            Kind::Primitive(primitive) => {
                self.cursor.numbers(primitive, n, slot.numbers_mut())?;
            }
            Kind::Text(bound) => {
                for _ in 0..n {
                    slot.add_text(self.cursor.text(bound)?);
                }
            }
            Kind::Struct(_) => {}
        }
        Ok(())
    }
}

/// Members of an array's elements are there, even if there are no elements.
fn mark_present(want: &Want, slots: &mut [Slot]) {
    for &slot in &want.whole {
        if let Some(slot) = slots.get_mut(slot) {
            slot.mark_present();
        }
    }
    for member in &want.members {
        mark_present(member, slots);
    }
}
