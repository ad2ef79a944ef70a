//! One IPC file.

use std::collections::HashMap;
use std::fs::File;
use std::path::Path;
use std::sync::Arc;

use arrow::array::{Array, ArrayRef, AsArray, RecordBatch, RecordBatchOptions};
use arrow::buffer::Buffer;
use arrow::datatypes::{DataType, Field, Fields, Schema, SchemaRef};
use arrow::ipc::Block;
use arrow::ipc::reader::{RecordBatchDecoder, read_dictionary};

use super::check::{Body, allowed, check_batch};
use super::messages::{HEAD, Messages, block_parts, message, read_at, read_into};
use crate::error::{DatasetError, Result};
use crate::guard;
use crate::source::Warning;

/// An open IPC file ("Feather version 2"). Columns with dictionaries are read as their values.
pub(crate) struct IpcFile {
    file: File,
    messages: Messages,
    /// The columns as they are read.
    schema: SchemaRef,
    dictionaries: HashMap<i64, ArrayRef>,
    /// Rows of each block.
    n_rows: Vec<u64>,
}

impl IpcFile {
    /// Opens a file: reads the footer, the dictionaries and the head of every record batch.
    ///
    /// # Errors
    /// The file is cut off or damaged, or has types or packing that are not read.
    pub(crate) fn open(path: &Path) -> Result<Self> {
        let (file, size) = open_file(path)?;
        let mut ipc = Self::of(file, Messages::of_footer)?;
        for place in 0..ipc.n_batches() {
            let n_rows = ipc.check_block(place)?;
            ipc.n_rows.push(n_rows);
        }
        debug_assert!(ipc.messages.end <= size);
        Ok(ipc)
    }

    /// Opens what is whole of a damaged file: the record batches before the first damage. What follows is not
    /// looked at, since rows would be missing inside an episode.
    ///
    /// # Errors
    /// Nothing can be read, or the file cannot be opened.
    pub(crate) fn recover(path: &Path) -> Result<(Self, Vec<Warning>)> {
        let (file, size) = open_file(path)?;
        let lost = |what: String| Warning::Lost { what };
        let mut warnings = Vec::new();
        let again = file.try_clone().map_err(|e| DatasetError::io("open", e))?;
        let mut ipc = Self::of(file, Messages::of_footer).or_else(|error| {
            let ipc = Self::of(again, Messages::in_order)?;
            let (end, n) = (ipc.messages.end, ipc.n_batches());
            warnings.push(lost(format!(
                "what follows the {n} whole record batches, from byte {end} of {size} ({error})"
            )));
            Ok::<_, DatasetError>(ipc)
        })?;
        let columns: Vec<usize> = (0..ipc.schema.fields().len()).collect();
        for place in 0..ipc.n_batches() {
            let checked = ipc.check_block(place);
            match checked.and_then(|n_rows| ipc.read(place, &columns).map(|_| n_rows)) {
                Ok(n_rows) => ipc.n_rows.push(n_rows),
                Err(error) => {
                    let n = ipc.n_batches();
                    warnings.push(lost(format!(
                        "record batches {place} to {} ({error})",
                        n - 1
                    )));
                    ipc.messages.batches.truncate(place);
                    break;
                }
            }
        }
        Ok((ipc, warnings))
    }

    fn of(mut file: File, messages: impl Fn(&mut File, u64) -> Result<Messages>) -> Result<Self> {
        let size = file_size(&file)?;
        let messages = messages(&mut file, size)?;
        let mut ipc = Self {
            schema: Arc::new(without_dictionaries(&messages.schema)),
            file,
            messages,
            dictionaries: HashMap::new(),
            n_rows: Vec::new(),
        };
        for block in ipc.messages.dictionaries.clone() {
            ipc.read_dictionary(&block)?;
        }
        Ok(ipc)
    }

    pub(crate) fn schema(&self) -> &SchemaRef {
        &self.schema
    }

    pub(crate) fn n_batches(&self) -> usize {
        self.messages.batches.len()
    }

    /// Rows of all record batches.
    pub(crate) fn n_rows(&self) -> u64 {
        self.n_rows.iter().fold(0, |sum, n| sum.saturating_add(*n))
    }

    /// Reads one record batch, only the columns whose places are in `columns`; others are not touched on disk.
    ///
    /// # Errors
    /// The bytes are no such batch.
    pub(crate) fn read(&mut self, place: usize, columns: &[usize]) -> Result<RecordBatch> {
        let block = *self.block(place)?;
        let damaged = || damaged(place);
        let (head, body_start, body_length) = self.head(&block)?;
        let batch = message(&head).and_then(|message| message.header_as_record_batch());
        let batch = batch.ok_or_else(damaged)?;
        let schema = Arc::clone(&self.messages.schema);
        let fields = || schema.fields().iter().map(AsRef::as_ref);
        let buffers = check_batch(batch, fields(), Body::Length(body_length))?;
        // What is not read stays zero: pages of it that are never touched take no memory.
        let mut bytes = vec![0; usize::try_from(body_length).map_err(|_| damaged())?];
        for range in columns
            .iter()
            .filter_map(|&column| buffers.get(column))
            .flatten()
        {
            let part = usize::try_from(range.start)
                .ok()
                .zip(usize::try_from(range.end).ok());
            let part = part.and_then(|(start, end)| bytes.get_mut(start..end));
            read_into(
                &mut self.file,
                body_start + range.start,
                part.ok_or_else(damaged)?,
            )?;
        }
        let body = Body::Read {
            bytes: &bytes,
            columns,
        };
        check_batch(batch, fields(), body)?;
        let version = self.messages.version;
        let bytes = Buffer::from(bytes);
        let batch = guard::decode(|| {
            RecordBatchDecoder::try_new(
                &bytes,
                batch,
                Arc::clone(&schema),
                &self.dictionaries,
                &version,
            )
            .and_then(|decoder| decoder.with_projection(Some(columns)).read_record_batch())
            .map_err(DatasetError::arrow("read a record batch"))
        })?;
        unpacked(batch, allowed(body_length))
    }

    fn read_dictionary(&mut self, block: &Block) -> Result<()> {
        let damaged = || DatasetError::corrupt("a dictionary of the Arrow file is damaged");
        let (head, body_start, body_length) = self.head(block)?;
        let message = message(&head).ok_or_else(damaged)?;
        let dictionary = message.header_as_dictionary_batch().ok_or_else(damaged)?;
        let schema = Arc::clone(&self.messages.schema);
        let values = dictionary_values(&schema, dictionary.id()).ok_or_else(damaged)?;
        let batch = dictionary.data().ok_or_else(damaged)?;
        let length = usize::try_from(body_length).map_err(|_| damaged())?;
        let bytes = read_at(&mut self.file, body_start, length)?;
        let body = Body::Read {
            bytes: &bytes,
            columns: &[0],
        };
        check_batch(batch, std::iter::once(&values), body)?;
        let version = self.messages.version;
        let dictionaries = &mut self.dictionaries;
        guard::decode(|| {
            read_dictionary(
                &Buffer::from(bytes),
                dictionary,
                &schema,
                dictionaries,
                &version,
            )
            .map_err(DatasetError::arrow("read a dictionary"))
        })
    }

    fn block(&self, place: usize) -> Result<&Block> {
        self.messages
            .batches
            .get(place)
            .ok_or_else(|| DatasetError::corrupt("a record batch vanished"))
    }

    /// The head of a block, and place and length of its body, which lies in the file.
    fn head(&mut self, block: &Block) -> Result<(Vec<u8>, u64, u64)> {
        let outside = || DatasetError::corrupt("a block lies outside the Arrow file");
        let (start, metadata, body) = block_parts(block).ok_or_else(outside)?;
        let end = start
            .checked_add(metadata)
            .and_then(|end| end.checked_add(body));
        if start < HEAD || metadata < HEAD || end.is_none_or(|end| end > self.messages.end) {
            return Err(outside());
        }
        let length = usize::try_from(metadata).map_err(|_| outside())?;
        Ok((
            read_at(&mut self.file, start, length)?,
            start + metadata,
            body,
        ))
    }

    /// Checks place and contents of a block and returns its number of rows.
    fn check_block(&mut self, place: usize) -> Result<u64> {
        let block = *self.block(place)?;
        let (head, _, body) = self.head(&block)?;
        let damaged = || damaged(place);
        let message = message(&head).ok_or_else(damaged)?;
        let batch = message.header_as_record_batch().ok_or_else(damaged)?;
        let fields = self.messages.schema.fields().iter().map(AsRef::as_ref);
        check_batch(batch, fields, Body::Length(body))?;
        u64::try_from(batch.length()).map_err(|_| damaged())
    }
}

fn damaged(place: usize) -> DatasetError {
    DatasetError::corrupt(format!("the head of record batch {place} is damaged"))
}

fn open_file(path: &Path) -> Result<(File, u64)> {
    let file = File::open(path).map_err(|e| DatasetError::io("open", e))?;
    let size = file_size(&file)?;
    Ok((file, size))
}

fn file_size(file: &File) -> Result<u64> {
    let metadata = file.metadata().map_err(|e| DatasetError::io("open", e))?;
    Ok(metadata.len())
}

/// The field of the values of a dictionary.
fn dictionary_values(schema: &Schema, id: i64) -> Option<Field> {
    #[expect(deprecated, reason = "the only way to a dictionary's columns")]
    let fields = schema.fields_with_dict_id(id);
    match fields.first()?.data_type() {
        DataType::Dictionary(_, values) => {
            Some(Field::new("dictionary", values.as_ref().clone(), true))
        }
        _ => None,
    }
}

fn without_dictionaries(schema: &Schema) -> Schema {
    let field = |field: &Arc<Field>| match field.data_type() {
        DataType::Dictionary(_, values) => {
            let field = Field::new(field.name(), values.as_ref().clone(), field.is_nullable())
                .with_metadata(field.metadata().clone());
            Arc::new(field)
        }
        _ => Arc::clone(field),
    };
    let fields: Fields = schema.fields().iter().map(field).collect();
    Schema::new_with_metadata(fields, schema.metadata().clone())
}

/// Writes dictionary columns out, to `allowed` bytes each at most.
fn unpacked(batch: RecordBatch, allowed: u64) -> Result<RecordBatch> {
    let is_packed = |array: &ArrayRef| matches!(array.data_type(), DataType::Dictionary(..));
    if !batch.columns().iter().any(is_packed) {
        return Ok(batch);
    }
    let schema = without_dictionaries(&batch.schema());
    let mut arrays = Vec::with_capacity(batch.num_columns());
    for (field, array) in schema.fields().iter().zip(batch.columns()) {
        arrays.push(if is_packed(array) {
            if written_out(array) > allowed {
                return Err(DatasetError::corrupt(format!(
                    "column \"{}\" takes more than {allowed} bytes without its dictionary",
                    field.name()
                )));
            }
            guard::decode(|| {
                arrow::compute::cast(array, field.data_type())
                    .map_err(DatasetError::arrow("read a dictionary column"))
            })?
        } else {
            Arc::clone(array)
        });
    }
    let options = RecordBatchOptions::new().with_row_count(Some(batch.num_rows()));
    RecordBatch::try_new_with_options(Arc::new(schema), arrays, &options)
        .map_err(DatasetError::arrow("read a record batch"))
}

/// Bytes that a dictionary column takes as values.
fn written_out(array: &ArrayRef) -> u64 {
    let Some(dictionary) = array.as_any_dictionary_opt() else {
        return 0;
    };
    let values = dictionary.values();
    let length = |key: usize| -> u64 {
        let bytes = match values.data_type() {
            DataType::Utf8 => values.as_string::<i32>().value_length(key).into(),
            DataType::LargeUtf8 => values.as_string::<i64>().value_length(key),
            DataType::Binary => values.as_binary::<i32>().value_length(key).into(),
            DataType::LargeBinary => values.as_binary::<i64>().value_length(key),
            _ => 8,
        };
        bytes.unsigned_abs()
    };
    if values.is_empty() {
        return 0;
    }
    let keys = dictionary.normalized_keys();
    keys.into_iter()
        .fold(0, |sum, key| sum.saturating_add(length(key)))
}
