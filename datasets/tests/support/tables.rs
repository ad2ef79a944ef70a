//! Canonical tables made up by proptest, and a source that holds one in memory.
//!
//! ```ignore
//! #[path = "support/tables.rs"]
//! mod tables;
//!
//! proptest! {
//!     #[test]
//!     fn survives(table in tables::tables(tables::Allowed { text: false, ..Default::default() })) {
//!         // `table` is a `DatasetSource`; `table.input()` is what a sink wants.
//!     }
//! }
//! ```

use std::collections::{BTreeMap, HashMap};
use std::path::PathBuf;
use std::sync::Arc;

use arrow::array::{
    Array, ArrayRef, BinaryArray, BooleanArray, FixedSizeListArray, Float64Array, Int64Array,
    PrimitiveArray, RecordBatch, RecordBatchIterator, RecordBatchReader, StringArray,
};
use arrow::buffer::NullBuffer;
use arrow::datatypes::{
    ArrowPrimitiveType, DataType, Field, Int8Type, Int16Type, Int32Type, Int64Type, Schema,
    SchemaRef, UInt8Type, UInt16Type, UInt32Type, UInt64Type,
};
use ksim_datasets::{
    DatasetInfo, DatasetSource, EpisodeEnd, EpisodeRecord, Format, LeafKind, LeafSpec, Result,
    Scan, SinkInput, schema,
};
use proptest::prelude::*;
use proptest::strategy::Union;
use serde_json::{Map, Value, json};

/// What tables may hold. Everything by default.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Allowed {
    /// Dictionaries and tuples; else observation and action are one leaf each.
    pub(crate) nested: bool,
    /// Leaves of more than one axis.
    pub(crate) tensors: bool,
    /// Text leaves.
    pub(crate) text: bool,
    /// Encoded pictures of 32 × 40 × 3 (any bytes after the start of a JPEG).
    pub(crate) pictures: bool,
    /// Integers of every width; else floats only.
    pub(crate) integers: bool,
    /// NaN, infinities, negative zero.
    pub(crate) special_floats: bool,
    /// Info columns.
    pub(crate) infos: bool,
    /// Whether episodes have the observation after their last step.
    pub(crate) final_rows: FinalRows,
    /// Seeds, options and other attributes of episodes.
    pub(crate) attributes: bool,
    /// Tables without rewards or flags.
    pub(crate) missing_columns: bool,
}

/// Whether episodes have a final-observation row.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum FinalRows {
    Never,
    Always,
    /// Each episode as it likes.
    Mixed,
}

impl Default for Allowed {
    fn default() -> Self {
        Self {
            nested: true,
            tensors: true,
            text: true,
            pictures: true,
            integers: true,
            special_floats: true,
            infos: true,
            final_rows: FinalRows::Mixed,
            attributes: true,
            missing_columns: true,
        }
    }
}

/// A table, as a source in memory.
#[derive(Debug, Clone)]
pub(crate) struct MemorySource {
    pub(crate) rows: RecordBatch,
    pub(crate) info: DatasetInfo,
    pub(crate) episodes: Vec<EpisodeRecord>,
}

impl MemorySource {
    /// What a sink must know before the first row. `schema` is [`DatasetSource::schema`], kept by the caller.
    pub(crate) fn input<'a>(&'a self, schema: &'a SchemaRef) -> SinkInput<'a> {
        SinkInput {
            schema,
            info: &self.info,
            episodes: &self.episodes,
        }
    }
}

impl DatasetSource for MemorySource {
    fn info(&self) -> &DatasetInfo {
        &self.info
    }

    fn schema(&self) -> SchemaRef {
        self.rows.schema()
    }

    fn scan(&self, scan: &Scan) -> Result<Box<dyn RecordBatchReader + Send + '_>> {
        let (schema, columns) = schema::project(&self.schema(), scan.columns.as_deref())?;
        let mut batches = Vec::new();
        for episode in &self.episodes {
            if scan
                .episodes
                .as_ref()
                .is_some_and(|wanted| !wanted.contains(&episode.episode_index))
            {
                continue;
            }
            let (first, n_rows) = (to_usize(episode.first_row), to_usize(episode.n_rows));
            let rows = self.rows.slice(first, n_rows).project(&columns)?;
            batches.push(rows);
        }
        // Batches are full, so that they cut through episodes.
        let whole = arrow::compute::concat_batches(&schema, &batches)?;
        let cut: Vec<_> = (0..whole.num_rows())
            .step_by(scan.batch_rows)
            .map(|row| Ok(whole.slice(row, scan.batch_rows.min(whole.num_rows() - row))))
            .collect();
        Ok(Box::new(RecordBatchIterator::new(cut, schema)))
    }

    fn episodes(&self) -> Result<Vec<EpisodeRecord>> {
        Ok(self.episodes.clone())
    }
}

fn to_usize(n: u64) -> usize {
    usize::try_from(n).unwrap()
}

/// Tables of one to five episodes of one to nine steps.
pub(crate) fn tables(allowed: Allowed) -> impl Strategy<Value = MemorySource> {
    let infos = match allowed.infos {
        true => prop::collection::btree_map(key(), leaf(allowed), 0..3).boxed(),
        false => Just(BTreeMap::new()).boxed(),
    };
    let episodes = prop::collection::vec(
        (1usize..10, any::<bool>(), 0u8..4, any::<Option<u64>>()),
        1..6,
    );
    let columns = prop::collection::vec(prop::bool::weighted(0.8), 3);
    (
        tree(allowed),
        tree(allowed),
        infos,
        episodes,
        columns,
        any::<u64>(),
    )
        .prop_map(
            move |(observation, action, infos, episodes, columns, seed)| {
                let plan = Plan {
                    allowed,
                    columns: columns
                        .into_iter()
                        .map(|there| there || !allowed.missing_columns)
                        .collect(),
                    episodes,
                };
                let mut leaves = Vec::new();
                observation.flatten(
                    schema::OBSERVATION.to_owned(),
                    Role::Observation,
                    &mut leaves,
                );
                action.flatten(schema::ACTION.to_owned(), Role::Action, &mut leaves);
                for (key, leaf) in infos {
                    leaves.push((schema::join_key(schema::INFO, &key), Role::Info, leaf));
                }
                plan.table(&leaves, Random(seed))
            },
        )
}

/// A part of a space.
#[derive(Debug, Clone)]
enum Node {
    Leaf(Leaf),
    Dict(BTreeMap<String, Node>),
    Tuple(Vec<Node>),
}

#[derive(Debug, Clone)]
enum Leaf {
    Numbers(DataType, Vec<usize>),
    Text,
    Picture,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Role {
    Observation,
    Action,
    Info,
}

fn key() -> impl Strategy<Value = String> {
    prop::sample::select(vec![
        "achieved_goal",
        "desired_goal",
        "observation",
        "qpos",
        "front camera",
        "a.b",
        "t~1",
        "Ω",
    ])
    .prop_map(str::to_owned)
}

fn leaf(allowed: Allowed) -> BoxedStrategy<Leaf> {
    let mut types = vec![DataType::Float32, DataType::Float64, DataType::Float16];
    if allowed.integers {
        types.extend([
            DataType::Int8,
            DataType::Int16,
            DataType::Int32,
            DataType::Int64,
            DataType::UInt8,
            DataType::UInt16,
            DataType::UInt32,
            DataType::UInt64,
        ]);
    }
    let mut shapes = vec![vec![], vec![1], vec![3], vec![17]];
    if allowed.tensors {
        shapes.extend([vec![2, 3], vec![1, 4], vec![2, 1, 3]]);
    }
    let numbers = (prop::sample::select(types), prop::sample::select(shapes));
    let mut kinds = vec![(4, numbers.prop_map(|(t, s)| Leaf::Numbers(t, s)).boxed())];
    if allowed.text {
        kinds.push((1, Just(Leaf::Text).boxed()));
    }
    if allowed.pictures {
        kinds.push((1, Just(Leaf::Picture).boxed()));
    }
    Union::new_weighted(kinds).boxed()
}

fn tree(allowed: Allowed) -> BoxedStrategy<Node> {
    let leaf = leaf(allowed).prop_map(Node::Leaf);
    if !allowed.nested {
        return leaf.boxed();
    }
    leaf.prop_recursive(3, 8, 3, |inner| {
        prop_oneof![
            prop::collection::btree_map(key(), inner.clone(), 1..4).prop_map(Node::Dict),
            prop::collection::vec(inner, 1..4).prop_map(Node::Tuple),
        ]
    })
    .boxed()
}

impl Node {
    /// Adds the leaves in canonical order.
    fn flatten(&self, column: String, role: Role, leaves: &mut Vec<(String, Role, Leaf)>) {
        match self {
            Self::Leaf(leaf) => leaves.push((column, role, leaf.clone())),
            Self::Dict(parts) => {
                let mut parts: Vec<_> = parts.iter().collect();
                parts.sort_by_key(|(key, _)| match key.as_str() {
                    "achieved_goal" => 0,
                    "desired_goal" => 2,
                    _ => 1,
                });
                for (key, part) in parts {
                    part.flatten(schema::join_key(&column, key), role, leaves);
                }
            }
            Self::Tuple(parts) => {
                for (index, part) in parts.iter().enumerate() {
                    part.flatten(format!("{column}[{index}]"), role, leaves);
                }
            }
        }
    }
}

impl Leaf {
    fn field(&self, column: &str, nullable: bool) -> Field {
        match self {
            Self::Numbers(data_type, shape) => {
                schema::leaf_field(column, data_type.clone(), shape, nullable)
            }
            Self::Text => schema::leaf_field(column, DataType::Utf8, &[], nullable),
            Self::Picture => schema::image_field(column, "jpeg", &[32, 40, 3]),
        }
    }

    fn spec(&self, column: &str) -> LeafSpec {
        let (kind, shape, data_type) = match self {
            Self::Numbers(data_type, shape) => {
                let picture = *data_type == DataType::UInt8 && matches!(shape.len(), 2 | 3);
                let kind = if picture {
                    LeafKind::Image
                } else {
                    LeafKind::Box
                };
                (kind, shape.clone(), data_type.clone())
            }
            Self::Text => (LeafKind::Text, vec![], DataType::Utf8),
            Self::Picture => (LeafKind::Image, vec![32, 40, 3], DataType::Binary),
        };
        LeafSpec {
            column: column.to_owned(),
            kind,
            shape,
            data_type,
        }
    }

    /// Rows of this leaf, null where `valid` is false.
    fn values(
        &self,
        field: &Field,
        valid: &[bool],
        special: bool,
        random: &mut Random,
    ) -> ArrayRef {
        match self {
            Self::Text => Arc::new(StringArray::from_iter(
                valid.iter().map(|valid| valid.then(|| random.text())),
            )),
            Self::Picture => Arc::new(BinaryArray::from_iter(
                valid.iter().map(|valid| valid.then(|| random.picture())),
            )),
            Self::Numbers(data_type, shape) => {
                let nulls = NullBuffer::from(valid.to_vec());
                let nulls = (nulls.null_count() > 0).then_some(nulls);
                let width: usize = shape.iter().product();
                let n = valid.len() * width;
                let DataType::FixedSizeList(child, size) = field.data_type() else {
                    return numbers(data_type, n, nulls, special, random);
                };
                let values = numbers(data_type, n, None, special, random);
                Arc::new(FixedSizeListArray::new(child.clone(), *size, values, nulls))
            }
        }
    }
}

fn numbers(
    data_type: &DataType,
    n: usize,
    nulls: Option<NullBuffer>,
    special: bool,
    random: &mut Random,
) -> ArrayRef {
    fn bits<T: ArrowPrimitiveType>(
        n: usize,
        nulls: Option<NullBuffer>,
        value: impl FnMut() -> T::Native,
    ) -> ArrayRef {
        let values: Vec<T::Native> = std::iter::repeat_with(value).take(n).collect();
        Arc::new(PrimitiveArray::<T>::new(values.into(), nulls))
    }
    #[expect(clippy::cast_possible_truncation, reason = "any bits will do")]
    #[expect(clippy::cast_possible_wrap, reason = "any bits will do")]
    match data_type {
        DataType::Int8 => bits::<Int8Type>(n, nulls, || random.next() as i8),
        DataType::Int16 => bits::<Int16Type>(n, nulls, || random.next() as i16),
        DataType::Int32 => bits::<Int32Type>(n, nulls, || random.next() as i32),
        DataType::Int64 => bits::<Int64Type>(n, nulls, || random.next() as i64),
        DataType::UInt8 => bits::<UInt8Type>(n, nulls, || random.next() as u8),
        DataType::UInt16 => bits::<UInt16Type>(n, nulls, || random.next() as u16),
        DataType::UInt32 => bits::<UInt32Type>(n, nulls, || random.next() as u32),
        DataType::UInt64 => bits::<UInt64Type>(n, nulls, || random.next()),
        float => {
            let values: Vec<f64> = std::iter::repeat_with(|| random.float(special))
                .take(n)
                .collect();
            let values = Float64Array::new(values.into(), nulls);
            arrow::compute::cast(&values, float).unwrap()
        }
    }
}

/// Steele's splitmix64: values need no shrinking, so one seed makes them all.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        z ^ (z >> 31)
    }

    fn below(&mut self, n: u64) -> usize {
        to_usize(self.next() % n)
    }

    /// Small eighths, exact in every float type, or something special.
    fn float(&mut self, special: bool) -> f64 {
        if special && self.below(8) == 0 {
            return [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, -0.0][self.below(4)];
        }
        #[expect(clippy::cast_precision_loss, reason = "small numbers")]
        let eighths = self.below(4001) as f64 - 2000.0;
        eighths / 8.0
    }

    fn text(&mut self) -> String {
        let n = self.below(6);
        (0..n)
            .map(|_| ['a', 'Z', '0', ' ', '"', '\n', 'é', '猫', '🦀'][self.below(9)])
            .collect()
    }

    /// Often, but not always, of the same length.
    fn picture(&mut self) -> Vec<u8> {
        let mut bytes = vec![0xFF, 0xD8];
        let n = 6 + self.below(4) / 3;
        bytes.extend((0..n).map(|_| self.next().to_le_bytes()[0]));
        bytes
    }
}

/// The shape of a table.
struct Plan {
    allowed: Allowed,
    /// Whether there are rewards, terminations, truncations.
    columns: Vec<bool>,
    /// Steps, whether a final row follows, flags of the last step, seed.
    episodes: Vec<(usize, bool, u8, Option<u64>)>,
}

impl Plan {
    fn has_final(&self, wish: bool) -> bool {
        match self.allowed.final_rows {
            FinalRows::Never => false,
            FinalRows::Always => true,
            FinalRows::Mixed => wish,
        }
    }

    fn table(&self, leaves: &[(String, Role, Leaf)], mut random: Random) -> MemorySource {
        let (mut episode_index, mut step_index, mut is_step) = (vec![], vec![], vec![]);
        let (mut terminated, mut truncated) = (vec![], vec![]);
        for (episode, &(n_steps, wish, flags, _)) in (0i64..).zip(&self.episodes) {
            let n_rows = n_steps + usize::from(self.has_final(wish));
            for (step, row) in (0i64..).zip(0..n_rows) {
                let last = row + 1 == n_steps;
                episode_index.push(episode);
                step_index.push(step);
                is_step.push(row < n_steps);
                terminated.push((row < n_steps).then_some(last && flags & 1 != 0));
                truncated.push((row < n_steps).then_some(last && flags & 2 != 0));
            }
        }
        let mut columns: Vec<(Field, ArrayRef)> = vec![
            index(schema::EPISODE_INDEX, episode_index),
            index(schema::STEP_INDEX, step_index),
        ];
        let everywhere = vec![true; is_step.len()];
        let special = self.allowed.special_floats;
        let mut add = |wanted: Role, columns: &mut Vec<(Field, ArrayRef)>| {
            for (name, _, leaf) in leaves.iter().filter(|(_, role, _)| *role == wanted) {
                let is_observation = wanted == Role::Observation;
                let field = leaf.field(name, !is_observation);
                let valid = if is_observation {
                    &everywhere
                } else {
                    &is_step
                };
                let values = leaf.values(&field, valid, special, &mut random);
                columns.push((field, values));
            }
        };
        add(Role::Observation, &mut columns);
        add(Role::Action, &mut columns);
        let reward = Leaf::Numbers(DataType::Float64, vec![]);
        let field = reward.field(schema::REWARD, true);
        // Rewards are finite: returns are compared.
        let rewards = reward.values(&field, &is_step, false, &mut Random(7));
        let flags = |name, values| {
            let field = Field::new(name, DataType::Boolean, true);
            (field, Arc::new(BooleanArray::from(values)) as ArrayRef)
        };
        let recorded = [
            (field, rewards.clone()),
            flags(schema::TERMINATED, terminated),
            flags(schema::TRUNCATED, truncated),
        ];
        let recorded = recorded.into_iter().zip(&self.columns);
        columns.extend(recorded.filter_map(|(column, there)| there.then_some(column)));
        add(Role::Info, &mut columns);
        self.source(leaves, columns, &rewards)
    }

    fn source(
        &self,
        leaves: &[(String, Role, Leaf)],
        columns: Vec<(Field, ArrayRef)>,
        rewards: &ArrayRef,
    ) -> MemorySource {
        let metadata = HashMap::from([
            (schema::VERSION_KEY.to_owned(), schema::VERSION.to_owned()),
            (schema::SOURCE_ID.to_owned(), "made-up-v0".to_owned()),
            (schema::SOURCE_FORMAT.to_owned(), "parquet".to_owned()),
        ]);
        let (fields, arrays): (Vec<_>, Vec<_>) = columns.into_iter().unzip();
        let schema = Arc::new(Schema::new_with_metadata(fields, metadata));
        let rows = RecordBatch::try_new(schema, arrays).unwrap();
        let episodes = self.records(rewards);
        let specs = |wanted: Role| {
            let leaves = leaves.iter().filter(|(_, role, _)| *role == wanted);
            leaves.map(|(name, _, leaf)| leaf.spec(name)).collect()
        };
        let info = DatasetInfo {
            id: "made-up-v0".to_owned(),
            format: Format::Parquet,
            path: PathBuf::from("memory"),
            n_episodes: Some(episodes.len() as u64),
            n_steps: Some(episodes.iter().map(|episode| episode.length).sum()),
            observation: specs(Role::Observation),
            action: specs(Role::Action),
            episode_rule: "as recorded".to_owned(),
            boundaries_inferred: false,
            env_spec: None,
            metadata: Map::new(),
            ref_min_score: None,
            ref_max_score: None,
            warnings: Vec::new(),
        };
        MemorySource {
            rows,
            info,
            episodes,
        }
    }

    fn records(&self, rewards: &ArrayRef) -> Vec<EpisodeRecord> {
        let rewards = rewards.as_any().downcast_ref::<Float64Array>().unwrap();
        let mut first_row = 0;
        let mut records = Vec::new();
        for (episode, &(n_steps, wish, flags, seed)) in (0i64..).zip(&self.episodes) {
            let has_final_obs = self.has_final(wish);
            let n_rows = (n_steps + usize::from(has_final_obs)) as u64;
            let steps = to_usize(first_row)..to_usize(first_row) + n_steps;
            let seed = seed.filter(|_| self.allowed.attributes);
            records.push(EpisodeRecord {
                episode_index: episode,
                length: n_steps as u64,
                first_row,
                n_rows,
                end: self.end(flags),
                has_final_obs,
                seed,
                success: None,
                total_return: self.columns[0].then(|| steps.map(|row| rewards.value(row)).sum()),
                attributes: match seed {
                    Some(seed) => attributes(seed),
                    None => Map::new(),
                },
            });
            first_row += n_rows;
        }
        records
    }

    fn end(&self, flags: u8) -> EpisodeEnd {
        match (self.columns[1], self.columns[2]) {
            (false, false) => EpisodeEnd::Unknown,
            (true, _) if flags & 1 != 0 => EpisodeEnd::Terminated,
            (_, true) if flags & 2 != 0 => EpisodeEnd::Truncated,
            _ => EpisodeEnd::Cut,
        }
    }
}

fn index(name: &str, values: Vec<i64>) -> (Field, ArrayRef) {
    let field = Field::new(name, DataType::Int64, false);
    (field, Arc::new(Int64Array::from(values)))
}

fn attributes(seed: u64) -> Map<String, Value> {
    let attributes = json!({
        "seed": seed,
        "note": "猫 \"quoted\"",
        "score": -0.125,
        "options": {"level": 3, "goal": {"x": 1.5, "name": "a"}},
    });
    match attributes {
        Value::Object(attributes) => attributes,
        _ => Map::new(),
    }
}
