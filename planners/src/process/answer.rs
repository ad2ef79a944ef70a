//! What comes back from the process.

use arrow::array::{Array as _, ArrayRef, AsArray as _, RecordBatch};
use arrow::datatypes::{DataType, Float32Type, Float64Type, UInt64Type};

use super::error::ProcessErrorKind;
use crate::planner::{Candidates, PlannerSpec};

/// The error that an answer tells, if it does.
pub(super) fn refusal(answer: &RecordBatch) -> Result<(), ProcessErrorKind> {
    let Some(column) = answer.column_by_name("error") else {
        return Ok(());
    };
    let texts = cast("error", column, &DataType::Utf8)?;
    let told = texts.as_string::<i32>().iter().flatten().next();
    told.map_or(Ok(()), |text| {
        Err(ProcessErrorKind::Refused(text.to_owned()))
    })
}

/// The plan in an answer: a row for every candidate, slot by slot in the order of the request.
pub(super) fn plan(
    answer: &RecordBatch,
    spec: &PlannerSpec,
    slots: &[usize],
) -> Result<Candidates, ProcessErrorKind> {
    refusal(answer)?;
    let n_rows = answer.num_rows();
    if n_rows == 0 || !n_rows.is_multiple_of(slots.len()) {
        return Err(ProcessErrorKind::Rows {
            of: "plan",
            expected: format!("as many for each of the {} slots", slots.len()),
            found: n_rows,
        });
    }
    let n_candidates = n_rows / slots.len();
    check_slots(answer, slots, n_candidates)?;
    Ok(Candidates {
        n_candidates,
        horizon: spec.horizon,
        actions: actions(answer, spec)?,
        scores: numbers(answer, "score")?,
        novelties: numbers(answer, "novelty")?,
        chosen: chosen(answer, slots, n_candidates)?,
    })
}

fn column<'a>(
    answer: &'a RecordBatch,
    name: &'static str,
    expected: &DataType,
) -> Result<&'a ArrayRef, ProcessErrorKind> {
    answer
        .column_by_name(name)
        .ok_or_else(|| ProcessErrorKind::Column {
            column: name,
            expected: expected.to_string(),
            found: "no such column".to_owned(),
        })
}

/// The column in a type, exactly or not at all.
fn cast(
    name: &'static str,
    column: &ArrayRef,
    to: &DataType,
) -> Result<ArrayRef, ProcessErrorKind> {
    let refuse = |found: String| ProcessErrorKind::Column {
        column: name,
        expected: to.to_string(),
        found,
    };
    let options = arrow::compute::CastOptions {
        safe: false,
        ..Default::default()
    };
    arrow::compute::cast_with_options(column, to, &options)
        .map_err(|_| refuse(column.data_type().to_string()))
}

/// A column without nulls.
fn required(
    answer: &RecordBatch,
    name: &'static str,
    to: &DataType,
) -> Result<ArrayRef, ProcessErrorKind> {
    let column = cast(name, column(answer, name, to)?, to)?;
    match (0..column.len()).find(|&row| column.is_null(row)) {
        None => Ok(column),
        Some(row) => Err(ProcessErrorKind::Column {
            column: name,
            expected: to.to_string(),
            found: format!("null in row {row}"),
        }),
    }
}

fn check_slots(
    answer: &RecordBatch,
    slots: &[usize],
    n_candidates: usize,
) -> Result<(), ProcessErrorKind> {
    let found = required(answer, "slot", &DataType::UInt64)?;
    let expected = slots
        .iter()
        .flat_map(|slot| std::iter::repeat_n(*slot, n_candidates));
    for (row, (found, expected)) in found
        .as_primitive::<UInt64Type>()
        .values()
        .iter()
        .zip(expected)
        .enumerate()
    {
        if *found != expected as u64 {
            return Err(ProcessErrorKind::Column {
                column: "slot",
                expected: format!("{expected} in row {row}, the slots in the order of the request"),
                found: found.to_string(),
            });
        }
    }
    Ok(())
}

fn actions(answer: &RecordBatch, spec: &PlannerSpec) -> Result<Vec<f32>, ProcessErrorKind> {
    let width = spec.horizon.saturating_mul(spec.action_dim);
    let name = "actions";
    let refuse = |found: String| ProcessErrorKind::Column {
        column: name,
        expected: format!("a fixed-size list of {width} Float32 (horizon × action_dim)"),
        found,
    };
    let Some(column) = answer.column_by_name(name) else {
        return Err(refuse("no such column".to_owned()));
    };
    let list = column.as_fixed_size_list_opt();
    let list = list.filter(|list| usize::try_from(list.value_length()) == Ok(width));
    let Some(list) = list else {
        return Err(refuse(column.data_type().to_string()));
    };
    if list.null_count() > 0 {
        return Err(refuse("nulls".to_owned()));
    }
    let start = usize::try_from(list.value_offset(0)).unwrap_or(0);
    let values = list.values().slice(start, list.len() * width);
    let values = cast(name, &values, &DataType::Float32)?;
    if values.null_count() > 0 {
        return Err(refuse("nulls".to_owned()));
    }
    Ok(values.as_primitive::<Float32Type>().values().to_vec())
}

/// A column of numbers: none where it is missing or all null.
fn numbers(answer: &RecordBatch, name: &'static str) -> Result<Vec<f64>, ProcessErrorKind> {
    match answer.column_by_name(name) {
        None => Ok(Vec::new()),
        Some(column) if column.logical_null_count() == column.len() => Ok(Vec::new()),
        Some(_) => {
            let column = required(answer, name, &DataType::Float64)?;
            Ok(column.as_primitive::<Float64Type>().values().to_vec())
        }
    }
}

fn chosen(
    answer: &RecordBatch,
    slots: &[usize],
    n_candidates: usize,
) -> Result<Vec<usize>, ProcessErrorKind> {
    let flags = required(answer, "chosen", &DataType::Boolean)?;
    let flags = flags.as_boolean();
    let one = |(place, &slot): (usize, &usize)| {
        let first = place * n_candidates;
        let of_slot = (0..n_candidates).filter(|candidate| flags.value(first + candidate));
        let found: Vec<usize> = of_slot.collect();
        match found[..] {
            [one] => Ok(one),
            _ => Err(ProcessErrorKind::Chosen {
                slot,
                found: found.len(),
            }),
        }
    };
    slots.iter().enumerate().map(one).collect()
}
