//! Pictures in messages: encoded bytes pass through, raw pixels become tensors.

use arrow::datatypes::DataType;

use super::decode::{FieldDescription, FieldKind, FieldPath, Slot};
use crate::error::{DatasetError, Result};

const PNG: &[u8] = b"\x89PNG\r\n\x1a\n";
const JPEG: &[u8] = b"\xff\xd8\xff";
/// Bytes before the PNG of `compressedDepth`: how depth was quantized.
const DEPTH_HEADER: usize = 12;

/// How a message holds a picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum PictureKind {
    /// `format` and `data`: a JPEG or PNG file.
    Encoded,
    /// `height`, `width`, `encoding`, `step` and `data`: pixels.
    Raw { has_endianness: bool },
}

/// What is known of a picture.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct PictureLayout {
    /// `jpeg` or `png`; `None` for pixels.
    pub(crate) codec: Option<&'static str>,
    /// Encoding of the pixels in the message, such as `bgr8`.
    pub(crate) encoding: Option<String>,
    /// (H, W) or (H, W, C).
    pub(crate) shape: Vec<usize>,
    pub(crate) value_type: DataType,
}

impl PictureKind {
    /// Tells from the fields of a message type.
    ///
    /// # Errors
    /// It is no picture.
    pub(crate) fn of(fields: &[FieldDescription]) -> Result<Self> {
        let has = |path: &str| fields.iter().any(|field| field.path == path);
        let has_data = fields
            .iter()
            .any(|field| field.path == "data" && field.kind == FieldKind::Bytes);
        match has_data {
            true if ["height", "width", "encoding", "step"].iter().all(|p| has(p)) => {
                Ok(Self::Raw {
                    has_endianness: has("is_bigendian"),
                })
            }
            true if has("format") => Ok(Self::Encoded),
            _ => Err(DatasetError::Unsupported {
                what: "a picture in a message that has neither `format` and `data` nor `height`, `width`, `encoding`, `step` and `data`".to_owned(),
            }),
        }
    }

    /// The fields that are read, in the order of the slots of [`Self::read`].
    pub(crate) fn paths(self) -> Result<Vec<FieldPath>> {
        let mut names = match self {
            Self::Encoded => vec!["format", "data"],
            Self::Raw { .. } => vec!["encoding", "data", "height", "width", "step"],
        };
        if self
            == (Self::Raw {
                has_endianness: true,
            })
        {
            names.push("is_bigendian");
        }
        names.into_iter().map(str::parse).collect()
    }

    /// Looks at a picture; the text says what is wrong with it.
    pub(crate) fn layout(self, slots: &[Slot]) -> Result<PictureLayout, String> {
        match self {
            Self::Encoded => {
                let (codec, bytes) = encoded(slots)?;
                let shape = match codec {
                    "png" => png_shape(bytes),
                    _ => jpeg_shape(bytes),
                };
                Ok(PictureLayout {
                    codec: Some(codec),
                    encoding: None,
                    shape: shape.ok_or_else(|| format!("its {codec} header is cut short"))?,
                    value_type: DataType::Binary,
                })
            }
            Self::Raw { .. } => Raw::new(slots).map(|raw| PictureLayout {
                codec: None,
                encoding: Some(raw.encoding.to_owned()),
                shape: raw.shape(),
                value_type: raw.pixel.value_type.clone(),
            }),
        }
    }

    /// Appends the bytes of a picture, which must be like `layout`; the text says how it is not.
    pub(crate) fn read(
        self,
        slots: &[Slot],
        layout: &PictureLayout,
        out: &mut Vec<u8>,
    ) -> Result<(), String> {
        if self == Self::Encoded {
            let (codec, bytes) = encoded(slots)?;
            if layout.codec != Some(codec) {
                let expected = layout.codec.unwrap_or("raw pixels");
                return Err(format!("a {codec} picture, expected {expected} as before"));
            }
            out.extend_from_slice(bytes);
            return Ok(());
        }
        let raw = Raw::new(slots)?;
        if layout.encoding.as_deref() != Some(raw.encoding) || layout.shape != raw.shape() {
            return Err(format!(
                "a picture of shape {:?} and encoding {}, expected {:?} and {} as before",
                raw.shape(),
                raw.encoding,
                layout.shape,
                layout.encoding.as_deref().unwrap_or("none"),
            ));
        }
        raw.read(out);
        Ok(())
    }
}

fn text(slots: &[Slot], at: usize) -> &str {
    let slot = slots.get(at);
    slot.and_then(|slot| slot.texts().next())
        .unwrap_or_default()
}

fn encoded(slots: &[Slot]) -> Result<(&'static str, &[u8]), String> {
    let format = text(slots, 0);
    let mut bytes = slots.get(1).map(Slot::bytes).unwrap_or_default();
    if format.contains("compressedDepth") {
        bytes = bytes.get(DEPTH_HEADER..).unwrap_or_default();
    }
    match bytes {
        _ if bytes.starts_with(JPEG) => Ok(("jpeg", bytes)),
        _ if bytes.starts_with(PNG) => Ok(("png", bytes)),
        _ => Err(format!(
            "a picture of format \"{}\" that is neither JPEG nor PNG",
            format.escape_debug()
        )),
    }
}

fn png_shape(bytes: &[u8]) -> Option<Vec<usize>> {
    let number = |at: usize| -> Option<usize> {
        let bytes: [u8; 4] = bytes.get(at..at + 4)?.try_into().ok()?;
        usize::try_from(u32::from_be_bytes(bytes)).ok()
    };
    let channels = match bytes.get(25)? {
        0 => return Some(vec![number(20)?, number(16)?]),
        4 => 2,
        6 => 4,
        _ => 3,
    };
    Some(vec![number(20)?, number(16)?, channels])
}

/// Finds the frame header (ITU-T T.81, B.2.2).
fn jpeg_shape(bytes: &[u8]) -> Option<Vec<usize>> {
    let byte = |at: usize| bytes.get(at).copied().map(usize::from);
    let number = |at: usize| Some(byte(at)? << 8 | byte(at + 1)?);
    let mut at = 2;
    loop {
        while byte(at)? == 0xff && byte(at + 1)? == 0xff {
            at += 1;
        }
        if byte(at)? != 0xff {
            return None;
        }
        match byte(at + 1)? {
            0x01 | 0xd0..=0xd8 => at += 2,
            0xc4 | 0xc8 | 0xcc => at += 2 + number(at + 2)?,
            0xc0..=0xcf => {
                let (height, width) = (number(at + 5)?, number(at + 7)?);
                return Some(match byte(at + 9)? {
                    1 => vec![height, width],
                    channels => vec![height, width, channels],
                });
            }
            _ => at += 2 + number(at + 2)?,
        }
    }
}

/// One pixel of an encoding.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Pixel {
    value_type: DataType,
    value_bytes: usize,
    channels: usize,
    /// Blue comes first; columns hold red first.
    is_bgr: bool,
}

impl Pixel {
    /// The encodings of `sensor_msgs/image_encodings.h` that are plain arrays.
    fn of(encoding: &str) -> Option<Self> {
        let (value_type, channels, is_bgr) = match encoding {
            "rgb8" | "8UC3" => (DataType::UInt8, 3, false),
            "bgr8" => (DataType::UInt8, 3, true),
            "rgba8" | "8UC4" => (DataType::UInt8, 4, false),
            "bgra8" => (DataType::UInt8, 4, true),
            "mono8" | "8UC1" => (DataType::UInt8, 1, false),
            "mono16" | "16UC1" => (DataType::UInt16, 1, false),
            "rgb16" | "16UC3" => (DataType::UInt16, 3, false),
            "32FC1" => (DataType::Float32, 1, false),
            _ => return None,
        };
        Some(Self {
            value_bytes: value_type.primitive_width()?,
            value_type,
            channels,
            is_bgr,
        })
    }
}

/// Pixels that were found to be all there.
struct Raw<'s> {
    encoding: &'s str,
    pixel: Pixel,
    height: usize,
    width: usize,
    step: usize,
    data: &'s [u8],
    is_big_endian: bool,
}

impl<'s> Raw<'s> {
    fn new(slots: &'s [Slot]) -> Result<Self, String> {
        let encoding = text(slots, 0);
        let pixel = Pixel::of(encoding).ok_or_else(|| {
            format!(
                "pixels of encoding \"{}\", which is not read",
                encoding.escape_debug()
            )
        })?;
        let number = |at: usize| {
            let number = slots.get(at).and_then(|slot| slot.numbers().first());
            // Counts are u32, so the cast is exact.
            number.map_or(0, |number| *number as usize)
        };
        let raw = Self {
            height: number(2),
            width: number(3),
            step: number(4),
            data: slots.get(1).map(Slot::bytes).unwrap_or_default(),
            is_big_endian: number(5) != 0,
            encoding,
            pixel,
        };
        let row = raw.row_bytes();
        let needed = raw.height.checked_mul(raw.step);
        if raw.step < row
            || row == 0
            || raw.height == 0
            || needed.is_none_or(|n| n > raw.data.len())
        {
            return Err(format!(
                "a picture of {} rows of {} bytes ({} pixels {encoding}) in {} bytes",
                raw.height,
                raw.step,
                raw.width,
                raw.data.len()
            ));
        }
        Ok(raw)
    }

    fn row_bytes(&self) -> usize {
        let pixel = self.pixel.channels * self.pixel.value_bytes;
        self.width.saturating_mul(pixel)
    }

    fn shape(&self) -> Vec<usize> {
        match self.pixel.channels {
            1 => vec![self.height, self.width],
            channels => vec![self.height, self.width, channels],
        }
    }

    /// Rows without their padding, red first, in native byte order.
    fn read(&self, out: &mut Vec<u8>) {
        let start = out.len();
        for row in self.data.chunks(self.step).take(self.height) {
            out.extend_from_slice(&row[..self.row_bytes().min(row.len())]);
        }
        let pixels = out.get_mut(start..).unwrap_or_default();
        if self.pixel.is_bgr {
            for pixel in pixels.chunks_exact_mut(self.pixel.channels) {
                pixel.swap(0, 2);
            }
        }
        if self.pixel.value_bytes > 1 && self.is_big_endian != cfg!(target_endian = "big") {
            for value in pixels.chunks_exact_mut(self.pixel.value_bytes) {
                value.reverse();
            }
        }
    }
}
