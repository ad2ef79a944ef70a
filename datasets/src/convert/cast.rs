//! Changing value types, and saying what that did to the values.

use std::collections::HashMap;
use std::sync::Arc;

use arrow::array::{Array, ArrayRef, AsArray, FixedSizeListArray, RecordBatch};
use arrow::compute::{CastOptions, cast, cast_with_options};
use arrow::datatypes::{DataType, Field, Float64Type, Int64Type, Schema, SchemaRef, UInt64Type};

use super::space;
use crate::error::{DatasetError, Result};
use crate::schema;

/// Numbers of some columns as another type.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Cast {
    /// A column or the root of several; `None` means all floating-point columns of observation and action.
    pub columns: Option<String>,
    /// The new value type: an integer or floating-point type.
    pub to: DataType,
}

/// What a cast did to a column.
#[derive(Debug, Clone, PartialEq)]
pub struct CastReport {
    /// The column.
    pub column: String,
    /// Value type in the source.
    pub from: DataType,
    /// Value type in the result.
    pub to: DataType,
    /// Values that are not the same after the cast.
    pub n_changed: u64,
    /// Largest difference between a value and what it became, as `f64`.
    pub max_abs_error: f64,
}

/// The casts of a conversion.
pub(super) struct Casts {
    schema: SchemaRef,
    /// Per column of the schema.
    reports: Vec<Option<CastReport>>,
}

impl Casts {
    /// # Errors
    /// A cast that names no column, or one that holds no numbers.
    pub(super) fn new(schema: &SchemaRef, casts: &[Cast]) -> Result<Self> {
        let mut metadata = schema.metadata().clone();
        let mut fields = Vec::new();
        let mut reports = Vec::new();
        for one in casts {
            one.check(schema)?;
        }
        for field in schema.fields() {
            // The last one wins, so that a general cast can stand before exceptions.
            let cast = casts.iter().rev().find(|cast| cast.concerns(field));
            match (cast, value_type(field)) {
                (Some(cast), Some(from)) if from != cast.to => {
                    fields.push(Arc::new(retyped(field, &cast.to, &mut metadata)));
                    reports.push(Some(CastReport {
                        column: field.name().clone(),
                        from,
                        to: cast.to.clone(),
                        n_changed: 0,
                        max_abs_error: 0.0,
                    }));
                }
                _ => {
                    fields.push(Arc::clone(field));
                    reports.push(None);
                }
            }
        }
        Ok(Self {
            schema: Arc::new(Schema::new_with_metadata(fields, metadata)),
            reports,
        })
    }

    /// The schema after the casts.
    pub(super) fn schema(&self) -> &SchemaRef {
        &self.schema
    }

    /// The columns of a batch after the casts. `episodes` and `first_row` are for messages.
    ///
    /// # Errors
    /// A value that the new type cannot hold, even roughly.
    pub(super) fn apply(
        &mut self,
        batch: &RecordBatch,
        episodes: &[i64],
        first_row: u64,
    ) -> Result<Vec<ArrayRef>> {
        let columns = batch.columns().iter().zip(&mut self.reports);
        columns
            .map(|(column, report)| match report {
                None => Ok(Arc::clone(column)),
                Some(report) => cast_column(column, report).map_err(|fault| match fault {
                    Fault::DoesNotFit { row, value } => DatasetError::DoesNotFit {
                        column: report.column.clone(),
                        episode: episodes.get(row).copied().unwrap_or(-1),
                        row: first_row + row as u64,
                        value,
                        to: report.to.to_string(),
                    },
                    Fault::Other(error) => error,
                }),
            })
            .collect()
    }

    pub(super) fn into_reports(self) -> Vec<CastReport> {
        self.reports.into_iter().flatten().collect()
    }
}

impl Cast {
    fn concerns(&self, field: &Field) -> bool {
        match &self.columns {
            Some(root) => schema::belongs_to(field.name(), root),
            None => {
                let roots = [
                    schema::OBSERVATION,
                    schema::ACTION,
                    schema::NEXT_OBSERVATION,
                ];
                let is_float = value_type(field).is_some_and(|t| t.is_floating());
                is_float
                    && roots
                        .iter()
                        .any(|root| schema::belongs_to(field.name(), root))
            }
        }
    }

    fn check(&self, schema: &Schema) -> Result<()> {
        let wrong = |key: String, actual: String| DatasetError::WrongType {
            key,
            actual,
            expected: "a column of numbers, cast to an integer or floating-point type",
        };
        if !schema::is_number(&self.to) {
            return Err(wrong("--cast".to_owned(), self.to.to_string()));
        }
        let Some(root) = &self.columns else {
            return Ok(());
        };
        let index = [schema::EPISODE_INDEX, schema::STEP_INDEX, schema::T_NS];
        let mut concerned = schema
            .fields()
            .iter()
            .filter(|f| self.concerns(f))
            .peekable();
        if concerned.peek().is_none() {
            return Err(DatasetError::MissingColumn {
                role: "dataset",
                name: format!("\"{root}\""),
                found: schema::column_names(schema),
            });
        }
        match concerned.find(|f| value_type(f).is_none() || index.contains(&f.name().as_str())) {
            Some(field) => Err(wrong(field.name().clone(), field.data_type().to_string())),
            None => Ok(()),
        }
    }
}

/// Type of the numbers in a column; `None` if it holds none.
fn value_type(field: &Field) -> Option<DataType> {
    let (data_type, _) = schema::row_shape(field)?;
    schema::is_number(&data_type).then_some(data_type)
}

/// The field with another value type; the space it belongs to follows.
fn retyped(field: &Field, to: &DataType, metadata: &mut HashMap<String, String>) -> Field {
    let data_type = match field.data_type() {
        DataType::FixedSizeList(child, size) => {
            let child = child.as_ref().clone().with_data_type(to.clone());
            DataType::FixedSizeList(Arc::new(child), *size)
        }
        _ => to.clone(),
    };
    // NumPy's names are Arrow's in lower case.
    space::retype(metadata, field.name(), &to.to_string().to_lowercase());
    field.clone().with_data_type(data_type)
}

enum Fault {
    DoesNotFit { row: usize, value: f64 },
    Other(DatasetError),
}

fn cast_column(column: &ArrayRef, report: &mut CastReport) -> Result<ArrayRef, Fault> {
    let Some(list) = column.as_fixed_size_list_opt() else {
        return cast_values(column, 1, report);
    };
    let width = usize::try_from(list.value_length()).unwrap_or(0);
    let start = usize::try_from(list.value_offset(0)).unwrap_or(0);
    let values = list.values().slice(start, list.len() * width);
    let values = cast_values(&values, width, report)?;
    let DataType::FixedSizeList(child, size) = list.data_type() else {
        return Ok(Arc::clone(column));
    };
    let child = Arc::new(child.as_ref().clone().with_data_type(report.to.clone()));
    FixedSizeListArray::try_new(child, *size, values, list.nulls().cloned())
        .map(|array| Arc::new(array) as ArrayRef)
        .map_err(|e| Fault::Other(DatasetError::arrow("convert a column")(e)))
}

fn cast_values(
    values: &ArrayRef,
    width: usize,
    report: &mut CastReport,
) -> Result<ArrayRef, Fault> {
    let other = |e| Fault::Other(DatasetError::arrow("convert a column")(e));
    // Out of range becomes null here, and is found below.
    let options = CastOptions {
        safe: true,
        ..CastOptions::default()
    };
    let casted = cast_with_options(values, &report.to, &options).map_err(other)?;
    let before = cast(values, &DataType::Float64).map_err(other)?;
    let after = cast(&casted, &DataType::Float64).map_err(other)?;
    let (before, after) = (
        before.as_primitive::<Float64Type>(),
        after.as_primitive::<Float64Type>(),
    );
    for place in 0..values.len() {
        if before.is_null(place) {
            continue;
        }
        let was = before.value(place);
        if casted.is_null(place) || (was.is_finite() && !after.value(place).is_finite()) {
            return Err(Fault::DoesNotFit {
                row: place / width.max(1),
                value: was,
            });
        }
        let after = after.value(place);
        let exact = exact_error(values, place, after).filter(|_| report.to.is_floating());
        let error = exact.unwrap_or_else(|| (was - after).abs());
        if error > 0.0 {
            report.n_changed += 1;
            report.max_abs_error = report.max_abs_error.max(error);
        }
    }
    Ok(casted)
}

/// Distance of a 64-bit integer, which `f64` may not hold, from what it became; `None` for other types.
fn exact_error(values: &ArrayRef, place: usize, after: f64) -> Option<f64> {
    let was = match values.data_type() {
        DataType::Int64 => i128::from(values.as_primitive::<Int64Type>().value(place)),
        DataType::UInt64 => i128::from(values.as_primitive::<UInt64Type>().value(place)),
        _ => return None,
    };
    Some((was - after as i128).unsigned_abs() as f64)
}

#[cfg(test)]
mod tests {
    use arrow::array::{Float64Array, Int64Array};

    use super::*;

    fn batch(values: Vec<Option<f64>>) -> RecordBatch {
        let list = FixedSizeListArray::try_new(
            schema::element(DataType::Float64),
            2,
            Arc::new(Float64Array::from(values)),
            None,
        )
        .unwrap();
        let rows = list.len();
        let fields = vec![
            Field::new(schema::EPISODE_INDEX, DataType::Int64, false),
            schema::leaf_field("observation", DataType::Float64, &[2], true),
        ];
        RecordBatch::try_new(
            Arc::new(Schema::new(fields)),
            vec![Arc::new(Int64Array::from(vec![7; rows])), Arc::new(list)],
        )
        .unwrap()
    }

    fn to(data_type: DataType) -> Vec<Cast> {
        vec![Cast {
            columns: Some("observation".to_owned()),
            to: data_type,
        }]
    }

    #[test]
    fn the_largest_error_is_reported() {
        let batch = batch(vec![Some(0.5), Some(0.1), None, Some(1.0)]);
        let mut casts = Casts::new(&batch.schema(), &to(DataType::Float32)).unwrap();
        let columns = casts.apply(&batch, &[7, 7], 0).unwrap();
        assert_eq!(columns[1].data_type(), casts.schema().field(1).data_type());
        let report = casts.into_reports().remove(0);
        assert_eq!(report.n_changed, 1);
        assert_eq!(report.max_abs_error, (0.1 - f64::from(0.1_f32)).abs());
    }

    #[test]
    fn integers_beyond_what_floats_hold_are_counted() {
        let fields = vec![
            Field::new(schema::EPISODE_INDEX, DataType::Int64, false),
            Field::new("observation", DataType::Int64, false),
        ];
        let values: ArrayRef = Arc::new(Int64Array::from(vec![1 << 53, (1 << 53) + 1]));
        let episodes = Arc::new(Int64Array::from(vec![7, 7]));
        let batch = RecordBatch::try_new(Arc::new(Schema::new(fields)), vec![episodes, values]);
        let batch = batch.unwrap();
        for (data_type, n_changed) in [(DataType::Float64, 1), (DataType::UInt64, 0)] {
            let mut casts = Casts::new(&batch.schema(), &to(data_type)).unwrap();
            casts.apply(&batch, &[7, 7], 0).unwrap();
            let report = casts.into_reports().remove(0);
            assert_eq!(
                (report.n_changed, report.max_abs_error),
                (n_changed, n_changed as f64)
            );
        }
    }

    #[test]
    fn a_value_that_does_not_fit_is_named() {
        let cases = [
            (1e300, DataType::Float32),
            (-1.0, DataType::UInt8),
            (f64::NAN, DataType::Int32),
        ];
        for (value, data_type) in cases {
            let batch = batch(vec![Some(0.0), Some(0.0), Some(0.0), Some(value)]);
            let mut casts = Casts::new(&batch.schema(), &to(data_type)).unwrap();
            let error = casts.apply(&batch, &[7, 8], 10).unwrap_err();
            assert!(
                matches!(
                    &error,
                    DatasetError::DoesNotFit {
                        row: 11,
                        episode: 8,
                        ..
                    }
                ),
                "{error}"
            );
        }
    }

    #[test]
    fn what_holds_no_numbers_is_refused() {
        let schema = Arc::new(Schema::new(vec![
            Field::new(schema::EPISODE_INDEX, DataType::Int64, false),
            Field::new("info.task", DataType::Utf8, true),
        ]));
        for column in ["info.task", schema::EPISODE_INDEX, "nothing"] {
            let casts = [Cast {
                columns: Some(column.to_owned()),
                to: DataType::Float32,
            }];
            assert!(Casts::new(&schema, &casts).is_err(), "{column}");
        }
    }
}
