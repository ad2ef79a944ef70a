//! Rows of a dataset as plain row-major matrices, ready for numeric code that knows nothing of Arrow.

mod fill;

use arrow::array::{Array, AsArray, RecordBatch, RecordBatchReader};
use arrow::datatypes::{DataType, Int64Type};

use self::fill::{LeafCopy, Rows, complete_rows, state_copies};
use crate::episode::{as_flags, column};
use crate::error::{DatasetError, Result};
use crate::schema;
use crate::source::{DatasetSource, Scan};

/// Which transitions to read, and what beside states and actions.
#[derive(Debug, Clone)]
pub struct TransitionOptions {
    /// Rows read at a time, at most; at least 1.
    pub batch_rows: usize,
    /// Episodes to read; `None` reads all.
    pub episodes: Option<Vec<i64>>,
    /// Columns of the state vector, from [`crate::ObservationLayout::select`], in the order wanted; `None` takes
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
