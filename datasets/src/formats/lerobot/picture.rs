//! What the head of an encoded picture says.

/// Names of the codecs, as [`crate::schema::IMAGE_CODEC`] has them.
pub(super) const JPEG: &str = "jpeg";
pub(super) const PNG: &str = "png";
const PNG_MAGIC: [u8; 8] = *b"\x89PNG\r\n\x1a\n";
const JPEG_MAGIC: [u8; 3] = [0xFF, 0xD8, 0xFF];

/// A picture's codec and size.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Head {
    pub(super) codec: &'static str,
    pub(super) height: usize,
    pub(super) width: usize,
    /// Channels once decoded: 1, 2 (gray with alpha), 3 or 4.
    pub(super) channels: usize,
    /// Bits of a value.
    pub(super) depth: u8,
}

impl Head {
    /// `[height, width, channels]`, without the channels if there is one.
    pub(super) fn shape(&self) -> Vec<usize> {
        match self.channels {
            1 => vec![self.height, self.width],
            channels => vec![self.height, self.width, channels],
        }
    }
}

/// The codec by the first bytes.
pub(super) fn codec(bytes: &[u8]) -> Option<&'static str> {
    if bytes.starts_with(&PNG_MAGIC) {
        return Some(PNG);
    }
    bytes.starts_with(&JPEG_MAGIC).then_some(JPEG)
}

/// Reads the head of a JPEG (ITU T.81, annex B) or PNG (its IHDR chunk); `None` for anything else.
pub(super) fn head(bytes: &[u8]) -> Option<Head> {
    match codec(bytes)? {
        PNG => png(bytes),
        _ => jpeg(bytes),
    }
}

fn png(bytes: &[u8]) -> Option<Head> {
    if bytes.get(12..16)? != b"IHDR" {
        return None;
    }
    let channels = match bytes.get(25)? {
        0 => 1,
        4 => 2,
        2 | 3 => 3,
        6 => 4,
        _ => return None,
    };
    let size = |at: usize| {
        let bytes = bytes.get(at..at + 4)?.try_into().ok()?;
        usize::try_from(u32::from_be_bytes(bytes)).ok()
    };
    Some(Head {
        codec: PNG,
        width: size(16)?,
        height: size(20)?,
        channels,
        depth: *bytes.get(24)?,
    })
}

fn jpeg(bytes: &[u8]) -> Option<Head> {
    let number = |at: usize| {
        let bytes = bytes.get(at..at + 2)?.try_into().ok()?;
        Some(usize::from(u16::from_be_bytes(bytes)))
    };
    let mut at = 2;
    loop {
        if *bytes.get(at)? != 0xFF {
            return None;
        }
        match *bytes.get(at + 1)? {
            // A fill byte.
            0xFF => at += 1,
            // Start of frame, of any kind; C4, C8 and CC are tables.
            0xC0..=0xC3 | 0xC5..=0xC7 | 0xC9..=0xCB | 0xCD..=0xCF => {
                return Some(Head {
                    codec: JPEG,
                    depth: *bytes.get(at + 4)?,
                    height: number(at + 5)?,
                    width: number(at + 7)?,
                    channels: usize::from(*bytes.get(at + 9)?),
                });
            }
            // The scan comes before any frame, or the picture ends.
            0xDA | 0xD9 => return None,
            _ => at += 2 + number(at + 2)?.max(2),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn heads() {
        let mut png = PNG_MAGIC.to_vec();
        png.extend(b"\0\0\0\x0dIHDR\0\0\0\x20\0\0\0\x18\x08\x02");
        let head = super::head(&png).unwrap();
        assert_eq!((head.shape(), head.depth), (vec![24, 32, 3], 8));
        let jpeg = b"\xFF\xD8\xFF\xE0\0\x04ab\xFF\xFF\xC0\0\x11\x08\0\x18\0\x20\x01";
        assert_eq!(super::head(jpeg).unwrap().shape(), [24, 32]);
        for end in 0..png.len() {
            assert_eq!(super::head(&png[..end]), None);
        }
        for end in 0..jpeg.len() {
            assert_eq!(super::head(&jpeg[..end]), None);
        }
    }
}
