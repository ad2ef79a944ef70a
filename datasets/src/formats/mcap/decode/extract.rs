//! Where extracted values go.

/// The fields taken out of a message, one slot for each path of the plan.
///
/// Make one with [`Extracted::default`] and use it for all messages.
#[derive(Debug, Clone, Default)]
pub struct Extracted {
    slots: Vec<Slot>,
    /// How often repeated fields were met so far (Protobuf).
    counters: Vec<usize>,
}

impl Extracted {
    /// The slots, in the order of the plan's paths.
    pub fn slots(&self) -> &[Slot] {
        &self.slots
    }

    /// Empties everything for the next message.
    pub(super) fn start(
        &mut self,
        n_slots: usize,
        n_counters: usize,
    ) -> (&mut [Slot], &mut [usize]) {
        self.slots.resize_with(n_slots, Slot::default);
        self.slots.iter_mut().for_each(Slot::clear);
        self.counters.clear();
        self.counters.resize(n_counters, 0);
        (&mut self.slots, &mut self.counters)
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
    /// are one for each element; where an element lacks the member, the number is
    /// NaN.
    pub fn numbers(&self) -> &[f64] {
        &self.numbers
    }

    /// The texts: one, or as many as the array holds. Those of members of an array of structs are one for each
    /// element; where a Protobuf element lacks the member, the text is empty.
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

    /// Empties it, keeping its buffers.
    pub(super) fn clear(&mut self) {
        self.present = false;
        self.numbers.clear();
        self.text.clear();
        self.text_ends.clear();
        self.bytes.clear();
        self.time_ns = None;
    }

    pub(super) fn mark_present(&mut self) {
        self.present = true;
    }

    /// Where numbers are appended that are there.
    pub(super) fn numbers_mut(&mut self) -> &mut Vec<f64> {
        self.present = true;
        &mut self.numbers
    }

    pub(super) fn add_number(&mut self, value: f64) {
        self.present = true;
        self.numbers.push(value);
    }

    pub(super) fn add_text(&mut self, text: &str) {
        self.present = true;
        self.text.push_str(text);
        self.text_ends.push(self.text.len());
    }

    pub(super) fn set_bytes(&mut self, bytes: &[u8]) {
        self.present = true;
        self.bytes.clear();
        self.bytes.extend_from_slice(bytes);
    }

    /// Sets a time; `None` for one that was never set.
    pub(super) fn set_time(&mut self, ns: Option<i64>) {
        self.present = ns.is_some();
        self.time_ns = ns;
    }

    /// How many values it has.
    pub(super) fn len(&self) -> usize {
        self.numbers.len().max(self.text_ends.len())
    }

    /// Drops the value at a place, with those after it, if there is one after that: a field given twice has the
    /// last value.
    pub(super) fn keep_last_from(&mut self, place: usize) {
        if let Some(&last) = self.numbers.last()
            && self.numbers.len() > place + 1
        {
            self.numbers.truncate(place);
            self.numbers.push(last);
        }
        if self.text_ends.len() > place + 1 {
            let end_of = |count: usize| {
                let before = count.checked_sub(1).and_then(|i| self.text_ends.get(i));
                before.copied().unwrap_or_default()
            };
            let (start, last) = (end_of(place), end_of(self.text_ends.len() - 1));
            self.text.replace_range(start..last, "");
            self.text_ends.truncate(place);
            self.text_ends.push(self.text.len());
        }
    }
}
