//! Taking some fields out of Protocol Buffers messages, by walking their bytes.
//!
//! A field that comes again replaces what it held, members of a submessage one by one, as the format says.

use prost_reflect::{FieldDescriptor, Kind, MessageDescriptor};

use super::wire::{self, Fields, Raw};
use super::{Clock, MessageType, clock};
use crate::error::{DatasetError, Result};
use crate::formats::mcap::decode::extract::Slot;
use crate::formats::mcap::decode::fault::{Fault, fault, time_ns};
use crate::formats::mcap::decode::path::{FieldPath, PathStep};

/// What is wanted of a value.
#[derive(Debug, Clone, Default)]
struct Want {
    /// Slots for the value itself.
    slots: Vec<usize>,
    /// If it is a time that is wanted itself.
    clock: Option<Clock>,
    /// Of its members, by number.
    members: Vec<Member>,
}

/// A field of which something is wanted.
#[derive(Debug, Clone)]
struct Member {
    number: u32,
    name: String,
    kind: Kind,
    is_list: bool,
    /// Whether unset and default are two things.
    has_presence: bool,
    /// How often it was met, in the counters of the message.
    counter: usize,
    /// Of the field, if it is no list.
    one: Want,
    /// Slots for the list as a whole.
    whole: Vec<usize>,
    /// Of single elements.
    elements: Vec<(usize, Want)>,
    /// Of each element.
    each: Option<Want>,
}

/// The fields wanted of a type of messages.
#[derive(Debug, Clone)]
pub(crate) struct ProtobufPlan {
    root: Want,
    n_counters: usize,
}

impl ProtobufPlan {
    pub(crate) fn new(of: &MessageType, paths: &[FieldPath]) -> Result<Self> {
        let mut root = Want::default();
        let mut n_counters = 0;
        for (slot, path) in paths.iter().enumerate() {
            let mut compile = Compile {
                path,
                slot,
                n_counters: &mut n_counters,
            };
            compile.members(&mut root, &of.0, &path.steps, false)?;
        }
        Ok(Self { root, n_counters })
    }

    pub(crate) fn n_counters(&self) -> usize {
        self.n_counters
    }

    /// Fills the slots.
    pub(crate) fn extract(
        &self,
        data: &[u8],
        slots: &mut [Slot],
        counters: &mut [usize],
    ) -> std::result::Result<(), Fault> {
        let mut run = Run { slots, counters };
        run.message(data, &self.root, None)
    }
}

struct Compile<'a> {
    path: &'a FieldPath,
    slot: usize,
    n_counters: &'a mut usize,
}

impl Compile<'_> {
    fn wrong(&self, actual: &str, expected: &'static str) -> DatasetError {
        DatasetError::WrongType {
            key: self.path.to_string(),
            actual: actual.to_owned(),
            expected,
        }
    }

    fn missing(&self, of: &MessageDescriptor) -> DatasetError {
        let names: Vec<String> = of.fields().map(|field| field.name().to_owned()).collect();
        DatasetError::MissingKey {
            key: self.path.to_string(),
            found: format!("{} with {}", of.full_name(), names.join(", ")),
        }
    }

    /// A path that goes on in a message.
    fn members(
        &mut self,
        want: &mut Want,
        of: &MessageDescriptor,
        steps: &[PathStep],
        each: bool,
    ) -> Result<()> {
        let [PathStep::Member(name), rest @ ..] = steps else {
            return Err(self.wrong(of.full_name(), "a field with a value"));
        };
        let field = of.get_field_by_name(name).ok_or_else(|| self.missing(of))?;
        if field.is_map() || field.is_group() {
            return Err(self.wrong("a map or group", "a field with a value"));
        }
        let member = self.member(want, &field);
        match (rest, field.is_list()) {
            (_, true) if each => Err(self.wrong("an array in an array", "a single value")),
            (rest, true) => self.list(member, &field, rest),
            (rest, false) => self.value(&mut member.one, &field, rest, each),
        }
    }

    /// The place for what is wanted of a field.
    fn member<'w>(&mut self, want: &'w mut Want, field: &FieldDescriptor) -> &'w mut Member {
        let place = want.members.iter().position(|m| m.number == field.number());
        let place = place.unwrap_or_else(|| {
            want.members.push(Member {
                number: field.number(),
                name: field.name().to_owned(),
                kind: field.kind(),
                is_list: field.is_list(),
                has_presence: field.supports_presence(),
                counter: *self.n_counters,
                one: Want::default(),
                whole: Vec::new(),
                elements: Vec::new(),
                each: None,
            });
            *self.n_counters += 1;
            want.members.len() - 1
        });
        &mut want.members[place]
    }

    fn value(
        &mut self,
        want: &mut Want,
        field: &FieldDescriptor,
        steps: &[PathStep],
        each: bool,
    ) -> Result<()> {
        match (field.kind(), steps) {
            (Kind::Message(of), []) => {
                want.clock = clock(&of).filter(|_| !each);
                if want.clock.is_none() {
                    return Err(self.wrong(of.full_name(), "a field with a value"));
                }
            }
            (Kind::Message(of), steps) => return self.members(want, &of, steps, each),
            (Kind::Bytes, []) if each => return Err(self.wrong("bytes", "numbers or texts")),
            (_, []) => {}
            (_, _) => return Err(self.wrong("a single value", "a struct or array")),
        }
        want.slots.push(self.slot);
        Ok(())
    }

    fn list(
        &mut self,
        member: &mut Member,
        field: &FieldDescriptor,
        steps: &[PathStep],
    ) -> Result<()> {
        match steps {
            [] if !matches!(field.kind(), Kind::Message(_) | Kind::Bytes) => {
                member.whole.push(self.slot);
                Ok(())
            }
            [PathStep::Index(index), rest @ ..] => {
                let place = member.elements.iter().position(|(i, _)| i == index);
                let place = place.unwrap_or_else(|| {
                    member.elements.push((*index, Want::default()));
                    member.elements.len() - 1
                });
                self.value(&mut member.elements[place].1, field, rest, false)
            }
            [PathStep::Each, rest @ ..] => {
                self.value(member.each.get_or_insert_default(), field, rest, true)
            }
            _ => Err(self.wrong("an array of structs", "one of them, or `[]` for all")),
        }
    }
}

struct Run<'a> {
    slots: &'a mut [Slot],
    counters: &'a mut [usize],
}

type Done = std::result::Result<(), Fault>;

impl Run<'_> {
    /// A message; `element` is its place if values are taken of each element of a list.
    fn message(&mut self, data: &[u8], want: &Want, element: Option<usize>) -> Done {
        let mut fields = Fields::new(data);
        while let Some((number, raw)) = fields.next()? {
            let member = want.members.iter().find(|member| member.number == number);
            if let Some(member) = member {
                self.field(member, raw, element)
                    .map_err(|fault| fault.in_member(&member.name))?;
            }
        }
        for member in &want.members {
            self.set_defaults(member, element);
        }
        Ok(())
    }

    fn field(&mut self, member: &Member, raw: Raw<'_>, element: Option<usize>) -> Done {
        if !member.is_list {
            if member.one.clock.is_some() && self.count(member) > 0 {
                // Its two parts could be in two places.
                return Err(fault("a time is given twice"));
            }
            return self.value(&member.kind, raw, &member.one, element);
        }
        match (&member.kind, raw) {
            (Kind::String | Kind::Bytes | Kind::Message(_), raw) => self.element(member, raw),
            (kind, Raw::Bytes(bytes)) => wire::packed(kind, bytes, |value| {
                let index = self.count(member);
                self.number(member, index, value);
            }),
            (kind, raw) => {
                let value = wire::number(kind, raw)?;
                let index = self.count(member);
                self.number(member, index, value);
                Ok(())
            }
        }
    }

    /// How often the field was met before now.
    fn count(&mut self, member: &Member) -> usize {
        let Some(counter) = self.counters.get_mut(member.counter) else {
            return 0;
        };
        *counter += 1;
        *counter - 1
    }

    /// A number in a list.
    fn number(&mut self, member: &Member, index: usize, value: f64) {
        let at = member.elements.iter().filter(|(i, _)| *i == index);
        let at = at.flat_map(|(_, want)| &want.slots);
        let each = member.each.iter().flat_map(|want| &want.slots);
        for &slot in member.whole.iter().chain(each).chain(at) {
            if let Some(slot) = self.slots.get_mut(slot) {
                slot.add_number(value);
            }
        }
    }

    /// A text or message in a list.
    fn element(&mut self, member: &Member, raw: Raw<'_>) -> Done {
        let index = self.count(member);
        if !member.whole.is_empty() {
            let text = text(raw)?;
            for &slot in &member.whole {
                if let Some(slot) = self.slots.get_mut(slot) {
                    slot.add_text(text);
                }
            }
        }
        for (_, want) in member.elements.iter().filter(|(i, _)| *i == index) {
            self.value(&member.kind, raw, want, None)?;
        }
        if let Some(want) = &member.each {
            self.value(&member.kind, raw, want, Some(index))?;
            self.settle(want, index);
        }
        Ok(())
    }

    /// A single value.
    fn value(&mut self, kind: &Kind, raw: Raw<'_>, want: &Want, element: Option<usize>) -> Done {
        match (kind, raw) {
            (Kind::Message(_), Raw::Bytes(bytes)) => {
                if let Some(clock) = want.clock {
                    let (seconds, ns) = wire::time(bytes)?;
                    let ns = time_ns(seconds, ns, clock == Clock::Time)?;
                    // A stamp of zero was never set.
                    let is_set = ns != 0 || clock == Clock::Duration;
                    self.put(want, None, |slot| slot.set_time(is_set.then_some(ns)));
                }
                self.message(bytes, want, element)
            }
            (Kind::String, raw) => {
                let text = text(raw)?;
                self.put(want, element, |slot| slot.add_text(text));
                Ok(())
            }
            (Kind::Bytes, Raw::Bytes(bytes)) => {
                self.put(want, None, |slot| slot.set_bytes(bytes));
                Ok(())
            }
            (Kind::Message(_) | Kind::Bytes, _) => Err(fault("a field has another wire type")),
            (kind, raw) => {
                let value = wire::number(kind, raw)?;
                self.put(want, element, |slot| slot.add_number(value));
                Ok(())
            }
        }
    }

    /// Sets a value, which replaces the one before; that of an element is added.
    fn put(&mut self, want: &Want, element: Option<usize>, act: impl Fn(&mut Slot)) {
        for &slot in &want.slots {
            if let Some(slot) = self.slots.get_mut(slot) {
                act(slot);
                slot.keep_last_from(element.unwrap_or(0));
            }
        }
    }

    /// What the fields hold that are not in a message.
    fn set_defaults(&mut self, member: &Member, element: Option<usize>) {
        if member.is_list {
            // A list without elements is there.
            for &slot in &member.whole {
                if let Some(slot) = self.slots.get_mut(slot) {
                    slot.mark_present();
                }
            }
            if let Some(want) = &member.each {
                self.mark_present(want);
            }
            return;
        }
        if member.has_presence {
            return;
        }
        let place = element.unwrap_or(0);
        for &slot in &member.one.slots {
            let slot = self.slots.get_mut(slot);
            let unset = slot.filter(|slot| match element {
                Some(_) => slot.len() == place,
                None => !slot.present(),
            });
            let Some(slot) = unset else { continue };
            match member.kind {
                Kind::String => slot.add_text(""),
                Kind::Bytes => slot.set_bytes(&[]),
                _ => slot.add_number(0.0),
            }
        }
    }

    fn mark_present(&mut self, want: &Want) {
        for &slot in &want.slots {
            if let Some(slot) = self.slots.get_mut(slot) {
                slot.mark_present();
            }
        }
        for member in &want.members {
            self.mark_present(&member.one);
        }
    }

    /// After an element: every list of values has one for it.
    fn settle(&mut self, want: &Want, element: usize) {
        for member in &want.members {
            for &slot in &member.one.slots {
                let slot = self.slots.get_mut(slot);
                let Some(slot) = slot.filter(|slot| slot.len() == element) else {
                    continue;
                };
                match member.kind {
                    Kind::String => slot.add_text(""),
                    _ => slot.add_number(f64::NAN),
                }
            }
            self.settle(&member.one, element);
        }
    }
}

fn text(raw: Raw<'_>) -> std::result::Result<&str, Fault> {
    match raw {
        Raw::Bytes(bytes) => std::str::from_utf8(bytes).map_err(|_| fault("a text is not UTF-8")),
        _ => Err(fault("a field has another wire type")),
    }
}
