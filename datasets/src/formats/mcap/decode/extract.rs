//! Where extracted values go.

/// The fields taken out of a message, one slot for each path of the plan.
///
/// Make one with [`Extracted::default`] and use it for all messages.
#[derive(Debug, Clone, Default)]
pub struct Extracted {
    slots: Vec<Slot>,
}

impl Extracted {
    /// The slots, in the order of the plan's paths.
    pub fn slots(&self) -> &[Slot] {
        &self.slots
    }
}

/// The values of one field.
///
/// Which of the accessors has something depends on the field's kind: `Number` and `Bool` give
/// [`Self::numbers`], `Text` gives [`Self::texts`], `Bytes` gives [`Self::bytes`], `Time` and `Duration` give
/// [`Self::time_ns`].
#[derive(Debug, Clone, Default)]
pub struct Slot {
    present: bool,
    numbers: Vec<f64>,
    text: String,
    text_ends: Vec<usize>,
    bytes: Vec<u8>,
    time_ns: Option<i64>,
}

impl Slot {
    /// Whether the message has the field. Absent are: an index beyond the array's end, unset `optional` fields
    /// and unset submessages of Protobuf, missing members and `null` of JSON, and a time stamp of zero.
    /// An empty array is present.
    pub fn present(&self) -> bool {
        self.present
    }

    /// The numbers: one, or as many as the array holds. Members of an array of structs (`joints[].velocity`)
    /// are one for each element; where an element lacks the member, the number is NaN.
    pub fn numbers(&self) -> &[f64] {
        &self.numbers
    }

    /// The texts: one, or as many as the array holds.
    pub fn texts(&self) -> impl ExactSizeIterator<Item = &str> {
        (0..self.text_ends.len()).map(|i| {
            let start = i.checked_sub(1).and_then(|i| self.text_ends.get(i));
            let end = self.text_ends.get(i).copied().unwrap_or_default();
            self.text
                .get(start.copied().unwrap_or(0)..end)
                .unwrap_or_default()
        })
    }

    /// The bytes.
    pub fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// The time in ns since the epoch, or the duration in ns.
    pub fn time_ns(&self) -> Option<i64> {
        self.time_ns
    }
}
