//! Delivering a file in batches.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use arrow::array::RecordBatchReader;
use arrow::datatypes::SchemaRef;
use serde_json::{Map, Value};

use super::demos::{DATA, Demo, Demos, NEXT_OBS, OBS};
use crate::episode::EpisodeRecord;
use crate::error::{DatasetError, Result};
use crate::format::{Format, OpenOptions};
use crate::formats::hdf5::{
    ColumnSource, EpisodeRows, H5File, LeafBuilder, MemberKind, Piece, RowRule, StepColumn,
    StepScan, StepTable, attributes, join, json_value, members, open_contained, table_schema,
};
use crate::schema;
use crate::source::{DatasetInfo, DatasetSource, Scan, Warning};
use crate::spec::LeafSpec;

const MASK: &str = "mask";
const ENV_ARGS: &str = "env_args";
const MODEL_FILE: &str = "model_file";
/// Bytes of an episode's simulator model that are kept as an attribute, at most.
const MAX_MODEL_FILE: usize = 4096;

/// Opens a file: lists its demonstrations, and compares next observations with observations.
///
/// # Errors
/// What is wrong with it.
pub(crate) fn open(path: &Path, options: &OpenOptions) -> Result<Box<dyn DatasetSource>> {
    let file = H5File::open(path)?;
    let mut demos = Demos::new(&file, options.recover)?;
    let n_listed = demos.list.len();
    demos.list.retain(|demo| demo.rows.n_steps > 0);
    let stem = path.file_stem().unwrap_or_default();
    let id = stem.to_string_lossy().into_owned();
    let mut info = DatasetInfo::new(id, Format::Robomimic, path.to_owned());
    info.warnings = std::mem::take(&mut demos.warnings);
    if demos.list.len() < n_listed {
        let n_episodes = (n_listed - demos.list.len()) as u64;
        info.warnings.push(Warning::EmptyEpisodes { n_episodes });
    }
    let masks = masks(&file, &mut info.warnings)?;
    describe(&file, &demos, &masks, &mut info)?;
    let schema = schema_with_rate(&demos.columns, &info);
    info.observation = leaves(&demos, schema::OBSERVATION);
    info.action = leaves(&demos, schema::ACTION);
    Ok(Box::new(RobomimicSource {
        path: path.to_owned(),
        file,
        demos,
        masks,
        schema,
        info,
    }))
}

fn leaves(demos: &Demos, root: &str) -> Vec<LeafSpec> {
    let fields = demos.columns.iter().map(|column| &column.field);
    let leaves = fields.filter(|field| schema::belongs_to(field.name(), root));
    leaves
        .filter_map(|field| LeafSpec::of_field(field))
        .collect()
}

/// The filters of a file: names of demonstrations by name.
fn masks(file: &H5File, warnings: &mut Vec<Warning>) -> Result<Vec<(String, Value)>> {
    if !file.root().link_exists(MASK) {
        return Ok(Vec::new());
    }
    let group = file.group(MASK)?;
    let mut masks = Vec::new();
    for member in members(&group, MASK)? {
        let key = join(MASK, &member.name);
        let names = match member.kind {
            MemberKind::Array => json_value(&open_contained(&group, &member.name, &key)?.0),
            MemberKind::Group => None,
        };
        match names {
            Some(names) => masks.push((member.name, names)),
            None => warnings.push(Warning::ColumnLeftOut {
                column: key,
                reason: "it is no list of at most 4096 names",
            }),
        }
    }
    Ok(masks)
}

fn describe(
    file: &H5File,
    demos: &Demos,
    masks: &[(String, Value)],
    info: &mut DatasetInfo,
) -> Result<()> {
    let n_steps = demos.list.iter().map(|demo| demo.rows.n_steps).sum();
    info.n_episodes = Some(demos.list.len() as u64);
    info.n_steps = Some(n_steps);
    info.episode_rule = "one group per demonstration".to_owned();
    info.metadata = attributes(&*file.group(DATA)?, DATA)?;
    let recorded = info.metadata.get("total").and_then(Value::as_u64);
    if let Some(recorded) = recorded.filter(|recorded| *recorded != n_steps) {
        info.warnings.push(Warning::CountMismatch {
            what: "steps",
            recorded,
            actual: n_steps,
        });
    }
    // Held as text; what is no JSON stays text.
    if let Some(Value::String(text)) = info.metadata.get(ENV_ARGS)
        && let Ok(spec) = serde_json::from_str::<Value>(text)
    {
        info.env_spec = Some(spec.clone());
        info.metadata.insert(ENV_ARGS.to_owned(), spec);
    }
    if !masks.is_empty() {
        let masks: Map<String, Value> = masks.iter().cloned().collect();
        info.metadata.insert(MASK.to_owned(), Value::Object(masks));
    }
    let mut has_model = false;
    for demo in &demos.list {
        let attributes = attributes(&*file.group(&demo.group)?, &demo.group)?;
        has_model |= is_large(attributes.get(MODEL_FILE));
    }
    if has_model {
        info.warnings.push(Warning::ColumnLeftOut {
            column: MODEL_FILE.to_owned(),
            reason: "the simulator's model has more than 4096 bytes",
        });
    }
    Ok(())
}

fn is_large(model: Option<&Value>) -> bool {
    model
        .and_then(Value::as_str)
        .is_some_and(|text| text.len() > MAX_MODEL_FILE)
}

/// The environment's control frequency is the rate of the rows.
fn schema_with_rate(columns: &[StepColumn], info: &DatasetInfo) -> SchemaRef {
    let schema = table_schema(columns, info);
    let arguments = info
        .env_spec
        .as_ref()
        .and_then(|spec| spec.get("env_kwargs"));
    let rate = arguments.and_then(|arguments| arguments.get("control_freq"));
    match rate.and_then(Value::as_f64).filter(|rate| *rate > 0.0) {
        None => schema,
        Some(rate) => {
            let mut metadata = schema.metadata().clone();
            metadata.insert(schema::FPS.to_owned(), rate.to_string());
            Arc::new(schema.as_ref().clone().with_metadata(metadata))
        }
    }
}

struct RobomimicSource {
    path: PathBuf,
    file: H5File,
    demos: Demos,
    masks: Vec<(String, Value)>,
    schema: SchemaRef,
    info: DatasetInfo,
}

impl RobomimicSource {
    fn append_piece(
        &self,
        piece: &Piece,
        column: &ColumnSource,
        to: &mut LeafBuilder,
    ) -> Result<()> {
        let demo = self.demo(piece.episode)?;
        let key = join(&demo.group, &column.key);
        if column.rule == RowRule::Info && !self.file.root().link_exists(&key) {
            // Not every demonstration has next observations.
            to.append_nulls(piece.split_at(u64::MAX).0);
            return Ok(());
        }
        let (n, rest) = piece.split_at(demo.rows.n_steps);
        to.append(&self.file.array(&key)?, piece.from, n)?;
        match column.key.strip_prefix(OBS) {
            Some(name) if rest > 0 => {
                let next = self
                    .file
                    .array(&join(&demo.group, &format!("{NEXT_OBS}{name}")))?;
                to.append(&next, demo.rows.n_steps.saturating_sub(1), rest)
            }
            _ => {
                to.append_nulls(rest);
                Ok(())
            }
        }
    }

    fn demo(&self, place: usize) -> Result<&Demo> {
        let demo = self.demos.list.get(place);
        demo.ok_or_else(|| DatasetError::corrupt("an episode vanished"))
    }

    /// What the file records of a demonstration.
    fn attributes(&self, demo: &Demo) -> Result<Map<String, Value>> {
        let mut attributes = attributes(&*self.file.group(&demo.group)?, &demo.group)?;
        if is_large(attributes.get(MODEL_FILE)) {
            attributes.remove(MODEL_FILE);
        }
        let holds = |names: &Value| {
            let names = names.as_array().map(Vec::as_slice).unwrap_or_default();
            names
                .iter()
                .any(|name| name.as_str() == Some(demo.name.as_str()))
        };
        let filters = self.masks.iter().filter(|(_, names)| holds(names));
        let filters: Vec<Value> = filters
            .map(|(name, _)| Value::from(name.as_str()))
            .collect();
        if !filters.is_empty() {
            attributes.insert(MASK.to_owned(), Value::Array(filters));
        }
        Ok(attributes)
    }
}

impl DatasetSource for RobomimicSource {
    fn info(&self) -> &DatasetInfo {
        &self.info
    }

    fn schema(&self) -> SchemaRef {
        Arc::clone(&self.schema)
    }

    fn scan(&self, scan: &Scan) -> Result<Box<dyn RecordBatchReader + Send + '_>> {
        let scan = StepScan::new(self, &self.schema, &self.demos.columns, scan);
        Ok(Box::new(scan.map_err(|error| error.in_file(&self.path))?))
    }

    fn episodes(&self) -> Result<Vec<EpisodeRecord>> {
        let mut records = (self as &dyn DatasetSource).derived_episodes()?;
        for (record, demo) in records.iter_mut().zip(&self.demos.list) {
            record.attributes = self
                .attributes(demo)
                .map_err(|error| error.in_file(&self.path))?;
        }
        Ok(records)
    }
}

impl StepTable for RobomimicSource {
    fn path(&self) -> &Path {
        &self.path
    }

    fn episode(&self, place: usize) -> Option<Result<EpisodeRows>> {
        self.demos.list.get(place).map(|demo| Ok(demo.rows))
    }

    fn append(&self, pieces: &[Piece], column: &ColumnSource, to: &mut LeafBuilder) -> Result<()> {
        pieces
            .iter()
            .try_for_each(|piece| self.append_piece(piece, column, to))
    }
}
