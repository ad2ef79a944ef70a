//! Which column of a file plays which part.

use std::collections::BTreeSet;
use std::sync::Arc;

use arrow::datatypes::{DataType, Field, FieldRef, Schema};

use super::names::{
    ACTION, ColumnNames, EPISODE, OBSERVATION, OBSERVATION_LAST, REWARD, STEP, TERMINATED,
    TRUNCATED,
};
use crate::error::{DatasetError, Result};
use crate::schema;
use crate::source::Warning;

/// What is done to a column on its way into the canonical layout.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Conversion {
    /// Nothing.
    None,
    /// An integer number to `Int64`, without nulls.
    Index,
    /// A text to the number of its first appearance, as `Int64`.
    Name,
    /// A list column to a `FixedSizeList`.
    List,
    /// A flag in any numeric type to a boolean.
    Flag,
}

/// One column of the canonical layout and where it comes from.
#[derive(Debug, Clone)]
pub(crate) struct ColumnPlan {
    /// Place of the source column among the file's columns.
    pub(crate) source: usize,
    /// The canonical field. Its list size is 0 until the first row was seen.
    pub(crate) field: FieldRef,
    /// What is done to it.
    pub(crate) conversion: Conversion,
    /// Whether nulls are refused (observations), or allowed in the last row of an episode (actions).
    pub(crate) role: Role,
}

/// The part a column plays.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Role {
    /// Episode number.
    Episode,
    /// Step number.
    Step,
    /// Part of the observation: never null.
    Observation,
    /// Part of the action: null only in a final-observation row.
    Action,
    /// Anything else.
    Other,
}

/// The plan of a whole file.
#[derive(Debug)]
pub(crate) struct FilePlan {
    pub(crate) columns: Vec<ColumnPlan>,
    pub(crate) warnings: Vec<Warning>,
}

impl FilePlan {
    /// Finds each part among the columns of `file`.
    ///
    /// # Errors
    /// A named column that is missing or has a type that cannot serve; no observation or action column.
    pub(crate) fn new(file: &Schema, names: &ColumnNames) -> Result<Self> {
        let mut planner = Planner {
            file,
            columns: Vec::new(),
            warnings: Vec::new(),
        };
        planner.scalar(
            Role::Episode,
            names.episode.as_deref(),
            EPISODE,
            schema::EPISODE_INDEX,
        )?;
        if planner.columns.is_empty() {
            planner.warnings.push(Warning::NoEpisodeColumn);
        }
        planner.scalar(Role::Step, names.step.as_deref(), STEP, schema::STEP_INDEX)?;
        let usual = (OBSERVATION, OBSERVATION_LAST);
        planner.leaves(Role::Observation, &names.observation, usual)?;
        planner.leaves(Role::Action, &names.action, (ACTION, &[]))?;
        planner.scalar(Role::Other, names.reward.as_deref(), REWARD, schema::REWARD)?;
        planner.scalar(
            Role::Other,
            names.terminated.as_deref(),
            TERMINATED,
            schema::TERMINATED,
        )?;
        planner.scalar(
            Role::Other,
            names.truncated.as_deref(),
            TRUNCATED,
            schema::TRUNCATED,
        )?;
        planner.rest();
        planner.check_names()?;
        Ok(Self {
            columns: planner.columns,
            warnings: planner.warnings,
        })
    }
}

struct Planner<'a> {
    file: &'a Schema,
    columns: Vec<ColumnPlan>,
    warnings: Vec<Warning>,
}

impl Planner<'_> {
    /// Whether all of a column is in the plan; the text of an episode is not in its number.
    fn is_used(&self, source: usize) -> bool {
        let mut columns = self.columns.iter();
        columns.any(|column| column.source == source && column.conversion != Conversion::Name)
    }

    fn find(&self, name: &str, role: &'static str) -> Result<usize> {
        self.file
            .index_of(name)
            .map_err(|_| self.missing(role, format!("\"{name}\"")))
    }

    fn missing(&self, role: &'static str, name: String) -> DatasetError {
        DatasetError::MissingColumn {
            role,
            name,
            found: schema::column_names(self.file),
        }
    }

    /// A column with one value a row, named or detected; not finding one is no error.
    fn scalar(
        &mut self,
        role: Role,
        named: Option<&str>,
        usual: &[&str],
        canonical: &'static str,
    ) -> Result<()> {
        let source = match named {
            Some(name) => self.find(name, canonical)?,
            None => match usual.iter().find_map(|name| self.file.index_of(name).ok()) {
                Some(source) => source,
                None => return Ok(()),
            },
        };
        let field = self.file.field(source);
        let data_type = field.data_type();
        let wrong = |expected| DatasetError::WrongType {
            key: field.name().clone(),
            actual: data_type.to_string(),
            expected,
        };
        let (target, conversion) = match (role, canonical) {
            (Role::Episode | Role::Step, _) if data_type.is_integer() => (
                Field::new(canonical, DataType::Int64, false),
                Conversion::Index,
            ),
            (Role::Episode, _) if is_text(data_type) => (
                Field::new(canonical, DataType::Int64, false),
                Conversion::Name,
            ),
            (Role::Episode, _) => return Err(wrong("integers or text")),
            (Role::Step, _) => return Err(wrong("integers")),
            (_, schema::REWARD) if schema::is_number(data_type) => (
                Field::new(canonical, data_type.clone(), true),
                Conversion::None,
            ),
            (_, schema::REWARD) => return Err(wrong("numbers")),
            _ if schema::is_number(data_type) || *data_type == DataType::Boolean => (
                Field::new(canonical, DataType::Boolean, true),
                Conversion::Flag,
            ),
            _ => return Err(wrong("flags")),
        };
        self.columns.push(ColumnPlan {
            source,
            field: Arc::new(with_metadata_of(field, target)),
            conversion,
            role,
        });
        Ok(())
    }

    fn leaves(&mut self, role: Role, named: &[String], usual: (&[&str], &[&str])) -> Result<()> {
        let root = if role == Role::Observation {
            schema::OBSERVATION
        } else {
            schema::ACTION
        };
        let mut found = 0;
        if named.is_empty() {
            for source in self.detect_leaves(root, usual) {
                match leaf_plan(
                    self.file.field(source),
                    self.file.field(source).name(),
                    source,
                    role,
                ) {
                    Some(plan) => {
                        let single = usual
                            .0
                            .iter()
                            .chain(usual.1)
                            .any(|name| name == plan.field.name());
                        self.columns
                            .push(if single { plan.renamed(root) } else { plan });
                        found += 1;
                    }
                    None => self.leave_out(source),
                }
            }
        }
        for name in named {
            let source = self.find(name, root)?;
            let target = match named.len() {
                _ if schema::belongs_to(name, root) => name.clone(),
                1 => root.to_owned(),
                _ => schema::join_key(root, name),
            };
            let field = self.file.field(source);
            let plan =
                leaf_plan(field, &target, source, role).ok_or_else(|| DatasetError::WrongType {
                    key: name.clone(),
                    actual: field.data_type().to_string(),
                    expected: "numbers or lists of numbers",
                })?;
            self.columns.push(plan);
            found += 1;
        }
        if found == 0 {
            let tried = usual
                .0
                .iter()
                .chain(usual.1)
                .map(|name| format!("\"{name}\""));
            return Err(self.missing(root, tried.collect::<Vec<_>>().join(" or ")));
        }
        Ok(())
    }

    /// One column with a usual name, else all columns under the root's prefix, else a last resort.
    fn detect_leaves(&self, root: &str, usual: (&[&str], &[&str])) -> Vec<usize> {
        let first = |names: &[&str]| names.iter().find_map(|name| self.file.index_of(name).ok());
        if let Some(source) = first(usual.0) {
            return vec![source];
        }
        let under_root: Vec<usize> = (0..self.file.fields().len())
            .filter(|&source| schema::belongs_to(self.file.field(source).name(), root))
            .collect();
        if under_root.is_empty() {
            first(usual.1).into_iter().collect()
        } else {
            under_root
        }
    }

    fn leave_out(&mut self, source: usize) {
        self.warnings.push(Warning::ColumnLeftOut {
            column: self.file.field(source).name().clone(),
            reason: "its type is neither numbers, lists of numbers, text nor an encoded picture",
        });
    }

    /// Columns are told apart by their names, in the file and in the canonical layout.
    fn check_names(&self) -> Result<()> {
        let file = self.file.fields().iter().map(|field| field.name());
        let canonical = self.columns.iter().map(|column| column.field.name());
        match first_twice(file).or_else(|| first_twice(canonical)) {
            Some(name) => Err(DatasetError::corrupt(format!("two columns are \"{name}\""))),
            None => Ok(()),
        }
    }

    /// Passes everything else on under `info`.
    fn rest(&mut self) {
        for source in 0..self.file.fields().len() {
            let field = self.file.field(source);
            let name = field.name();
            let left_out = self.warnings.iter().any(
                |warning| matches!(warning, Warning::ColumnLeftOut { column, .. } if column == name),
            );
            if self.is_used(source) || left_out {
                continue;
            }
            let keeps_name = schema::belongs_to(name, schema::INFO)
                || schema::belongs_to(name, schema::NEXT_OBSERVATION)
                || name == schema::T_NS;
            let target = if keeps_name {
                name.clone()
            } else {
                schema::join_key(schema::INFO, name)
            };
            let plan =
                leaf_plan(field, &target, source, Role::Other).unwrap_or_else(|| ColumnPlan {
                    source,
                    field: Arc::new(field.clone().with_name(target).with_nullable(true)),
                    conversion: Conversion::None,
                    role: Role::Other,
                });
            // Ragged lists are fine outside observation and action.
            let plan = if plan.conversion == Conversion::List {
                let field = field
                    .clone()
                    .with_name(plan.field.name().clone())
                    .with_nullable(true);
                ColumnPlan {
                    field: Arc::new(field),
                    conversion: Conversion::None,
                    ..plan
                }
            } else {
                plan
            };
            self.columns.push(plan);
        }
    }
}

impl ColumnPlan {
    fn renamed(self, name: &str) -> Self {
        Self {
            field: Arc::new(self.field.as_ref().clone().with_name(name)),
            ..self
        }
    }
}

fn first_twice<'n>(names: impl Iterator<Item = &'n String>) -> Option<&'n String> {
    let mut seen = BTreeSet::new();
    names.into_iter().find(|name| !seen.insert(*name))
}

fn is_text(data_type: &DataType) -> bool {
    matches!(
        data_type,
        DataType::Utf8 | DataType::LargeUtf8 | DataType::Utf8View
    )
}

/// Keeps what a column says about itself, but for the numbers Parquet gives its fields.
fn with_metadata_of(field: &Field, target: Field) -> Field {
    let mut metadata = field.metadata().clone();
    metadata.retain(|key, _| !key.starts_with("PARQUET:"));
    metadata.extend(target.metadata().clone());
    target.with_metadata(metadata)
}

/// How a leaf column is read, or `None` if its type cannot be one.
fn leaf_plan(field: &Field, target: &str, source: usize, role: Role) -> Option<ColumnPlan> {
    let nullable = role != Role::Observation;
    let (canonical, conversion) = match field.data_type() {
        DataType::List(child) | DataType::LargeList(child)
            if schema::is_number(child.data_type()) =>
        {
            (
                schema::leaf_field(target, child.data_type().clone(), &[0], nullable),
                Conversion::List,
            )
        }
        _ => {
            let (data_type, shape) = schema::row_shape(field)?;
            let canonical = match data_type {
                DataType::Binary => field.clone().with_name(target).with_nullable(true),
                _ => with_metadata_of(
                    field,
                    schema::leaf_field(target, data_type, &shape, nullable),
                ),
            };
            (canonical, Conversion::None)
        }
    };
    Some(ColumnPlan {
        source,
        field: Arc::new(canonical),
        conversion,
        role,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn list(name: &str) -> Field {
        Field::new(
            name,
            DataType::List(schema::element(DataType::Float32)),
            true,
        )
    }

    fn names(plan: &FilePlan) -> Vec<&str> {
        plan.columns
            .iter()
            .map(|column| column.field.name().as_str())
            .collect()
    }

    #[test]
    fn usual_names_are_found_and_the_rest_becomes_info() {
        let file = Schema::new(vec![
            Field::new("episode_id", DataType::Int32, true),
            Field::new("planner", DataType::Utf8, true),
            list("obs"),
            list("actions"),
            Field::new("done", DataType::UInt8, true),
            Field::new("a.b", DataType::Int8, true),
        ]);
        let plan = FilePlan::new(&file, &ColumnNames::default()).unwrap();
        let expected = [
            "episode_index",
            "observation",
            "action",
            "terminated",
            "info.planner",
            "info.a~1b",
        ];
        assert_eq!(names(&plan), expected);
    }

    #[test]
    fn leaves_under_the_prefix_are_taken_together() {
        let file = Schema::new(vec![
            list("observation.state"),
            Field::new(
                "observation.image",
                DataType::Struct(Vec::<FieldRef>::new().into()),
                true,
            ),
            list("action"),
        ]);
        let plan = FilePlan::new(&file, &ColumnNames::default()).unwrap();
        assert_eq!(names(&plan), ["observation.state", "action"]);
        assert_eq!(plan.warnings.len(), 2);
    }

    #[test]
    fn what_is_missing_or_unfit_is_named() {
        let file = Schema::new(vec![
            Field::new("x", DataType::Float32, true),
            list("action"),
        ]);
        let error = FilePlan::new(&file, &ColumnNames::default()).unwrap_err();
        assert!(
            error
                .to_string()
                .contains("no observation column \"observation\" or"),
            "{error}"
        );
        let wrong = ColumnNames {
            observation: vec!["y".into()],
            ..ColumnNames::default()
        };
        let error = FilePlan::new(&file, &wrong).unwrap_err().to_string();
        assert_eq!(error, "no observation column \"y\"; columns are x, action");
        let float = Schema::new(vec![
            Field::new("episode", DataType::Float64, true),
            list("obs"),
            list("act"),
        ]);
        let error = FilePlan::new(&float, &ColumnNames::default()).unwrap_err();
        assert!(matches!(error, DatasetError::WrongType { .. }), "{error:?}");
    }
}
