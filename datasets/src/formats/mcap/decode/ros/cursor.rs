//! Reading the bytes of a ROS message. Nothing is read or allocated beyond the bytes that are there.

use super::types::{Clock, Count, Flavor, Kind, Primitive, Struct, Types};
use crate::formats::mcap::decode::Value;
use crate::formats::mcap::decode::fault::{Fault, exact_i64, exact_u64, fault, time_ns};

/// A place in a message.
#[derive(Debug, Clone)]
pub(super) struct Cursor<'a> {
    /// From the origin of alignment.
    data: &'a [u8],
    position: usize,
    /// Whether values stand at multiples of their size.
    aligned: bool,
    big_endian: bool,
}

/// Hands the numbers of one type in some bytes on, as an iterator.
macro_rules! each_number {
    ($bytes:expr, $type:ty, $big:expr, |$numbers:ident| $act:expr) => {{
        let (chunks, _) = $bytes.as_chunks::<{ size_of::<$type>() }>();
        if $big {
            let $numbers = chunks.iter().map(|b| <$type>::from_be_bytes(*b));
            $act
        } else {
            let $numbers = chunks.iter().map(|b| <$type>::from_le_bytes(*b));
            $act
        }
    }};
}

impl<'a> Cursor<'a> {
    pub(super) fn new(data: &'a [u8], flavor: Flavor) -> Result<Self, Fault> {
        if flavor == Flavor::Ros1 {
            return Ok(Self {
                data,
                position: 0,
                aligned: false,
                big_endian: false,
            });
        }
        let Some((&[zero, id, _, _], data)) = data.split_first_chunk::<4>() else {
            return Err(fault(
                "it is shorter than the 4 bytes every CDR message starts with",
            ));
        };
        if zero != 0 || id > 1 {
            return Err(fault(format!(
                "encapsulation {zero:#04x} {id:#04x} is not read (only CDR version 1)"
            )));
        }
        Ok(Self {
            data,
            position: 0,
            aligned: true,
            big_endian: id == 0,
        })
    }

    pub(super) fn left(&self) -> usize {
        self.data.len().saturating_sub(self.position)
    }

    fn take(&mut self, n: usize) -> Result<&'a [u8], Fault> {
        let bytes = self.data.get(self.position..).and_then(|b| b.get(..n));
        let bytes = bytes.ok_or_else(|| {
            fault(format!(
                "{n} bytes are expected where {} are left",
                self.left()
            ))
        })?;
        self.position += n;
        Ok(bytes)
    }

    fn align(&mut self, size: usize) {
        if self.aligned {
            self.position = self.position.next_multiple_of(size);
        }
    }

    /// The bytes of some primitives.
    fn primitives(&mut self, size: usize, n: usize) -> Result<&'a [u8], Fault> {
        if n == 0 {
            return Ok(&[]);
        }
        self.align(size);
        let total = size.checked_mul(n);
        self.take(total.ok_or_else(|| fault(format!("{n} values cannot be there")))?)
    }

    fn u32(&mut self) -> Result<u32, Fault> {
        self.align(4);
        let bytes = self.data.get(self.position..);
        let Some(bytes) = bytes.and_then(|bytes| bytes.first_chunk::<4>()) else {
            return Err(fault(format!(
                "4 bytes are expected where {} are left",
                self.left()
            )));
        };
        self.position += 4;
        Ok(match self.big_endian {
            true => u32::from_be_bytes(*bytes),
            false => u32::from_le_bytes(*bytes),
        })
    }

    /// How many values a field has, if so many can be there.
    pub(super) fn count(&mut self, count: Count, min_size: usize) -> Result<usize, Fault> {
        let n = match count {
            Count::One => return Ok(1),
            Count::Fixed(n) => n,
            Count::Bounded(_) | Count::Any => usize::try_from(self.u32()?).unwrap_or(usize::MAX),
        };
        if let Count::Bounded(max) = count
            && n > max
        {
            return Err(fault(format!("{n} values, at most {max} are allowed")));
        }
        // Without a size, any number of them would be there.
        if n.saturating_mul(min_size.max(1)) > self.left() {
            return Err(fault(format!(
                "{n} values where {} bytes are left",
                self.left()
            )));
        }
        Ok(n)
    }

    /// The bytes of a text, without a NUL at the end.
    fn text_bytes(&mut self) -> Result<&'a [u8], Fault> {
        let n = usize::try_from(self.u32()?).unwrap_or(usize::MAX);
        let bytes = self.take(n)?;
        match bytes.split_last() {
            _ if !self.aligned => Ok(bytes),
            Some((0, text)) => Ok(text),
            // Some writers leave the NUL of an empty text out.
            None => Ok(bytes),
            Some(_) => Err(fault("a text does not end with NUL")),
        }
    }

    pub(super) fn text(&mut self, bound: Option<usize>) -> Result<&'a str, Fault> {
        let bytes = self.text_bytes()?;
        if let Some(max) = bound
            && bytes.len() > max
        {
            return Err(fault(format!(
                "a text of {} bytes, at most {max} are allowed",
                bytes.len()
            )));
        }
        std::str::from_utf8(bytes).map_err(|_| fault("a text is not UTF-8"))
    }

    /// The bytes of an array of bytes.
    pub(super) fn byte_array(&mut self, n: usize) -> Result<&'a [u8], Fault> {
        self.take(n)
    }

    /// Appends some numbers, flags as 0 and 1.
    pub(super) fn numbers(
        &mut self,
        primitive: Primitive,
        n: usize,
        out: &mut Vec<f64>,
    ) -> Result<(), Fault> {
        let bytes = self.primitives(primitive.size(), n)?;
        let big = self.big_endian;
        match primitive {
            Primitive::Bool => out.extend(bytes.iter().map(|&b| f64::from(u8::from(b != 0)))),
            Primitive::U8 => out.extend(bytes.iter().map(|&b| f64::from(b))),
            Primitive::I8 => each_number!(bytes, i8, big, |v| out.extend(v.map(f64::from))),
            Primitive::I16 => each_number!(bytes, i16, big, |v| out.extend(v.map(f64::from))),
            Primitive::U16 => each_number!(bytes, u16, big, |v| out.extend(v.map(f64::from))),
            Primitive::I32 => each_number!(bytes, i32, big, |v| out.extend(v.map(f64::from))),
            Primitive::U32 => each_number!(bytes, u32, big, |v| out.extend(v.map(f64::from))),
            Primitive::F32 => each_number!(bytes, f32, big, |v| out.extend(v.map(f64::from))),
            Primitive::F64 => each_number!(bytes, f64, big, |v| out.extend(v)),
            Primitive::I64 => each_number!(bytes, i64, big, |v| {
                for value in v {
                    out.push(exact_i64(value)?);
                }
            }),
            Primitive::U64 => each_number!(bytes, u64, big, |v| {
                for value in v {
                    out.push(exact_u64(value)?);
                }
            }),
        }
        Ok(())
    }

    /// Appends some numbers or flags as they are.
    pub(super) fn values(
        &mut self,
        primitive: Primitive,
        n: usize,
        out: &mut Vec<Value>,
    ) -> Result<(), Fault> {
        let bytes = self.primitives(primitive.size(), n)?;
        let big = self.big_endian;
        let int = |v: i64| Value::Int(v);
        let uint = |v: u64| Value::Uint(v);
        match primitive {
            Primitive::Bool => out.extend(bytes.iter().map(|&b| Value::Bool(b != 0))),
            Primitive::U8 => out.extend(bytes.iter().map(|&b| uint(b.into()))),
            Primitive::I8 => {
                each_number!(bytes, i8, big, |v| out.extend(v.map(|v| int(v.into()))));
            }
            Primitive::I16 => {
                each_number!(bytes, i16, big, |v| out.extend(v.map(|v| int(v.into()))));
            }
            Primitive::U16 => {
                each_number!(bytes, u16, big, |v| out.extend(v.map(|v| uint(v.into()))));
            }
            Primitive::I32 => {
                each_number!(bytes, i32, big, |v| out.extend(v.map(|v| int(v.into()))));
            }
            Primitive::U32 => {
                each_number!(bytes, u32, big, |v| out.extend(v.map(|v| uint(v.into()))));
            }
            Primitive::I64 => each_number!(bytes, i64, big, |v| out.extend(v.map(int))),
            Primitive::U64 => each_number!(bytes, u64, big, |v| out.extend(v.map(uint))),
            Primitive::F32 => {
                each_number!(bytes, f32, big, |v| out.extend(v.map(Value::Float32)));
            }
            Primitive::F64 => {
                each_number!(bytes, f64, big, |v| out.extend(v.map(Value::Float64)));
            }
        }
        Ok(())
    }

    /// Reads a time; in ns.
    pub(super) fn time(&mut self, of: &Struct, clock: Clock) -> Result<i64, Fault> {
        let mut parts = [0_i64; 2];
        for (part, field) in parts.iter_mut().zip(&of.fields) {
            let word = self.u32()?;
            *part = match field.kind {
                Kind::Primitive(Primitive::I32) => word.cast_signed().into(),
                _ => word.into(),
            };
        }
        let [seconds, ns] = parts;
        time_ns(seconds, ns, clock == Clock::Time)
    }

    /// The byte that stands for a struct without members, if there is one.
    pub(super) fn dummy(&mut self) {
        if self.aligned && self.left() > 0 {
            self.position += 1;
        }
    }

    /// Passes a value.
    pub(super) fn skip(&mut self, types: &Types, kind: Kind) -> Result<(), Fault> {
        if let Some((size, n)) = types.uniform(kind) {
            return self.primitives(size, n).map(|_| ());
        }
        match kind {
            Kind::Primitive(primitive) => self.primitives(primitive.size(), 1).map(|_| ()),
            Kind::Text(_) => self.text_bytes().map(|_| ()),
            Kind::Struct(place) => {
                let of = types.get(place).filter(|of| of.min_size > 0);
                let Some(of) = of else { return Ok(()) };
                if of.fields.is_empty() {
                    self.dummy();
                }
                of.fields.iter().try_for_each(|field| {
                    self.skip_field(types, field.kind, field.count)
                        .map_err(|fault| fault.in_member(&field.name))
                })
            }
        }
    }

    /// Passes a field with all its values.
    pub(super) fn skip_field(
        &mut self,
        types: &Types,
        kind: Kind,
        count: Count,
    ) -> Result<(), Fault> {
        if count == Count::One {
            return self.skip(types, kind);
        }
        let n = self.count(count, types.min_size(kind))?;
        self.skip_many(types, kind, n)
    }

    /// Passes some values.
    pub(super) fn skip_many(&mut self, types: &Types, kind: Kind, n: usize) -> Result<(), Fault> {
        if let Some((size, each)) = types.uniform(kind) {
            let n = n.checked_mul(each);
            let n = n.ok_or_else(|| fault("more values than can be there"))?;
            return self.primitives(size, n).map(|_| ());
        }
        if types.min_size(kind) == 0 {
            return Ok(());
        }
        (0..n).try_for_each(|_| self.skip(types, kind))
    }

    /// What is left after a whole message: CDR is padded, ROS 1 is not.
    pub(super) fn finish(&self) -> Result<(), Fault> {
        const MAX_PADDING: usize = 7;
        match self.left() {
            0 => Ok(()),
            n if self.aligned && n <= MAX_PADDING => Ok(()),
            n => Err(fault(format!("{n} bytes are left at its end"))),
        }
    }
}
