//! Gymnasium's keyword arguments.

use serde_json::{Map, Value};

use crate::error::EnvironmentError;

/// The keyword arguments given for one environment. Each is asked for by its name, with its default; what nobody
/// asked for is refused in the end.
pub(crate) struct Arguments<'a> {
    id: &'a str,
    given: &'a Map<String, Value>,
    known: Vec<&'static str>,
    /// Those that differ from their default.
    changed: Map<String, Value>,
}

impl<'a> Arguments<'a> {
    pub(crate) fn new(id: &'a str, given: &'a Map<String, Value>) -> Self {
        Self {
            id,
            given,
            known: Vec::new(),
            changed: Map::new(),
        }
    }

    /// A finite number.
    pub(crate) fn number(
        &mut self,
        name: &'static str,
        default: f64,
    ) -> Result<f64, EnvironmentError> {
        self.take(name, default, "a number", Value::as_f64)
    }

    pub(crate) fn flag(
        &mut self,
        name: &'static str,
        default: bool,
    ) -> Result<bool, EnvironmentError> {
        self.take(name, default, "true or false", Value::as_bool)
    }

    /// A number of things, at least one.
    pub(crate) fn count(
        &mut self,
        name: &'static str,
        default: usize,
    ) -> Result<usize, EnvironmentError> {
        self.take(name, default, "a positive whole number", |value| {
            let count = usize::try_from(value.as_u64()?).ok()?;
            (count > 0).then_some(count)
        })
    }

    /// Lower and upper end. JSON has no infinity: it is the text `inf` or `-inf`.
    pub(crate) fn range(
        &mut self,
        name: &'static str,
        default: [f64; 2],
    ) -> Result<[f64; 2], EnvironmentError> {
        let end = |value: &Value| match value.as_str() {
            Some("inf") => Some(f64::INFINITY),
            Some("-inf") => Some(f64::NEG_INFINITY),
            _ => value.as_f64(),
        };
        self.take(name, default, "[low, high] with low <= high", |value| {
            let [low, high] = value.as_array()?.as_slice() else {
                return None;
            };
            let range = [end(low)?, end(high)?];
            (range[0] <= range[1]).then_some(range)
        })
    }

    pub(crate) fn text(
        &mut self,
        name: &'static str,
        default: &str,
    ) -> Result<String, EnvironmentError> {
        let read = |value: &Value| value.as_str().map(str::to_owned);
        self.take(name, default.to_owned(), "a text", read)
    }

    /// An argument of any kind: `read` says whether a given value is as `expected`.
    pub(crate) fn take<T: PartialEq>(
        &mut self,
        name: &'static str,
        default: T,
        expected: &str,
        read: impl Fn(&Value) -> Option<T>,
    ) -> Result<T, EnvironmentError> {
        self.known.push(name);
        let Some(value) = self.given.get(name) else {
            return Ok(default);
        };
        let read = read(value).ok_or_else(|| EnvironmentError::Argument {
            id: self.id.to_owned(),
            name: name.to_owned(),
            expected: expected.to_owned(),
            found: value.to_string(),
        })?;
        if read != default {
            self.changed.insert(name.to_owned(), value.clone());
        }
        Ok(read)
    }

    /// The arguments that differ from their defaults.
    ///
    /// # Errors
    /// An argument that nobody asked for.
    pub(crate) fn finish(self) -> Result<Map<String, Value>, EnvironmentError> {
        match self
            .given
            .iter()
            .find(|(name, _)| !self.known.contains(&name.as_str()))
        {
            None => Ok(self.changed),
            Some((name, value)) => Err(EnvironmentError::Argument {
                id: self.id.to_owned(),
                name: name.clone(),
                expected: format!("one of {}", self.known.join(", ")),
                found: format!("{name}={value}"),
            }),
        }
    }
}
