//! Base64 with padding (RFC 4648, section 4): how JSON messages carry bytes.

const ALPHABET: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";

/// Bytes as text.
pub(crate) fn encode(bytes: &[u8]) -> String {
    let mut text = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for group in bytes.chunks(3) {
        let bits = (0..3).fold(0u32, |bits, i| {
            bits << 8 | u32::from(group.get(i).copied().unwrap_or(0))
        });
        for i in 0..4 {
            let six = (bits >> (18 - 6 * i) & 63) as usize;
            text.push(match i <= group.len() {
                true => char::from(ALPHABET[six]),
                false => '=',
            });
        }
    }
    text
}

/// Text as bytes; `None` if it is not base64.
pub(crate) fn decode(text: &str) -> Option<Vec<u8>> {
    let text = text.as_bytes();
    if !text.len().is_multiple_of(4) {
        return None;
    }
    let mut bytes = Vec::with_capacity(text.len() / 4 * 3);
    for (at, group) in text.chunks(4).enumerate() {
        let is_last = (at + 1) * 4 == text.len();
        let n_padding = group.iter().rev().take_while(|&&c| c == b'=').count();
        if n_padding > 2 || (n_padding > 0 && !is_last) {
            return None;
        }
        let mut bits = 0u32;
        for &c in group.iter().take(4 - n_padding) {
            let six = ALPHABET.iter().position(|&known| known == c)?;
            bits = bits << 6 | u32::try_from(six).ok()?;
        }
        bits <<= 6 * n_padding;
        bytes.extend_from_slice(bits.to_be_bytes().get(1..4 - n_padding)?);
    }
    Some(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_examples_of_the_standard() {
        let examples = [
            ("", ""),
            ("f", "Zg=="),
            ("fo", "Zm8="),
            ("foo", "Zm9v"),
            ("foobar", "Zm9vYmFy"),
        ];
        for (plain, text) in examples {
            assert_eq!(encode(plain.as_bytes()), text);
            assert_eq!(decode(text).as_deref(), Some(plain.as_bytes()));
        }
        for bad in ["Zg=", "Z===", "Zg==Zg==", "Z!==", "=AAA"] {
            assert_eq!(decode(bad), None, "{bad}");
        }
    }
}
