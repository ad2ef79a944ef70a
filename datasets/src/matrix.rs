//! Rows of a dataset as plain row-major matrices, ready for numeric code that knows nothing of Arrow.

use std::ops::Range;

use arrow::array::{Array, ArrayRef, AsArray, PrimitiveArray, RecordBatch, RecordBatchReader};
use arrow::datatypes::{
    ArrowPrimitiveType, DataType, Float16Type, Float32Type, Float64Type, Int8Type, Int16Type,
    Int32Type, Int64Type, UInt8Type, UInt16Type, UInt32Type, UInt64Type,
};

use crate::episode::{as_flags, column};
use crate::error::{DatasetError, Result};
use crate::layout::ObservationLayout;
use crate::schema;
use crate::source::{DatasetSource, Scan};
use crate::spec::LeafSpec;

/// Which transitions to read, and what beside states and actions.
#[derive(Debug, Clone)]
pub struct TransitionOptions {
    /// Rows read at a time, at most; at least 1.
    pub batch_rows: usize,
    /// Episodes to read; `None` reads all.
    pub episodes: Option<Vec<i64>>,
    /// Columns of the state vector, from [`ObservationLayout::select`], in the order wanted; `None` takes
    /// all. Leaves without a chosen column are not read.
    pub state_columns: Option<Vec<usize>>,
    /// Read the rewards.
    pub rewards: bool,
    /// Read `terminated` and `truncated`.
    pub flags: bool,
    /// Read `info.success`.
    pub success: bool,
    /// Read a text column, such as `info.planner`.
    pub text_column: Option<String>,
}

impl Default for TransitionOptions {
    fn default() -> Self {
        Self {
            batch_rows: Scan::default().batch_rows,
            episodes: None,
            state_columns: None,
            rewards: false,
            flags: false,
            success: false,
            text_column: None,
        }
    }
}

/// Complete transitions of one batch: state before the action, and the action.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Transitions {
    /// Episode of each row.
    pub episode_index: Vec<i64>,
    /// Step of each row inside its episode.
    pub step_index: Vec<i64>,
    /// Columns of `states`.
    pub state_width: usize,
    /// States, shape `(n_rows, state_width)`, row-major; every source type fits `f64` exactly.
    pub states: Vec<f64>,
    /// Columns of `actions`.
    pub action_width: usize,
    /// Actions, shape `(n_rows, action_width)`, row-major.
    pub actions: Vec<f64>,
    /// Rewards, if asked for and recorded.
    pub rewards: Option<Vec<f64>>,
    /// Flags, if asked for and recorded.
    pub terminated: Option<Vec<bool>>,
    /// Flags, if asked for and recorded.
    pub truncated: Option<Vec<bool>>,
    /// Success of each step, if asked for and recorded; `None` where a row has none.
    pub success: Option<Vec<Option<bool>>>,
    /// The text column, if asked for.
    pub text: Option<Vec<Option<String>>>,
}

impl Transitions {
    /// Number of transitions.
    pub fn n_rows(&self) -> usize {
        self.episode_index.len()
    }
}

/// Iterates over a dataset's complete transitions; final-observation rows are left out.
pub struct TransitionReader<'a> {
    batches: Box<dyn RecordBatchReader + Send + 'a>,
    states: Vec<LeafCopy>,
    actions: Vec<LeafCopy>,
    state_width: usize,
    action_width: usize,
    options: TransitionOptions,
    rows_seen: u64,
}

impl<'a> TransitionReader<'a> {
    /// Starts a pass over `source`.
    ///
    /// # Errors
    /// A state column outside the layout, a text column that does not exist or is no text, a dataset without
    /// numeric states or actions, and the errors of the scan.
    pub fn new(source: &'a dyn DatasetSource, options: &TransitionOptions) -> Result<Self> {
        let info = source.info();
        let states = state_copies(&info.observation, options.state_columns.as_deref())?;
        let actions = state_copies(&info.action, None)?;
        for (copies, role) in [
            (&states, "numeric observation"),
            (&actions, "numeric action"),
        ] {
            if copies.is_empty() {
                let found = schema::column_names(&source.schema());
                return Err(DatasetError::MissingColumn {
                    role,
                    name: String::new(),
                    found,
                }
                .in_file(&info.path));
            }
        }
        let columns = wanted_columns(source, options, states.iter().chain(&actions))?;
        let scan = Scan {
            columns: Some(columns),
            episodes: options.episodes.clone(),
            batch_rows: options.batch_rows,
        };
        Ok(Self {
            batches: source.scan(&scan)?,
            state_width: states.iter().map(LeafCopy::width).sum(),
            action_width: actions.iter().map(LeafCopy::width).sum(),
            states,
            actions,
            options: options.clone(),
            rows_seen: 0,
        })
    }

    /// Columns of the states.
    pub fn state_width(&self) -> usize {
        self.state_width
    }

    /// Columns of the actions.
    pub fn action_width(&self) -> usize {
        self.action_width
    }

    fn convert(&mut self, batch: &RecordBatch) -> Result<Transitions> {
        let marker = column(batch, &self.actions[0].column)?;
        let rows = complete_rows(marker);
        let place = Rows {
            rows: &rows,
            first_row: self.rows_seen,
        };
        self.rows_seen += batch.num_rows() as u64;
        let index = |name: &str| -> Result<Vec<i64>> {
            let values = column(batch, name)?.as_primitive::<Int64Type>().values();
            Ok(rows
                .iter()
                .flat_map(|run| values[run.clone()].iter().copied())
                .collect())
        };
        let mut transitions = Transitions {
            episode_index: index(schema::EPISODE_INDEX)?,
            step_index: index(schema::STEP_INDEX)?,
            state_width: self.state_width,
            states: place.matrix(batch, &self.states, self.state_width)?,
            action_width: self.action_width,
            actions: place.matrix(batch, &self.actions, self.action_width)?,
            ..Transitions::default()
        };
        self.add_optional(batch, &place, &mut transitions)?;
        Ok(transitions)
    }

    fn add_optional(
        &self,
        batch: &RecordBatch,
        place: &Rows<'_>,
        out: &mut Transitions,
    ) -> Result<()> {
        if self.options.rewards && batch.column_by_name(schema::REWARD).is_some() {
            let reward = LeafCopy::whole(schema::REWARD, 1);
            out.rewards = Some(place.matrix(batch, &[reward], 1)?);
        }
        if self.options.flags {
            out.terminated = place.flags(batch, schema::TERMINATED)?;
            out.truncated = place.flags(batch, schema::TRUNCATED)?;
        }
        if let Some(column) = batch
            .column_by_name(schema::INFO_SUCCESS)
            .filter(|_| self.options.success)
        {
            out.success = as_flags(column)?.map(|flags| {
                let flags = flags.as_boolean().clone();
                place
                    .indices()
                    .map(|row| (!flags.is_null(row)).then(|| flags.value(row)))
                    .collect()
            });
        }
        if let Some(name) = &self.options.text_column {
            let text = arrow::compute::cast(column(batch, name)?, &DataType::Utf8)
                .map_err(DatasetError::arrow("read a text column"))?;
            let text = text.as_string::<i32>();
            let value = |row: usize| (!text.is_null(row)).then(|| text.value(row).to_owned());
            out.text = Some(place.indices().map(value).collect());
        }
        Ok(())
    }
}

impl Iterator for TransitionReader<'_> {
    type Item = Result<Transitions>;

    fn next(&mut self) -> Option<Self::Item> {
        let batch = self.batches.next()?;
        Some(
            batch
                .map_err(DatasetError::from)
                .and_then(|batch| self.convert(&batch)),
        )
    }
}

/// Which values of a leaf go to which columns of the matrix.
#[derive(Debug, Clone)]
struct LeafCopy {
    column: String,
    /// Values in a row of the leaf.
    leaf_width: usize,
    /// Runs of (values in the leaf, first column of the matrix).
    runs: Vec<(Range<usize>, usize)>,
}

impl LeafCopy {
    fn whole(column: &str, width: usize) -> Self {
        Self {
            column: column.to_owned(),
            leaf_width: width,
            runs: vec![(0..width, 0)],
        }
    }

    fn width(&self) -> usize {
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
fn state_copies(leaves: &[LeafSpec], chosen: Option<&[usize]>) -> Result<Vec<LeafCopy>> {
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

fn wanted_columns<'c>(
    source: &dyn DatasetSource,
    options: &TransitionOptions,
    copies: impl Iterator<Item = &'c LeafCopy>,
) -> Result<Vec<String>> {
    let schema = source.schema();
    let mut columns = vec![
        schema::EPISODE_INDEX.to_owned(),
        schema::STEP_INDEX.to_owned(),
    ];
    columns.extend(copies.map(|copy| copy.column.clone()));
    let optional = [
        (options.rewards, schema::REWARD),
        (options.flags, schema::TERMINATED),
        (options.flags, schema::TRUNCATED),
        (options.success, schema::INFO_SUCCESS),
    ];
    for (wanted, name) in optional {
        if wanted && schema.index_of(name).is_ok() {
            columns.push(name.to_owned());
        }
    }
    if let Some(name) = &options.text_column {
        let field = schema.field_with_name(name).map_err(|_| {
            let found = schema::column_names(&schema);
            DatasetError::MissingColumn {
                role: "text",
                name: format!("\"{name}\""),
                found,
            }
        })?;
        if !is_text(field.data_type()) {
            let actual = field.data_type().to_string();
            return Err(DatasetError::WrongType {
                key: name.clone(),
                actual,
                expected: "text",
            });
        }
        columns.push(name.clone());
    }
    Ok(columns)
}

fn is_text(data_type: &DataType) -> bool {
    match data_type {
        DataType::Utf8 | DataType::LargeUtf8 | DataType::Utf8View => true,
        DataType::Dictionary(_, value) => is_text(value),
        _ => false,
    }
}

/// Runs of rows whose action is there.
fn complete_rows(action: &ArrayRef) -> Vec<Range<usize>> {
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
struct Rows<'r> {
    rows: &'r [Range<usize>],
    first_row: u64,
}

impl Rows<'_> {
    fn len(&self) -> usize {
        self.rows.iter().map(ExactSizeIterator::len).sum()
    }

    fn indices(&self) -> impl Iterator<Item = usize> + '_ {
        self.rows.iter().flat_map(Clone::clone)
    }

    fn matrix(&self, batch: &RecordBatch, copies: &[LeafCopy], width: usize) -> Result<Vec<f64>> {
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

    fn flags(&self, batch: &RecordBatch, name: &str) -> Result<Option<Vec<bool>>> {
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
