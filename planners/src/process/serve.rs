//! The other end: a planner of ours, asked through pipes.

use std::io::{BufReader, BufWriter, Read, Write};
use std::sync::Arc;

use arrow::array::{
    Array as _, ArrayRef, AsArray as _, BooleanArray, FixedSizeListArray, Float32Array,
    Float64Array, RecordBatch, StringArray, UInt64Array, new_null_array,
};
use arrow::datatypes::{DataType, Float64Type, SchemaRef, UInt64Type};
use arrow::error::ArrowError;
use arrow::ipc::reader::StreamReader;
use arrow::ipc::writer::StreamWriter;

use super::error::{ProcessError, ProcessErrorKind};
use super::protocol::{self, Setting};
use crate::error::PlannerError;
use crate::planner::{Candidates, PlanRequest, Planner};

/// Answers requests with a planner until they end: the whole of a planner process that is written in Rust.
///
/// `make` gets what is known of the task. What goes wrong with a request is told in its answer; what is wrong with the
/// stream, or with `make`, ends it.
///
/// # Errors
/// `make` failed, or the stream is not as the protocol says.
pub fn serve(
    make: impl FnOnce(&Setting) -> Result<Box<dyn Planner>, PlannerError>,
    requests: impl Read,
    answers: impl Write,
) -> Result<(), PlannerError> {
    let requests = StreamReader::try_new(BufReader::new(requests), None).map_err(broken)?;
    let setting = protocol::setting_of(&requests.schema()).map_err(failed)?;
    let mut planner = make(&setting)?;
    let schema = protocol::answer_schema(planner.spec());
    let answers = BufWriter::new(answers);
    let mut answers = StreamWriter::try_new(answers, &schema).map_err(broken)?;
    let mut answer = |batch: &RecordBatch| -> Result<(), ArrowError> {
        answers.write(batch)?;
        answers.flush()
    };
    answer(&RecordBatch::new_empty(Arc::clone(&schema))).map_err(broken)?;
    for request in requests {
        let request = request.map_err(broken)?;
        let batch = match answer_to(&request, &mut *planner, &schema) {
            Ok(batch) => batch,
            Err(error) => refusal(&schema, &told(&error)).map_err(broken)?,
        };
        answer(&batch).map_err(broken)?;
    }
    answers.finish().map_err(broken)
}

fn failed(kind: ProcessErrorKind) -> PlannerError {
    PlannerError::Process(Box::new(ProcessError {
        command: "the one that asks".to_owned(),
        kind,
        said: String::new(),
    }))
}

fn broken(error: ArrowError) -> PlannerError {
    failed(error.into())
}

/// The message with those of its causes.
fn told(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(error) = cause {
        text = format!("{text}: {error}");
        cause = error.source();
    }
    text
}

fn answer_to(
    request: &RecordBatch,
    planner: &mut dyn Planner,
    schema: &SchemaRef,
) -> Result<RecordBatch, PlannerError> {
    let column = |name: &'static str, expected: &DataType| {
        let found = request.column_by_name(name);
        let fits = found.filter(|column| column.data_type() == expected);
        fits.ok_or_else(|| {
            let found = found.map_or("no such column".to_owned(), |column| {
                column.data_type().to_string()
            });
            failed(ProcessErrorKind::Column {
                column: name,
                expected: expected.to_string(),
                found,
            })
        })
    };
    let kinds = column("message", &DataType::Utf8)?.as_string::<i32>();
    let slots = column("slot", &DataType::UInt64)?.as_primitive::<UInt64Type>();
    let slots: Vec<usize> = slots
        .values()
        .iter()
        .map(|&slot| usize::try_from(slot).unwrap_or(usize::MAX))
        .collect();
    let is_all = |kind: &str| kinds.iter().all(|found| found == Some(kind));
    match slots.is_empty() {
        false if is_all(protocol::RESET) => {
            let seeds = column("seed", &DataType::UInt64)?.as_primitive::<UInt64Type>();
            for (slot, seed) in slots.into_iter().zip(seeds.values()) {
                planner.reset(slot, *seed)?;
            }
            Ok(RecordBatch::new_empty(Arc::clone(schema)))
        }
        false if is_all(protocol::PLAN) => {
            let list = request.column_by_name("observation");
            let list = list.and_then(|list| list.as_fixed_size_list_opt());
            let values = list.and_then(|list| list.values().as_primitive_opt::<Float64Type>());
            let observations = values.map_or(&[][..], |values| &values.values()[..]);
            let plan = planner.plan(&PlanRequest {
                slots: &slots,
                observations,
            })?;
            plan.check(planner.spec(), slots.len())?;
            if plan.horizon != planner.spec().horizon {
                return Err(PlannerError::Plan {
                    what: "horizon",
                    expected: planner.spec().horizon.to_string(),
                    found: plan.horizon.to_string(),
                });
            }
            batch_of(&plan, &slots, schema).map_err(broken)
        }
        _ => Err(failed(ProcessErrorKind::Column {
            column: "message",
            expected: "\"reset\" in all rows or \"plan\" in all".to_owned(),
            found: format!("{:?}", kinds.iter().collect::<Vec<_>>()),
        })),
    }
}

fn batch_of(
    plan: &Candidates,
    slots: &[usize],
    schema: &SchemaRef,
) -> Result<RecordBatch, ArrowError> {
    let n = plan.n_candidates;
    let rows = slots.len() * n;
    let of_rows = slots
        .iter()
        .flat_map(|&slot| std::iter::repeat_n(slot as u64, n));
    let numbers = |values: &[f64]| -> ArrayRef {
        match values.is_empty() {
            true => new_null_array(&DataType::Float64, rows),
            false => Arc::new(Float64Array::from(values.to_vec())),
        }
    };
    let chosen = plan.chosen.iter();
    let chosen = chosen.flat_map(|&chosen| (0..n).map(move |candidate| candidate == chosen));
    let DataType::FixedSizeList(item, width) = schema.field(1).data_type() else {
        return Err(ArrowError::SchemaError("actions are no list".to_owned()));
    };
    let actions: ArrayRef = Arc::new(Float32Array::from(plan.actions.clone()));
    let columns: Vec<ArrayRef> = vec![
        Arc::new(of_rows.map(Some).collect::<UInt64Array>()),
        Arc::new(FixedSizeListArray::try_new(
            Arc::clone(item),
            *width,
            actions,
            None,
        )?),
        numbers(&plan.scores),
        numbers(&plan.novelties),
        Arc::new(chosen.map(Some).collect::<BooleanArray>()),
        new_null_array(&DataType::Utf8, rows),
    ];
    RecordBatch::try_new(Arc::clone(schema), columns)
}

/// One row that tells an error.
fn refusal(schema: &SchemaRef, message: &str) -> Result<RecordBatch, ArrowError> {
    let columns = schema.fields().iter().map(|field| -> ArrayRef {
        match field.name().as_str() {
            "error" => Arc::new(StringArray::from(vec![message])),
            _ => new_null_array(field.data_type(), 1),
        }
    });
    RecordBatch::try_new(Arc::clone(schema), columns.collect())
}
