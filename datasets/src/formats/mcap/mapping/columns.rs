//! The columns of a mapping, checked one by one and against each other.

use toml::Spanned;

use super::check::Place;
use super::file::{Field, Fields, File, Paths};
use super::{Column, From, Kind, Missing, NamesField, OnMiss, Role, TopicFields};
use crate::error::Result;
use crate::formats::mcap::align::Align;
use crate::schema;

/// All columns in the order of the table. With an index they match by equal time.
pub(super) fn columns(place: &Place<'_>, file: File<Fields>, indexed: bool) -> Result<Vec<Column>> {
    let mut out = Columns {
        place,
        indexed,
        columns: Vec::new(),
    };
    out.add_all(Role::Observation, schema::OBSERVATION, file.observation)?;
    out.add_all(
        Role::Action,
        schema::ACTION,
        file.action.unwrap_or_default(),
    )?;
    let singles = [
        (Role::Reward, schema::REWARD, file.reward),
        (Role::Terminated, schema::TERMINATED, file.terminated),
        (Role::Truncated, schema::TRUNCATED, file.truncated),
    ];
    for (role, name, field) in singles {
        if let Some(field) = field {
            out.add(role, name.to_owned(), &field)?;
        }
    }
    out.add_all(Role::Info, schema::NEXT_OBSERVATION, file.next_observation)?;
    out.add_all(Role::Info, schema::INFO, file.info)?;
    if out.columns.is_empty() {
        return Err(place.fault(
            0..0,
            "there are no columns: add [observation.NAME] and [action.NAME]",
        ));
    }
    out.check_next()?;
    Ok(out.columns)
}

struct Columns<'p> {
    place: &'p Place<'p>,
    indexed: bool,
    columns: Vec<Column>,
}

impl Columns<'_> {
    fn add_all(&mut self, role: Role, root: &str, fields: Fields) -> Result<()> {
        let mut fields: Vec<_> = fields.into_iter().collect();
        fields.sort_by_key(|(_, field)| field.span().start);
        for (name, field) in fields {
            let separator = if name.is_empty() || name.starts_with('[') {
                ""
            } else {
                "."
            };
            self.add(role, format!("{root}{separator}{name}"), &field)?;
        }
        Ok(())
    }

    fn add(&mut self, role: Role, name: String, field: &Spanned<Field>) -> Result<()> {
        let from = self.from(role, field)?;
        let Field {
            required,
            align,
            on_miss,
            kind,
            ..
        } = field.get_ref();
        let is_next = matches!(from, From::NextOf(_));
        let fault = |message: &str| Err(self.place.fault(field.span(), message));
        let is_step = matches!(
            role,
            Role::Action | Role::Reward | Role::Terminated | Role::Truncated
        );
        if self.indexed && (align.is_some() || on_miss.is_some() || required.is_some()) {
            return fault(
                "with [index], columns match by equal time: no `align`, `on_miss`, `required`",
            );
        }
        let required = !self.indexed && required.unwrap_or(true);
        let fallback = if required && !is_next {
            OnMiss::Split
        } else {
            OnMiss::Null
        };
        let on_miss = on_miss.unwrap_or(fallback);
        let may_be_null = on_miss == OnMiss::Null || field.get_ref().missing == Missing::Null;
        if is_step && may_be_null && !self.indexed && !is_next {
            return fault(
                "actions, rewards and flags cannot be null: use \"drop\", \"split\" or \"error\"",
            );
        }
        if *kind == Some(Kind::Image) && align.is_some_and(|align| align == Align::Linear) {
            return fault("there is no picture between two pictures: use another `align`");
        }
        let (align, reach) = self.align(field)?;
        let field = field.get_ref();
        self.columns.push(Column {
            name,
            role,
            from,
            dtype: field.dtype,
            shape: field.shape.clone(),
            unit: field.unit.clone(),
            kind: field.kind,
            align,
            reach,
            on_miss,
            required,
            metadata: field.metadata.clone(),
        });
        Ok(())
    }

    fn align(&self, field: &Spanned<Field>) -> Result<(Align, Option<u64>)> {
        if self.indexed {
            return Ok((Align::Latest, Some(0)));
        }
        let span = field.span();
        let field = field.get_ref();
        let align = field.align.unwrap_or(Align::Latest);
        let (wrong, right, key) = match align {
            Align::Linear => (field.max_age_s, field.max_gap_s, "max_gap_s"),
            _ => (field.max_gap_s, field.max_age_s, "max_age_s"),
        };
        if wrong.is_some() {
            let message = "`max_gap_s` is for `align = \"linear\"`, `max_age_s` for the others";
            return Err(self.place.fault(span, message));
        }
        let reach = right.map(|seconds| self.place.nanoseconds(seconds, key, &span));
        Ok((align, reach.transpose()?))
    }

    fn from(&self, role: Role, field: &Spanned<Field>) -> Result<From> {
        let fault = |message: &str| Err(self.place.fault(field.span(), message));
        let parts = field.get_ref();
        if let Some(of) = &parts.next_of {
            let alone = parts.topic.is_none() && parts.field.is_none() && parts.names.is_none();
            let plain =
                parts.align.is_none() && parts.on_miss.is_none() && parts.required.is_none();
            if role != Role::Action || self.indexed || !alone || !plain {
                return fault(
                    "`next_of` stands alone, in an action: its value is that of an observation",
                );
            }
            let name = format!("{}.{of}", schema::OBSERVATION);
            return match self.columns.iter().position(|column| column.name == name) {
                Some(column) => Ok(From::NextOf(column)),
                None => fault(&format!("`next_of` names no [observation.{of}]")),
            };
        }
        let Some(topic) = parts.topic.clone() else {
            return fault("`topic` is missing");
        };
        let paths = match (&parts.field, parts.kind) {
            (None, Some(Kind::Image)) => Vec::new(),
            (Some(_), Some(Kind::Image)) if !self.indexed => {
                return fault("a picture is a whole message: leave `field` away");
            }
            (None, _) => return fault("`field` is missing: which value of the message"),
            (Some(Paths::One(path)), _) => vec![path.clone()],
            (Some(Paths::Several(paths)), _) if paths.is_empty() => {
                return fault("`field` is an empty list");
            }
            (Some(Paths::Several(paths)), _) => paths.clone(),
        };
        Ok(From::Topic(TopicFields {
            topic,
            paths,
            names: parts.names.clone(),
            names_field: match parts.names_field.as_deref() {
                None if self.indexed => NamesField::None,
                None => NamesField::Beside,
                Some("") => NamesField::None,
                Some(path) => NamesField::Path(path.to_owned()),
            },
            missing: parts.missing,
        }))
    }

    /// An action that is the next observation needs that observation at the very next moment.
    fn check_next(&self) -> Result<()> {
        let next = self.columns.iter().find_map(|column| match column.from {
            From::NextOf(of) => Some(of),
            From::Topic(_) => None,
        });
        let Some(of) = next else {
            return Ok(());
        };
        let fault = |message: &str| Err(self.place.fault(0..0, message));
        if self
            .columns
            .iter()
            .any(|column| column.on_miss == OnMiss::Drop)
        {
            return fault(
                "`next_of` and `on_miss = \"drop\"` exclude each other: the next row would not be the next moment; use \"split\"",
            );
        }
        let nullable = |column: &Column| {
            let missing = match &column.from {
                From::Topic(fields) => fields.missing == Missing::Null,
                From::NextOf(_) => false,
            };
            column.on_miss == OnMiss::Null || missing
        };
        match self.columns.get(of).is_some_and(nullable) {
            true => fault("`next_of` needs an observation that is never null"),
            false => Ok(()),
        }
    }
}
