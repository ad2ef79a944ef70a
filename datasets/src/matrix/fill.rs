//! Copying leaves of a batch into the columns of a matrix.

use std::ops::Range;

use arrow::array::{Array, ArrayRef, AsArray, PrimitiveArray, RecordBatch};
use arrow::datatypes::{
    ArrowPrimitiveType, DataType, Float16Type, Float32Type, Float64Type, Int8Type, Int16Type,
    Int32Type, Int64Type, UInt8Type, UInt16Type, UInt32Type, UInt64Type,
};

use crate::episode::column;
use crate::error::{DatasetError, Result};
use crate::layout::ObservationLayout;
use crate::spec::LeafSpec;

/// Which values of a leaf go to which columns of the matrix.
#[derive(Debug, Clone)]
pub(super) struct LeafCopy {
    pub(super) column: String,
    /// Values in a row of the leaf.
    leaf_width: usize,
    /// Runs of (values in the leaf, first column of the matrix).
    runs: Vec<(Range<usize>, usize)>,
}

impl LeafCopy {
    pub(super) fn whole(column: &str, width: usize) -> Self {
        Self {
            column: column.to_owned(),
            leaf_width: width,
            runs: vec![(0..width, 0)],
        }
    }

    pub(super) fn width(&self) -> usize {
        self.runs.iter().map(|(values, _)| values.len()).sum()
    }

    fn push(&mut self, value: usize, target: usize) {
        match self.runs.last_mut() {
            Some((run, first)) if run.end == value && *first + run.len() == target => run.end += 1,
            _ => self.runs.push((value..value + 1, target)),
        }
    }
}

/// The copies that fill a matrix with the chosen columns, or with all.
pub(super) fn state_copies(leaves: &[LeafSpec], chosen: Option<&[usize]>) -> Result<Vec<LeafCopy>> {
    let layout = ObservationLayout::new(leaves);
    let all: Vec<usize>;
    let chosen = match chosen {
        Some(chosen) => chosen,
        None => {
            all = (0..layout.width()).collect();
            &all
        }
    };
    let mut copies: Vec<LeafCopy> = layout
        .leaves()
        .iter()
        .map(|leaf| LeafCopy {
            column: leaf.column.clone(),
            leaf_width: leaf.width,
            runs: Vec::new(),
        })
        .collect();
    for (target, &column) in chosen.iter().enumerate() {
        let place = layout
            .leaves()
            .iter()
            .position(|leaf| column < leaf.offset + leaf.width);
        let Some(place) = place else {
            // One past the end, so that the message lists what there is.
            return layout.select(&column.to_string()).map(|_| Vec::new());
        };
        copies[place].push(column - layout.leaves()[place].offset, target);
    }
    copies.retain(|copy| !copy.runs.is_empty());
    Ok(copies)
}

/// Runs of rows whose action is there.
pub(super) fn complete_rows(action: &ArrayRef) -> Vec<Range<usize>> {
    match action.nulls().filter(|nulls| nulls.null_count() > 0) {
        None if action.is_empty() => Vec::new(),
        None => std::iter::once(0..action.len()).collect(),
        Some(nulls) => nulls
            .valid_slices()
            .map(|(start, end)| start..end)
            .collect(),
    }
}

/// The complete rows of a batch, and where the batch stands in the scan.
pub(super) struct Rows<'r> {
    pub(super) rows: &'r [Range<usize>],
    pub(super) first_row: u64,
}

impl Rows<'_> {
    pub(super) fn len(&self) -> usize {
        self.rows.iter().map(ExactSizeIterator::len).sum()
    }

    pub(super) fn indices(&self) -> impl Iterator<Item = usize> + '_ {
        self.rows.iter().flat_map(Clone::clone)
    }

    pub(super) fn matrix(
        &self,
        batch: &RecordBatch,
        copies: &[LeafCopy],
        width: usize,
    ) -> Result<Vec<f64>> {
        let mut matrix = vec![0.0; self.len() * width];
        for copy in copies {
            self.fill(column(batch, &copy.column)?, copy, &mut matrix, width)?;
        }
        Ok(matrix)
    }

    fn fill(
        &self,
        array: &ArrayRef,
        copy: &LeafCopy,
        matrix: &mut [f64],
        width: usize,
    ) -> Result<()> {
        if let Some(row) = self.indices().find(|&row| array.is_null(row)) {
            return Err(self.null(copy, row));
        }
        let (values, offset) = match array.data_type() {
            DataType::FixedSizeList(..) => {
                let list = array.as_fixed_size_list();
                (
                    list.values(),
                    usize::try_from(list.value_offset(0)).unwrap_or(0),
                )
            }
            _ => (array, 0),
        };
        let mut fill = Fill {
            rows: self,
            values,
            offset,
            copy,
            matrix,
            width,
        };
        match values.data_type() {
            DataType::Float64 => fill.run::<Float64Type>(|v| v),
            DataType::Float32 => fill.run::<Float32Type>(f64::from),
            DataType::Float16 => fill.run::<Float16Type>(f64::from),
            DataType::Int8 => fill.run::<Int8Type>(f64::from),
            DataType::Int16 => fill.run::<Int16Type>(f64::from),
            DataType::Int32 => fill.run::<Int32Type>(f64::from),
            DataType::UInt8 => fill.run::<UInt8Type>(f64::from),
            DataType::UInt16 => fill.run::<UInt16Type>(f64::from),
            DataType::UInt32 => fill.run::<UInt32Type>(f64::from),
            DataType::Int64 => fill.run_exact::<Int64Type>(exact_i64),
            DataType::UInt64 => fill.run_exact::<UInt64Type>(exact_u64),
            other => Err(DatasetError::WrongType {
                key: copy.column.clone(),
                actual: other.to_string(),
                expected: "numbers",
            }),
        }
    }

    pub(super) fn flags(&self, batch: &RecordBatch, name: &str) -> Result<Option<Vec<bool>>> {
        let Some(array) = batch.column_by_name(name) else {
            return Ok(None);
        };
        if let Some(row) = self.indices().find(|&row| array.is_null(row)) {
            return Err(self.null(&LeafCopy::whole(name, 1), row));
        }
        let array = array.as_boolean();
        Ok(Some(self.indices().map(|row| array.value(row)).collect()))
    }

    fn null(&self, copy: &LeafCopy, row: usize) -> DatasetError {
        DatasetError::NullValue {
            column: copy.column.clone(),
            row: self.first_row + row as u64,
        }
    }
}

/// One leaf on its way into the matrix.
struct Fill<'f> {
    rows: &'f Rows<'f>,
    values: &'f ArrayRef,
    offset: usize,
    copy: &'f LeafCopy,
    matrix: &'f mut [f64],
    width: usize,
}

impl Fill<'_> {
    fn run<T: ArrowPrimitiveType>(&mut self, widen: impl Fn(T::Native) -> f64) -> Result<()> {
        let array: &PrimitiveArray<T> = self.values.as_primitive();
        self.check_nulls()?;
        let values = array.values();
        let mut matrix_rows = self.matrix.chunks_exact_mut(self.width);
        for row in self.rows.indices() {
            let Some(target) = matrix_rows.next() else {
                break;
            };
            let start = self.offset + row * self.copy.leaf_width;
            let source = &values[start..start + self.copy.leaf_width];
            for (run, first) in &self.copy.runs {
                let target = &mut target[*first..*first + run.len()];
                for (to, from) in target.iter_mut().zip(&source[run.clone()]) {
                    *to = widen(*from);
                }
            }
        }
        Ok(())
    }

    /// As [`Self::run`] for types that `f64` may not hold; NaN marks those, as no integer widens to it.
    fn run_exact<T: ArrowPrimitiveType>(&mut self, widen: impl Fn(T::Native) -> f64) -> Result<()> {
        self.run::<T>(widen)?;
        for (n, row) in self.rows.indices().enumerate() {
            let target = &self.matrix[n * self.width..(n + 1) * self.width];
            let mut written = self
                .copy
                .runs
                .iter()
                .flat_map(|(run, first)| &target[*first..*first + run.len()]);
            if written.any(|value| value.is_nan()) {
                let row = self.rows.first_row + row as u64;
                return Err(DatasetError::InexactInteger {
                    column: self.copy.column.clone(),
                    row,
                });
            }
        }
        Ok(())
    }

    fn check_nulls(&self) -> Result<()> {
        let Some(nulls) = self.values.nulls().filter(|nulls| nulls.null_count() > 0) else {
            return Ok(());
        };
        let row_is_null = |row: usize| {
            let start = self.offset + row * self.copy.leaf_width;
            (start..start + self.copy.leaf_width).any(|i| nulls.is_null(i))
        };
        match self.rows.indices().find(|&row| row_is_null(row)) {
            Some(row) => Err(self.rows.null(self.copy, row)),
            None => Ok(()),
        }
    }
}

/// 2^53: up to here every integer is an `f64`.
const EXACT: u64 = 1 << 53;

#[expect(clippy::cast_precision_loss, reason = "the value is checked to fit")]
fn exact_i64(value: i64) -> f64 {
    if value.unsigned_abs() <= EXACT {
        value as f64
    } else {
        f64::NAN
    }
}

#[expect(clippy::cast_precision_loss, reason = "the value is checked to fit")]
fn exact_u64(value: u64) -> f64 {
    if value <= EXACT {
        value as f64
    } else {
        f64::NAN
    }
}
