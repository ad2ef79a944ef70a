//! Columns of numbers as text: little-endian, base64.

use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use serde::Serialize;

/// A column of numbers. Its JSON is `{"type", "base64"}`, the type one of `u8`, `u16`, `u32`, `f32` and `f64`, the
/// bytes little-endian. With `low` and `high` the integers stand for the places between them, evenly: 0 is `low`, the
/// largest of the type is `high`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Column {
    #[serde(rename = "type")]
    kind: &'static str,
    #[serde(skip_serializing_if = "Option::is_none")]
    low: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    high: Option<f64>,
    base64: String,
}

impl Column {
    fn new(kind: &'static str, bytes: &[u8]) -> Self {
        Self {
            kind,
            low: None,
            high: None,
            base64: BASE64_STANDARD.encode(bytes),
        }
    }

    /// Single precision.
    pub fn f32(values: impl Iterator<Item = f64>) -> Self {
        let bytes: Vec<u8> = values
            .flat_map(|value| (value as f32).to_le_bytes())
            .collect();
        Self::new("f32", &bytes)
    }

    /// Single precision that stays on its side of a border: what is within, as told, is not rounded beyond it, nor the
    /// other way round.
    pub fn beside(values: impl Iterator<Item = (f64, bool)>, border: f64) -> Self {
        let rounded = |(value, is_within): (f64, bool)| {
            let single = (value as f32).min(f32::MAX);
            match f64::from(single) <= border {
                true if !is_within => single.next_up(),
                false if is_within => single.next_down(),
                _ => single,
            }
        };
        let bytes: Vec<u8> = values
            .flat_map(|value| rounded(value).to_le_bytes())
            .collect();
        Self::new("f32", &bytes)
    }

    /// Bytes as they are.
    pub fn u8(values: &[u8]) -> Self {
        Self::new("u8", values)
    }

    /// Whole numbers exactly, in the smallest type that holds them all; beyond 2⁵³ to the nearest double.
    pub fn integers(values: &[i64]) -> Self {
        let fits = |most: u32| {
            values
                .iter()
                .all(|value| (0..=i64::from(most)).contains(value))
        };
        if fits(u32::from(u16::MAX)) {
            let bytes: Vec<u8> = values
                .iter()
                .flat_map(|value| (*value as u16).to_le_bytes())
                .collect();
            Self::new("u16", &bytes)
        } else if fits(u32::MAX) {
            let bytes: Vec<u8> = values
                .iter()
                .flat_map(|value| (*value as u32).to_le_bytes())
                .collect();
            Self::new("u32", &bytes)
        } else {
            let bytes: Vec<u8> = values
                .iter()
                .flat_map(|value| (*value as f64).to_le_bytes())
                .collect();
            Self::new("f64", &bytes)
        }
    }

    /// Places between `low` and `high` to 1/65535 of the way; what lies outside is moved to the nearer end.
    pub fn places(values: impl Iterator<Item = f64>, [low, high]: [f64; 2]) -> Self {
        let most = f64::from(u16::MAX);
        let place = |value: f64| {
            ((value - low) / (high - low) * most)
                .round()
                .clamp(0.0, most)
        };
        let bytes: Vec<u8> = values
            .flat_map(|value| (place(value) as u16).to_le_bytes())
            .collect();
        Self {
            low: Some(low),
            high: Some(high),
            ..Self::new("u16", &bytes)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn json(column: &Column) -> String {
        serde_json::to_string(column).unwrap()
    }

    #[test]
    fn numbers_take_the_smallest_type_that_holds_them() {
        assert_eq!(
            json(&Column::integers(&[1, 256])),
            r#"{"type":"u16","base64":"AQAAAQ=="}"#
        );
        assert!(json(&Column::integers(&[65_536])).contains("u32"));
        assert!(json(&Column::integers(&[-1])).contains("f64"));
        assert!(json(&Column::integers(&[])).contains("u16"));
        assert_eq!(
            json(&Column::f32([1.0].into_iter())),
            r#"{"type":"f32","base64":"AACAPw=="}"#
        );
    }

    #[test]
    fn rounding_does_not_cross_the_border() {
        // 0.1 lies between two singles, 0.3 as well.
        for border in [0.1, 0.3, 0.5] {
            let near = [border * (1.0 - 1e-12), border, border * (1.0 + 1e-12)];
            let column = Column::beside(
                near.map(|value| (value, value <= border)).into_iter(),
                border,
            );
            let bytes = BASE64_STANDARD.decode(&column.base64).unwrap();
            let singles = bytes
                .chunks_exact(4)
                .map(|b| f32::from_le_bytes(b.try_into().unwrap()));
            let within: Vec<bool> = singles.map(|single| f64::from(single) <= border).collect();
            assert_eq!(within, [true, true, false]);
        }
    }

    #[test]
    fn places_reach_from_end_to_end_and_not_beyond() {
        let column = Column::places([-5.0, 0.0, 2.0, 9.0].into_iter(), [0.0, 4.0]);
        assert_eq!(
            json(&column),
            r#"{"type":"u16","low":0.0,"high":4.0,"base64":"AAAAAACA//8="}"#
        );
    }
}
