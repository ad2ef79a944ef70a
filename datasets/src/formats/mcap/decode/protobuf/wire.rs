//! The wire format of Protocol Buffers.

use prost_reflect::Kind;

use crate::formats::mcap::decode::fault::{Fault, exact_i64, exact_u64, fault};

/// Groups in groups beyond this are refused.
const MAX_GROUPS: usize = 100;

/// A value as it is on the wire.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Raw<'a> {
    Varint(u64),
    Fixed64([u8; 8]),
    Fixed32([u8; 4]),
    Bytes(&'a [u8]),
}

/// The fields of a message, one after another.
pub(super) struct Fields<'a> {
    rest: &'a [u8],
}

impl<'a> Fields<'a> {
    pub(super) fn new(data: &'a [u8]) -> Self {
        Self { rest: data }
    }

    /// Number and value of the next field; groups, which are outdated, are passed over.
    pub(super) fn next(&mut self) -> Result<Option<(u32, Raw<'a>)>, Fault> {
        const START_GROUP: u64 = 3;
        loop {
            if self.rest.is_empty() {
                return Ok(None);
            }
            let (number, wire) = self.tag()?;
            if wire != START_GROUP {
                return self.raw(wire).map(|raw| Some((number, raw)));
            }
            self.skip_group(number)?;
        }
    }

    fn tag(&mut self) -> Result<(u32, u64), Fault> {
        let tag = self.varint()?;
        match u32::try_from(tag >> 3) {
            Ok(number) if number > 0 && tag <= u64::from(u32::MAX) => Ok((number, tag & 7)),
            _ => Err(fault(format!("{tag} is no tag of a field"))),
        }
    }

    fn raw(&mut self, wire: u64) -> Result<Raw<'a>, Fault> {
        match wire {
            0 => self.varint().map(Raw::Varint),
            1 => self.array().map(Raw::Fixed64),
            2 => {
                let n = usize::try_from(self.varint()?).unwrap_or(usize::MAX);
                self.bytes(n).map(Raw::Bytes)
            }
            5 => self.array().map(Raw::Fixed32),
            other => Err(fault(format!("a field has wire type {other}"))),
        }
    }

    fn skip_group(&mut self, number: u32) -> Result<(), Fault> {
        let mut open = vec![number];
        while let Some(&innermost) = open.last() {
            match self.tag()? {
                (number, 3) if open.len() < MAX_GROUPS => open.push(number),
                (number, 4) if number == innermost => {
                    open.pop();
                }
                (_, wire) => self.raw(wire).map(|_| ())?,
            }
        }
        Ok(())
    }

    fn bytes(&mut self, n: usize) -> Result<&'a [u8], Fault> {
        let split = self.rest.split_at_checked(n);
        let (taken, rest) = split.ok_or_else(|| {
            fault(format!(
                "{n} bytes are expected where {} are left",
                self.rest.len()
            ))
        })?;
        self.rest = rest;
        Ok(taken)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], Fault> {
        let bytes = self.bytes(N)?;
        bytes.try_into().map_err(|_| fault("a value is cut off"))
    }

    fn varint(&mut self) -> Result<u64, Fault> {
        let mut value = 0_u64;
        for shift in (0..64).step_by(7) {
            let [byte] = self.array()?;
            let part = u64::from(byte & 0x7f);
            if shift == 63 && part > 1 {
                break;
            }
            value |= part << shift;
            if byte & 0x80 == 0 {
                return Ok(value);
            }
        }
        Err(fault("an integer is longer than 10 bytes"))
    }
}

/// A number or flag of a field.
pub(super) fn number(kind: &Kind, raw: Raw<'_>) -> Result<f64, Fault> {
    // 32-bit integers are the low bits of what is on the wire.
    match (kind, raw) {
        (Kind::Double, Raw::Fixed64(bytes)) => Ok(f64::from_le_bytes(bytes)),
        (Kind::Float, Raw::Fixed32(bytes)) => Ok(f32::from_le_bytes(bytes).into()),
        (Kind::Int32 | Kind::Enum(_), Raw::Varint(value)) => Ok((value as i32).into()),
        (Kind::Int64, Raw::Varint(value)) => exact_i64(value as i64),
        (Kind::Uint32, Raw::Varint(value)) => Ok((value as u32).into()),
        (Kind::Uint64, Raw::Varint(value)) => exact_u64(value),
        (Kind::Sint32, Raw::Varint(value)) => Ok((zigzag((value as u32).into()) as i32).into()),
        (Kind::Sint64, Raw::Varint(value)) => exact_i64(zigzag(value)),
        (Kind::Bool, Raw::Varint(value)) => Ok(f64::from(u8::from(value != 0))),
        (Kind::Fixed32, Raw::Fixed32(bytes)) => Ok(u32::from_le_bytes(bytes).into()),
        (Kind::Sfixed32, Raw::Fixed32(bytes)) => Ok(i32::from_le_bytes(bytes).into()),
        (Kind::Fixed64, Raw::Fixed64(bytes)) => exact_u64(u64::from_le_bytes(bytes)),
        (Kind::Sfixed64, Raw::Fixed64(bytes)) => exact_i64(i64::from_le_bytes(bytes)),
        (kind, _) => Err(fault(format!(
            "a field of type {kind:?} has another wire type"
        ))),
    }
}

fn zigzag(value: u64) -> i64 {
    (value >> 1) as i64 ^ -((value & 1) as i64)
}

/// The numbers in a packed field.
pub(super) fn packed(kind: &Kind, bytes: &[u8], mut put: impl FnMut(f64)) -> Result<(), Fault> {
    let mut fields = Fields::new(bytes);
    while !fields.rest.is_empty() {
        let raw = match kind {
            Kind::Double | Kind::Fixed64 | Kind::Sfixed64 => Raw::Fixed64(fields.array()?),
            Kind::Float | Kind::Fixed32 | Kind::Sfixed32 => Raw::Fixed32(fields.array()?),
            _ => Raw::Varint(fields.varint()?),
        };
        put(number(kind, raw)?);
    }
    Ok(())
}

/// Seconds and nanoseconds of a time.
pub(super) fn time(bytes: &[u8]) -> Result<(i64, i64), Fault> {
    let (mut seconds, mut ns) = (0, 0);
    let mut fields = Fields::new(bytes);
    while let Some((number, raw)) = fields.next()? {
        match (number, raw) {
            (1, Raw::Varint(value)) => seconds = value as i64,
            (2, Raw::Varint(value)) => ns = (value as i32).into(),
            (1 | 2, _) => return Err(fault("a time has another wire type")),
            _ => {}
        }
    }
    Ok((seconds, ns))
}
